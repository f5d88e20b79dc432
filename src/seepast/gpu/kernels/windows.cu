// Stage "candidates" of the many-view method, for all views at once: where a coarser level says to look, and
// which rows of the volume that makes.
#include "device.h"
#include "matching.h"

using namespace seepast;

constexpr int kColumns = 32, kRows = 8;  // of a tile of coarse pixels: one thread each
constexpr int kThreads = 256;
constexpr int kPixels = 4 * kThreads;  // that a block counts

// Quotient rounded down; C++ rounds towards zero.
__device__ inline int floor_div(int a, int b) { return a / b - (a % b != 0 && (a % b < 0) != (b < 0)); }

// The chunks within reach of a coarse pixel's disparity.
__device__ inline uint64_t chunks_near(int d, int ratio, int origin, int spacing, int count, int reach) {
  const int centre = d * ratio - origin;
  const int low = clamp(floor_div(centre - reach, spacing), 0, count - 1) / kChunk,
            high = clamp(-floor_div(-(centre + reach), spacing), 0, count - 1) / kChunk;
  return (~uint64_t{0} >> (63 - (high - low))) << low;
}

// disparity uint16, where uint8, around uint64 [n, rows, columns]: the chunks of all pixels within `spread`
// of each one that is wanted. origin, spacing and reach in 32nds of a fine pixel. Blocks 32 x 8: tiles; z is
// the view. Shared: (8 + 2 spread + 8) (32 + 2 spread) uint64.
extern "C" __global__ void __launch_bounds__(kColumns* kRows)
    windows_around(const uint16_t* __restrict__ disparity, const uint8_t* __restrict__ where, int rows,
                   int columns, int ratio, int origin, int spacing, int count, int reach, int spread,
                   uint64_t* __restrict__ around) {
  SEEPAST_SHARED(uint64_t, bits);
  const int thread = threadIdx.y * kColumns + threadIdx.x;
  const int span_x = kColumns + 2 * spread, span_y = kRows + 2 * spread;
  const int left = blockIdx.x * kColumns - spread, top = blockIdx.y * kRows - spread;
  const size_t view = blockIdx.z * static_cast<size_t>(rows) * columns;
  uint64_t* const gathered = bits + span_y * span_x;
  for (int i = thread; i < span_y * span_x; i += kColumns * kRows) {
    const int x = left + i % span_x, y = top + i / span_x;
    const bool inside = x >= 0 && x < columns && y >= 0 && y < rows;
    bits[i] = inside ? chunks_near(disparity[view + static_cast<size_t>(y) * columns + x], ratio, origin,
                                   spacing, count, reach)
                     : 0;
  }
  __syncthreads();
  for (int i = thread; i < kRows * span_x; i += kColumns * kRows) {
    uint64_t found = 0;
    for (int j = 0; j <= 2 * spread; ++j) found |= bits[i + j * span_x];
    gathered[i] = found;
  }
  __syncthreads();
  const int x = blockIdx.x * kColumns + threadIdx.x, y = blockIdx.y * kRows + threadIdx.y;
  if (x >= columns || y >= rows) return;
  const size_t at = view + static_cast<size_t>(y) * columns + x;
  uint64_t found = 0;
  if (where[at])
    for (int i = 0; i <= 2 * spread; ++i) found |= gathered[threadIdx.y * span_x + threadIdx.x + i];
  around[at] = found;
}

// Sum over the block of 256; every thread gets it.
__device__ inline int block_sum(int value, int* warp_sums) {
  const int thread = threadIdx.x;
  for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffffu, value, step);
  if (thread % 32 == 0) warp_sums[thread / 32] = value;
  __syncthreads();
  int sum = 0;
  for (int warp = 0; warp < kThreads / 32; ++warp) sum += warp_sums[warp];
  return sum;
}

// active uint64 [n, height, width]: that of the coarse pixel around each, none where `within` uint8 [n,
// height, width] does not hold, if it limits the views, all but the `whole`; sums int32 [n, blocks] of its
// chunks. Blocks of 256 threads for 1024 pixels; y is the view.
extern "C" __global__ void __launch_bounds__(kThreads)
    windows_active(const uint64_t* __restrict__ around, const uint8_t* __restrict__ within, int limited,
                   int whole, int rows, int columns, int ratio, int height, int width,
                   uint64_t* __restrict__ active, int32_t* __restrict__ sums) {
  __shared__ int warp_sums[kThreads / 32];
  const int pixels = height * width, first = blockIdx.x * kPixels + threadIdx.x;
  around += blockIdx.y * static_cast<size_t>(rows) * columns;
  active += blockIdx.y * static_cast<size_t>(pixels);
  within += limited ? blockIdx.y * static_cast<size_t>(pixels) : 0;
  const bool everywhere = !limited || static_cast<int>(blockIdx.y) == whole;
  int chunks = 0;
#pragma unroll
  for (int i = 0; i < kPixels / kThreads; ++i) {
    const int p = first + i * kThreads;
    if (p < pixels) {
      const int y = min(p / width / ratio, rows - 1), x = min(p % width / ratio, columns - 1);
      const uint64_t found = everywhere || within[p] ? around[static_cast<size_t>(y) * columns + x] : 0;
      active[p] = found;
      chunks += __popcll(found);
    }
  }
  const int sum = block_sum(chunks, warp_sums);
  if (threadIdx.x == 0) sums[blockIdx.y * gridDim.x + blockIdx.x] = sum;
}

// start int32 [n, pixels + 1]: the chunks before each pixel of its view; totals int32 [n]. Blocks as above.
extern "C" __global__ void __launch_bounds__(kThreads)
    windows_start(const uint64_t* __restrict__ active, int pixels, const int32_t* __restrict__ sums,
                  int32_t* __restrict__ start, int32_t* __restrict__ totals) {
  __shared__ int warp_sums[2][kThreads / 32];
  const int thread = threadIdx.x, lane = thread % 32, warp = thread / 32, view = blockIdx.y;
  active += view * static_cast<size_t>(pixels);
  start += view * (static_cast<size_t>(pixels) + 1);
  sums += view * gridDim.x;
  int before = 0;
  for (int i = thread; i < blockIdx.x; i += kThreads) before += sums[i];
  before = block_sum(before, warp_sums[0]);

  const int first = blockIdx.x * kPixels + 4 * thread;
  int chunks[4], mine = 0;
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    chunks[i] = first + i < pixels ? __popcll(active[first + i]) : 0;
    mine += chunks[i];
  }
  int until = mine;  // chunks of the warp's threads up to this one
  for (int step = 1; step < 32; step *= 2) {
    const int other = __shfl_up_sync(0xffffffffu, until, step);
    if (lane >= step) until += other;
  }
  if (lane == 31) warp_sums[1][warp] = until;
  __syncthreads();
  for (int i = 0; i < warp; ++i) before += warp_sums[1][i];
  before += until - mine;
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    if (first + i < pixels) start[first + i] = before;
    before += chunks[i];
    if (first + i == pixels - 1) start[pixels] = totals[view] = before;
  }
}
