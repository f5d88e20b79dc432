// Percentiles of the sure disparities of all views (host.inner_span): a histogram, and where its ranks lie.
#include "device.h"

using namespace seepast;

namespace {

constexpr int kBins = 1 << 16, kThreads = 1024, kEach = kBins / kThreads;

}  // namespace

// disparity uint16, agree, clear uint8 [count]; bins int32 [65536], zero before: those where both hold.
//
extern "C" __global__ void __launch_bounds__(256)
    count_disparities(const uint16_t* __restrict__ disparity, const uint8_t* __restrict__ agree,
                      const uint8_t* __restrict__ clear, int count, int32_t* __restrict__ bins) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i < count && agree[i] && clear[i]) atomicAdd(&bins[disparity[i]], 1);
}

// out int32 [1 + 2 n]: how many there are, N; then for each share q double [n] in 0 .. 1 the values of the
// ranks floor(q (N - 1)) and the next, which there need not be. One block.
extern "C" __global__ void __launch_bounds__(kThreads)
    ranks(const int32_t* __restrict__ bins, const double* __restrict__ shares, int n,
          int32_t* __restrict__ out) {
  __shared__ int sums[kThreads];
  const int t = threadIdx.x;
  int own = 0;
  const int4* four = reinterpret_cast<const int4*>(bins) + t * (kEach / 4);
  for (int i = 0; i < kEach / 4; ++i) own += four[i].x + four[i].y + four[i].z + four[i].w;
  sums[t] = own;
  __syncthreads();
  for (int step = 1; step < kThreads; step *= 2) {
    const int before = t >= step ? sums[t - step] : 0;
    __syncthreads();
    sums[t] += before;
    __syncthreads();
  }
  const int total = sums[kThreads - 1];
  if (t == 0) out[0] = total;
  for (int q = 0; q < 2 * n; ++q) {
    const int first = static_cast<int>(floor(shares[q / 2] * static_cast<double>(total - 1)));
    const int rank = min(first + q % 2, total - 1);
    int below = sums[t] - own;
    if (rank < below || rank >= sums[t]) continue;
    int bin = t * kEach;
    while (rank >= below + bins[bin]) below += bins[bin++];
    out[1 + q] = bin;
  }
}
