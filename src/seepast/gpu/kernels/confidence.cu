// Last of all: how sure disparities are (confidence.py), and how far away what they show is.
#include "device.h"

constexpr int kTileX = 32, kTileY = 8;
constexpr int kReach = 4;        // confidence.py REACH: a square of 9 x 9
constexpr float kUnits = 32.0f;  // many.py UNITS, of a pixel

// 7 where the disparities of a square are equal, less the more they differ: confidence.py STEPS, 32nds of a
// pixel.
static __device__ int flatness(int spread) {
  return 7 - (spread > 7) - (spread > 15) - (spread > 23) - (spread > 31) - (spread > 47) - (spread > 63) -
         (spread > 127);
}

// confidence.of_labels: evidence uint8 [H, W] of disparity float32 px and labels uint16 [H, W]. Blocks of 32
// x 8.
extern "C" __global__ void __launch_bounds__(kTileX* kTileY)
    evidence_of_labels(const float* __restrict__ disparity, const uint16_t* __restrict__ labels,
                       int reference, int height, int width, uint8_t* __restrict__ evidence) {
  __shared__ int lows[kTileY + 2 * kReach][kTileX], highs[kTileY + 2 * kReach][kTileX];  // of nine in a row
  const int x = blockIdx.x * kTileX + threadIdx.x, top = blockIdx.y * kTileY;
  for (int j = threadIdx.y; j < kTileY + 2 * kReach; j += kTileY) {
    const int y = min(max(top + j - kReach, 0), height - 1);  // what is repeated changes no extreme
    int low = 0xffff, high = 0;
    for (int i = -kReach; i <= kReach; ++i) {
      const float d = disparity[static_cast<size_t>(y) * width + min(max(x + i, 0), width - 1)];
      const int units = static_cast<int>((d > 0.0f ? d : 0.0f) * kUnits);
      low = min(low, units), high = max(high, units);
    }
    lows[j][threadIdx.x] = low, highs[j][threadIdx.x] = high;
  }
  __syncthreads();
  const int y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  int low = 0xffff, high = 0;
  for (int j = 0; j <= 2 * kReach; ++j)
    low = min(low, lows[threadIdx.y + j][threadIdx.x]), high = max(high, highs[threadIdx.y + j][threadIdx.x]);
  const size_t at = static_cast<size_t>(y) * width + x;
  const int rays = __popc(static_cast<unsigned>(labels[at])), own = labels[at] >> reference & 1;
  evidence[at] = static_cast<uint8_t>(128 * own + 32 * min(rays - own, 3) + flatness(high - low));
}

// table[evidence[i]]: float32 [256]. Blocks of 256.
extern "C" __global__ void __launch_bounds__(256)
    probability(const uint8_t* __restrict__ evidence, const float* __restrict__ table, int count,
                float* __restrict__ out) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i < count) out[i] = table[evidence[i]];
}

// focal_baseline / disparity, 0 where that is not above 0. Blocks of 256.
extern "C" __global__ void __launch_bounds__(256)
    depth(const float* __restrict__ disparity, float focal_baseline, int count, float* __restrict__ out) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i < count) out[i] = disparity[i] > 0.0f ? focal_baseline / disparity[i] : 0.0f;
}
