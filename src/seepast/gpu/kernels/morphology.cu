// Masks dilated by rectangles: of rows as words of bits, which shift.
#include "device.h"

constexpr int kTile = 32, kWarps = 8;
constexpr int kMostReach = 16;  // what a word of 64 columns leaves on either side of a tile

// Bits of columns left - 16 .. left + 47 of a row; with `invert`, of the pixels that are 0. Outside: never.
static __device__ uint64_t row_bits(const uint8_t* row, int left, int width, bool invert) {
  unsigned half[2];
  for (int h = 0; h < 2; ++h) {
    const int x = left - kMostReach + kTile * h + threadIdx.x;
    half[h] = __ballot_sync(0xffffffffu, x >= 0 && x < width && (row[x] != 0) != invert);
  }
  return static_cast<uint64_t>(half[1]) << 32 | half[0];
}

// Bit j: any of the bits j + 16 - reach .. j + 16 + reach.
static __device__ unsigned dilated(uint64_t bits, int reach) {
  const int span = 2 * reach + 1;
  bits >>= kMostReach - reach;
  int have = 1;
  for (; 2 * have <= span; have *= 2) bits |= bits >> have;
  return static_cast<unsigned>(bits | bits >> (span - have));
}

// out[k, y, x] = any of in[k, y - down .. y + down, x - across .. x + across], both <= 16. With `invert` both
// masks are taken inverted, which makes it the erosion; what is outside never counts. Blocks of 32 x 8
// threads, tiles of 32 x 32 pixels of view blockIdx.z.
extern "C" __global__ void __launch_bounds__(kTile* kWarps)
    grow(const uint8_t* __restrict__ in, int height, int width, int across, int down, int invert,
         uint8_t* __restrict__ out) {
  __shared__ unsigned rows[kTile + 2 * kMostReach];
  const int left = blockIdx.x * kTile, top = blockIdx.y * kTile;
  const size_t view = static_cast<size_t>(blockIdx.z) * height * width;
  for (int j = threadIdx.y; j < kTile + 2 * down; j += kWarps) {
    const int y = top + j - down;
    unsigned bits = 0;
    if (y >= 0 && y < height)
      bits = dilated(row_bits(in + view + static_cast<size_t>(y) * width, left, width, invert != 0), across);
    if (threadIdx.x == 0) rows[j] = bits;
  }
  __syncthreads();
  const int x = left + threadIdx.x;
  for (int j = threadIdx.y; j < kTile && top + j < height; j += kWarps) {
    unsigned bits = 0;
    for (int i = 0; i <= 2 * down; ++i) bits |= rows[j + i];
    if (x < width)
      out[view + static_cast<size_t>(top + j) * width + x] =
          static_cast<uint8_t>((bits >> threadIdx.x & 1) ^ invert);
  }
}
