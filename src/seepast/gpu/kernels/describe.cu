// Stage "describe": 3x3 Sobel responses and the 16-sample descriptors made of them.
#include "device.h"

using namespace seepast;

constexpr int kTileX = 32, kTileY = 8, kReach = 2;  // of a block; of the descriptor's pattern
constexpr int kGradientsX = kTileX + 2 * kReach, kGradientsY = kTileY + 2 * kReach;
constexpr int kGreyX = kGradientsX + 2, kGreyY = kGradientsY + 2;

// (du, dv) / 2 at a place of a tile of grey levels, biased by 128.
static __device__ uchar2 sobel(const uint8_t (*grey)[kGreyX], int x, int y) {
  const int a = grey[y - 1][x - 1], b = grey[y - 1][x], c = grey[y - 1][x + 1];
  const int d = grey[y][x - 1], f = grey[y][x + 1];
  const int g = grey[y + 1][x - 1], h = grey[y + 1][x], i = grey[y + 1][x + 1];
  const int du = ((c - a) + 2 * (f - d) + (i - g)) >> 1, dv = ((g - a) + 2 * (h - b) + (i - c)) >> 1;
  uchar2 both;
  both.x = static_cast<uint8_t>(clamp(du, -127, 127) + 128);
  both.y = static_cast<uint8_t>(clamp(dv, -127, 127) + 128);
  return both;
}

static __device__ unsigned bytes(unsigned a, unsigned b, unsigned c, unsigned d) {
  return a | b << 8 | c << 16 | d << 24;
}

// Blocks of 32 x 8 pixels of camera blockIdx.z. grey [K, H, W]; gradients int8 [K, H, W, 2]; descriptors [K,
// H, W] of 16 bytes each, biased by 128.
extern "C" __global__ void __launch_bounds__(kTileX* kTileY)
    describe(const uint8_t* __restrict__ grey, int height, int width, uint8_t* __restrict__ gradients,
             uint8_t* __restrict__ descriptors) {
  __shared__ uint8_t levels[kGreyY][kGreyX];
  __shared__ uint8_t du[kGradientsY][kGradientsX], dv[kGradientsY][kGradientsX];
  const int left = blockIdx.x * kTileX, top = blockIdx.y * kTileY, t = threadIdx.y * kTileX + threadIdx.x;
  const size_t image = static_cast<size_t>(blockIdx.z) * height * width;
  for (int i = t; i < kGreyX * kGreyY; i += kTileX * kTileY) {
    const int x = clamp(left + i % kGreyX - kReach - 1, 0, width - 1),
              y = clamp(top + i / kGreyX - kReach - 1, 0, height - 1);
    levels[i / kGreyX][i % kGreyX] = grey[image + static_cast<size_t>(y) * width + x];
  }
  __syncthreads();
  for (int i = t; i < kGradientsX * kGradientsY; i += kTileX * kTileY) {
    // beyond the image: the gradient of the nearest pixel in it
    const int x = clamp(left + i % kGradientsX - kReach, 0, width - 1) - left,
              y = clamp(top + i / kGradientsX - kReach, 0, height - 1) - top;
    const uchar2 both = sobel(levels, x + kReach + 1, y + kReach + 1);
    du[i / kGradientsX][i % kGradientsX] = both.x;
    dv[i / kGradientsX][i % kGradientsX] = both.y;
  }
  __syncthreads();
  const int x = left + threadIdx.x, y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  const int i = threadIdx.x + kReach, j = threadIdx.y + kReach;
  const size_t at = image + static_cast<size_t>(y) * width + x;
  uchar2 own;  // signed again
  own.x = du[j][i] ^ 128;
  own.y = dv[j][i] ^ 128;
  reinterpret_cast<uchar2*>(gradients)[at] = own;
  reinterpret_cast<uint4*>(descriptors)[at] =
      make_uint4(bytes(du[j - 2][i], du[j - 1][i - 2], du[j - 1][i], du[j - 1][i + 2]),
                 bytes(du[j][i - 1], du[j][i], du[j][i], du[j][i + 1]),
                 bytes(du[j + 1][i - 2], du[j + 1][i], du[j + 1][i + 2], du[j + 2][i]),
                 bytes(dv[j - 1][i], dv[j][i - 1], dv[j][i + 1], dv[j + 1][i]));
}
