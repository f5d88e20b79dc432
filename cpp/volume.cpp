// Stage "volume" of the many-view method: matching costs of one view over all pairs of static rays.
//
// Blocks of 64 columns are matched candidate by candidate: at one candidate a block of a camera is read with one
// constant shift, so that everything vectorises; a tile of candidates is then transposed into [x][d].
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kMaxPairs = 64;
typedef uint64_t Word __attribute__((may_alias, aligned(1)));

// Where a block of one camera is read at one candidate. `planes` points at the block's first column in plane 0.
struct Block {
  const uint8_t* planes;  // null: no ray of this block exists
  int phase;
  bool clear;  // every neighbour of every sample is static
};

// Bits of a ^ b (& valid), counted per byte column over the 8 planes of the census.
template <bool kMasked>
inline __attribute__((always_inline)) void count_bits(const uint8_t* a, const uint8_t* b, const uint8_t* va,
                                                      const uint8_t* vb, size_t stride, uint8_t* differing,
                                                      uint8_t* valid) {
  const auto nibbles = [](uint64_t t) {
    t -= (t >> 1) & 0x5555555555555555ull;
    return (t & 0x3333333333333333ull) + ((t >> 2) & 0x3333333333333333ull);
  };
  const auto fold = [](uint64_t t) { return (t & 0x0f0f0f0f0f0f0f0full) + ((t >> 4) & 0x0f0f0f0f0f0f0f0full); };
  Word* out = reinterpret_cast<Word*>(differing);
  Word* out_valid = reinterpret_cast<Word*>(valid);
  for (int w = 0; w < kBlock / 8; ++w) {
    const auto at = [w, stride](const uint8_t* from, int plane) {
      return static_cast<uint64_t>(*reinterpret_cast<const Word*>(from + plane * stride + 8 * w));
    };
    const auto both = [&](int p) { return at(va, p) & at(vb, p); };
    const auto bits = [&](int p) {
      const uint64_t t = at(a, p) ^ at(b, p);
      return nibbles(kMasked ? t & both(p) : t);
    };
    out[w] = fold(bits(0) + bits(1)) + fold(bits(2) + bits(3)) + fold(bits(4) + bits(5)) + fold(bits(6) + bits(7));
    if (kMasked)
      out_valid[w] = fold(nibbles(both(0)) + nibbles(both(1))) + fold(nibbles(both(2)) + nibbles(both(3))) +
                     fold(nibbles(both(4)) + nibbles(both(5))) + fold(nibbles(both(6)) + nibbles(both(7)));
  }
}

inline __attribute__((always_inline)) uint8_t apart(uint8_t p, uint8_t q) {
  return static_cast<uint8_t>(p > q ? p - q : q - p);
}

// Colour part of the cost in 256ths, and what rounds it.
inline __attribute__((always_inline)) void colour_costs(const uint8_t* a, const uint8_t* b, size_t stride,
                                                        const PairCostParams& params, uint16_t* __restrict out) {
  const uint16_t limit = static_cast<uint16_t>(params.colour_limit), weight = static_cast<uint16_t>(params.colour_weight),
                 cap = static_cast<uint16_t>(params.colour_cap);
  const uint8_t *a1 = a + stride, *a2 = a1 + stride, *b1 = b + stride, *b2 = b1 + stride;
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t sum = static_cast<uint16_t>(apart(a[x], b[x]) + apart(a1[x], b1[x]) + apart(a2[x], b2[x]));
    const uint16_t cut = sum < limit ? sum : limit;
    const uint16_t cost = static_cast<uint16_t>(cut * weight);
    out[x] = static_cast<uint16_t>((cost < cap ? cost : cap) + 128);
  }
}

// Cost of one pair of rays for a block: reference_multiview.pair_cost.
SEEPAST_CLONES
void pair_block(const Block& a, const Block& b, size_t stride, const PairCostParams& params, uint8_t* __restrict out) {
  uint8_t differing[kBlock], valid[kBlock], both[kBlock];
  uint16_t cost[kBlock], scale[kBlock];
  colour_costs(a.planes + plane_colour(a.phase) * stride, b.planes + plane_colour(b.phase) * stride, stride, params,
               cost);
  const uint8_t *ca = a.planes + plane_census(a.phase) * stride, *cb = b.planes + plane_census(b.phase) * stride;
  if (a.clear && b.clear) {
    count_bits<false>(ca, cb, nullptr, nullptr, stride, differing, valid);
    const uint16_t all = params.census_scale[62];
    for (int x = 0; x < kBlock; ++x)
      out[x] = static_cast<uint8_t>(static_cast<uint16_t>(differing[x] * all + cost[x]) >> 8);
    return;
  }
  count_bits<true>(ca, cb, a.planes + plane_valid(a.phase) * stride, b.planes + plane_valid(b.phase) * stride, stride,
                   differing, valid);
  const uint8_t *sa = a.planes + plane_static(a.phase) * stride, *sb = b.planes + plane_static(b.phase) * stride;
  for (int x = 0; x < kBlock; ++x) both[x] = sa[x] & sb[x];
  for (int x = 0; x < kBlock; ++x) scale[x] = params.census_scale[valid[x]];
  const uint16_t few = static_cast<uint16_t>(params.few);
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t part = static_cast<uint16_t>(differing[x] * scale[x] + (scale[x] ? 0 : few));
    const uint8_t sum = static_cast<uint8_t>(static_cast<uint16_t>(part + cost[x]) >> 8);
    out[x] = both[x] ? sum : kNoPair;
  }
}

// Mean of the smaller half of `count` rows of costs, kNoPair where none exists. Reorders the rows.
SEEPAST_CLONES
void smaller_half(uint8_t (*rows)[kBlock], int count, uint8_t* __restrict out) {
  uint8_t half[kBlock];
  for (int x = 0; x < kBlock; ++x) half[x] = 0;
  for (int p = 0; p < count; ++p)
    for (int x = 0; x < kBlock; ++x) half[x] = static_cast<uint8_t>(half[x] + (rows[p][x] != kNoPair));
  for (int x = 0; x < kBlock; ++x) half[x] = static_cast<uint8_t>((half[x] + 1) >> 1);
  uint16_t sum[kBlock], reciprocal[kBlock];
  for (int x = 0; x < kBlock; ++x) sum[x] = half[x] >> 1, reciprocal[x] = 0;
  for (int q = 0; q < (count + 1) / 2; ++q) {
    for (int p = count - 1; p > q; --p) {  // the smallest of the rest rises to q
      uint8_t *a = rows[p - 1], *b = rows[p];
      for (int x = 0; x < kBlock; ++x) {
        const uint8_t p = a[x], q2 = b[x];
        a[x] = p < q2 ? p : q2;
        b[x] = p < q2 ? q2 : p;
      }
    }
    const uint16_t share = static_cast<uint16_t>(65535 / (q + 1) + 1);  // ceil(65536 / half); 0 stands for 1
    for (int x = 0; x < kBlock; ++x) {
      const bool counts = half[x] > q;
      sum[x] = static_cast<uint16_t>(sum[x] + (counts ? rows[q][x] : 0));
      reciprocal[x] = counts ? share : reciprocal[x];
    }
  }
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t mean = static_cast<uint16_t>(static_cast<uint32_t>(sum[x]) * reciprocal[x] >> 16);
    const uint16_t cost = half[x] == 1 ? sum[x] : mean;
    out[x] = half[x] ? static_cast<uint8_t>(cost) : kNoPair;
  }
}

// One row of the volume.
struct RowMatcher {
  RowMatcher(const Array& array, const FeatureRows& features, int view, const Grid& grid, const int32_t* with_own,
             int with_own_count, const int32_t* others, int others_count, const PairCostParams& params)
      : array(array),
        features(features),
        view(view),
        grid(grid),
        pairs{with_own, others},
        pair_counts{with_own_count, others_count},
        params(params) {
    for (int i = 0; i < grid.count; ++i)
      for (int k = 0; k < array.cameras; ++k) shifts.push_back(array.shift(k, grid.value(i)));
    tile.resize(static_cast<size_t>(grid.count) * kBlock);
  }

  void match_row(int y, uint8_t* out) {
    for (int from = 0; from < array.width; from += kBlock) {
      const int to = std::min(from + kBlock, array.width);
      const uint8_t* own = features.row(view, array.height, y) + plane_static(0) * features.stride + kBlock + from;
      int seen = 0;
      for (int x = 0; x < to - from; ++x) seen += own[x];
      for (int i = 0; i < grid.count; ++i) match_block(y, from, to, i, own, seen, tile.data() + i * kBlock);
      transpose(tile.data(), kBlock, grid.count, to - from, out + static_cast<size_t>(from) * grid.count, grid.count);
    }
  }

  // Candidate i for columns [from, to), runs of one shift at a time.
  void match_block(int y, int from, int to, int i, const uint8_t* own, int seen, uint8_t* out) {
    const RayShift* shift = shifts.data() + static_cast<size_t>(i) * array.cameras;
    for (int first = from; first < to;) {
      int last = to;
      for (int k = 0; k < array.cameras; ++k) {
        const auto offset_at = [&](int x) { return quarter_offset(ray_dx(shift[k], x, array.cx)); };
        int end = last;
        const int offset = offset_at(first);
        if (offset_at(last - 1) != offset) {
          int same = first;
          while (end - same > 1) {
            const int middle = same + (end - same) / 2;
            (offset_at(middle) == offset ? same : end) = middle;
          }
        }
        last = end;
        blocks[k] = block_of(k, y + whole_offset(ray_dy(shift[k], y, array.cy)), from, offset);
      }
      if (first == from && last == to) {
        costs(own, seen, to - from, out);
      } else {
        uint8_t part[kBlock];
        costs(own, seen, to - from, part);
        std::memcpy(out + (first - from), part + (first - from), last - first);
      }
      first = last;
    }
  }

  Block block_of(int k, int row, int from, int quarter) const {
    const int start = from + (quarter >> 2) + kBlock, phase = quarter & 3;
    if (row < 0 || row >= array.height || start < 0 || start > features.stride - kBlock) return {nullptr, 0, false};
    const int32_t* unclear = features.unclear_row(k, array.height, row, phase);
    return {features.row(k, array.height, row) + start, phase, unclear[start + kBlock] == unclear[start]};
  }

  void costs(const uint8_t* own, int seen, int count, uint8_t* out) {
    if (seen) mean_of_pairs(0, out);
    if (seen < count) {
      uint8_t theirs[kBlock];
      mean_of_pairs(1, seen ? theirs : out);
      if (seen)
        for (int x = 0; x < kBlock; ++x) out[x] = own[x] ? out[x] : theirs[x];
    }
    uint8_t any[kBlock] = {};
    for (int k = 0; k < array.cameras; ++k) {
      if (!blocks[k].planes) continue;
      const uint8_t* is_static = blocks[k].planes + static_cast<size_t>(plane_static(blocks[k].phase)) * features.stride;
      for (int x = 0; x < kBlock; ++x) any[x] |= is_static[x];
    }
    const uint8_t lone = static_cast<uint8_t>(params.lone), unseen = static_cast<uint8_t>(params.unseen);
    for (int x = 0; x < kBlock; ++x) out[x] = out[x] != kNoPair ? out[x] : (any[x] ? lone : unseen);
  }

  void mean_of_pairs(int kind, uint8_t* out) {
    int count = 0;
    for (int p = 0; p < pair_counts[kind]; ++p) {
      const Block &a = blocks[pairs[kind][2 * p]], &b = blocks[pairs[kind][2 * p + 1]];
      if (!a.planes || !b.planes) continue;
      pair_block(a, b, features.stride, params, rows[count++]);
    }
    smaller_half(rows, count, out);
  }

  const Array& array;
  const FeatureRows& features;
  int view;
  const Grid& grid;
  const int32_t* pairs[2];
  int pair_counts[2];
  const PairCostParams& params;
  std::vector<RayShift> shifts;  // [candidate][camera]
  std::vector<uint8_t> tile;     // [candidate][kBlock]
  Block blocks[kMaxCameras];
  uint8_t rows[kMaxPairs][kBlock];
};

// The 8 x 8 bytes in `rows`, one row per word, transposed in place (Hacker's Delight, section 7-3).
inline __attribute__((always_inline)) void transpose_8x8(uint64_t* rows) {
  const auto exchange = [](uint64_t& a, uint64_t& b, int shift, uint64_t mask) {
    const uint64_t t = ((a >> shift) ^ b) & mask;
    b ^= t;
    a ^= t << shift;
  };
  for (int i = 0; i < 4; ++i) exchange(rows[i], rows[i + 4], 32, 0x00000000ffffffffull);
  for (int i : {0, 1, 4, 5}) exchange(rows[i], rows[i + 2], 16, 0x0000ffff0000ffffull);
  for (int i : {0, 2, 4, 6}) exchange(rows[i], rows[i + 1], 8, 0x00ff00ff00ff00ffull);
}

}  // namespace

SEEPAST_CLONES
void transpose(const uint8_t* rows, int row_stride, int count, int width, uint8_t* out, size_t out_stride) {
  for (int i = 0; i < count; i += 8)
    for (int x = 0; x < width; x += 8) {
      if (i + 8 > count || x + 8 > width) {
        for (int a = x; a < std::min(width, x + 8); ++a)
          for (int b = i; b < std::min(count, i + 8); ++b) out[a * out_stride + b] = rows[b * row_stride + a];
        continue;
      }
      uint64_t word[8];
      for (int b = 0; b < 8; ++b) std::memcpy(word + b, rows + (i + b) * row_stride + x, 8);
      transpose_8x8(word);
      for (int a = 0; a < 8; ++a) std::memcpy(out + (x + a) * out_stride + i, word + a, 8);
    }
}

void volume(const Array& array, const FeatureRows& features, int view, const Grid& grid, const int32_t* with_own,
            int with_own_count, const int32_t* others, int others_count, const PairCostParams& params, uint8_t* out) {
#pragma omp parallel
  {
    RowMatcher matcher(array, features, view, grid, with_own, with_own_count, others, others_count, params);
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < array.height; ++y)
      matcher.match_row(y, out + static_cast<size_t>(y) * array.width * grid.count);
  }
}

}  // namespace seepast
