// Stage "describe" of the many-view method: pixels and cubic samples half way between them, their census and
// which of it is static.
#include "device.h"
#include "matching.h"

using namespace seepast;

constexpr int kColumns = 32, kRows = 8;  // of a tile: one thread per pixel
constexpr int kSpanX = kColumns + 2 * kReach, kSpanY = kRows + 2 * kReach;
constexpr int kBrightX = kSpanX + 3;  // a sample lies between the second and third of four pixels

// The cubic sample half way between b and c (many.py CUBIC), at least 0 and at most `most`.
__device__ inline int half_way(int a, int b, int c, int d, int most) {
  return min(max((9 * (b + c) - (a + d) + 8) >> 4, 0), most);
}

__device__ inline int low(unsigned word) { return word & 0xffff; }
__device__ inline int high(unsigned word) { return word >> 16; }

// One view's part of the image that a tile needs, brought into shared memory.
struct Tile {
  int bright[kSpanY][kBrightX];   // luma of the pixels, column x at x + kReach + 1; edges repeat
  unsigned luma[kSpanY][kSpanX];  // of the pixels, and half way to the next in the high 16 bits; 0 outside
  uint8_t open[kSpanY][kSpanX];   // bit 0: the pixel is static; bit 1: so is the one right of it
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
                              int left, int top, int thread) {
  bool all = true;
  for (int i = thread; i < kSpanY * kSpanX; i += kColumns * kRows) {
    const int j = i / kSpanX, column = i % kSpanX, x = left + column - kReach, y = top + j - kReach;
    unsigned found = 0;
    int open = 0;
    if (x >= 0 && x < width && y >= 0 && y < height) {
      const int* b = tile.bright[j] + column;
      found = b[1] | static_cast<unsigned>(half_way(b[0], b[1], b[2], b[3], 65535)) << 16;
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

// B, G, R of a pixel, and of the sample half way between b and c.
__device__ inline unsigned colour_of(const uint8_t* at) { return at[0] | at[1] << 8 | at[2] << 16; }
__device__ inline unsigned colour_between(const uint8_t* a, const uint8_t* b, const uint8_t* c,
                                          const uint8_t* d) {
  unsigned found = 0;
#pragma unroll
  for (int i = 0; i < 3; ++i) found |= static_cast<unsigned>(half_way(a[i], b[i], c[i], d[i], 255)) << 8 * i;
  return found;
}

// colour uint8 [K, H, W, 3], is_static uint8 [K, H, W]; luma int32 [3] of B, G, R in 256ths.
// samples [K, 2, H, W, 2], valid [K, 2, H, W]: matching.h. Blocks 32 x 8: tiles of the image, z is the
// camera.
extern "C" __global__ void __launch_bounds__(kColumns* kRows)
    census(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ is_static, int height, int width,
           const int32_t* __restrict__ luma, uint32_t* __restrict__ samples, uint32_t* __restrict__ valid) {
  __shared__ Tile tile;
  const int thread = threadIdx.y * kColumns + threadIdx.x, k = blockIdx.z;
  const int left = blockIdx.x * kColumns, top = blockIdx.y * kRows;
  const size_t pixels = static_cast<size_t>(height) * width;
  colour += 3 * k * pixels;
  load(tile, colour, height, width, left, top, luma, thread);
  __syncthreads();
  const bool open = sample(tile, is_static + k * pixels, height, width, left, top, thread);
  const bool all_open = __syncthreads_and(open);

  const int x = left + threadIdx.x, y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  const int column = threadIdx.x + kReach, row = threadIdx.y + kReach;
  const unsigned mid = tile.luma[row][column];
  unsigned darker_here = 0, darker_between = 0;
  // from the last neighbour to the first: the sign of every difference is shifted in from the right
  for_each_neighbour([&](int dy, int dx) {
    const unsigned a = tile.luma[row + dy][column + dx];
    darker_here = __funnelshift_l(low(a) - low(mid), darker_here, 1);
    darker_between = __funnelshift_l(high(a) - high(mid), darker_between, 1);
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
  const auto flags = [](bool is_static, unsigned known) {
    return is_static ? (known == kAllNeighbours ? kStatic | kClear : kStatic) : 0;
  };
  const uint8_t* line = colour + 3 * static_cast<size_t>(y) * width;
  const uint8_t *a = line + 3 * max(x - 1, 0), *b = line + 3 * x, *c = line + 3 * min(x + 1, width - 1),
                *d = line + 3 * min(x + 2, width - 1);
  uint2* to = reinterpret_cast<uint2*>(samples) + 2 * k * pixels + at;
  uint32_t* known = valid + 2 * k * pixels + at;
  to[0] = make_uint2(darker_here, colour_of(b) | flags(own & 1, whole));
  to[pixels] = make_uint2(darker_between, colour_between(a, b, c, d) | flags(own & 2, between));
  known[0] = own & 1 ? whole : 0;
  known[pixels] = own & 2 ? between : 0;
}
