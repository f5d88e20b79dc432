// Proves that a device works: a sum that needs a barrier, a shuffle, an atomic and both kinds of shared
// memory.
#include "device.h"

constexpr int kTrialThreads = 64;

// Per block of 64: out[i] = factor * values[i] + the sum of the block's values; total = the sum of all.
// Shared: 64 ints.
extern "C" __global__ void __launch_bounds__(kTrialThreads)
    trial(const int32_t* __restrict__ values, int count, float factor, float* __restrict__ out,
          int* __restrict__ total) {
  SEEPAST_SHARED(int, turned);
  __shared__ int warp_sums[kTrialThreads / 32];
  const int t = threadIdx.x, i = blockIdx.x * kTrialThreads + t;
  turned[kTrialThreads - 1 - t] = i < count ? values[i] : 0;
  __syncthreads();
  int sum = turned[t];
  for (int step = 16; step > 0; step /= 2) sum += __shfl_down_sync(0xffffffffu, sum, step);
  if (t % 32 == 0) warp_sums[t / 32] = sum;
  __syncthreads();
  if (t == 0) atomicAdd(total, warp_sums[0] + warp_sums[1]);
  if (i < count)
    out[i] = factor * static_cast<float>(values[i]) + static_cast<float>(warp_sums[0] + warp_sums[1]);
}
