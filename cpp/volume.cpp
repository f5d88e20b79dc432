// Stage "volume" of the many-view method. Runs block by block of columns and candidate by candidate, not
// pixel by pixel: at one candidate a block of a camera is read with one constant shift, so that everything
// vectorises, in bytes; the costs of a chunk of candidates are then transposed into [x][d] for the pixels
// that want them.
#include <algorithm>
#include <cstring>
#include <vector>

#include "multiview.h"

// What a loop over a block writes never overlaps what it reads of others; unsaid, compilers test or give up.
#if defined(__GNUC__) && !defined(__clang__)
#define SEEPAST_APART _Pragma("GCC ivdep")
#else
#define SEEPAST_APART
#endif

namespace seepast {
namespace {

constexpr int kMaxPairs = 64;
constexpr int kScales = 32;  // entries of census_scale
#if defined(__x86_64__)
constexpr int kTable = 64;  // bytes that one instruction permutes, where bits are counted in one
#else
constexpr int kTable = 16;
#endif

// Where a block of one camera is read at one candidate.
struct Block {
  const uint8_t* at;     // its census planes and colours; null: no ray of this block exists
  const uint8_t* valid;  // its valid planes and static flags
  size_t stride;         // from plane to plane
  bool clear;            // every neighbour of every sample is static
  bool operator==(const Block& other) const { return at == other.at; }
};

// table[index[x]] of kScales entries, by permutations of vectors (the loop would be a gather).
template <class Vector>
inline __attribute__((always_inline)) void look_up(const uint8_t* table, const uint8_t* index, uint8_t* out) {
#if defined(__clang__)
  for (int x = 0; x < kBlock; ++x) out[x] = table[index[x]];
#else
  Vector low, high{}, i;
  std::memcpy(&low, table, sizeof(low) < kScales ? sizeof(low) : size_t{kScales});
  if (sizeof(low) < kScales) std::memcpy(&high, table + sizeof(low), kScales - sizeof(low));
  for (int x = 0; x < kBlock; x += static_cast<int>(sizeof(i))) {
    std::memcpy(&i, index + x, sizeof(i));
    const Vector found = sizeof(low) < kScales ? __builtin_shuffle(low, high, i) : __builtin_shuffle(low, i);
    std::memcpy(out + x, &found, sizeof(found));
  }
#endif
}

// How to count the bits of bytes: most machines by sums of neighbouring bits ...
struct SumBits {
  using Table = Sixteen;
  static inline __attribute__((always_inline)) uint8_t nibbles(uint8_t v) {
    const uint8_t pairs = static_cast<uint8_t>(v - ((v >> 1) & 0x55));
    return static_cast<uint8_t>((pairs & 0x33) + ((pairs >> 2) & 0x33));
  }
  static inline __attribute__((always_inline)) uint8_t of(uint8_t a, uint8_t b, uint8_t c) {
    const uint8_t sum = static_cast<uint8_t>(nibbles(a) + nibbles(b) + nibbles(c));
    return static_cast<uint8_t>((sum & 15) + (sum >> 4));
  }
};
// ... and some in one instruction.
struct CountBits {
  using Table = uint8_t __attribute__((vector_size(kTable)));
  static inline __attribute__((always_inline)) uint8_t one(uint8_t v) {
    return static_cast<uint8_t>(__builtin_popcount(v));
  }
  static inline __attribute__((always_inline)) uint8_t of(uint8_t a, uint8_t b, uint8_t c) {
    return static_cast<uint8_t>(one(a) + one(b) + one(c));
  }
};

inline __attribute__((always_inline)) uint8_t apart(uint8_t p, uint8_t q) {
  return static_cast<uint8_t>((p > q ? p : q) - (p > q ? q : p));
}

inline __attribute__((always_inline)) uint8_t mean(uint8_t p, uint8_t q) {  // rounded up
  return static_cast<uint8_t>((p + q + 1) >> 1);
}

// Cost of one pair of rays for a block: reference_multiview.pair_cost.
template <class Bits>
inline __attribute__((always_inline)) void match_pair(const Block& a, const Block& b,
                                                      const PairCostParams& params, uint8_t* __restrict out) {
  const uint8_t *a0 = a.at, *a1 = a0 + a.stride, *a2 = a1 + a.stride, *ab = a2 + a.stride,
                *ag = ab + a.stride, *ar = ag + a.stride;
  const uint8_t *b0 = b.at, *b1 = b0 + b.stride, *b2 = b1 + b.stride, *bb = b2 + b.stride,
                *bg = bb + b.stride, *br = bg + b.stride;
  const uint8_t cap = params.colour_cap;
  const auto colour = [&](int x) {
    const uint8_t step = mean(mean(apart(ab[x], bb[x]), apart(ar[x], br[x])), apart(ag[x], bg[x]));
    return step < cap ? step : cap;
  };
  if (a.clear && b.clear) {
    SEEPAST_APART
    for (int x = 0; x < kBlock; ++x) {
      const uint8_t differing = Bits::of(a0[x] ^ b0[x], a1[x] ^ b1[x], a2[x] ^ b2[x]);
      out[x] = static_cast<uint8_t>(4 * differing + colour(x));
    }
    return;
  }
  const uint8_t *v0 = a.valid, *v1 = v0 + a.stride, *v2 = v1 + a.stride, *sa = v2 + a.stride;
  const uint8_t *w0 = b.valid, *w1 = w0 + b.stride, *w2 = w1 + b.stride, *sb = w2 + b.stride;
  uint8_t differing[kBlock], known[kBlock], scale[kBlock];
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    const uint8_t k0 = v0[x] & w0[x], k1 = v1[x] & w1[x], k2 = v2[x] & w2[x];
    known[x] = Bits::of(k0, k1, k2);
    differing[x] = Bits::of((a0[x] ^ b0[x]) & k0, (a1[x] ^ b1[x]) & k1, (a2[x] ^ b2[x]) & k2);
  }
  look_up<typename Bits::Table>(params.census_scale, known, scale);
  const uint8_t few = params.few;
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t product = static_cast<uint16_t>(differing[x] * scale[x] + 4);
    const uint8_t census = scale[x] ? static_cast<uint8_t>(product >> 3) : few;
    const uint8_t sum = static_cast<uint8_t>(census + colour(x));
    out[x] = sa[x] & sb[x] ? sum : kNoPair;
  }
}

inline __attribute__((always_inline)) void order(uint8_t& a, uint8_t& b) {
  const uint8_t low = a < b ? a : b, high = a < b ? b : a;
  a = low, b = high;
}

// Mean of the smaller half of up to four costs, kNoPair where none exists: two costs or one.
inline void smaller_half_of_4(const uint8_t* const* rows, uint8_t* __restrict out) {
  const uint8_t *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3];
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    uint8_t a = r0[x], b = r1[x], c = r2[x], d = r3[x];
    order(a, b), order(c, d), order(a, c), order(b, d), order(b, c);
    out[x] = c != kNoPair ? mean(a, b) : a;
  }
}

// The same of up to six: three costs, two or one.
inline void smaller_half_of_6(const uint8_t* const* rows, uint8_t* __restrict out) {
  const uint8_t *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4], *r5 = rows[5];
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    uint8_t a = r0[x], b = r1[x], c = r2[x], d = r3[x], e = r4[x], f = r5[x];
    order(a, f), order(b, d), order(c, e);  // the shortest network that sorts six
    order(b, c), order(d, e);
    order(a, d), order(c, f);
    order(a, b), order(c, d), order(e, f);
    order(b, c), order(d, e);
    const uint16_t sum = static_cast<uint16_t>(a + b + c + 1);
    const uint8_t third = static_cast<uint8_t>(static_cast<uint32_t>(sum) * 21846 >> 16);
    const uint8_t two = c != kNoPair ? mean(a, b) : a;
    out[x] = e != kNoPair ? third : two;
  }
}

// The same of any number. Reorders the rows.
inline void smaller_half_of_many(uint8_t (*rows)[kBlock], int count, uint8_t* __restrict out) {
  uint8_t half[kBlock];
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) half[x] = 0;
  for (int p = 0; p < count; ++p) SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) half[x] = static_cast<uint8_t>(half[x] + (rows[p][x] != kNoPair));
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) half[x] = static_cast<uint8_t>((half[x] + 1) >> 1);
  uint16_t sum[kBlock], reciprocal[kBlock];
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) sum[x] = half[x] >> 1, reciprocal[x] = 0;
  for (int q = 0; q < (count + 1) / 2; ++q) {
    for (int p = count - 1; p > q; --p) {  // the smallest of the rest rises to q
      uint8_t *a = rows[p - 1], *b = rows[p];
      SEEPAST_APART
      for (int x = 0; x < kBlock; ++x) {
        const uint8_t p = a[x], q2 = b[x];
        a[x] = p < q2 ? p : q2;
        b[x] = p < q2 ? q2 : p;
      }
    }
    const uint16_t share = static_cast<uint16_t>(65535 / (q + 1) + 1);  // ceil(65536 / half); 0 stands for 1
    SEEPAST_APART
    for (int x = 0; x < kBlock; ++x) {
      const bool counts = half[x] > q;
      sum[x] = static_cast<uint16_t>(sum[x] + (counts ? rows[q][x] : 0));
      reciprocal[x] = counts ? share : reciprocal[x];
    }
  }
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t mean = static_cast<uint16_t>(static_cast<uint32_t>(sum[x]) * reciprocal[x] >> 16);
    const uint16_t cost = half[x] == 1 ? sum[x] : mean;
    out[x] = half[x] ? static_cast<uint8_t>(cost) : kNoPair;
  }
}

// Puts what the view does not see itself into a block of costs.
inline void put_theirs(const uint8_t* __restrict own, const uint8_t* __restrict theirs,
                       uint8_t* __restrict out) {
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) out[x] = own[x] ? out[x] : theirs[x];
}

// Puts what no pair sees.
inline void put_pairless(const uint8_t* __restrict any, uint8_t lone, uint8_t unseen,
                         uint8_t* __restrict out) {
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) {
    const uint8_t without = any[x] ? lone : unseen;
    out[x] = out[x] != kNoPair ? out[x] : without;
  }
}

inline void add_static(const uint8_t* __restrict is_static, uint8_t* __restrict any) {
  SEEPAST_APART
  for (int x = 0; x < kBlock; ++x) any[x] |= is_static[x];
}

// Whole rows that a ray of every camera lands on at every candidate, for row y.
inline void rows_at(int y, float cy, const float* zoom, const float* shift, const float* view, int count,
                    int32_t* __restrict out) {
  for (int i = 0; i < count; ++i)
    out[i] = y + whole_offset(ray_dy(RayShift{zoom[i], 0, shift[i], 0, view[i]}, y, cy));
}

// Where a camera is read for a block of columns: which column of the padded row, the phase in its low bits.
struct Place {
  int32_t quarter;
  int column() const { return quarter >> 2; }
  int phase() const { return quarter & 3; }
};
constexpr Place kNowhere{-1};

// Columns [from, to) of a block that are read with the same shifts at a candidate.
struct Run {
  int from, to, candidate;
};

// Where the columns of every camera are read at every candidate: the same for all rows.
struct Columns {
  Columns(const Array& array, const Grid& grid, int stride)
      : cameras(array.cameras),
        count(grid.count),
        stride(stride),
        blocks((array.width + kBlock - 1) / kBlock),
        runs(blocks),
        places(blocks),
        starts(blocks) {
    for (int i = 0; i < count; ++i)
      for (int k = 0; k < cameras; ++k) {
        const RayShift shift = array.shift(k, grid.value(i));
        shifts.push_back(shift);
        zoom.push_back(shift.zoom), down.push_back(shift.y), view.push_back(shift.view_y);
      }
#pragma omp parallel for schedule(static)
    for (int b = 0; b < blocks; ++b) fill(array, b);
  }

  void fill(const Array& array, int b) {
    const int from = b * kBlock, to = std::min(from + kBlock, array.width);
    for (int i = 0; i < count; ++i) {
      starts[b].push_back(static_cast<int32_t>(runs[b].size()));
      for (int first = from; first < to;) {
        int last = to;
        for (int k = 0; k < cameras; ++k)
          places[b].push_back(
              place_of(array, shifts[static_cast<size_t>(i) * cameras + k], from, first, last));
        runs[b].push_back({first - from, last - from, i});
        first = last;
      }
    }
    starts[b].push_back(static_cast<int32_t>(runs[b].size()));
  }

  // Where the block that starts at `from` is read for column `first`; cuts `last` to the columns that have
  // its shift.
  Place place_of(const Array& array, const RayShift& shift, int from, int first, int& last) const {
    int quarter = 0, end = last;
    for_each_run(
        first, last, [&](int x) { return quarter_offset(ray_dx(shift, x, array.cx)); },
        [&](int run, int to, int found) {
          if (run == first) end = to, quarter = found;
        });
    last = end;
    const Place place{quarter + 4 * (from + kBlock)};
    return place.quarter >= 0 && place.column() <= stride - kBlock ? place : kNowhere;
  }

  int cameras, count, stride, blocks;
  std::vector<RayShift> shifts;  // [candidate][camera]
  std::vector<float> zoom, down, view;
  std::vector<std::vector<Run>> runs;        // [block][run]
  std::vector<std::vector<Place>> places;    // [block][run * cameras + camera]
  std::vector<std::vector<int32_t>> starts;  // [block][candidate]: its first run
};

struct Pairs {
  const int32_t* cameras;  // [count, 2]
  int count;
};

// A row of a camera; null outside the image.
struct Row {
  const uint8_t* planes;
  const uint64_t* unclear;
};

// One row of the volume.
template <class Bits>
struct RowMatcher {
  RowMatcher(const Array& array, const FeatureRows& features, int view, const Columns& columns,
             const Chunks& chunks, const Pairs& with_own, const Pairs& others, const PairCostParams& params)
      : array(array),
        features(features),
        view(view),
        columns(columns),
        chunks(chunks),
        pairs{with_own, others},
        params(params),
        landed(columns.zoom.size()),
        rows(columns.zoom.size()) {
    std::memset(nothing, kNoPair, sizeof(nothing));
  }

  void match_row(int y, uint8_t* out) {
    find_rows(y);
    for (int b = 0; b < columns.blocks; ++b) {
      const int from = b * kBlock;
      width = std::min(kBlock, array.width - from);
      look_at_own(y, from);
      const size_t first = static_cast<size_t>(y) * array.width + from;
      match_block(b, chunks.active + first, chunks.start + first, out);
    }
  }

  void find_rows(int y) {
    rows_at(y, array.cy, columns.zoom.data(), columns.down.data(), columns.view.data(),
            static_cast<int>(landed.size()), landed.data());
    for (size_t i = 0; i < landed.size(); ++i)
      rows[i] = row_of(static_cast<int>(i % array.cameras), landed[i]);
  }

  Row row_of(int k, int y) const {
    if (y < 0 || y >= array.height) return {nullptr, nullptr};
    return {features.row(k, array.height, y), features.unclear_row(k, array.height, y, 0)};
  }

  // Copies the view's own block, which all candidates share.
  void look_at_own(int y, int from) {
    const Block block = block_of(row_of(view, y), {4 * (from + kBlock)});
    for (int i = 0; i < 2 * kBytes; ++i) std::memcpy(own_planes[i], block.at + i * block.stride, kBlock);
    for (int i = 0; i <= kBytes; ++i)
      std::memcpy(own_planes[2 * kBytes + i], block.valid + i * block.stride, kBlock);
    own = {own_planes[0], own_planes[2 * kBytes], kBlock, block.clear};
    own_static = own_planes[3 * kBytes];
    seen = 0;
    for (int x = 0; x < width; ++x) seen += own_static[x];
  }

  // The chunks that some pixel of a block wants, from the farthest on.
  void match_block(int b, const uint64_t* active, const int32_t* start, uint8_t* out) {
    int32_t next[kBlock];
    uint64_t wanted[kBlock / kChunk] = {}, any = 0;
    for (int x = 0; x < width; ++x) next[x] = start[x], wanted[x / kChunk] |= active[x];
    for (uint64_t group : wanted) any |= group;
    for (; any; any &= any - 1) {
      const int chunk = __builtin_ctzll(any);
      match_chunk(b, chunk);
      for (int x = 0; x < width; x += kChunk) {
        if (!(wanted[x / kChunk] >> chunk & 1)) continue;
        Sixteen turned[kChunk];
        transpose_16x16(tile[0] + x, kBlock, turned);
        for (int i = 0; i < std::min(kChunk, width - x); ++i)
          if (active[x + i] >> chunk & 1)
            std::memcpy(out + kChunk * static_cast<size_t>(next[x + i]++), turned + i, kChunk);
      }
    }
  }

  // The candidates of a chunk for one block into `tile`, up to kItems runs at a time.
  void match_chunk(int b, int chunk) {
    const int32_t* starts = columns.starts[b].data() + kChunk * chunk;
    for (int r = starts[0]; r < starts[kChunk]; r += items) {
      items = std::min(kItems, starts[kChunk] - r);
      const Run* run = columns.runs[b].data() + r;
      const Place* place = columns.places[b].data() + static_cast<size_t>(r) * array.cameras;
      for (int i = 0; i < items; ++i, place += array.cameras) {
        const Row* row = rows.data() + static_cast<size_t>(run[i].candidate) * array.cameras;
        for (int k = 0; k < array.cameras; ++k) blocks[k][i] = k == view ? own : block_of(row[k], place[k]);
      }
      match_items();
      for (int i = 0; i < items; ++i) {
        uint8_t* to = tile[run[i].candidate % kChunk];
        if (run[i].to - run[i].from == width)
          std::memcpy(to, costs[i], kBlock);
        else
          std::memcpy(to + run[i].from, costs[i] + run[i].from, run[i].to - run[i].from);
      }
    }
  }

  Block block_of(const Row& row, Place place) const {
    const size_t stride = features.stride;
    if (!row.planes || place.quarter < 0) return {nullptr, nullptr, stride, false};
    const int column = place.column(), phase = place.phase(), skip = column % 64;
    const uint8_t* at = row.planes + column;
    const uint64_t* unclear = row.unclear + (phase ? stride / 64 + 1 : 0) + column / 64;
    const bool clear = !(unclear[0] >> skip | unclear[1] << 1 << (63 - skip));
    return {at + plane_census(phase) * stride, at + plane_valid(phase) * stride, stride, clear};
  }

  // All items: `blocks` to `costs`.
  void match_items() {
    uint32_t sure = 0;                         // bit per item in which some pair has a cost in every column
    if (seen) sure = mean_of_pairs(0, costs);  // then the whole block is the view's own
    if (seen < width) {
      sure = mean_of_pairs(1, seen ? theirs : costs);
      for (int i = 0; seen && i < items; ++i) put_theirs(own_static, theirs[i], costs[i]);
    }
    for (int i = 0; i < items; ++i) {
      if (sure >> i & 1) continue;
      uint8_t any[kBlock] = {};
      for (int k = 0; k < array.cameras; ++k)
        if (blocks[k][i].at) add_static(blocks[k][i].valid + kBytes * blocks[k][i].stride, any);
      put_pairless(any, params.lone, params.unseen, costs[i]);
    }
  }

  uint32_t mean_of_pairs(int kind, uint8_t (*out)[kBlock]) {
    uint32_t sure = 0;
    const int count = pairs[kind].count;
    for (int p = 0; p < count; ++p)
      sure |=
          match_pairs(blocks[pairs[kind].cameras[2 * p]], blocks[pairs[kind].cameras[2 * p + 1]], found[p]);
    for (int i = 0; i < items; ++i) smaller_half(count, i, out[i]);
    return sure;
  }

  // One pair of cameras at all items; returns the items that have a cost in every column.
  uint32_t match_pairs(const Block* a, const Block* b, uint8_t (*out)[kBlock]) {
    uint32_t sure = 0;
    for (int i = 0; i < items; ++i) {
      if (!a[i].at || !b[i].at)
        std::memset(out[i], kNoPair, kBlock);
      else if (i && a[i] == a[i - 1] && b[i] == b[i - 1])  // near cameras move less than a quarter pixel
        std::memcpy(out[i], out[i - 1], kBlock);
      else
        match_pair<Bits>(a[i], b[i], params, out[i]);
      sure |= static_cast<uint32_t>(a[i].clear && b[i].clear) << i;
    }
    return sure;
  }

  void smaller_half(int count, int item, uint8_t* out) {
    const uint8_t* rows_of[6];
    for (int p = 0; p < std::min(count, 6); ++p) rows_of[p] = found[p][item];
    for (int p = count; p < 6; ++p) rows_of[p] = nothing;
    if (count <= 1) {
      std::memcpy(out, rows_of[0], kBlock);
    } else if (count <= 4) {
      smaller_half_of_4(rows_of, out);
    } else if (count <= 6) {
      smaller_half_of_6(rows_of, out);
    } else {
      for (int p = 0; p < count; ++p) std::memcpy(sorted[p], found[p][item], kBlock);
      smaller_half_of_many(sorted, count, out);
    }
  }

  const Array& array;
  const FeatureRows& features;
  int view;
  const Columns& columns;
  const Chunks& chunks;
  const Pairs pairs[2];
  const PairCostParams& params;
  std::vector<int32_t> landed;  // [candidate][camera]: where the row that is being matched lands
  std::vector<Row> rows;
  Block own;  // of the view: its planes, which are copied, and its static flags; how many of those are set
  const uint8_t* own_static;
  int seen, width, items;
  static constexpr int kItems = kChunk;
  Block blocks[kMaxCameras][kItems];
  alignas(64) uint8_t own_planes[3 * kBytes + 1][kBlock];
  alignas(64) uint8_t found[kMaxPairs][kItems][kBlock];  // costs of every pair
  alignas(64) uint8_t costs[kItems][kBlock], theirs[kItems][kBlock], tile[kChunk][kBlock];
  alignas(64) uint8_t sorted[kMaxPairs][kBlock];
  alignas(64) uint8_t nothing[kBlock];
};

// Everything that a row calls becomes part of it, and is compiled for what the row is.
#if defined(__aarch64__)
using Bits = CountBits;
#else
using Bits = SumBits;
#endif
SEEPAST_CLONES
__attribute__((flatten)) void match_row_anywhere(RowMatcher<Bits>& matcher, int y, uint8_t* out) {
  matcher.match_row(y, out);
}

#if defined(SEEPAST_V4_BYTES)
// Simd::avx512_bytes, which target_clones cannot name.
__attribute__((flatten, target("arch=x86-64-v4,avx512bitalg,avx512vbmi"))) void match_row_counting(
    RowMatcher<CountBits>& matcher, int y, uint8_t* out) {
  matcher.match_row(y, out);
}
#endif

template <class Matcher, class MatchRow>
void match_rows(Matcher matcher_of, int height, MatchRow match_row, uint8_t* out) {
#pragma omp parallel
  {
    auto matcher = matcher_of();
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < height; ++y) match_row(matcher, y, out);
  }
}

}  // namespace

SEEPAST_CLONES
void chunk_starts(const uint64_t* active, size_t pixels, int32_t* start) {
  int32_t before = 0;
  for (size_t p = 0; p < pixels; ++p) {
    start[p] = before;
    before += __builtin_popcountll(active[p]);
  }
  start[pixels] = before;
}

void volume(const Array& array, const FeatureRows& features, int view, const Grid& grid, const Chunks& chunks,
            const int32_t* with_own, int with_own_count, const int32_t* others, int others_count,
            const PairCostParams& params, uint8_t* out) {
  const Columns columns(array, grid, features.stride);
  const Pairs own_pairs{with_own, with_own_count}, other_pairs{others, others_count};
  const auto match = [&](auto bits, auto match_row) {
    const auto matcher = [&] {
      return RowMatcher<decltype(bits)>(array, features, view, columns, chunks, own_pairs, other_pairs,
                                        params);
    };
    match_rows(matcher, array.height, match_row, out);
  };
#if defined(SEEPAST_V4_BYTES)
  if (simd() == Simd::avx512_bytes) return match(CountBits(), match_row_counting);
#endif
  match(Bits(), match_row_anywhere);
}

}  // namespace seepast
