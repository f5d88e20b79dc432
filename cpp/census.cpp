// Stage "describe" of the many-view method: cubic samples at half pixels, their census and which of it is
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

template <int n>
struct Ones {
  constexpr Ones() { std::fill_n(list, n, uint8_t{1}); }
  uint8_t list[n]{};
};

// Takes BGR apart, and luma in 16 bits.
SEEPAST_CLONES
void split_row(const uint8_t* __restrict pixels, int width, const int32_t* luma, uint8_t* __restrict b,
               uint8_t* __restrict g, uint8_t* __restrict r, uint16_t* __restrict bright) {
  const uint16_t lb = static_cast<uint16_t>(luma[0]), lg = static_cast<uint16_t>(luma[1]),
                 lr = static_cast<uint16_t>(luma[2]);
  for (int x = 0; x < width; ++x) {
    const uint8_t pb = pixels[3 * x], pg = pixels[3 * x + 1], pr = pixels[3 * x + 2];
    b[x] = pb, g[x] = pg, r[x] = pr;
    bright[x] = static_cast<uint16_t>(lb * pb + lg * pg + lr * pr);
  }
}

// The entries beside a row of luma or colours are as those at its ends.
template <class T>
void extend_edges(T* row, int width) {
  row[-1] = row[0];
  row[width] = row[width + 1] = row[width - 1];
}

// Cubic samples half way to the next pixel (Keys 1981, A = -1/2).
SEEPAST_CLONES
void half_way(const uint8_t* __restrict in, int width, uint8_t* __restrict out) {
  for (int x = 0; x < width; ++x) {
    const int16_t sum = static_cast<int16_t>(9 * (in[x] + in[x + 1]) - (in[x - 1] + in[x + 2]) + 8);
    const int16_t sample = static_cast<int16_t>(sum >> 4), low = sample > 0 ? sample : int16_t{0};
    out[x] = static_cast<uint8_t>(low < 255 ? low : int16_t{255});
  }
}

SEEPAST_CLONES
void half_way(const uint16_t* __restrict in, int width, uint16_t* __restrict out) {
  for (int x = 0; x < width; ++x) {
    const int sample = (9 * (in[x] + in[x + 1]) - (in[x - 1] + in[x + 2]) + 8) >> 4;
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

// Bit i of out is flags[i] & 1.
inline void pack_bits(const uint8_t* flags, int count, uint8_t* out) {
  for (int x = 0; x < count; x += 8) {
    uint64_t eight;
    std::memcpy(&eight, flags + x, 8);
    out[x / 8] = static_cast<uint8_t>((eight & 0x0101010101010101ull) * 0x0102040810204080ull >> 56);
  }
}

// Clears the valid bits of what is not static itself. `valid` are three planes of a block and the static one.
// unclear: 1 where a valid bit lacks.
SEEPAST_CLONES
void find_unclear(uint8_t* valid, int stride, uint8_t* __restrict unclear) {
  uint8_t *v0 = valid, *v1 = v0 + stride, *v2 = v1 + stride;
  const uint8_t* is_static = v2 + stride;
  for (int x = 0; x < kBlock; ++x) {
    const uint8_t all = static_cast<uint8_t>(-is_static[x]);
    v0[x] &= all, v1[x] &= all, v2[x] &= all;
    unclear[x] = (v0[x] & v1[x] & v2[x]) == 255 ? 0 : 1;
  }
}

}  // namespace

Describer::Describer(const DescribedView& view, FeatureRing& ring, int camera)
    : view(view),
      ring(ring),
      camera(camera),
      line((view.width + kBlock - 1) / kBlock * kBlock + 2 * kMargin),
      luma(static_cast<size_t>(kRows) * kPhases * line),
      is_static(static_cast<size_t>(kRows) * kPhases * line),
      full(static_cast<size_t>(kRows) * kPhases * (line / kBlock)) {}

void Describer::describe(int from, int to) {
  // too far on, or back to what was not made, or is not there any more since others were sampled in its place
  if (from > next + kReach || from < begun || from + ring.slots < sampled) {
    begun = next = from;
    sampled = from - kReach;
  }
  for (; next < to; ++next) {
    for (; sampled <= next + kReach; ++sampled) sample(sampled);
    for (int phase = 0; phase < kPhases; ++phase) {
      census_row(next, phase);
      valid_row(next, phase);
    }
  }
}

uint16_t* Describer::luma_row(int y, int phase) {
  return luma.data() + (static_cast<size_t>(y & (kRows - 1)) * kPhases + phase) * line + kMargin;
}

uint8_t* Describer::static_row(int y, int phase) {
  return is_static.data() + (static_cast<size_t>(y & (kRows - 1)) * kPhases + phase) * line + kMargin;
}

uint8_t* Describer::full_row(int y, int phase) {
  return full.data() + (static_cast<size_t>(y & (kRows - 1)) * kPhases + phase) * (line / kBlock);
}

void Describer::sample(int y) {
  const int width = view.width;
  if (y < 0 || y >= view.height) {
    for (int phase = 0; phase < kPhases; ++phase) {
      std::fill_n(luma_row(y, phase), width, uint16_t{0});
      std::fill_n(static_row(y, phase), width, uint8_t{0});
      std::fill_n(full_row(y, phase), line / kBlock, uint8_t{0});
    }
    return;
  }
  uint8_t *const blue = plane(y, plane_colour(0)), *const green = blue + ring.stride,
                 *const red = green + ring.stride;
  uint16_t* const bright = luma_row(y, 0);
  split_row(view.colour + static_cast<size_t>(y) * width * 3, width, view.luma, blue, green, red, bright);
  extend_edges(bright, width);  // outside the image luma and colours may be anything
  half_way(bright, width, luma_row(y, 1));
  for (uint8_t* channel : {blue, green, red}) {
    extend_edges(channel, width);
    half_way(channel, width, channel + kPlanesOfPhase * static_cast<size_t>(ring.stride));
  }
  const uint8_t* here = view.is_static + static_cast<size_t>(y) * width;
  uint8_t *whole = static_row(y, 0), *between = static_row(y, 1);
  for (int x = 0; x < width; ++x) whole[x] = here[x];
  for (int x = 0; x + 1 < width; ++x) between[x] = here[x] & here[x + 1];
  between[width - 1] = 0;
  constexpr Ones<kBlock + 2 * kReach> ones;
  for (int phase = 0; phase < kPhases; ++phase)
    for (int from = 0; from < width; from += kBlock)
      full_row(y, phase)[from / kBlock] =
          !std::memcmp(static_row(y, phase) + from - kReach, ones.list, sizeof(ones.list));
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

// Which neighbours are static, at whole (phase 0) or half positions.
void Describer::valid_row(int y, int phase) {
  for (int from = 0; from < view.width; from += kBlock)
    if (clear_block(y, phase, from / kBlock)) {
      for (int byte = 0; byte < kBytes; ++byte)
        std::memset(plane(y, plane_valid(phase) + byte) + from, 255, kBlock);
      std::memset(plane(y, plane_static(phase)) + from, 1, kBlock);
      std::memset(bits(y, phase, from) + bits_unclear(ring.stride), 0, kBlock / 8);
      std::memset(bits(y, phase, from) + bits_seen(ring.stride), 255, kBlock / 8);
    } else {
      valid_block(y, phase, from);
    }
}

// Everything that its census looks at is static.
bool Describer::clear_block(int y, int phase, int block) {
  for (int dy = -kReach; dy <= kReach; ++dy)
    if (!full_row(y + dy, phase)[block]) return false;
  return true;
}

void Describer::valid_block(int y, int phase, int from) {
  const int width = std::min(kBlock, view.width - from);
  uint8_t* const valid = plane(y, plane_valid(phase)) + from;
  for (int byte = 0; byte < kBytes; ++byte) {
    const uint8_t* around[8];
    for (int i = 0; i < 8; ++i) {
      const auto [dy, dx] = kAround.list[8 * byte + i];
      around[i] = static_row(y + dy, phase) + from + dx;
    }
    gather_bits(around, width, valid + byte * ring.stride);
  }
  uint8_t* const is_static = plane(y, plane_static(phase)) + from;
  std::memcpy(is_static, static_row(y, phase) + from, width);
  pack_bits(is_static, kBlock, bits(y, phase, from) + bits_seen(ring.stride));
  uint8_t unclear[kBlock];
  find_unclear(valid, ring.stride, unclear);
  pack_bits(unclear, kBlock, bits(y, phase, from) + bits_unclear(ring.stride));
}

uint8_t* Describer::plane(int y, int number) const {
  return ring.row(camera, y) + static_cast<size_t>(number) * ring.stride + kBlock;
}

// Those of the columns from `from` on, which is a multiple of 8, in the first of a row's two kinds of bits
// but for the bytes before it.
uint8_t* Describer::bits(int y, int phase, int from) const {
  return ring.row(camera, y) + phase * bit_stride(ring.stride) + (kBlock + from) / 8;
}

}  // namespace seepast
