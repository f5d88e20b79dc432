// Stage "describe" of the many-view method: cubic samples at quarter pixels, their census and which of it is
// static, row by row.
#include "census.h"

#include <algorithm>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace seepast {
namespace {

constexpr int kReach = Describer::kReach, kNeighbours = 8 * kBytes;
constexpr int kMargin = 16;  // empty columns on either side of a row of luma

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

#if defined(SEEPAST_V4)
// The same, 64 columns at a time: up to 63 more are read, and written.
__attribute__((target("avx512bw"))) void compare_row_of_64(const uint16_t* mid, const uint16_t* const* around,
                                                           int width, uint8_t* out) {
  for (int x = 0; x < width; x += 64) {
    const __m512i low = _mm512_loadu_si512(mid + x), high = _mm512_loadu_si512(mid + x + 32);
    __m512i bits = _mm512_setzero_si512();
    for (int i = 0; i < 8; ++i) {
      const __mmask32 first = _mm512_cmplt_epu16_mask(_mm512_loadu_si512(around[i] + x), low);
      const __mmask32 second = _mm512_cmplt_epu16_mask(_mm512_loadu_si512(around[i] + x + 32), high);
      bits = _mm512_mask_add_epi8(bits, _mm512_kunpackd(second, first), bits,
                                  _mm512_set1_epi8(static_cast<char>(1 << i)));
    }
    _mm512_storeu_si512(out + x, bits);
  }
}
#endif

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

}  // namespace

Describer::Describer(const DescribedView& view, FeatureRing& ring, int camera)
    : view(view),
      ring(ring),
      camera(camera),
      line((view.width + kBlock - 1) / kBlock * kBlock + 2 * kMargin),
      luma(static_cast<size_t>(kRows) * 4 * line),
      is_static(static_cast<size_t>(kRows) * 2 * line),
      channels(3 * static_cast<size_t>(view.width + 3)),
      bright(view.width + 3),
      flags(ring.stride) {}

void Describer::describe(int from, int to) {
  if (from > next + kReach ||
      from + ring.slots < next) {  // too far on, or back: what lies between is not made
    next = from;
    sampled = from - kReach;
  }
  for (; next < to; ++next) {
    for (; sampled <= next + kReach; ++sampled) sample(sampled);
    for (int phase = 0; phase < 4; ++phase) census_row(next, phase);
    for (int phase = 0; phase < 2; ++phase) valid_row(next, phase);
  }
}

uint16_t* Describer::luma_row(int y, int phase) {
  return luma.data() + (static_cast<size_t>(y & (kRows - 1)) * 4 + phase) * line + kMargin;
}

uint8_t* Describer::static_row(int y, int phase) {
  return is_static.data() + (static_cast<size_t>(y & (kRows - 1)) * 2 + phase) * line + kMargin;
}

void Describer::sample(int y) {
  const int width = view.width;
  if (y < 0 || y >= view.height) {
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
  for (int c = 0; c < 3; ++c) {
    extend_edges(lines[c], width);
    for (int phase = 0; phase < 4; ++phase)
      sample_row(lines[c], width, view.cubic + 4 * phase, plane(y, plane_colour(phase) + c));
  }
  const uint8_t* here = view.is_static + static_cast<size_t>(y) * width;
  uint8_t *whole = static_row(y, 0), *between = static_row(y, 1);
  for (int x = 0; x < width; ++x) whole[x] = here[x];
  for (int x = 0; x + 1 < width; ++x) between[x] = here[x] & here[x + 1];
  between[width - 1] = 0;
}

void Describer::census_row(int y, int phase) {
  const uint16_t* mid = luma_row(y, phase);
  for (int byte = 0; byte < kBytes; ++byte) {
    const uint16_t* around[8];
    for (int i = 0; i < 8; ++i) {
      const auto [dy, dx] = kAround.list[8 * byte + i];
      around[i] = luma_row(y + dy, phase) + dx;
    }
    uint8_t* const to = plane(y, plane_census(phase) + byte);
#if defined(SEEPAST_V4)
    if (wide) {
      compare_row_of_64(mid, around, view.width, to);
      continue;
    }
#endif
    compare_row(mid, around, view.width, to);
  }
}

// Which neighbours are static, at whole (phase 0) or fractional positions.
void Describer::valid_row(int y, int phase) {
  uint8_t* planes = plane(y, plane_valid(phase)) - kBlock;
  std::memset(planes, 0, (kBytes + 1) * static_cast<size_t>(ring.stride));
  for (int byte = 0; byte < kBytes; ++byte) {
    const uint8_t* around[8];
    for (int i = 0; i < 8; ++i) {
      const auto [dy, dx] = kAround.list[8 * byte + i];
      around[i] = static_row(y + dy, phase) + dx;
    }
    gather_bits(around, view.width, plane(y, plane_valid(phase) + byte));
  }
  std::memcpy(plane(y, plane_static(phase)), static_row(y, phase), view.width);
  mark_unclear(planes, ring.stride, flags.data(), ring.row(camera, y).unclear + phase * ring.words);
}

uint8_t* Describer::plane(int y, int number) const {
  return ring.row(camera, y).planes + static_cast<size_t>(number) * ring.stride + kBlock;
}

}  // namespace seepast
