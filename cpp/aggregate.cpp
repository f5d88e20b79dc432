// Stage "aggregate" of the many-view method: semi-global matching along 8 or 4 paths (Hirschmueller 2008).
//
// Two sweeps over the rows: one goes down with the path from the left and those from above, the other goes up
// with the rest. They start at once, on two threads; each stores its sums in its first half of the image, and
// in its second half finds the other's there, adds them and picks each pixel's candidate. Paths over pixels
// outside the image have cost 0, which lets a path that enters the image begin with the matching cost alone.
//
// A row of path costs is stored dense, kBeyond where a pixel is not matched: so a pixel reads its neighbour's
// costs, and those beside them, without asking where that one was matched. What is written twice over is
// cleared where the pixel two rows before was matched and this one is not.
#include <algorithm>
#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include <memory>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int16_t kBeyond =
    20000;  // path cost where a pixel is not matched: more than any, and 1000, P2's most
constexpr int16_t kUnsettled = 8000;  // lowest path cost at which what has gathered on the path is taken away
constexpr int kGuard = kChunk;        // entries of it between two pixels' candidates
constexpr size_t kLine = 32;          // entries of a cache line

size_t lines(size_t entries) { return (entries + kLine - 1) / kLine * kLine; }

// Where things lie in the scratch memory, in entries.
struct Layout {
  Layout(int height, int width, int count, int paths, size_t chunks)
      : vertical(paths == 8 ? 3 : 1), pitch(count + kGuard), columns(width + 2) {
    row = (kGuard + columns * pitch + 2047) / 2048 * 2048 + 352;
    lows = lines(columns);
    sweep = 2 * vertical * (row + lows) + lines(3 * pitch + kGuard) + lines(4 * width);
    steps = lines(static_cast<size_t>(width + 2) * (height + 1));
    sums = chunks * kChunk;
    total = 2 * sweep + (vertical + 1) * steps + sums + kLine;
  }

  size_t vertical, pitch, columns;
  size_t row, lows;  // of one path: entries, spread over a page (a load waits for stores that are a page
                     // away), lowest
  size_t sweep, steps, sums, total;
};

// Number and sum of a pixel's lowest candidate, and the sums beside it, which count only where they are
// active.
struct Pick {
  int16_t best, left, lowest, right;
};

// What does not change from row to row; `paths` are those from the row before, at x - 1, x, x + 1 or only x,
// and then the one along the row.
struct Row {
  const uint8_t* costs;
  const uint64_t* active;        // [W]
  const uint64_t* active_stale;  // [W] two rows before, or nullptr
  const int32_t* start;          // [W]
  int width, direction, small;
  Grid grid;
  const int16_t* before;                // of the row before: column 0 or -1, path 0
  ptrdiff_t before_path, before_pitch;  // from path to path, each a column farther, and from column to column
  const int16_t* before_low[3];
  int16_t* to;
  ptrdiff_t path, pitch;
  int16_t* to_low[3];
  const int16_t* large[4];  // P2, [W]
  int16_t* beside;          // two pixels' entries of the path along the row
  const int16_t* outside;   // entries that are 0
  int16_t* sums;
  Pick* picks;    // [W]
  uint16_t* out;  // nullptr: store the sums
};

#if defined(SEEPAST_V4)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // in GCC's own headers
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

using Run = void (*)(const Row&, bool);
Run runner() {
#if defined(SEEPAST_V4)
  if (simd() >= Simd::avx512) return v4::run;
#endif
#if defined(SEEPAST_V3)
  if (simd() == Simd::avx2) return v3::run;
#endif
  return baseline::run;
}

// P2 between every pixel and the one left of it, above it, above left, and above right; 0 at the image's
// edge. Rows have an entry before and one after them, and there is one row more than the image has.
SEEPAST_CLONES void step_row(const uint8_t* image, const uint8_t* is_static, int from, int to,
                             ptrdiff_t other, const Penalties& penalties, int16_t* out) {
  for (int x0 = from; x0 < to; x0 += 256) {
    const int n = std::min(256, to - x0);
    const uint8_t *a = image + 3 * x0, *b = a + 3 * other, *s = is_static + x0;
    uint16_t step[256];
    for (int i = 0; i < n; ++i) {
      const int d0 = a[3 * i] - b[3 * i], d1 = a[3 * i + 1] - b[3 * i + 1], d2 = a[3 * i + 2] - b[3 * i + 2];
      step[i] = static_cast<uint16_t>((d0 < 0 ? -d0 : d0) + (d1 < 0 ? -d1 : d1) + (d2 < 0 ? -d2 : d2));
    }
    for (int i = 0; i < n; ++i)
      out[x0 + i] = static_cast<int16_t>(s[i] & s[i + other] ? penalties.large[step[i]] : penalties.dynamic);
  }
}

struct View {
  const uint8_t *costs, *image, *is_static;
  const uint64_t* active;
  const int32_t* start;
  int height, width;
};

struct Steps {
  Steps(const View& view, const Penalties& penalties, const Layout& layout, int16_t* memory)
      : memory(memory), plane(layout.steps), pitch(view.width + 2) {
    const int dx[4] = {-1, 0, -1, 1};
#pragma omp parallel for schedule(static)
    for (int y = 0; y <= view.height; ++y)
      for (size_t way = 0; way <= layout.vertical; ++way) {
        int16_t* to = row(way, y);
        const bool inside = y < view.height && (way == 0 || y > 0);
        const int first = std::max(0, -dx[way]), last = inside ? view.width - std::max(0, dx[way]) : first;
        std::fill(to - 1, to + first, int16_t{0});
        std::fill(to + std::max(first, last), to + view.width + 1, int16_t{0});
        const size_t at = static_cast<size_t>(y) * view.width;
        if (last > first)
          step_row(view.image + 3 * at, view.is_static + at, first, last,
                   dx[way] - (way ? static_cast<ptrdiff_t>(view.width) : 0), penalties, to);
      }
  }
  int16_t* row(size_t way, int y) const { return memory + way * plane + static_cast<size_t>(y) * pitch + 1; }

  int16_t* memory;
  size_t plane, pitch;
};

// One sweep: direction 1 goes down and right, -1 up and left.
struct Sweep {
  Sweep(const View& view, const Grid& grid, const Penalties& penalties, const Steps& large,
        const Layout& layout, int direction, int16_t* memory, int16_t* sums)
      : view(view),
        grid(grid),
        small(penalties.small),
        large(large),
        layout(layout),
        direction(direction),
        sums(sums) {
    entries = memory;
    lows = entries + 2 * layout.vertical * layout.row;
    beside = lows + 2 * layout.vertical * layout.lows;
  }

  int16_t* entry(int n, size_t path) const {
    return entries + ((n & 1) * layout.vertical + path) * layout.row + kGuard + layout.pitch;
  }
  int16_t* low(int n, size_t path) const {
    return lows + ((n & 1) * layout.vertical + path) * layout.lows + 1;
  }

  void begin() const {
    std::fill_n(entries, 2 * layout.vertical * layout.row, kBeyond);
    std::fill_n(lows, 2 * layout.vertical * layout.lows, int16_t{0});
    for (int n = 0; n < 2; ++n)
      for (size_t path = 0; path < layout.vertical; ++path)
        for (const int x : {-1, view.width})
          std::fill_n(entry(n, path) + x * static_cast<ptrdiff_t>(layout.pitch), grid.count, int16_t{0});
    std::fill_n(beside, kGuard + 2 * layout.pitch, kBeyond);
    std::fill_n(beside + kGuard + 2 * layout.pitch, layout.pitch, int16_t{0});
  }

  // The sweep's rows [from, to): sums are stored, or, with `out`, added to and their winners written.
  void rows(int from, int to, uint16_t* out) const {
    const Run run = runner();
    if (from == 0) begin();
    for (int n = from; n < to; ++n) {
      const int y = direction > 0 ? n : view.height - 1 - n;
      const Row r = row(n, y, out ? out + static_cast<size_t>(y) * view.width : nullptr);
      run(r, layout.vertical == 3);
    }
  }

  Row row(int n, int y, uint16_t* out) const {
    const size_t at = static_cast<size_t>(y) * view.width;
    Row r{};
    r.costs = view.costs;
    r.active = view.active + at;
    r.active_stale = n > 1 ? r.active - 2 * static_cast<ptrdiff_t>(direction) * view.width : nullptr;
    r.start = view.start + at;
    r.width = view.width, r.direction = direction, r.small = small;
    r.grid = grid;
    r.to = entry(n, 0);
    r.path = layout.row, r.pitch = layout.pitch;
    r.beside = beside + kGuard;
    r.outside = r.beside + 2 * layout.pitch;
    r.before = n ? entry(n - 1, 0) - (layout.vertical == 3 ? r.pitch : 0) : r.outside;
    r.before_path = n ? r.path + r.pitch : 0, r.before_pitch = n ? r.pitch : 0;
    for (size_t path = 0; path < layout.vertical; ++path) {
      r.before_low[path] =
          low(n + 1, path) + static_cast<ptrdiff_t>(path) - static_cast<ptrdiff_t>(layout.vertical / 2);
      r.to_low[path] = low(n, path);
    }
    large_of(y, r.large);
    r.sums = sums;
    r.picks = reinterpret_cast<Pick*>(beside + lines(3 * layout.pitch + kGuard));
    r.out = out;
    return r;
  }

  // Penalties between row y and those before it; they are stored with the lower, or right, of two pixels.
  void large_of(int y, const int16_t** to) const {
    const bool down = direction > 0;
    const int from = down ? y : y + 1;
    to[layout.vertical] = large.row(0, y) + (down ? 0 : 1);
    to[layout.vertical / 2] = large.row(1, from);
    if (layout.vertical == 1) return;
    to[0] = down ? large.row(2, from) : large.row(3, from) - 1;
    to[2] = down ? large.row(3, from) : large.row(2, from) + 1;
  }

  const View& view;
  Grid grid;
  int small;
  const Steps& large;
  const Layout& layout;
  int direction;
  int16_t *sums, *entries, *lows, *beside;
};

}  // namespace

size_t aggregate_scratch(int height, int width, int count, int paths, size_t chunks) {
  return Layout(height, width, count, paths, chunks).total;
}

void aggregate(const uint8_t* costs, const uint8_t* image, const uint8_t* is_static, int height, int width,
               const Grid& grid, const uint64_t* active, const int32_t* start, const Penalties& penalties,
               int paths, uint16_t* scratch, uint16_t* out) {
  const View view{costs, image, is_static, active, start, height, width};
  const Layout layout(height, width, grid.count, paths, start[static_cast<size_t>(height) * width]);
  void* memory = scratch;
  size_t space = layout.total * sizeof(int16_t);
  int16_t* base =
      static_cast<int16_t*>(std::align(2 * kLine, (layout.total - kLine) * sizeof(int16_t), memory, space));
  const Steps large(view, penalties, layout, base + 2 * layout.sweep);
  int16_t* sums = base + 2 * layout.sweep + (layout.vertical + 1) * layout.steps;
  const Sweep sweeps[2] = {{view, grid, penalties, large, layout, 1, base, sums},
                           {view, grid, penalties, large, layout, -1, base + layout.sweep, sums}};
  const int half = height / 2, met[2] = {half, height - half};  // rows that each has done when they meet
#pragma omp parallel for schedule(static, 1)
  for (int s = 0; s < 2; ++s) sweeps[s].rows(0, met[s], nullptr);
#pragma omp parallel for schedule(static, 1)
  for (int s = 0; s < 2; ++s) sweeps[s].rows(met[s], height, out);
}

}  // namespace seepast
