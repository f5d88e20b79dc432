// 5x5 medians of disparities: one pass of the paper's smoothing.
#include "device.h"

constexpr int kTileX = 32, kTileY = 8, kReach = 2;
constexpr int kColumns = kTileX + 2 * kReach, kRows = kTileY + 2 * kReach;
constexpr int kKept = 14;  // of 25: the median is never among the least or largest of so many

static __device__ __forceinline__ void sort_two(float& a, float& b) {
  const float low = fminf(a, b);
  b = fmaxf(a, b);
  a = low;
}

// Puts the least of v[0 .. n - 1] first and the largest last.
template <int n>
static __device__ __forceinline__ void part_ends(float* v) {
#pragma unroll
  for (int i = 0; i < n / 2; ++i) sort_two(v[i], v[n - 1 - i]);
#pragma unroll
  for (int i = 1; i < (n + 1) / 2; ++i) sort_two(v[0], v[i]);
#pragma unroll
  for (int i = n / 2; i < n - 1; ++i) sort_two(v[i], v[n - 1]);
}

// Of v[0 .. n - 1] the ends go, and the next of the 25 comes; until three are left.
template <int n>
static __device__ __forceinline__ float forget(float* v, const float (*tile)[kColumns], int next) {
  part_ends<n>(v);
  if constexpr (n == 3) {
    return v[1];
  } else {
    v[0] = tile[next / 5][next % 5];
    return forget<n - 1>(v, tile, next + 1);
  }
}

static __device__ __forceinline__ float median25(const float (*tile)[kColumns]) {
  float v[kKept];
#pragma unroll
  for (int i = 0; i < kKept; ++i) v[i] = tile[i / 5][i % 5];
  return forget<kKept>(v, tile, kKept);
}

// out = 5x5 median of in, edges continued. On the first pass the prior mean (eighths) stands in where not
// wanted; on the last the result is 0 there. Blocks of 32 x 8.
extern "C" __global__ void __launch_bounds__(kTileX* kTileY)
    smooth(const float* __restrict__ in, const int32_t* __restrict__ mean, const uint8_t* __restrict__ wanted,
           int height, int width, int is_first, int is_last, float* __restrict__ out) {
  __shared__ float tile[kRows][kColumns];
  const int left = blockIdx.x * kTileX, top = blockIdx.y * kTileY;
  for (int i = threadIdx.y * kTileX + threadIdx.x; i < kRows * kColumns; i += kTileX * kTileY) {
    const int x = min(max(left + i % kColumns - kReach, 0), width - 1),
              y = min(max(top + i / kColumns - kReach, 0), height - 1);
    const size_t at = static_cast<size_t>(y) * width + x;
    tile[i / kColumns][i % kColumns] = is_first && !wanted[at] ? static_cast<float>(mean[at]) / 8.0f : in[at];
  }
  __syncthreads();
  const int x = left + threadIdx.x, y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t at = static_cast<size_t>(y) * width + x;
  const float median = median25(reinterpret_cast<const float (*)[kColumns]>(&tile[threadIdx.y][threadIdx.x]));
  out[at] = is_last && !wanted[at] ? 0.0f : median;
}
