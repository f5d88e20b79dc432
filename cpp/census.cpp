// Stage "describe" of the many-view method: cubic samples at quarter pixels, their census and which of it is
// static. Bands of rows are worked on one by one, so that what a band needs stays in the cache.
#include <algorithm>
#include <cstring>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kReach = 3, kNeighbours = 8 * kBytes;
constexpr int kBandRows = 32;
constexpr int kMargin = 16;  // empty columns on either side of a band's rows

// The neighbours as offsets (dy, dx), in the order of many.py REACH.
struct Neighbour {
  int dy, dx;
};
struct Neighbourhood {
  constexpr Neighbourhood() {
    int at = 0;
    for (int dy = -kReach; dy <= kReach; ++dy)
      for (int dx = -kReach; dx <= kReach; ++dx)
        if ((dy + dx) % 2 == 0 && (dy || dx)) list[at++] = {dy, dx};
  }
  Neighbour list[kNeighbours]{};
};
constexpr Neighbourhood kAround;

// Takes BGR apart, less 128, and luma in 16 bits.
SEEPAST_CLONES
void split_row(const uint8_t* __restrict pixels, int width, const int32_t* luma, int16_t* __restrict b,
               int16_t* __restrict g, int16_t* __restrict r, int32_t* __restrict bright) {
  const int lb = luma[0], lg = luma[1], lr = luma[2];
  for (int x = 0; x < width; ++x) {
    const int pb = pixels[3 * x], pg = pixels[3 * x + 1], pr = pixels[3 * x + 2];
    b[x] = static_cast<int16_t>(pb - 128);
    g[x] = static_cast<int16_t>(pg - 128);
    r[x] = static_cast<int16_t>(pr - 128);
    bright[x] = lb * pb + lg * pg + lr * pr;
  }
}

template <class T>
void extend_edges(T* padded, int width) {
  padded[0] = padded[1];
  padded[width + 1] = padded[width + 2] = padded[width];
}

// Cubic samples of one channel. Less 128, the weighted sum is below 152 * 128 and fits 16 bits.
SEEPAST_CLONES
void sample_row(const int16_t* __restrict in, int width, const int32_t* weights, uint8_t* __restrict out) {
  const int16_t w0 = static_cast<int16_t>(weights[0]), w1 = static_cast<int16_t>(weights[1]),
                w2 = static_cast<int16_t>(weights[2]), w3 = static_cast<int16_t>(weights[3]);
  for (int x = 0; x < width; ++x) {
    const int16_t sum =
        static_cast<int16_t>(w0 * in[x] + w1 * in[x + 1] + w2 * in[x + 2] + w3 * in[x + 3] + 64);
    const int16_t sample = static_cast<int16_t>(sum >> 7);
    const int16_t low = sample > -128 ? sample : int16_t{-128};
    const int16_t cut = low < 127 ? low : int16_t{127};
    out[x] = static_cast<uint8_t>(cut + 128);
  }
}

SEEPAST_CLONES
void sample_luma(const int32_t* __restrict in, int width, const int32_t* weights, uint16_t* __restrict out) {
  const int w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3];
  for (int x = 0; x < width; ++x) {
    const int sample = (w0 * in[x] + w1 * in[x + 1] + w2 * in[x + 2] + w3 * in[x + 3] + 64) >> 7;
    out[x] = static_cast<uint16_t>(std::clamp(sample, 0, 65535));
  }
}

// Eight comparisons of a row with rows around it: bit i of out[x] is around[i][x] < mid[x].
SEEPAST_CLONES
void compare_row(const uint16_t* __restrict mid, const uint16_t* const* around, int width,
                 uint8_t* __restrict out) {
  const uint16_t *a0 = around[0], *a1 = around[1], *a2 = around[2], *a3 = around[3], *a4 = around[4],
                 *a5 = around[5], *a6 = around[6], *a7 = around[7];
  for (int x = 0; x < width; ++x) {
    const uint16_t m = mid[x];
    const auto bit = [m](uint16_t a, int i) { return static_cast<uint16_t>(a < m ? 1 << i : 0); };
    out[x] = static_cast<uint8_t>(bit(a0[x], 0) | bit(a1[x], 1) | bit(a2[x], 2) | bit(a3[x], 3) |
                                  bit(a4[x], 4) | bit(a5[x], 5) | bit(a6[x], 6) | bit(a7[x], 7));
  }
}

// Bit i of out[x] is around[i][x], which is 0 or 1.
SEEPAST_CLONES
void gather_bits(const uint8_t* const* around, int width, uint8_t* __restrict out) {
  const uint8_t *a0 = around[0], *a1 = around[1], *a2 = around[2], *a3 = around[3], *a4 = around[4],
                *a5 = around[5], *a6 = around[6], *a7 = around[7];
  const auto twice = [](uint8_t v, uint8_t bit) { return static_cast<uint8_t>(v + v + bit); };
  for (int x = 0; x < width; ++x) {
    const uint8_t high = twice(twice(twice(a7[x], a6[x]), a5[x]), a4[x]);
    out[x] = twice(twice(twice(twice(high, a3[x]), a2[x]), a1[x]), a0[x]);
  }
}

// Bit per column that is not static or has a neighbour that is not; `valid` are three planes and the static
// one.
SEEPAST_CLONES
void mark_unclear(const uint8_t* valid, int stride, uint8_t* __restrict flags, uint64_t* __restrict out) {
  const uint8_t *v0 = valid, *v1 = v0 + stride, *v2 = v1 + stride, *is_static = v2 + stride;
  for (int x = 0; x < stride; ++x)
    flags[x] = (v0[x] & v1[x] & v2[x] & static_cast<uint8_t>(-is_static[x])) == 255 ? 0 : 1;
  for (int x = 0; x < stride; x += 64) {
    uint64_t bits = 0;
    for (int i = 0; i < 8; ++i) {
      uint64_t eight;
      std::memcpy(&eight, flags + x + 8 * i, 8);
      bits |= (eight * 0x0102040810204080ull >> 56) << (8 * i);
    }
    out[x / 64] = bits;
  }
  out[stride / 64] = ~uint64_t{0};
}

struct View {
  const Array& array;
  const uint8_t* colour;
  const uint8_t* is_static;
  const int32_t *cubic, *luma;
  int stride;
  uint8_t* planes;
  uint64_t* unclear;

  uint8_t* plane(int y, int number) const {
    return planes + (static_cast<size_t>(y) * kPlanes + number) * stride + kBlock;
  }
};

// Luma and static flags of the rows of a band and kReach rows around it, and what makes features of them.
class Band {
 public:
  Band(int width, int stride)
      : line(width + 2 * kMargin),
        luma(static_cast<size_t>(kRows) * 4 * line),
        is_static(static_cast<size_t>(kRows) * 2 * line),
        channels(3 * static_cast<size_t>(width + 3)),
        bright(width + 3),
        flags(stride) {}

  void describe(const View& view, int from, int to) {
    first = from - kReach;
    for (int y = first; y < to + kReach; ++y) sample(view, y, y >= from && y < to);
    for (int y = from; y < to; ++y) {
      for (int phase = 0; phase < 4; ++phase) census_row(view, y, phase);
      for (int phase = 0; phase < 2; ++phase) valid_row(view, y, phase);
    }
  }

 private:
  static constexpr int kRows = kBandRows + 2 * kReach;
  uint16_t* luma_row(int y, int phase) {
    return luma.data() + (static_cast<size_t>(y - first) * 4 + phase) * line + kMargin;
  }
  uint8_t* static_row(int y, int phase) {
    return is_static.data() + (static_cast<size_t>(y - first) * 2 + phase) * line + kMargin;
  }

  // Row y of the band; its colours only if they are `wanted`.
  void sample(const View& view, int y, bool wanted) {
    const int width = view.array.width;
    if (y < 0 || y >= view.array.height) {
      for (int phase = 0; phase < 4; ++phase) std::fill_n(luma_row(y, phase), width, uint16_t{0});
      for (int phase = 0; phase < 2; ++phase) std::fill_n(static_row(y, phase), width, uint8_t{0});
      return;
    }
    int16_t* lines[3] = {channels.data(), channels.data() + width + 3, channels.data() + 2 * (width + 3)};
    split_row(view.colour + static_cast<size_t>(y) * width * 3, width, view.luma, lines[0] + 1, lines[1] + 1,
              lines[2] + 1, bright.data() + 1);
    extend_edges(bright.data(), width);
    for (int phase = 0; phase < 4; ++phase)
      sample_luma(bright.data(), width, view.cubic + 4 * phase, luma_row(y, phase));
    for (int c = 0; wanted && c < 3; ++c) {
      extend_edges(lines[c], width);
      for (int phase = 0; phase < 4; ++phase)
        sample_row(lines[c], width, view.cubic + 4 * phase, view.plane(y, plane_colour(phase) + c));
    }
    const uint8_t* here = view.is_static + static_cast<size_t>(y) * width;
    uint8_t *whole = static_row(y, 0), *between = static_row(y, 1);
    for (int x = 0; x < width; ++x) whole[x] = here[x];
    for (int x = 0; x + 1 < width; ++x) between[x] = here[x] & here[x + 1];
    between[width - 1] = 0;
  }

  void census_row(const View& view, int y, int phase) {
    const uint16_t* mid = luma_row(y, phase);
    for (int byte = 0; byte < kBytes; ++byte) {
      const uint16_t* around[8];
      for (int i = 0; i < 8; ++i) {
        const auto [dy, dx] = kAround.list[8 * byte + i];
        around[i] = luma_row(y + dy, phase) + dx;
      }
      compare_row(mid, around, view.array.width, view.plane(y, plane_census(phase) + byte));
    }
  }

  // Which neighbours are static, at whole (phase 0) or fractional positions.
  void valid_row(const View& view, int y, int phase) {
    const int width = view.array.width;
    uint8_t* planes = view.plane(y, plane_valid(phase)) - kBlock;
    std::memset(planes, 0, (kBytes + 1) * static_cast<size_t>(view.stride));
    for (int byte = 0; byte < kBytes; ++byte) {
      const uint8_t* around[8];
      for (int i = 0; i < 8; ++i) {
        const auto [dy, dx] = kAround.list[8 * byte + i];
        around[i] = static_row(y + dy, phase) + dx;
      }
      gather_bits(around, width, view.plane(y, plane_valid(phase) + byte));
    }
    std::memcpy(view.plane(y, plane_static(phase)), static_row(y, phase), width);
    mark_unclear(planes, view.stride, flags.data(),
                 view.unclear + (static_cast<size_t>(y) * 2 + phase) * (view.stride / 64 + 1));
  }

  size_t line;
  int first = 0;
  std::vector<uint16_t> luma;
  std::vector<uint8_t> is_static;
  std::vector<int16_t> channels;
  std::vector<int32_t> bright;
  std::vector<uint8_t> flags;
};

}  // namespace

void census(const Array& array, const uint8_t* colour, const uint8_t* is_static, const int32_t* cubic,
            const int32_t* luma, int stride, uint8_t* planes, uint64_t* unclear) {
  const int bands = (array.height + kBandRows - 1) / kBandRows;
#pragma omp parallel
  {
    Band band(array.width, stride);
#pragma omp for schedule(dynamic, 1)
    for (int task = 0; task < array.cameras * bands; ++task) {
      const int k = task / bands, from = task % bands * kBandRows;
      const size_t rows = static_cast<size_t>(k) * array.height;
      const View view{
          array,  colour + k * array.pixels() * 3,  is_static + k * array.pixels(),        cubic, luma,
          stride, planes + rows * kPlanes * stride, unclear + rows * 2 * (stride / 64 + 1)};
      band.describe(view, from, std::min(from + kBandRows, array.height));
    }
  }
}

}  // namespace seepast
