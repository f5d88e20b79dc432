// Stage "volume" of the many-view method: matching costs of one view over all pairs of static rays.
//
// Blocks of 64 columns are matched candidate by candidate: at one candidate a block of a camera is read with
// one constant shift, so that everything vectorises; a tile of candidates is then transposed into [x][d].
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kMaxPairs = 64;
constexpr int kScales = 64;  // entries of census_scale, two vectors of 32
typedef uint16_t Lanes __attribute__((vector_size(64)));
// Where a block of one camera is read at one candidate.
struct Block {
  const uint8_t* row;  // null: no ray of this block exists
  int start, phase;    // column of the padded row
  bool clear;          // every neighbour of every sample is static
  const uint8_t* plane(int plane, size_t stride) const { return row + plane * stride + start; }
  const uint64_t* words(int plane, size_t stride) const {
    return reinterpret_cast<const uint64_t*>(row + plane * stride) + start;
  }
  bool operator==(const Block& other) const = default;
};

inline __attribute__((always_inline)) uint8_t apart(uint8_t p, uint8_t q) {
  return static_cast<uint8_t>(p > q ? p - q : q - p);
}

// Colour part of the cost in 256ths, and what rounds it.
inline __attribute__((always_inline)) void colour_costs(const uint8_t* a, const uint8_t* b, size_t stride,
                                                        const PairCostParams& params,
                                                        uint16_t* __restrict out) {
  const uint16_t limit = static_cast<uint16_t>(params.colour_limit),
                 weight = static_cast<uint16_t>(params.colour_weight),
                 cap = static_cast<uint16_t>(params.colour_cap);
  const uint8_t *a1 = a + stride, *a2 = a1 + stride, *b1 = b + stride, *b2 = b1 + stride;
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t sum = static_cast<uint16_t>(apart(a[x], b[x]) + apart(a1[x], b1[x]) + apart(a2[x], b2[x]));
    const uint16_t cut = sum < limit ? sum : limit;
    const uint16_t cost = static_cast<uint16_t>(cut * weight);
    out[x] = static_cast<uint16_t>((cost < cap ? cost : cap) + 128);
  }
}

// census_scale[valid[x]]: a permutation of vectors where the machine has one (the loop would be a gather).
inline __attribute__((always_inline)) void look_up(const uint16_t* table, const uint8_t* valid,
                                                   uint16_t* out) {
  Lanes low, high;
  std::memcpy(&low, table, sizeof(low));
  std::memcpy(&high, table + kScales / 2, sizeof(high));
  for (int x = 0; x < kBlock; ++x) out[x] = valid[x];
  for (int x = 0; x < kBlock; x += kScales / 2) {
    Lanes index;
    std::memcpy(&index, out + x, sizeof(index));
    const Lanes found = __builtin_shuffle(low, high, index);
    std::memcpy(out + x, &found, sizeof(found));
  }
}

// Cost of one pair of rays for a block: reference_multiview.pair_cost.
inline __attribute__((always_inline)) void match_pair(const Block& a, const Block& b, size_t stride,
                                                      const PairCostParams& params, uint8_t* __restrict out) {
  uint8_t differing[kBlock], valid[kBlock], both[kBlock];
  uint16_t cost[kBlock], scale[kBlock];
  colour_costs(a.plane(plane_colour(a.phase), stride), b.plane(plane_colour(b.phase), stride), stride, params,
               cost);
  const uint64_t *ca = a.words(plane_census(a.phase), stride), *cb = b.words(plane_census(b.phase), stride);
  if (a.clear && b.clear) {
    for (int x = 0; x < kBlock; ++x) differing[x] = static_cast<uint8_t>(__builtin_popcountll(ca[x] ^ cb[x]));
    const uint16_t all = params.census_scale[62];
    for (int x = 0; x < kBlock; ++x)
      out[x] = static_cast<uint8_t>(static_cast<uint16_t>(differing[x] * all + cost[x]) >> 8);
    return;
  }
  const uint64_t *va = a.words(plane_valid(a.phase), stride), *vb = b.words(plane_valid(b.phase), stride);
  for (int x = 0; x < kBlock; ++x) {
    const uint64_t known = va[x] & vb[x];
    valid[x] = static_cast<uint8_t>(__builtin_popcountll(known));
    differing[x] = static_cast<uint8_t>(__builtin_popcountll((ca[x] ^ cb[x]) & known));
  }
  const uint8_t *sa = a.plane(plane_static(a.phase), stride), *sb = b.plane(plane_static(b.phase), stride);
  for (int x = 0; x < kBlock; ++x) both[x] = sa[x] & sb[x];
  look_up(params.census_scale, valid, scale);
  const uint16_t few = static_cast<uint16_t>(params.few);
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t part = static_cast<uint16_t>(differing[x] * scale[x] + (scale[x] ? 0 : few));
    const uint8_t sum = static_cast<uint8_t>(static_cast<uint16_t>(part + cost[x]) >> 8);
    out[x] = both[x] ? sum : kNoPair;
  }
}

SEEPAST_CLONES
void match_pair_anywhere(const Block& a, const Block& b, size_t stride, const PairCostParams& params,
                         uint8_t* out) {
  match_pair(a, b, stride, params, out);
}

using MatchPair = void (*)(const Block&, const Block&, size_t, const PairCostParams&, uint8_t*);

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
// Machines that count the bits of eight words at once (target_clones cannot name what they are).
__attribute__((target("arch=x86-64-v4,avx512vpopcntdq"))) void match_pair_counting(
    const Block& a, const Block& b, size_t stride, const PairCostParams& params, uint8_t* out) {
  match_pair(a, b, stride, params, out);
}

MatchPair best_match_pair() {
  __builtin_cpu_init();
  const bool counts = __builtin_cpu_supports("avx512vpopcntdq") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq");
  return counts ? match_pair_counting : match_pair_anywhere;
}
#else
MatchPair best_match_pair() { return match_pair_anywhere; }
#endif

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

// Puts what the view does not see itself, and what no pair sees, into a block of costs.
SEEPAST_CLONES
void finish_block(const uint8_t* __restrict own, const uint8_t* __restrict theirs,
                  const uint8_t* __restrict any, uint8_t lone, uint8_t unseen, uint8_t* __restrict out) {
  for (int x = 0; x < kBlock; ++x) {
    const uint8_t cost = own[x] ? out[x] : theirs[x], without = any[x] ? lone : unseen;
    out[x] = cost != kNoPair ? cost : without;
  }
}

SEEPAST_CLONES
void add_static(const uint8_t* __restrict is_static, uint8_t* __restrict any) {
  for (int x = 0; x < kBlock; ++x) any[x] |= is_static[x];
}

// One row of the volume.
struct RowMatcher {
  RowMatcher(const Array& array, const FeatureRows& features, int view, const Grid& grid,
             const int32_t* with_own, int with_own_count, const int32_t* others, int others_count,
             const PairCostParams& params)
      : array(array),
        features(features),
        view(view),
        grid(grid),
        pairs{with_own, others},
        pair_counts{with_own_count, others_count},
        params(params) {
    for (int i = 0; i < grid.count; ++i)
      for (int k = 0; k < array.cameras; ++k) {
        const RayShift shift = array.shift(k, grid.value(i));
        const int left = quarter_offset(ray_dx(shift, 0, array.cx));
        const int right = quarter_offset(ray_dx(shift, array.width - 1, array.cx));
        aims.push_back({shift, left, left == right, 0});
      }
    tile.resize(static_cast<size_t>(grid.count) * kBlock);
  }

  void match_row(int y, uint8_t* out) {
    for (Aim& aim : aims) aim.row = y + whole_offset(ray_dy(aim.shift, y, array.cy));
    for (int from = 0; from < array.width; from += kBlock) {
      const int to = std::min(from + kBlock, array.width);
      const uint8_t* own =
          features.row(view, array.height, y) + plane_static(0) * features.stride + kBlock + from;
      int seen = 0;
      for (int x = 0; x < to - from; ++x) seen += own[x];
      for (int i = 0; i < grid.count; ++i) match_block(from, to, i, own, seen, tile.data() + i * kBlock);
      transpose(tile.data(), kBlock, grid.count, to - from, out + static_cast<size_t>(from) * grid.count,
                grid.count);
    }
  }

  // Candidate i for columns [from, to), runs of one shift at a time.
  void match_block(int from, int to, int i, const uint8_t* own, int seen, uint8_t* out) {
    const Aim* aim = aims.data() + static_cast<size_t>(i) * array.cameras;
    for (int first = from; first < to;) {
      int last = to;
      for (int k = 0; k < array.cameras; ++k) {
        int offset = aim[k].quarter;
        if (!aim[k].same_everywhere) last = end_of_run(aim[k].shift, first, last, offset);
        blocks[k] = block_of(k, aim[k].row, from, offset);
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

  // The end of the run of columns from `first` on that have its quarter-pixel offset, which is returned too.
  int end_of_run(const RayShift& shift, int first, int last, int& offset) const {
    int end = last;
    for_each_run(
        first, last, [&](int x) { return quarter_offset(ray_dx(shift, x, array.cx)); },
        [&](int from, int to, int found) {
          if (from == first) end = to, offset = found;
        });
    return end;
  }

  Block block_of(int k, int row, int from, int quarter) const {
    const int start = from + (quarter >> 2) + kBlock, phase = quarter & 3;
    if (row < 0 || row >= array.height || start < 0 || start > features.stride - kBlock)
      return {nullptr, 0, 0, false};
    const int32_t* unclear = features.unclear_row(k, array.height, row, phase);
    return {features.row(k, array.height, row), start, phase, unclear[start + kBlock] == unclear[start]};
  }

  void costs(const uint8_t* own, int seen, int count, uint8_t* out) {
    if (seen) mean_of_pairs(0, out);
    uint8_t theirs[kBlock], any[kBlock] = {};
    if (seen < count) mean_of_pairs(1, theirs);
    for (int k = 0; k < array.cameras; ++k)
      if (blocks[k].row) add_static(blocks[k].plane(plane_static(blocks[k].phase), features.stride), any);
    finish_block(own, theirs, any, static_cast<uint8_t>(params.lone), static_cast<uint8_t>(params.unseen),
                 out);
  }

  void mean_of_pairs(int kind, uint8_t* out) {
    int count = 0;
    for (int p = 0; p < pair_counts[kind]; ++p) {
      const Block &a = blocks[pairs[kind][2 * p]], &b = blocks[pairs[kind][2 * p + 1]];
      if (!a.row || !b.row) continue;
      Matched& pair = matched[kind][p];
      if (!(pair.a == a &&
            pair.b == b)) {  // near cameras move less than a quarter pixel from candidate to candidate
        match_pair_here(a, b, features.stride, params, pair.costs);
        pair.a = a;
        pair.b = b;
      }
      std::memcpy(rows[count++], pair.costs, kBlock);
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
  struct Aim {
    RayShift shift;
    int quarter;  // offset of column 0
    bool same_everywhere;
    int row;  // where the row that is being matched lands
  };
  std::vector<Aim> aims;      // [candidate][camera]
  std::vector<uint8_t> tile;  // [candidate][kBlock]
  const MatchPair match_pair_here = best_match_pair();
  Block blocks[kMaxCameras];
  struct Matched {
    Block a{}, b{};
    uint8_t costs[kBlock];
  };
  Matched matched[2][kMaxPairs];  // the last costs of every pair
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
void transpose(const uint8_t* rows, size_t row_stride, int count, int width, uint8_t* out,
               size_t out_stride) {
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

void volume(const Array& array, const FeatureRows& features, int view, const Grid& grid,
            const int32_t* with_own, int with_own_count, const int32_t* others, int others_count,
            const PairCostParams& params, uint8_t* out) {
#pragma omp parallel
  {
    RowMatcher matcher(array, features, view, grid, with_own, with_own_count, others, others_count, params);
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < array.height; ++y)
      matcher.match_row(y, out + static_cast<size_t>(y) * array.width * grid.count);
  }
}

}  // namespace seepast
