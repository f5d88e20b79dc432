// Stage "aggregate" of the many-view method: semi-global matching along 8 or 4 paths (Hirschmueller 2008).
//
// Two sweeps over the rows: one goes down with the paths from above, the other up with those from below. They
// start at once, on two threads; each stores its sums until they meet, and from there on finds the other's,
// adds them and those along the row, of both directions, and picks each pixel's candidate. What all
// candidates of a pixel have in common does not matter: so a path that enters the image, or comes from a
// pixel that is not matched, may begin with any number.
//
// A path from row to row holds its costs in one place per column, or diagonal: dense, kBeyond where the pixel
// is not matched. So a pixel reads the costs before it, and those beside them, without asking where that one
// was matched. Neighbours mostly are matched at the same chunks: such runs of pixels have no branches in
// them.
#include <algorithm>
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include <memory>
#include <utility>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int16_t kBeyond = 20000;   // path cost where a pixel is not matched: more than any
constexpr int kGuard = kChunk;       // entries of it between two pixels' candidates
constexpr int kRows = 4;             // that go along together
constexpr int kColourSteps = 766;    // entries of Penalties::large
constexpr int kBlockOfSteps = 8;     // pixels whose penalties are computed together
constexpr size_t kLine = 32;         // entries of a cache line
constexpr size_t kPartEntries = 12;  // entries of a Part

size_t lines(size_t entries) { return (entries + kLine - 1) / kLine * kLine; }

// Where things lie in the scratch memory, in entries.
struct Layout {
  // most: the largest penalty
  Layout(int height, int width, int count, int paths, int most, size_t chunks)
      : vertical(paths == 8 ? 3 : 1), bytes(paths == 4 && most < 256), pitch(count + kGuard) {
    slots = width + (vertical == 3 ? height : 0);
    entries = lines(kGuard + slots * pitch);
    line = lines(2 * kGuard + count);
    steps = lines(width + 2);
    plane = lines(steps * (height + 1));
    totals = std::min(chunks, static_cast<size_t>(width) * (count / kChunk)) * kChunk;
    along = std::min(chunks * kChunk, kRows * totals);
    sweep = vertical * entries + kRows * (line + steps) + lines(4 * width) + lines(kPartEntries * 3 * width) +
            totals + along;
    sums = lines(chunks * kChunk / (bytes ? 2 : 1));
    found = 2 * sweep + vertical * plane + sums;
    total = found + static_cast<size_t>(height) * width + kLine;
  }

  size_t vertical;
  bool bytes;                         // are enough for the sums of the paths from row to row
  size_t pitch;                       // paths from row to row; entries of a column
  size_t slots, entries;              // of one path from row to row
  size_t plane;                       // penalties from row to row
  size_t line, steps, totals, along;  // of one row; path costs, penalties, and the sums of kRows rows
  size_t sweep, sums;
  size_t found, total;  // the disparities before their median
};

constexpr int16_t kNone = -20000;  // the sum of a candidate that is not active: there is no vertex beside it

// Sum and number of a pixel's lowest candidate, and the sums beside it.
struct Pick {
  int16_t left, lowest, right, best;
};

// Columns [from, end) of one row, or some, that are active at the same chunks.
struct Run {
  int32_t from, end;
  uint64_t active;
};

// Columns where rows that go along together are active at the same chunks, or not.
struct Part {
  Run run;
  bool same;
};

// The runs of a row that are active at all.
struct Runs {
  const Run *first, *last;
  const Run* begin() const { return first; }
  const Run* end() const { return last; }
};

// A path along a row.
struct Line {
  const uint8_t* costs;
  Runs runs;
  const int32_t* start;  // [W]
  const int16_t* large;  // P2 between every pixel and the one before it
  int16_t* entries;
  int16_t* sums;  // of all chunks, though there is memory for some rows'
  uint64_t held;  // chunks of `entries` that are not beyond
};

// A row, and the paths into it from the row before: from x - dx.
struct Row {
  const uint8_t* costs;
  Runs runs, before;     // `before`: of the row before
  const int32_t* start;  // [W]
  int width;
  int16_t small;
  Grid grid;
  int dx[3];
  int16_t* entries[3];      // where column 0 has its place
  const int16_t* large[3];  // P2, [W]
  ptrdiff_t pitch;
  uint8_t* saved_bytes;  // the sums of the paths from row to row: bytes,
  int16_t* saved;        // or, where they need more, this
  const int16_t* along;  // the sums of those along it, as in Line
  int16_t* totals;       // of all paths, likewise
  Pick* picks;           // [W]
  uint16_t* out;         // nullptr: save the sums
};

// P2 by the colour step, and behind them that between pixels that are not static both.
using Large = int16_t[kColourSteps + 1];

// P2 between n pixels and the others, `other` from them.
inline void steps_of(const uint8_t* a, const uint8_t* is_static, int n, ptrdiff_t other, const Large& large,
                     int16_t* out) {
  const uint8_t *b = a + 3 * other, *s = is_static, *t = s + other;
  for (int i = 0; i < n; ++i) {
    const int d0 = a[3 * i] - b[3 * i], d1 = a[3 * i + 1] - b[3 * i + 1], d2 = a[3 * i + 2] - b[3 * i + 2];
    const int sum = (d0 < 0 ? -d0 : d0) + (d1 < 0 ? -d1 : d1) + (d2 < 0 ? -d2 : d2);
    out[i] = large[s[i] & t[i] ? sum : kColourSteps];
  }
}

#if defined(SEEPAST_V4)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // in GCC's own headers
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
namespace v4 {
#define SEEPAST_AVX2
#define SEEPAST_AVX512
#include "aggregate_rows.h"
}  // namespace v4
#pragma GCC pop_options
#pragma GCC diagnostic pop
#undef SEEPAST_AVX512
#undef SEEPAST_AVX2
#endif
#if defined(SEEPAST_V3)
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
namespace v3 {
#define SEEPAST_AVX2
#include "aggregate_rows.h"
}  // namespace v3
#undef SEEPAST_AVX2
#pragma GCC pop_options
#endif
namespace baseline {
#include "aggregate_rows.h"
}

struct Loops {
  void (*along)(Line*, int, int, Part*, int16_t);
  void (*down)(const Row&, bool);
  void (*steps)(const uint8_t*, const uint8_t*, Runs, int, int, ptrdiff_t, const Large&, int16_t*);
  void (*runs)(const uint64_t*, int, std::vector<Run>&);
};
Loops loops() {
#if defined(SEEPAST_V4)
  if (simd() >= Simd::avx512) return {v4::along_rows, v4::down_row, v4::step_row, v4::add_runs};
#endif
#if defined(SEEPAST_V3)
  if (simd() == Simd::avx2) return {v3::along_rows, v3::down_row, v3::step_row, v3::add_runs};
#endif
  return {baseline::along_rows, baseline::down_row, baseline::step_row, baseline::add_runs};
}

struct View {
  const uint8_t *costs, *image, *is_static;
  const uint64_t* active;
  const int32_t* start;
  int height, width;

  size_t at(int y) const { return static_cast<size_t>(y) * width; }
  size_t chunks() const { return start[at(height)]; }
};

// Where a view is matched: looked for once, since most of it may be empty.
class Matched {
 public:
  explicit Matched(const View& view) : view(view), half(view.height / 2), ends(view.height) {}

  // In the upper half of the rows (0), or the lower one (1).
  void look(int i) {
    const auto add = loops().runs;
    for (int y = i ? half : 0; y < (i ? view.height : half); ++y) {
      add(view.active + view.at(y), view.width, runs[i]);
      ends[y] = runs[i].size();
    }
  }

  Runs row(int y) const {
    const Run* all = runs[y >= half].data();
    return {all + (y == 0 || y == half ? 0 : ends[y - 1]), all + ends[y]};
  }

  // The row that halves the work.
  int middle() const {
    std::vector<size_t> until;
    size_t n = 0;
    for (size_t y = 0; y < ends.size(); ++y) {
      for (const Run& run : row(static_cast<int>(y))) n += run.end - run.from;
      until.push_back(n);
    }
    return static_cast<int>(std::lower_bound(until.begin(), until.end(), (n + 1) / 2) - until.begin());
  }

 private:
  const View& view;
  int half;
  std::vector<Run> runs[2];  // of the rows before `half`, and the others
  std::vector<size_t> ends;  // how many of them there are until each row's end
};

// One sweep: direction 1 goes down, -1 up.
struct Sweep {
  Sweep(const View& view, const Matched& matched, const Grid& grid, const Large& large, int small,
        const Layout& layout, int direction, int16_t* memory, int16_t* planes, int16_t* saved)
      : view(view),
        matched(matched),
        grid(grid),
        large(large),
        small(static_cast<int16_t>(small)),
        layout(layout),
        direction(direction),
        run(loops()),
        saved(saved),
        entries(memory),
        planes(planes),
        line_entries(entries + layout.vertical * layout.entries),
        line_steps(line_entries + kRows * layout.line),
        picks(line_steps + kRows * layout.steps),
        parts(picks + lines(4 * view.width)),
        totals(parts + lines(kPartEntries * 3 * view.width)),
        along(totals + layout.totals) {}

  void begin() const {
    std::fill_n(entries, layout.vertical * layout.entries, kBeyond);
    std::fill_n(line_entries, kRows * layout.line, kBeyond);
    for (size_t p = 0; p < layout.vertical; ++p)
      std::fill_n(plane(p, direction > 0 ? 0 : view.height) - 1, view.width + 2, int16_t{0});
  }

  // The sweep's rows before n = `to`: sums are saved.
  void first(int to) const {
    begin();
    for (int n = 0; n < to; ++n) {
      if (n) steps_between(direction > 0 ? n : view.height - n);
      run.down(row(n, nullptr, nullptr), layout.vertical == 3);
    }
    if (direction > 0 && to > 0 && to < view.height) steps_between(to);
  }

  // Those from n = `from` on: they are added to what was saved, with those along the rows, and the winners
  // are written.
  void second(int from, uint16_t* out) const {
    for (int n = from; n < view.height; n += kRows) {
      const int count = std::min(kRows, view.height - n);
      const int top = std::min(y_of(n), y_of(n + count - 1));
      int16_t* sums = numbered(along, view.start[view.at(top)]);
      Line rows[kRows];
      for (int i = 0; i < count; ++i) rows[i] = line(n + i, i, sums);
      run.along(rows, count, view.width, reinterpret_cast<Part*>(parts), small);
      for (int i = 0; i < count; ++i) run.down(row(n + i, sums, out), layout.vertical == 3);
    }
  }

  // Where chunk 0 would be, if there were memory for all and chunk `first` were at `sums`.
  static int16_t* numbered(int16_t* sums, int first) {
    return reinterpret_cast<int16_t*>(reinterpret_cast<uintptr_t>(sums) - sizeof(int16_t) * kChunk * first);
  }

  int y_of(int n) const { return direction > 0 ? n : view.height - 1 - n; }

  Line line(int n, int i, int16_t* sums) const {
    const size_t at = view.at(y_of(n));
    Line l{};
    l.costs = view.costs, l.runs = matched.row(y_of(n)), l.start = view.start + at;
    l.entries = line_entries + i * layout.line + kGuard;
    l.sums = sums;
    l.large = step(y_of(n), 1, 0, line_steps + i * layout.steps + 1);
    return l;
  }

  Row row(int n, const int16_t* sums, uint16_t* out) const {
    const int y = y_of(n);
    const size_t at = view.at(y);
    Row r{};
    r.costs = view.costs, r.runs = matched.row(y), r.start = view.start + at;
    r.before = n ? matched.row(y - direction) : Runs{};
    r.width = view.width, r.small = small, r.grid = grid;
    r.pitch = layout.pitch;
    for (int p = 0; p < static_cast<int>(layout.vertical); ++p) {
      const int dx = r.dx[p] = layout.vertical == 3 ? p - 1 : 0;
      const ptrdiff_t slot = (dx > 0 ? view.height : 0) - dx * n;
      r.entries[p] = entries + p * layout.entries + kGuard + slot * r.pitch;
      r.large[p] = direction > 0 ? plane(p, y) : plane(layout.vertical - 1 - p, y + 1) - dx;
    }
    r.saved_bytes = layout.bytes ? reinterpret_cast<uint8_t*>(saved) : nullptr, r.saved = saved;
    r.along = sums;
    r.totals = numbered(totals, view.start[at]);
    r.picks = reinterpret_cast<Pick*>(picks);
    r.out = out ? out + at : nullptr;
    return r;
  }

  // P2 between the pixels of row y and those above them that path p comes from.
  int16_t* plane(size_t p, int y) const { return planes + p * layout.plane + y * layout.steps + 1; }

  void steps_between(int y) const {
    for (int p = 0; p < static_cast<int>(layout.vertical); ++p)
      step(y, layout.vertical == 3 ? p - 1 : 0, view.width, plane(p, y));
  }

  // P2 between the pixels of row y and those dx to their left, `rows` pixels before.
  const int16_t* step(int y, int dx, int rows, int16_t* out) const {
    const size_t at = view.at(y);
    const int from = std::max(0, dx), to = view.width - std::max(0, -dx);
    out[-1] = out[0] = out[view.width - 1] = out[view.width] = 0;
    run.steps(view.image + 3 * at, view.is_static + at, matched.row(y), from, to, -dx - rows, large, out);
    return out;
  }

  const View& view;
  const Matched& matched;
  Grid grid;
  const Large& large;
  int16_t small;
  const Layout& layout;
  int direction;
  Loops run;
  int16_t* saved;
  int16_t *entries, *planes, *line_entries, *line_steps, *picks, *parts, *totals, *along;
};

// One view's two sweeps, and what they share.
struct Aggregation {
  Aggregation(const View& view, uint16_t* out, const Layout& layout, int16_t* memory)
      : view(view), matched(this->view), out(out), layout(layout), memory(memory) {}
  Aggregation(const Aggregation&) = delete;

  // Half i of the rows before any sweep.
  void look(int i) {
    matched.look(i);
    const int half = view.height / 2, from = i ? half : 0, to = i ? view.height : half;
    std::copy_n(out + view.at(from), view.at(to - from), found() + view.at(from));
  }

  void begin(const Grid& grid, const Large& large, int small) {
    int16_t* const planes = memory + 2 * layout.sweep;
    for (const int direction : {1, -1})
      sweeps.emplace_back(view, matched, grid, large, small, layout, direction,
                          memory + (direction > 0 ? 0 : layout.sweep), planes,
                          planes + layout.vertical * layout.plane);
    half = matched.middle();
  }

  int met(int s) const { return s ? view.height - half : half; }  // rows that a sweep has done when they meet
  void first(int s) const { sweeps[s].first(met(s)); }
  void second(int s) const { sweeps[s].second(met(s), found()); }
  // Row y, where it is matched, or all of it.
  void smooth(int y, bool everywhere, MedianOfRows& medians) const {
    const Runs runs = matched.row(y);
    uint16_t* const to = out + view.at(y);
    if (everywhere) {
      std::copy_n(medians.of(found(), y, 0, view.width), view.width, to);
    } else if (runs.begin() != runs.end()) {
      const int from = runs.begin()->from, end = (runs.end() - 1)->end;
      const uint16_t* row = medians.of(found(), y, from, end);
      for (const Run& run : runs) std::copy(row + run.from - from, row + run.end - from, to + run.from);
    }
  }

  uint16_t* found() const { return reinterpret_cast<uint16_t*>(memory + layout.found); }

  const View view;
  Matched matched;
  uint16_t* out;
  const Layout layout;
  int16_t* memory;
  std::vector<Sweep> sweeps;
  int half = 0;
};

}  // namespace

size_t aggregate_scratch(int height, int width, int count, int paths, int most, size_t chunks) {
  return Layout(height, width, count, paths, most, chunks).total;
}

void aggregates(const AggregatedView* views, int count, int height, int width, const Grid& grid,
                const Penalties& penalties, int paths, bool everywhere, uint16_t* scratch) {
  Large large;
  std::copy_n(penalties.large, kColourSteps, large);
  large[kColourSteps] = static_cast<int16_t>(penalties.dynamic);
  const int most = *std::max_element(large, large + kColourSteps + 1);
  std::vector<std::unique_ptr<Aggregation>> all;
  for (int i = 0; i < count; ++i) {
    const AggregatedView& v = views[i];
    const View view{v.costs, v.image, v.is_static, v.active, v.start, height, width};
    const Layout layout(height, width, grid.count, paths, most, view.chunks());
    void* memory = scratch;
    size_t space = layout.total * sizeof(int16_t);
    std::align(sizeof(int16_t) * kLine, space - sizeof(int16_t) * kLine, memory, space);
    all.push_back(std::make_unique<Aggregation>(view, v.out, layout, static_cast<int16_t*>(memory)));
    scratch += layout.total;
  }
  // the longest first, so that threads end together
  std::stable_sort(all.begin(), all.end(),
                   [](const auto& a, const auto& b) { return a->view.chunks() > b->view.chunks(); });
#pragma omp parallel
  {
    MedianOfRows medians(height, width);
#pragma omp for schedule(dynamic, 1)
    for (int i = 0; i < 2 * count; ++i) all[i / 2]->look(i % 2);
#pragma omp single
    for (const auto& one : all) one->begin(grid, large, penalties.small);
#pragma omp for schedule(dynamic, 1)
    for (int i = 0; i < 2 * count; ++i) all[i / 2]->first(i % 2);
#pragma omp for schedule(dynamic, 1)
    for (int i = 0; i < 2 * count; ++i) all[i / 2]->second(i % 2);
#pragma omp for schedule(dynamic, 16)
    for (int row = 0; row < count * height; ++row)
      all[row / height]->smooth(row % height, everywhere, medians);
  }
}

}  // namespace seepast
