// Stage "volume" of the many-view method, of all views at once: while the rows that they share are in the
// cache. Runs tile by tile, of 32 columns and two rows, and candidate by candidate, not pixel by pixel: at
// one candidate a tile of a camera is read with one constant shift, so that everything vectorises, in bytes;
// the costs of a chunk of candidates are then transposed into [x][d] for the pixels that want them. Tiles are
// that small because what is asked for of a view often is in small pieces. Here is what does not depend on
// the instructions; volume_rows.h has the rest.
#include <algorithm>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include <memory>
#include <vector>

#include "census.h"
#include "multiview.h"

namespace seepast {
namespace {

constexpr int kMaxPairs = 64;
constexpr int kStrip = 8;     // rows that a thread matches one after the other
constexpr int kColumns = 32;  // of a tile
constexpr int kTileRows = kBlock / kColumns;

inline int least(int a, int b) { return a < b ? a : b; }

// Where a camera is read for a row of a tile: its planes of one phase from `at` of the row on, and the bits
// of its columns.
struct Place {
  int32_t at;
  int16_t bits;  // bytes before that of the first column
  int8_t skip;   // bits before its
  bool outside;  // the image, everywhere
};
constexpr Place kNowhere{0, 0, 0, true};

// Columns [from, to) of a tile that are read with the same shifts at a candidate.
struct Run {
  int from, to, candidate;
  uint64_t lanes() const {
    const uint64_t row = (~uint64_t{0} >> (64 - to)) & (~uint64_t{0} << from);
    return row | row << kColumns;
  }
};

// By how many halves of a pixel rays of column x land beside it, at every candidate of every camera.
SEEPAST_CLONES
void halves_at(int x, float cx, const float* __restrict zoom, const float* __restrict across,
               const float* __restrict view, int count, int32_t* __restrict out) {
  for (int i = 0; i < count; ++i)
    out[i] = half_offset(ray_dx(RayShift{zoom[i], across[i], 0, view[i], 0}, x, cx));
}

// Where the columns of every camera are read at every candidate: the same for all rows.
struct Columns {
  Columns(const Array& array, const Grid& grid)
      : cameras(array.cameras),
        count(grid.count),
        stride(feature_stride(array.width)),
        tiles((array.width + kColumns - 1) / kColumns),
        of_tiles(tiles) {
    for (int k = 0; k < cameras; ++k)
      for (int i = 0; i < count; ++i) {
        const RayShift shift = array.shift(k, grid.value(i));
        zoom.push_back(shift.zoom), across.push_back(shift.x), view_x.push_back(shift.view_x);
        down.push_back(shift.y), view_y.push_back(shift.view_y);
      }
  }

  int shifts() const { return static_cast<int>(zoom.size()); }

  // Tile t; `first` and `last` are scratch of shifts() entries.
  void fill(const Array& array, int t, std::vector<int32_t>& first, std::vector<int32_t>& last) {
    const int from = t * kColumns, to = std::min(from + kColumns, array.width);
    halves_at(from, array.cx, zoom.data(), across.data(), view_x.data(), shifts(), first.data());
    halves_at(to - 1, array.cx, zoom.data(), across.data(), view_x.data(), shifts(), last.data());
    OfTile& tile = of_tiles[t];
    tile.runs.reserve(count), tile.starts.reserve(count + 1);
    for (int i = 0; i < count; ++i) {
      tile.starts.push_back(static_cast<int32_t>(tile.runs.size()));
      for (int x = from; x < to;) {
        const int end = same_until(array, i, x, to, x == from ? first.data() : nullptr, last.data());
        tile.runs.push_back({x - from, end - from, i});
        x = end;
      }
    }
    const size_t runs = tile.runs.size();
    tile.starts.push_back(static_cast<int32_t>(runs));
    tile.places.reserve(cameras * runs), tile.at.reserve(cameras * runs);
    tile.steps.reserve(cameras * count / kChunk);
    for (int k = 0; k < cameras; ++k) {
      for (const Run& run : tile.runs) {
        const int i = k * count + run.candidate;
        const Place place = place_of(run.from ? halves(array, i, from + run.from) : first[i], from);
        tile.places.push_back(place), tile.at.push_back(place.at);
      }
      for (int i = 0; i < count; i += kChunk)
        tile.steps.push_back(steps_of(tile.places.data() + k * runs + tile.starts[i],
                                      tile.starts[i + kChunk] - tile.starts[i]));
    }
  }

  int halves(const Array& array, int i, int x) const {
    return half_offset(ray_dx(RayShift{zoom[i], across[i], 0, view_x[i], 0}, x, array.cx));
  }

  // From x on the columns, to before `to`, whose rays are moved alike in every camera at a candidate. `first`
  // and `last`: what is known of the columns x, or null, and to - 1.
  int same_until(const Array& array, int candidate, int x, int to, const int32_t* first,
                 const int32_t* last) const {
    int end = to;
    for (int k = 0; k < cameras; ++k) {
      const int i = k * count + candidate;
      if (zoom[i] == 0 || (first && first[i] == last[i])) continue;
      bool found = false;
      for_each_run(
          x, end, [&](int column) { return halves(array, i, column); },
          [&](int, int run_end, int) { end = found ? end : run_end, found = true; });
    }
    return end;
  }

  // The runs of a chunk, as bits, from which on another place is read; 0 where there is more than one per
  // candidate or one is outside.
  static uint16_t steps_of(const Place* places, int runs) {
    if (runs != kChunk) return 0;
    uint16_t steps = 1;
    for (int i = 0; i < kChunk; ++i) {
      if (places[i].outside) return 0;
      if (i && places[i].at != places[i - 1].at) steps = static_cast<uint16_t>(steps | 1 << i);
    }
    return steps;
  }

  // Where the tile that starts at `from` is read for columns whose rays are moved by as many halves.
  Place place_of(int halves, int from) const {
    const int column = (halves >> 1) + from + kBlock;
    if (column < 0 || column > stride - kColumns) return kNowhere;
    const int phase = halves & 1;
    return {plane_census(phase) * stride + column,
            static_cast<int16_t>(phase * bit_stride(stride) + column / 8), static_cast<int8_t>(column % 8),
            false};
  }

  struct OfTile {
    std::vector<Run> runs;
    std::vector<Place> places;    // [camera, run]
    std::vector<int32_t> at;      // theirs alone
    std::vector<uint16_t> steps;  // [camera, chunk]: steps_of
    std::vector<int32_t> starts;  // [candidate]: its first run
  };
  int cameras, count, stride, tiles;
  std::vector<float> zoom, across, view_x, down, view_y;  // [camera, candidate]: of RayShift
  std::vector<OfTile> of_tiles;
};

// How many rows below row y rays land at every candidate; `height` rows below or above it is outside in any
// case.
SEEPAST_CLONES
void drops_at(int y, float cy, int height, const Columns& columns, int32_t* __restrict out) {
  const float *zoom = columns.zoom.data(), *down = columns.down.data(), *view = columns.view_y.data();
  const int count = static_cast<int>(columns.zoom.size());
  for (int i = 0; i < count; ++i)
    out[i] = clamp(whole_offset(ray_dy(RayShift{zoom[i], 0, down[i], 0, view[i]}, y, cy)), -height, height);
}

// What all rows of a view share.
struct Volume {
  const MatchedView& view;
  Columns columns;
  const PairCostParams& params;

  const Array& array() const { return view.array; }
  bool wants(int from, int to) const {  // of these rows
    const size_t width = view.array.width;
    return view.chunks.start[width * from] != view.chunks.start[width * to];
  }
};

// Whole rows that rays land below the pixel they belong to, over all views: [least, most].
struct Drop {
  int least = 0, most = 0;
};

// The rows of all cameras around those that are matched, as far as rays drop from the first of them.
struct Rows {
  // Of one camera, by how far below the first of them.
  const uint8_t* const* of(int camera) const { return list.data() + camera * count() - reach.least; }
  int count() const { return reach.most - reach.least + kTileRows; }

  const Drop reach;
  const uint8_t* outside;            // every image
  std::vector<const uint8_t*> list;  // [camera, count]
};

#if defined(SEEPAST_V4_BYTES)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // in GCC's own headers
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4,avx512bitalg,avx512vbmi,prefer-vector-width=512")
namespace v4_bytes {
#define SEEPAST_BYTES_AVX512
#include "volume_rows.h"
#undef SEEPAST_BYTES_AVX512
}  // namespace v4_bytes
#pragma GCC pop_options
#pragma GCC diagnostic pop
#endif
#if defined(SEEPAST_V3) || defined(SEEPAST_V4)
#pragma GCC push_options
#if !defined( \
    SEEPAST_LEVEL)  // else it is that already, or more, which takes no functions for less into itself
#pragma GCC target("arch=x86-64-v3")
#endif
namespace v3 {
#define SEEPAST_BYTES_AVX2
#include "volume_rows.h"
#undef SEEPAST_BYTES_AVX2
}  // namespace v3
#pragma GCC pop_options
#endif
namespace baseline {
#include "volume_rows.h"
}  // namespace baseline

// A thread's part: whole strips of rows.
template <class RowMatcher>
struct Matcher {
  Matcher(const std::vector<Volume>& volumes, const std::vector<DescribedView>& described, const Drop& drop)
      : volumes(volumes),
        ring(static_cast<int>(described.size()), described[0].width,
             std::min(drop.most - drop.least + kTileRows, described[0].height) + Describer::kReach + 1),
        rows{drop, ring.outside(), {}} {
    for (size_t k = 0; k < described.size(); ++k)
      describers.emplace_back(described[k], ring, static_cast<int>(k));
    for (const Volume& volume : volumes) matchers.push_back(std::make_unique<RowMatcher>(volume, rows));
  }

  // Rows [y, end), at most kTileRows.
  void match_rows(int y, int end) {
    const auto wants = [&](const Volume& volume) { return volume.wants(y, end); };
    if (std::none_of(volumes.begin(), volumes.end(), wants)) return;
    const int height = volumes[0].array().height;
    const auto [least, most] = rows.reach;
    for (Describer& describer : describers)
      describer.describe(std::max(0, y + least), std::min(height, end + most));
    rows.list.clear();
    for (int k = 0; k < ring.cameras; ++k)
      for (int to = y + least; to < y + kTileRows + most; ++to)
        rows.list.push_back(to >= 0 && to < std::min(height, end + most) ? ring.row(k, to) : rows.outside);
    for (size_t i = 0; i < volumes.size(); ++i)
      if (wants(volumes[i])) {
        for (int j = 0; j < kTileRows; ++j)
          drops_at(y + j, volumes[i].array().cy, height, volumes[i].columns, matchers[i]->drops[j].data());
        matchers[i]->match_rows(y, end);
      }
  }

  const std::vector<Volume>& volumes;
  FeatureRing ring;
  Rows rows;
  std::vector<Describer> describers;
  std::vector<std::unique_ptr<RowMatcher>> matchers;
};

// Hands out strips to threads, which mostly go on where they are: what they described of the rows there is of
// use again.
class Strips {
 public:
  explicit Strips(int count) : taken(count) {}

  // One that nobody had: the one behind `last` if there is such; -1 where none is left.
  int next(int last) {
    int found;
#pragma omp critical(strips)
    {
      found = free(last + 1) ? last + 1 : middle_of_longest();
      if (found >= 0) taken[found] = true;
    }
    return found;
  }

 private:
  bool free(int strip) const { return strip < static_cast<int>(taken.size()) && !taken[strip]; }

  int middle_of_longest() const {
    const int count = static_cast<int>(taken.size());
    int found = -1, most = 0;
    for (int from = 0, to; from < count; from = to + 1) {
      for (to = from; free(to);) ++to;
      if (to - from > most) most = to - from, found = from + most / 2;
    }
    return found;
  }

  std::vector<bool> taken;
};

template <class RowMatcher>
void match_rows(std::vector<Volume>& volumes, const std::vector<DescribedView>& described, const Drop& drop) {
  const int height = described[0].height;
  Strips strips((height + kStrip - 1) / kStrip);
  const int tiles = volumes[0].columns.tiles, count = static_cast<int>(volumes.size());
#pragma omp parallel
  {
    std::vector<int32_t> first(volumes[0].columns.shifts()), last(first.size());
#pragma omp for schedule(static)
    for (int i = 0; i < count * tiles; ++i) {
      Volume& volume = volumes[i / tiles];
      volume.columns.fill(volume.array(), i % tiles, first, last);
    }
    Matcher<RowMatcher> matcher(volumes, described, drop);
    for (int strip = strips.next(-1); strip >= 0; strip = strips.next(strip))
      for (int y = kStrip * strip; y < std::min(height, kStrip * (strip + 1)); y += kTileRows)
        matcher.match_rows(y, std::min(height, y + kTileRows));
  }
}

Drop drop_of(const std::vector<Volume>& volumes) {
  Drop drop;
  for (const Volume& volume : volumes) {
    std::vector<int32_t> drops(volume.columns.shifts());
    const int height = volume.array().height;
    for (const int y : {0, height - 1}) {  // in between it lies between these
      drops_at(y, volume.array().cy, height, volume.columns, drops.data());
      for (const int rows : drops)
        drop.least = std::min(drop.least, rows), drop.most = std::max(drop.most, rows);
    }
  }
  return drop;
}

}  // namespace

void volumes(const MatchedView* views, int count, const uint8_t* colour, const uint8_t* is_static,
             const int32_t* luma, const Grid& grid, const PairCostParams& params) {
  std::vector<Volume> all;
  for (int i = 0; i < count; ++i) all.push_back({views[i], Columns(views[i].array, grid), params});
  const Array& array = views[0].array;
  std::vector<DescribedView> described;
  for (int k = 0; k < array.cameras; ++k)
    described.push_back(
        {array.height, array.width, colour + 3 * k * array.pixels(), is_static + k * array.pixels(), luma});
  const Drop drop = drop_of(all);
#if defined(SEEPAST_V4_BYTES)
  if (simd() == Simd::avx512_bytes) return match_rows<v4_bytes::RowMatcher>(all, described, drop);
#endif
#if defined(SEEPAST_V3) || defined(SEEPAST_V4)
  if (simd() >= Simd::avx2) return match_rows<v3::RowMatcher>(all, described, drop);
#endif
  match_rows<baseline::RowMatcher>(all, described, drop);
}

}  // namespace seepast
