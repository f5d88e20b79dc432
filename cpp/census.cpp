// Stage "describe" of the many-view method: cubic samples at quarter pixels, their census and which of it is
// static.
#include <algorithm>
#include <cstring>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kReachX = 4, kReachY = 3;
constexpr uint64_t kAllValid = (uint64_t{1} << 62) - 1;  // there are 62 neighbours

// Four samples wide interpolation of one interleaved row; `value` in 128ths, luma in 16 bits.
SEEPAST_CLONES
void sample_row(const int16_t* __restrict padded, int width, size_t channel_stride, const int32_t* weights,
                const int32_t* luma, uint8_t* __restrict out, size_t out_stride,
                uint16_t* __restrict out_luma) {
  const int w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3];
  const int16_t *b = padded, *g = b + channel_stride, *r = g + channel_stride;
  uint8_t *ob = out, *og = ob + out_stride, *orr = og + out_stride;
  for (int x = 0; x < width; ++x) {
    const int vb = w0 * b[x] + w1 * b[x + 1] + w2 * b[x + 2] + w3 * b[x + 3];
    const int vg = w0 * g[x] + w1 * g[x + 1] + w2 * g[x + 2] + w3 * g[x + 3];
    const int vr = w0 * r[x] + w1 * r[x + 1] + w2 * r[x + 2] + w3 * r[x + 3];
    const auto byte = [](int v) { return static_cast<uint8_t>(std::clamp((v + 64) >> 7, 0, 255)); };
    ob[x] = byte(vb);
    og[x] = byte(vg);
    orr[x] = byte(vr);
    const int bright = (luma[0] * vb + luma[1] * vg + luma[2] * vr + 64) >> 7;
    out_luma[x] = static_cast<uint16_t>(std::clamp(bright, 0, 65535));
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

SEEPAST_CLONES
void gather_bits(const uint8_t* const* around, int width, uint8_t* __restrict out) {
  const uint8_t *a0 = around[0], *a1 = around[1], *a2 = around[2], *a3 = around[3], *a4 = around[4],
                *a5 = around[5], *a6 = around[6], *a7 = around[7];
  for (int x = 0; x < width; ++x)
    out[x] = static_cast<uint8_t>(a0[x] | a1[x] << 1 | a2[x] << 2 | a3[x] << 3 | a4[x] << 4 | a5[x] << 5 |
                                  a6[x] << 6 | a7[x] << 7);
}

// The neighbours as offsets (dy, dx), in the order of many.py REACH.
struct Neighbour {
  int dy, dx;
};
struct Reach {
  Reach() {
    int at = 0;
    for (int dy = -kReachY; dy <= kReachY; ++dy)
      for (int dx = -kReachX; dx <= kReachX; ++dx)
        if (dy || dx) list[at++] = {dy, dx};
    count = at;
  }
  Neighbour list[64];
  int count;
};

struct View {
  const Array& array;
  const uint8_t* colour;
  const uint8_t* is_static;
  int stride;
  uint8_t* planes;
  int32_t* unclear;

  uint8_t* row(int y) const { return planes + static_cast<size_t>(y) * kPlanes * stride; }
};

// Colours and static flags of row y at the four phases; luma of phase p at luma + p * luma_stride.
void samples(const View& view, int y, const int32_t* cubic, const int32_t* luma_weights, int16_t* padded,
             uint16_t* luma, size_t luma_stride) {
  const int width = view.array.width;
  const uint8_t* pixels = view.colour + static_cast<size_t>(y) * width * 3;
  const size_t channel = width + 3;
  for (int c = 0; c < 3; ++c) {
    int16_t* line = padded + c * channel;
    for (int x = 0; x < width; ++x) line[x + 1] = pixels[3 * x + c];
    line[0] = line[1];
    line[width + 1] = line[width + 2] = line[width];
  }
  uint8_t* out = view.row(y);
  for (int phase = 0; phase < 4; ++phase)
    sample_row(padded, width, channel, cubic + 4 * phase, luma_weights,
               out + static_cast<size_t>(plane_colour(phase)) * view.stride + kBlock, view.stride,
               luma + phase * luma_stride + kBlock);
  const uint8_t* here = view.is_static + static_cast<size_t>(y) * width;
  uint8_t* whole = out + static_cast<size_t>(plane_static(0)) * view.stride + kBlock;
  uint8_t* between = out + static_cast<size_t>(plane_static(1)) * view.stride + kBlock;
  for (int x = 0; x < width; ++x) whole[x] = here[x];
  for (int x = 0; x + 1 < width; ++x) between[x] = here[x] & here[x + 1];
}

// Calls row_of(dy) for the neighbours' rows and fills the words of row y: `group` fills one byte of every
// word.
template <class Element, class RowOf, class Group>
void words_of_row(const View& view, const Element* nothing, RowOf row_of, Group group, uint8_t* bytes,
                  uint8_t* words) {
  static const Reach reach;
  const int width = view.array.width;
  for (int byte = 0; byte < kWord; ++byte) {
    const Element* around[8];
    for (int i = 0; i < 8; ++i) {
      const int n = kWord * byte + i;
      around[i] = n < reach.count ? row_of(reach.list[n].dy) + reach.list[n].dx : nothing;
    }
    group(around, bytes + static_cast<size_t>(byte) * width);
  }
  transpose(bytes, width, kWord, width, words + kBlock * kWord, kWord);
}

// Census of row y at one phase from the luma rows of that phase; `none` is an empty row, `bytes` 8 rows of
// scratch.
void census_row(const View& view, int y, int phase, const uint16_t* luma, size_t line, const uint16_t* none,
                uint8_t* bytes) {
  const auto luma_row = [&](int dy) {
    const int at = y + dy;
    return (at < 0 || at >= view.array.height ? none : luma + static_cast<size_t>(at) * 4 * line) + kBlock;
  };
  const uint16_t* mid = luma_row(0);  // is not darker than itself
  words_of_row(
      view, mid, luma_row,
      [&](const uint16_t* const* around, uint8_t* out) { compare_row(mid, around, view.array.width, out); },
      bytes, view.row(y) + static_cast<size_t>(plane_census(phase)) * view.stride);
}

// Which neighbours are static, at whole (phase 0) or fractional positions, and the count of columns that lack
// one.
void valid_row(const View& view, int y, int phase, const uint8_t* none, uint8_t* bytes) {
  const size_t stride = view.stride;
  const auto static_row = [&](int dy) {
    const int at = y + dy;
    const bool outside = at < 0 || at >= view.array.height;
    return (outside ? none : view.row(at) + plane_static(phase) * stride) + kBlock;
  };
  uint8_t* words = view.row(y) + plane_valid(phase) * stride;
  words_of_row(
      view, none + kBlock, static_row,
      [&](const uint8_t* const* around, uint8_t* out) { gather_bits(around, view.array.width, out); }, bytes,
      words);
  const uint8_t* centre = view.row(y) + plane_static(phase) * stride;
  int32_t* count = view.unclear + (static_cast<size_t>(y) * 2 + (phase ? 1 : 0)) * (stride + 1);
  count[0] = 0;
  for (size_t x = 0; x < stride; ++x) {
    uint64_t word;
    std::memcpy(&word, words + kWord * x, sizeof(word));
    count[x + 1] = count[x] + !(word == kAllValid && centre[x]);
  }
}

}  // namespace

void census(const Array& array, const uint8_t* colour, const uint8_t* is_static, const int32_t* cubic,
            const int32_t* luma_weights, int stride, uint8_t* planes, int32_t* unclear) {
  const int height = array.height;
  const size_t line = stride, row_bytes = static_cast<size_t>(kPlanes) * stride;
  std::vector<uint16_t> luma(static_cast<size_t>(height) * 4 * line), none(line);
  std::vector<uint8_t> no_static(line);
  for (int k = 0; k < array.cameras; ++k) {
    const View view{array,
                    colour + k * array.pixels() * 3,
                    is_static + k * array.pixels(),
                    stride,
                    planes + k * height * row_bytes,
                    unclear + static_cast<size_t>(k) * height * 2 * (stride + 1)};
#pragma omp parallel
    {
      std::vector<int16_t> padded(3 * static_cast<size_t>(array.width + 3));
      std::vector<uint8_t> bytes(kWord * static_cast<size_t>(array.width));
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) {
        std::memset(view.row(y), 0, row_bytes);
        samples(view, y, cubic, luma_weights, padded.data(), luma.data() + y * 4 * line, line);
      }
#pragma omp for schedule(static)
      for (int y = 0; y < height; ++y) {
        for (int phase = 0; phase < 4; ++phase)
          census_row(view, y, phase, luma.data() + phase * line, line, none.data(), bytes.data());
        for (int phase = 0; phase < 2; ++phase) valid_row(view, y, phase, no_static.data(), bytes.data());
      }
    }
  }
}

}  // namespace seepast
