// Stage "refocus" of the many-view method: reference_multiview.blend, one thread per pixel.
#include "cubic.h"
#include "landing.h"

using namespace seepast;

namespace {

constexpr int kTaps = 4, kColours = 3;

// Adds weight times image [H, W, 3] at (x + dx, y + dy), edges continued.
__device__ void add_bicubic(const uint8_t* __restrict__ image, int height, int width, int x, int y, float dx,
                            float dy, float weight, float* total) {
  const int left = floor_int(dx), top = floor_int(dy);
  float wx[kTaps], wy[kTaps], sample[kColours] = {};
  cubic_weights(dx - static_cast<float>(left), wx);
  cubic_weights(dy - static_cast<float>(top), wy);
  int columns[kTaps];
#pragma unroll
  for (int i = 0; i < kTaps; ++i) columns[i] = kColours * clamp(x + left + i - 1, 0, width - 1);
#pragma unroll
  for (int j = 0; j < kTaps; ++j) {
    const uint8_t* row =
        image + kColours * static_cast<size_t>(clamp(y + top + j - 1, 0, height - 1)) * width;
    float line[kColours] = {};
#pragma unroll
    for (int i = 0; i < kTaps; ++i)
#pragma unroll
      for (int c = 0; c < kColours; ++c) line[c] += wx[i] * static_cast<float>(row[columns[i] + c]);
#pragma unroll
    for (int c = 0; c < kColours; ++c) sample[c] += wy[j] * line[c];
  }
#pragma unroll
  for (int c = 0; c < kColours; ++c) total[c] += weight * sample[c];
}

}  // namespace

// Of one view: offsets [K, 5]; colour uint8 [K, H, W, 3]; rays, d uint16, wanted uint8 [H, W]; clear uint8
// [K, H, W]: where 0, pixels weigh `edge`; near [K]; order int32 [K]: the nearest camera first, and so the
// greatest; rays of cameras that weigh less than `light` of the heaviest so far are left out. background
// uint8 [H, W, 3].
extern "C" __global__ void __launch_bounds__(256, 4)
    blend(const float* __restrict__ offsets, float cx, float cy, const uint8_t* __restrict__ colour,
          const uint16_t* __restrict__ rays, const uint8_t* __restrict__ clear,
          const float* __restrict__ near, const int32_t* __restrict__ order, float light, float edge,
          const uint16_t* __restrict__ d, const uint8_t* __restrict__ wanted, int cameras, int reference,
          int height, int width, uint8_t* __restrict__ background) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t pixels = static_cast<size_t>(height) * width, at = static_cast<size_t>(y) * width + x;
  uint8_t* out = background + kColours * at;
  if (!wanted[at]) {
    const uint8_t* own = colour + kColours * (reference * pixels + at);
    for (int c = 0; c < kColours; ++c) out[c] = own[c];
    return;
  }
  const float disparity = static_cast<float>(d[at]) / static_cast<float>(kUnits);
  float total[kColours] = {}, weights = 0, heaviest = 0;
#pragma unroll 1
  for (int i = 0; i < cameras; ++i) {
    const int k = order[i];
    if (near[k] < light * heaviest) break;
    if (!(rays[at] >> k & 1)) continue;
    const RayShift shift = shift_of(offsets + kOffsets * k, disparity);
    const float dx = ray_dx(shift, x, cx), dy = ray_dy(shift, y, cy);
    const int column = clamp(x + whole_offset(dx), 0, width - 1),
              row = clamp(y + whole_offset(dy), 0, height - 1);
    const bool is_clear = clear[k * pixels + static_cast<size_t>(row) * width + column];
    const float weight = (is_clear ? 1.0f : edge) * near[k];
    add_bicubic(colour + kColours * k * pixels, height, width, x, y, dx, dy, weight, total);
    weights += weight;
    heaviest = fmaxf(heaviest, weight);
  }
#pragma unroll
  for (int c = 0; c < kColours; ++c) {
    const float value = floorf(total[c] / (weights > 0.0f ? weights : 1.0f) + 0.5f);
    out[c] = static_cast<uint8_t>(value < 0.0f ? 0.0f : (value > 255.0f ? 255.0f : value));
  }
}
