// Stage "describe" of the many-view method: cubic samples at quarter pixels, their census and which of it is
// static.
#include "device.h"
#include "matching.h"

using namespace seepast;

constexpr int kColumns = 32, kRows = 8;  // of a tile: one thread per pixel
constexpr int kSpanX = kColumns + 2 * kReach, kSpanY = kRows + 2 * kReach;
constexpr int kBrightX = kSpanX + 3;  // a sample lies between the second and third of four pixels

__device__ inline int weighted(const int32_t* w, int a, int b, int c, int d) {
  return w[0] * a + w[1] * b + w[2] * c + w[3] * d;
}

__device__ inline int within(int v, int most) { return min(max(v, 0), most); }
__device__ inline int low(unsigned word) { return word & 0xffff; }
__device__ inline int high(unsigned word) { return word >> 16; }

// One view's part of the image that a tile needs, brought into shared memory.
struct Tile {
  int bright[kSpanY][kBrightX];  // luma of the pixels, column x at x + kReach + 1; edges repeat
  uint2 luma[kSpanY][kSpanX];    // of the samples at phases 0..3, 16 bits each; 0 outside the image
  uint8_t open[kSpanY][kSpanX];  // bit 0: the pixel is static; bit 1: so is the one right of it
};

__device__ inline void load(Tile& tile, const uint8_t* __restrict__ colour, int height, int width, int left,
                            int top, const int32_t* __restrict__ luma, int thread) {
  const int lb = luma[0], lg = luma[1], lr = luma[2];
  for (int i = thread; i < kSpanY * kBrightX; i += kColumns * kRows) {
    const int j = i / kBrightX, y = top + j - kReach;
    const int x = clamp(left + i % kBrightX - kReach - 1, 0, width - 1);
    int bright = 0;
    if (y >= 0 && y < height) {
      const uint8_t* at = colour + 3 * (static_cast<size_t>(y) * width + x);
      bright = lb * at[0] + lg * at[1] + lr * at[2];
    }
    tile.bright[j][i % kBrightX] = bright;
  }
}

// Luma samples and static flags of the tile and around it; whether all flags are set.
__device__ inline bool sample(Tile& tile, const uint8_t* __restrict__ is_static, int height, int width,
                              int left, int top, const int32_t* __restrict__ cubic, int thread) {
  bool all = true;
  for (int i = thread; i < kSpanY * kSpanX; i += kColumns * kRows) {
    const int j = i / kSpanX, column = i % kSpanX, x = left + column - kReach, y = top + j - kReach;
    uint2 found = make_uint2(0, 0);
    int open = 0;
    if (x >= 0 && x < width && y >= 0 && y < height) {
      const int* b = tile.bright[j] + column;
      const auto at = [&](int phase) -> unsigned {
        return within((weighted(cubic + 4 * phase, b[0], b[1], b[2], b[3]) + 64) >> 7, 65535);
      };
      found = make_uint2(at(0) | at(1) << 16, at(2) | at(3) << 16);
      const uint8_t* here = is_static + static_cast<size_t>(y) * width + x;
      if (here[0]) open = x + 1 < width && here[1] ? 3 : 1;
    }
    tile.luma[j][column] = found;
    tile.open[j][column] = static_cast<uint8_t>(open);
    all = all && open == 3;
  }
  return all;
}

// The neighbours (dy, dx) of many.py REACH, from the last to the first.
template <typename Use>
__device__ inline void for_each_neighbour(Use use) {
#pragma unroll
  for (int dy = kReach; dy >= -kReach; --dy)
#pragma unroll
    for (int dx = kReach; dx >= -kReach; --dx)
      if ((dy + dx) % 2 == 0 && (dy != 0 || dx != 0)) use(dy, dx);
}

// B, G, R of the sample at x + phase / 4, from the four pixels around it.
__device__ inline unsigned colour_at(const int32_t* __restrict__ w, const uint8_t* a, const uint8_t* b,
                                     const uint8_t* c, const uint8_t* d) {
  unsigned found = 0;
#pragma unroll
  for (int i = 0; i < 3; ++i)
    found |= static_cast<unsigned>(within((weighted(w, a[i], b[i], c[i], d[i]) + 64) >> 7, 255)) << 8 * i;
  return found;
}

// colour uint8 [K, H, W, 3], is_static uint8 [K, H, W]; weights int32: cubic [4, 4] in 128ths, then luma [3]
// in 256ths. samples [K, 4, H, W, 2], valid [K, 4, H, W]: matching.h. Blocks 32 x 8: tiles of the image, z is
// the camera.
extern "C" __global__ void __launch_bounds__(kColumns* kRows)
    census(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ is_static, int height, int width,
           const int32_t* __restrict__ weights, uint32_t* __restrict__ samples,
           uint32_t* __restrict__ valid) {
  __shared__ Tile tile;
  const int thread = threadIdx.y * kColumns + threadIdx.x, k = blockIdx.z;
  const int left = blockIdx.x * kColumns, top = blockIdx.y * kRows;
  const size_t pixels = static_cast<size_t>(height) * width;
  colour += 3 * k * pixels;
  load(tile, colour, height, width, left, top, weights + 16, thread);
  __syncthreads();
  const bool open = sample(tile, is_static + k * pixels, height, width, left, top, weights, thread);
  const bool all_open = __syncthreads_and(open);

  const int x = left + threadIdx.x, y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  const int column = threadIdx.x + kReach, row = threadIdx.y + kReach;
  const uint2 mid = tile.luma[row][column];
  const int mids[4] = {low(mid.x), high(mid.x), low(mid.y), high(mid.y)};
  unsigned darker[4] = {0, 0, 0, 0};
  // from the last neighbour to the first: the sign of every difference is shifted in from the right
  for_each_neighbour([&](int dy, int dx) {
    const uint2 a = tile.luma[row + dy][column + dx];
    darker[0] = __funnelshift_l(low(a.x) - mids[0], darker[0], 1);
    darker[1] = __funnelshift_l(high(a.x) - mids[1], darker[1], 1);
    darker[2] = __funnelshift_l(low(a.y) - mids[2], darker[2], 1);
    darker[3] = __funnelshift_l(high(a.y) - mids[3], darker[3], 1);
  });
  unsigned whole = kAllNeighbours, between = kAllNeighbours;
  if (!all_open) {
    whole = between = 0;
    for_each_neighbour([&](int dy, int dx) {
      const unsigned flags = tile.open[row + dy][column + dx];
      whole = whole << 1 | (flags & 1);
      between = between << 1 | flags >> 1;
    });
  }

  const size_t at = static_cast<size_t>(y) * width + x;
  const unsigned own = tile.open[row][column];
  const unsigned flags[2] = {own & 1 ? (whole == kAllNeighbours ? kStatic | kClear : kStatic) : 0,
                             own & 2 ? (between == kAllNeighbours ? kStatic | kClear : kStatic) : 0};
  const uint8_t* line = colour + 3 * static_cast<size_t>(y) * width;
  const uint8_t *a = line + 3 * max(x - 1, 0), *b = line + 3 * x, *c = line + 3 * min(x + 1, width - 1),
                *d = line + 3 * min(x + 2, width - 1);
#pragma unroll
  for (int phase = 0; phase < 4; ++phase) {
    uint2* to = reinterpret_cast<uint2*>(samples) + (4 * static_cast<size_t>(k) + phase) * pixels + at;
    valid[(4 * static_cast<size_t>(k) + phase) * pixels + at] = phase ? between : whole;
    *to = make_uint2(darker[phase], colour_at(weights + 4 * phase, a, b, c, d) | flags[phase > 0]);
  }
}
