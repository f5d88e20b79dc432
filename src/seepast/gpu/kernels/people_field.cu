// The two-label scanline field of the mask refinement: reference_people.field.
//
// A step of a chain is t = u + clip(t, -w, w), that is t = clamp(t + a, low, high) with a = u, low = u - w,
// high = u + w; w = 0 begins anew. Two such steps in a row are one of the same form, so the chains along rows
// are a scan: a warp goes along a row by 32 pixels at a time. Chains across rows are as many as there are
// columns, and have a thread each.
#include "landing.h"
#include "people_pixel.h"

using namespace seepast;

namespace {

constexpr uint32_t kAll = 0xffffffffu;
constexpr int kDirections = 4;  // from the left, upper left, upper, upper right; then the same backwards
constexpr int kAhead = 8;       // rows that are loaded together

struct Step {
  int a, low, high;
};

__device__ Step step_of(int u, int w) { return {u, u - w, u + w}; }

__device__ int after(const Step& s, int t) { return min(max(t + s.a, s.low), s.high); }

__device__ Step then(const Step& first, const Step& next) {
  return {first.a + next.a, after(next, first.low), after(next, first.high)};
}

__device__ Step shuffled(const Step& s, int lane) {
  return {__shfl_sync(kAll, s.a, lane), __shfl_sync(kAll, s.low, lane), __shfl_sync(kAll, s.high, lane)};
}

// All steps of the lanes up to this one; backwards, from the last lane down to this one.
__device__ Step scanned(Step s, bool backwards) {
  const int lane = threadIdx.x % 32;
  for (int far = 1; far < 32; far *= 2) {
    const int from = backwards ? lane + far : lane - far;
    const Step before = shuffled(s, from & 31);
    if (within(from, 32)) s = then(before, s);
  }
  return s;
}

}  // namespace

// Costs of a label change between a lattice pixel and the one before it in each direction, 0 where there is
// none: w int16 [4, K, h, w]. Blocks of 32 x 8 threads, blockIdx.z the camera.
extern "C" __global__ void __launch_bounds__(256)
    change_costs(const uint8_t* __restrict__ colour, const float* __restrict__ surfaces,
                 const int16_t* __restrict__ contrast, int count, float depth_step, int cut, int channels,
                 int height, int width, int stride, int16_t* __restrict__ costs) {
  const Lattice grid(height, width, stride);
  const int i = blockIdx.x * 32 + threadIdx.x, j = blockIdx.y * 8 + threadIdx.y, k = blockIdx.z;
  if (i >= grid.width || j >= grid.height) return;
  const size_t all = gridDim.z * grid.pixels(),
               out = k * grid.pixels() + static_cast<size_t>(j) * grid.width + i;
  const size_t here = (static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i);
  const int steps[kDirections][2] = {{0, 1}, {1, 1}, {1, 0}, {1, -1}};
#pragma unroll
  for (int q = 0; q < kDirections; ++q) {
    const int dy = steps[q][0], dx = steps[q][1];
    int cost = 0;
    if (j >= dy && within(i - dx, grid.width)) {
      const size_t before = here - (static_cast<size_t>(dy) * width + dx) * stride;
      int squared = 0;
      for (int c = 0; c < channels; ++c) {
        const int step = colour[here * channels + c] - colour[before * channels + c];
        squared += step * step;
      }
      cost = change_cost(contrast[min(squared * (3 / channels), count - 1)],
                         surfaces[here] - surfaces[before], depth_step, cut, dy && dx);
    }
    costs[q * all + out] = static_cast<int16_t>(cost);
  }
}

// total int32 [K, h, w]: u int16 and the messages along rows, both ways. A warp per row, 8 of a block;
// `costs` of the first direction.
extern "C" __global__ void __launch_bounds__(256)
    along_rows(const int16_t* __restrict__ u, const int16_t* __restrict__ costs, int rows, int width,
               int32_t* __restrict__ total) {
  const int row = blockIdx.x * 8 + threadIdx.x / 32, lane = threadIdx.x % 32;
  if (row >= rows) return;
  const size_t line = static_cast<size_t>(row) * width;
  int t = 0;
  for (int left = 0; left < width; left += 32) {
    const int x = left + lane;
    const int own = x < width ? u[line + x] : 0, w = x < width ? costs[line + x] : 0;
    const int here = after(scanned(step_of(own, w), false), t);
    if (x < width) total[line + x] = here;  // u and the message
    t = __shfl_sync(kAll, here, 31);
  }
  t = 0;
  for (int left = (width - 1) / 32 * 32; left >= 0; left -= 32) {
    const int x = left + lane;
    const int own = x < width ? u[line + x] : 0, w = x + 1 < width ? costs[line + x + 1] : 0;
    const int here = after(scanned(step_of(own, w), true), t);
    if (x < width) total[line + x] += here - own;
    t = __shfl_sync(kAll, here, 0);
  }
}

// Adds the messages across rows to total. A thread per chain, which goes on at the other side where it leaves
// the lattice: what comes in there has no cost. blockIdx.y: direction and way; blockIdx.z: camera, of K.
extern "C" __global__ void __launch_bounds__(128)
    across_rows(const int16_t* __restrict__ u, const int16_t* __restrict__ costs, int height, int width,
                int32_t* __restrict__ total) {
  const int c = blockIdx.x * 128 + threadIdx.x, q = 1 + blockIdx.y / 2;
  const bool up = blockIdx.y % 2;
  if (c >= width) return;
  const size_t camera = blockIdx.z * static_cast<size_t>(height) * width;
  const int16_t* w_of = costs + q * gridDim.z * static_cast<size_t>(height) * width + camera;
  const int dx = (up ? -1 : 1) * (2 - q);  // of the chain per row
  int t = 0, x = c, before = 0;            // before: the pixel that the chain comes from
  for (int first = 0; first < height; first += kAhead) {
    int own[kAhead], w[kAhead], at[kAhead];
#pragma unroll
    for (int n = 0; n < kAhead; ++n) {
      const int step = first + n, y = up ? height - 1 - step : step;
      const bool there = step < height;
      at[n] = there ? y * width + x : -1;
      own[n] = there ? u[camera + at[n]] : 0;
      w[n] = there && step > 0 ? w_of[up ? before : at[n]] : 0;
      before = at[n];
      x += dx;
      x = x < 0 ? width - 1 : (x >= width ? 0 : x);
    }
#pragma unroll
    for (int n = 0; n < kAhead; ++n) {
      t = after(step_of(own[n], w[n]), t);
      if (at[n] >= 0) atomicAdd(&total[camera + at[n]], t - own[n]);
    }
  }
}
