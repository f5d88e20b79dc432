// Stage "masks": labels of (reference pixel, camera) pairs carried into each camera's own pixels, nearest
// first.
#include "device.h"

using namespace seepast;

// Per pixel of every camera the rank of the reference pixel that speaks for it: the bits of its disparity,
// which is not negative, and below them the more the earlier it comes. ranks [K, H, W], zero before. Blocks
// of 32 x 8 of camera blockIdx.z.
extern "C" __global__ void __launch_bounds__(256)
    land(const float* __restrict__ offsets, int height, int width, float cx, float cy,
         const float* __restrict__ d, const uint8_t* __restrict__ wanted,
         unsigned long long* __restrict__ ranks) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, k = blockIdx.z;
  if (x >= width || y >= height) return;
  const unsigned from = y * width + x;
  if (!wanted[from]) return;
  const RayShift shift = ray_shift(offsets + kOffsets * k, d[from]);
  const int px = x + whole_offset(ray_dx(shift, x, cx)), py = y + whole_offset(ray_dy(shift, y, cy));
  if (px < 0 || px >= width || py < 0 || py >= height) return;
  const unsigned long long rank = static_cast<unsigned long long>(__float_as_uint(d[from])) << 32 | ~from;
  atomicMax(ranks + (static_cast<size_t>(k) * height + py) * width + px, rank);
}

// Both priors with what the labels say in their place. Pixels without a ray keep theirs. Blocks of 256 pixels
// of camera blockIdx.y.
extern "C" __global__ void __launch_bounds__(256)
    carry_back(const unsigned long long* __restrict__ ranks, const uint16_t* __restrict__ labels,
               const uint8_t* __restrict__ posterior, const uint8_t* __restrict__ prior_dynamic,
               const uint8_t* __restrict__ prior_static, int pixels, uint8_t* __restrict__ dynamic,
               uint8_t* __restrict__ is_static) {
  const int i = blockIdx.x * 256 + threadIdx.x, k = blockIdx.y;
  if (i >= pixels) return;
  const size_t to = static_cast<size_t>(k) * pixels + i;
  uint8_t value = prior_dynamic[to], label = prior_static[to];
  if (value != kNoRay && ranks[to]) {
    const unsigned from = ~static_cast<unsigned>(ranks[to]);
    label = labels[from] >> k & 1;
    const uint8_t found = posterior[static_cast<size_t>(k) * pixels + from];
    if (found != kUnchanged) value = found;
  }
  dynamic[to] = value;
  is_static[to] = label;
}
