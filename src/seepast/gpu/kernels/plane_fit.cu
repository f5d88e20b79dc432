// Completion of unconfirmed disparities: reference_multiview.planes.
//
// A block takes a tile of one view into shared memory with a margin of what its pixels reach, lists those of
// its pixels that are wanted, and its threads work the list off: wanted pixels lie here and there, and a warp
// of neighbours would mostly wait for a few.
#include "landing.h"
#include "planes.h"

using namespace seepast;

namespace {

// many.py PLANE.
constexpr int kRadius = 16, kStride = 2, kTaps = 2 * kRadius / kStride + 1, kGate = 4 * kUnits;
constexpr float kNeed = 4.0f;
constexpr double kRidge = 4.0;

constexpr int kAcross = 64, kDown = 16, kThreads = 256;
constexpr int kWide = kAcross + 2 * kRadius, kHigh = kDown + 2 * kRadius;
constexpr int kPitch = kWide + 1;   // lists jump between rows: these begin in different banks
constexpr float kUntrusted = 1e9f;  // a disparity beyond every gate

struct Nearness {
  float of[kTaps][kTaps];
  constexpr Nearness() : of() {
    for (int n = 0; n < kTaps; ++n)
      for (int m = 0; m < kTaps; ++m) {
        const int j = n * kStride - kRadius, i = m * kStride - kRadius;
        of[n][m] = static_cast<float>(1.0 / (1.0 + 4.0 * (i * i + j * j) / (kRadius * kRadius)));
      }
  }
};
__constant__ const Nearness kNearness{};

struct Tile {
  float trust[kHigh][kPitch];      // disparity of the trusted pixels
  uint32_t colour[kHigh][kPitch];  // B, G, R in bytes
  uint16_t list[kAcross * kDown];
  int count;
};

struct View {
  const uint16_t* d;
  const uint8_t *image, *is_static;
  uint16_t* out;
  int height, width;
};

// Of each pixel: may the fit use its disparity, and is it wanted?
struct Flags {
  const uint8_t *trusted, *wanted;
  __device__ bool trusts(const View&, int at) const { return trusted[at]; }
  __device__ bool wants(int at) const { return wanted[at]; }
};
struct Agreeing {
  const uint8_t* agree;  // views that do
  __device__ bool trusts(const View& view, int at) const { return agree[at] && view.is_static[at]; }
  __device__ bool wants(int at) const { return !agree[at]; }
};

// (1 - g / 256)^8, or 1 where `coloured` is 0 and not 1 / 256.
__device__ float likeness(uint32_t step, float coloured) {
  // a whole number below 2^23 to a float: its bits behind those of 2^23
  const float g = __int_as_float(0x4b000000 | static_cast<int>(min(step, 256u))) - 8388608.0f;
  float t = 1.0f - g * coloured;
  t = t * t;
  t = t * t;
  return t * t;
}

__device__ PlaneSums fit(const Tile& tile, int y, int x, float d, float coloured) {
  PlaneSums s{};
  const uint32_t own = tile.colour[y + kRadius][x + kRadius];
#pragma unroll 1
  for (int n = 0; n < kTaps; ++n) {
    const float *trust = &tile.trust[y + n * kStride][x], *near = kNearness.of[n];
    const uint32_t* colour = &tile.colour[y + n * kStride][x];
    float w_ = 0, x_ = 0, xx_ = 0, e_ = 0, ex_ = 0;
#pragma unroll
    for (int m = 0; m < kTaps; ++m) {
      const float i = static_cast<float>(m * kStride - kRadius), e = trust[m * kStride] - d;
      float weight = likeness(__vsadu4(colour[m * kStride], own), coloured) * near[m];
      weight = fabsf(e) <= static_cast<float>(kGate) ? weight : 0.0f;
      const float we = weight * e, wi = weight * i;
      w_ += weight;
      x_ += wi;
      xx_ += wi * i;
      e_ += we;
      ex_ += we * i;
    }
    const float j = static_cast<float>(n * kStride - kRadius);
    s.w += w_;
    s.x += x_;
    s.xx += xx_;
    s.e += e_;
    s.ex += ex_;
    s.y += w_ * j;
    s.yy += w_ * (j * j);
    s.xy += x_ * j;
    s.ey += e_ * j;
  }
  return s;
}

template <class Pixels>
__device__ void list_wanted(Tile& tile, const Pixels& pixels, const View& view, int left, int top) {
  for (int n = threadIdx.x; n < kAcross * kDown; n += kThreads) {
    const int x = left + n % kAcross, y = top + n / kAcross, at = y * view.width + x;
    const bool inside = x < view.width && y < view.height, wanted = inside && pixels.wants(at);
    if (inside && !wanted) view.out[at] = view.d[at];
    const uint32_t all = __ballot_sync(0xffffffffu, wanted), lane = threadIdx.x % 32;
    int first = 0;
    if (lane == 0 && all) first = atomicAdd(&tile.count, __popc(all));
    first = __shfl_sync(0xffffffffu, first, 0);
    if (wanted) tile.list[first + __popc(all & ((1u << lane) - 1))] = static_cast<uint16_t>(n);
  }
}

template <class Pixels>
__device__ void load(Tile& tile, const Pixels& pixels, const View& view, int left, int top) {
  for (int n = threadIdx.x; n < kWide * kHigh; n += kThreads) {
    const int i = n % kWide, j = n / kWide, x = left + i - kRadius, y = top + j - kRadius;
    float trust = kUntrusted;
    uint32_t colour = 0;
    if (within(x, view.width) && within(y, view.height)) {
      const int at = y * view.width + x;
      const uint8_t* bgr = view.image + 3 * static_cast<size_t>(at);
      if (pixels.trusts(view, at)) trust = static_cast<float>(view.d[at]);
      colour = bgr[0] | static_cast<uint32_t>(bgr[1]) << 8 | static_cast<uint32_t>(bgr[2]) << 16;
    }
    tile.trust[j][i] = trust;
    tile.colour[j][i] = colour;
  }
}

template <class Pixels>
__device__ void complete(const Pixels& pixels, const View& view) {
  __shared__ Tile tile;
  const int left = blockIdx.x * kAcross, top = blockIdx.y * kDown;
  if (threadIdx.x == 0) tile.count = 0;
  __syncthreads();
  list_wanted(tile, pixels, view, left, top);
  __syncthreads();
  if (tile.count == 0) return;  // the whole block
  load(tile, pixels, view, left, top);
  __syncthreads();
  for (int n = threadIdx.x; n < tile.count; n += kThreads) {
    const int x = tile.list[n] % kAcross, y = tile.list[n] / kAcross, at = (top + y) * view.width + left + x;
    int d = view.d[at];
    const PlaneSums sums = fit(tile, y, x, static_cast<float>(d), view.is_static[at] ? 1.0f / 256.0f : 0.0f);
    if (sums.w >= kNeed) {
      const double moved = floor(plane_height(sums, kRidge) + 0.5);
      if (fabs(moved) <= kGate) d = max(0, d + static_cast<int>(moved));
    }
    view.out[at] = static_cast<uint16_t>(d);
  }
}

__device__ View view_of(const uint16_t* d, const uint8_t* image, const uint8_t* is_static, uint16_t* out,
                        int height, int width) {
  const size_t from = static_cast<size_t>(blockIdx.z) * height * width;
  return {d + from, image + 3 * from, is_static + from, out + from, height, width};
}

}  // namespace

// One view per blockIdx.z: d, out uint16, trusted, wanted, is_static uint8 [V, H, W]; image uint8 [V, H, W,
// 3].
extern "C" __global__ void __launch_bounds__(kThreads)
    planes(const uint16_t* __restrict__ d, const uint8_t* __restrict__ trusted,
           const uint8_t* __restrict__ wanted, const uint8_t* __restrict__ image,
           const uint8_t* __restrict__ is_static, int height, int width, uint16_t* __restrict__ out) {
  const size_t from = static_cast<size_t>(blockIdx.z) * height * width;
  complete(Flags{trusted + from, wanted + from}, view_of(d, image, is_static, out, height, width));
}

// The same with pixels trusted that another view agrees with and are static, and wanted that none agrees
// with.
extern "C" __global__ void __launch_bounds__(kThreads)
    planes_of_views(const uint16_t* __restrict__ d, const uint8_t* __restrict__ agree,
                    const uint8_t* __restrict__ image, const uint8_t* __restrict__ is_static, int height,
                    int width, uint16_t* __restrict__ out) {
  const size_t from = static_cast<size_t>(blockIdx.z) * height * width;
  complete(Agreeing{agree + from}, view_of(d, image, is_static, out, height, width));
}
