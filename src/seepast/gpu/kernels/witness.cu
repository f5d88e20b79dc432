// What the views say about each other's disparities: reference_multiview.witnesses, labels, graded.
//
// One thread per pixel, blockIdx.z is the view. offsets [V, K, 5], centers [V, 2]: the array as seen from V
// cameras. d uint16 [V, H, W]; disparities uint16, is_static uint8 [K, H, W] of all cameras.
#include "landing.h"

using namespace seepast;

namespace {

constexpr int kAcross = 32, kDown = 8;
constexpr uint64_t kNothing = 0, kEverything = 1;  // in place of an address

struct Said {
  int agree, farther;
};

// What all cameras but `skip` say about the disparity of pixel (x, y) of a view.
__device__ Said ask(const float* __restrict__ offsets, float cx, float cy, int x, int y, int units,
                    const uint16_t* __restrict__ disparities, const uint8_t* __restrict__ is_static,
                    int cameras, int height, int width, int skip, int tolerance) {
  Said said{0, 0};
#pragma unroll 4
  for (int k = 0; k < cameras; ++k) {
    const Landing to = land(offsets + kOffsets * k, cx, cy, x, y, units);
    const bool there = k != skip && within(to.column, width) && within(to.row, height);
    const int at = there ? (k * height + to.row) * width + to.column : 0;
    const bool open = there && is_static[at];
    const int e = disparities[at] - to.expected;
    said.agree += open && abs(e) <= tolerance;
    said.farther |= open && e < -tolerance;
  }
  return said;
}

// 7 where disparities are equal, less the more they differ (confidence.py STEPS).
__device__ int flatness(int spread) {
  return (spread <= 7) + (spread <= 15) + (spread <= 23) + (spread <= 31) + (spread <= 47) + (spread <= 63) +
         (spread <= 127);
}

}  // namespace

// skips int32 [V]: the camera that is not asked, or -1. agree, farther uint8 [V, H, W].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    witnesses(const float* __restrict__ offsets, const float* __restrict__ centers,
              const uint16_t* __restrict__ d, const uint16_t* __restrict__ disparities,
              const uint8_t* __restrict__ is_static, const int32_t* __restrict__ skips, int cameras,
              int height, int width, int tolerance, uint8_t* __restrict__ agree,
              uint8_t* __restrict__ farther) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height) return;
  const int at = (view * height + y) * width + x;
  const Said said = ask(offsets + kOffsets * cameras * view, centers[2 * view], centers[2 * view + 1], x, y,
                        d[at], disparities, is_static, cameras, height, width, skips[view], tolerance);
  agree[at] = static_cast<uint8_t>(said.agree);
  farther[at] = static_cast<uint8_t>(said.farther);
}

// What witnesses make of the views themselves (reference_multiview.graded). actives uint64 [K]: the address
// of a view's active chunks uint64 [H, W], which are asked about; kNothing; or kEverything. confidence, sure
// uint8 [K, H, W].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    graded(const float* __restrict__ offsets, const float* __restrict__ centers,
           const uint16_t* __restrict__ found, const uint8_t* __restrict__ is_static,
           const uint64_t* __restrict__ actives, int cameras, int height, int width, int tolerance,
           int confident, int lone, int doubtful, uint8_t* __restrict__ confidence,
           uint8_t* __restrict__ sure) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height) return;
  const int at = (view * height + y) * width + x;
  const uint64_t active = actives[view];
  const bool asked = active == kEverything ||
                     (active != kNothing && reinterpret_cast<const uint64_t*>(active)[y * width + x] != 0);
  Said said{0, 0};
  if (asked)
    said = ask(offsets + kOffsets * cameras * view, centers[2 * view], centers[2 * view + 1], x, y, found[at],
               found, is_static, cameras, height, width, view, tolerance);
  const int grade = said.agree ? confident : (said.farther ? doubtful : lone);
  confidence[at] = static_cast<uint8_t>(asked && is_static[at] ? grade : 0);
  sure[at] = said.agree > 0;
}

// Of one view: offsets [K, 5]; d, shown, rays uint16 [H, W]; wanted, close uint8 [H, W].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    labels(const float* __restrict__ offsets, float cx, float cy, const uint16_t* __restrict__ d,
           const uint16_t* __restrict__ disparities, const uint8_t* __restrict__ is_static,
           const uint8_t* __restrict__ wanted, int reference, int cameras, int height, int width,
           int tolerance, int near, uint16_t* __restrict__ shown, uint16_t* __restrict__ rays,
           uint8_t* __restrict__ close) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y;
  if (x >= width || y >= height) return;
  const int pixel = y * width + x, units = d[pixel];
  const int asked = wanted[pixel] ? cameras : 0;
  uint32_t show = asked ? 0 : 1u << reference, pass = 0, confirm = 0;
#pragma unroll 4
  for (int k = 0; k < asked; ++k) {
    const Landing to = land(offsets + kOffsets * k, cx, cy, x, y, units);
    const bool there = within(to.column, width) && within(to.row, height);
    const int at = there ? (k * height + to.row) * width + to.column : 0;
    const bool open = there && is_static[at];
    const int e = abs(disparities[at] - to.expected);
    pass |= static_cast<uint32_t>(open) << k;
    show |= static_cast<uint32_t>(open && (k == reference || e <= tolerance)) << k;
    confirm += open && k != reference && e <= near;
  }
  close[pixel] = static_cast<uint8_t>(confirm);
  shown[pixel] = static_cast<uint16_t>(show);
  rays[pixel] = static_cast<uint16_t>(show ? show : pass);
}

// Evidence on the disparities of one view (confidence.py): d, shown uint16, is_static, closes, evidence uint8
// [H, W]. Blocks of 32 x 8 threads, tiles of 32 x 32 pixels.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    evidence(const uint16_t* __restrict__ d, const uint8_t* __restrict__ is_static,
             const uint8_t* __restrict__ closes, const uint16_t* __restrict__ shown, int height, int width,
             uint8_t* __restrict__ out) {
  constexpr int kReach = 4, kTile = 32;  // confidence.py REACH = 9
  __shared__ uint16_t low[kTile + 2 * kReach][kTile], high[kTile + 2 * kReach][kTile];
  const int left = blockIdx.x * kTile, top = blockIdx.y * kTile, x = left + threadIdx.x;
  for (int j = threadIdx.y; j < kTile + 2 * kReach; j += kDown) {
    const int y = top + j - kReach;
    int least = 0xffff, most = 0;
    if (within(y, height))
      for (int i = max(0, x - kReach); i <= min(width - 1, x + kReach); ++i) {
        const int value = d[y * width + i];
        least = min(least, value);
        most = max(most, value);
      }
    low[j][threadIdx.x] = static_cast<uint16_t>(least);
    high[j][threadIdx.x] = static_cast<uint16_t>(most);
  }
  __syncthreads();
  for (int j = threadIdx.y; j < kTile; j += kDown) {
    const int y = top + j, at = y * width + x;
    if (x >= width || y >= height) continue;
    int least = 0xffff, most = 0;
#pragma unroll
    for (int i = 0; i <= 2 * kReach; ++i) {
      least = min(least, static_cast<int>(low[j + i][threadIdx.x]));
      most = max(most, static_cast<int>(high[j + i][threadIdx.x]));
    }
    const int close = closes[at], own = is_static[at];
    const int loose = max(0, __popc(shown[at]) - own - close);
    out[at] =
        static_cast<uint8_t>(128 * own + 32 * min(close, 3) + 8 * min(loose, 3) + flatness(most - least));
  }
}
