// Stage "aggregate" of the many-view method: semi-global matching along 8 paths (Hirschmueller 2008).
//
// Two sweeps over the rows. The first goes down and adds both horizontal paths and the three from above; the second
// goes up with the three from below and picks each pixel's candidate while its sums are at hand. Pixels outside the
// image are paths of cost 0, which makes a path that enters the image begin with the matching cost alone.
#include <algorithm>
#include <cstdlib>
#ifdef _OPENMP
#include <omp.h>
#endif
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr uint16_t kBeyond = 20000;  // cost of candidates outside the range; sums of two stay below 2^16
constexpr int kGuard = 32;           // entries of it between two pixels' candidates
constexpr int kRowsAtOnce = 4;       // of the horizontal paths
constexpr int kDirections = 3;       // of a sweep: from the row before at x - 1, x, x + 1

inline __attribute__((always_inline)) uint16_t least(uint16_t a, uint16_t b) { return a < b ? a : b; }

// One pixel's step of one path.
struct Step {
  const uint16_t* before;
  uint16_t lowest, large;  // min of before; P2
  uint16_t* to;
};

inline __attribute__((always_inline)) uint16_t next(uint8_t cost, const uint16_t* before, int i, uint16_t lowest,
                                                    uint16_t far, uint16_t small) {
  const uint16_t beside = static_cast<uint16_t>(least(before[i - 1], before[i + 1]) + small);
  return static_cast<uint16_t>(static_cast<uint16_t>(least(least(before[i], beside), far) - lowest) + cost);
}

// A horizontal path over one row; adds to `total` or begins it. `line` is two pixels of scratch.
SEEPAST_CLONES
void horizontal(const uint8_t* costs, int width, int count, int direction, const uint16_t* large, uint16_t small,
                uint16_t* line, bool begin, uint16_t* total) {
  const int pitch = count + kGuard;
  uint16_t* entry[2] = {line + kGuard, line + kGuard + pitch};
  std::fill_n(entry[1], count, 0);
  uint16_t lowest = 0;
  for (int n = 0; n < width; ++n) {
    const int x = direction > 0 ? n : width - 1 - n;
    const uint8_t* __restrict c = costs + static_cast<size_t>(x) * count;
    const uint16_t* before = entry[(n & 1) ^ 1];
    uint16_t* __restrict to = entry[n & 1];
    uint16_t* __restrict sum = total + static_cast<size_t>(x) * count;
    const uint16_t p2 = n == 0 ? 0 : large[direction > 0 ? x : x + 1];  // large[x] is between x - 1 and x
    const uint16_t far = static_cast<uint16_t>(lowest + p2), low = lowest;
    uint16_t m = 65535;
    if (begin)
      for (int i = 0; i < count; ++i) {
        const uint16_t value = next(c[i], before, i, low, far, small);
        to[i] = value;
        sum[i] = value;
        m = least(m, value);
      }
    else
      for (int i = 0; i < count; ++i) {
        const uint16_t value = next(c[i], before, i, low, far, small);
        to[i] = value;
        sum[i] = static_cast<uint16_t>(sum[i] + value);
        m = least(m, value);
      }
    lowest = m;
  }
}

// Three paths' steps into one pixel: total = sum + their costs. Writes the paths' new minima.
inline __attribute__((always_inline)) void three_steps(const uint8_t* __restrict costs, int count, uint16_t small,
                                                       const Step* steps, const uint16_t* sum,
                                                       uint16_t* total, uint16_t* minima) {
  const uint16_t *b0 = steps[0].before, *b1 = steps[1].before, *b2 = steps[2].before;
  uint16_t *__restrict t0 = steps[0].to, *__restrict t1 = steps[1].to, *__restrict t2 = steps[2].to;
  const uint16_t l0 = steps[0].lowest, l1 = steps[1].lowest, l2 = steps[2].lowest;
  const uint16_t f0 = static_cast<uint16_t>(l0 + steps[0].large), f1 = static_cast<uint16_t>(l1 + steps[1].large),
                 f2 = static_cast<uint16_t>(l2 + steps[2].large);
  uint16_t m0 = 65535, m1 = 65535, m2 = 65535;
#pragma GCC ivdep
  for (int i = 0; i < count; ++i) {
    const uint8_t c = costs[i];
    const uint16_t v0 = next(c, b0, i, l0, f0, small), v1 = next(c, b1, i, l1, f1, small),
                   v2 = next(c, b2, i, l2, f2, small);
    t0[i] = v0;
    t1[i] = v1;
    t2[i] = v2;
    m0 = least(m0, v0);
    m1 = least(m1, v1);
    m2 = least(m2, v2);
    total[i] = static_cast<uint16_t>(sum[i] + v0 + v1 + v2);
  }
  minima[0] = m0;
  minima[1] = m1;
  minima[2] = m2;
}

// First lowest sum, moved to the vertex of the parabola through it and its neighbours: 32nds of a pixel.
inline __attribute__((always_inline)) uint16_t winner(const uint16_t* total, const Grid& grid) {
  uint16_t lowest = 65535, best = 65535;
  for (int i = 0; i < grid.count; ++i) lowest = least(lowest, total[i]);
  for (int i = 0; i < grid.count; ++i)
    best = least(best, total[i] == lowest ? static_cast<uint16_t>(i) : static_cast<uint16_t>(65535));
  int place = kUnits / 8 * (grid.first + grid.step * best);
  if (best > 0 && best + 1 < grid.count) {
    const int left = total[best - 1], right = total[best + 1], bend = left + right - 2 * lowest;
    const int half = kUnits / 16 * grid.step;
    if (bend > 0) place += (2 * half * (left - right + bend) + bend) / (2 * bend) - half;
  }
  return static_cast<uint16_t>(place);
}

// State of the three vertical and diagonal paths: two rows of entries [direction][x = -1 .. width].
struct Paths {
  Paths(int width, int count) : width(width), pitch(count + kGuard), entries(2 * size(), kBeyond), lowest(2 * lows()) {}

  size_t size() const { return static_cast<size_t>(kDirections) * (width + 2) * pitch + kGuard; }
  size_t lows() const { return static_cast<size_t>(kDirections) * (width + 2); }
  uint16_t* entry(int row, int direction, int x) {
    return entries.data() + (row & 1) * size() + kGuard + (static_cast<size_t>(direction) * (width + 2) + x + 1) * pitch;
  }
  uint16_t* low(int row, int direction, int x) {
    return lowest.data() + (row & 1) * lows() + static_cast<size_t>(direction) * (width + 2) + x + 1;
  }
  // Nothing before the first row (which is number 0), nor ever beside the image.
  void begin(int count) {
    for (int direction = 0; direction < kDirections; ++direction)
      for (int x = -1; x <= width; ++x)
        for (int row = 0; row < 2; ++row)
          if (row == 1 || x < 0 || x == width) {
            std::fill_n(entry(row, direction, x), count, 0);
            *low(row, direction, x) = 0;
          }
  }

  int width, pitch;
  std::vector<uint16_t> entries, lowest;
};

// Columns [from, to) of one row of a sweep, whose number is n. large[direction] are of this row and direction.
// Writes sums back, or, with `out`, the winners.
SEEPAST_CLONES
void sweep_row(const uint8_t* costs, int from, int to, const Grid& grid, int n, uint16_t small,
               const uint16_t* const* large, Paths& paths, uint16_t* sums, uint16_t* last, uint16_t* out) {
  const int count = grid.count;
  for (int x = from; x < to; ++x) {
    Step steps[kDirections];
    for (int direction = 0; direction < kDirections; ++direction) {
      const int before = x + direction - 1;
      steps[direction] = {paths.entry(n - 1, direction, before), *paths.low(n - 1, direction, before),
                          large[direction][x], paths.entry(n, direction, x)};
    }
    uint16_t minima[kDirections];
    uint16_t* sum = sums + static_cast<size_t>(x) * count;
    three_steps(costs + static_cast<size_t>(x) * count, count, small, steps, sum, out ? last : sum, minima);
    for (int direction = 0; direction < kDirections; ++direction) *paths.low(n, direction, x) = minima[direction];
    if (out) out[x] = winner(last, grid);
  }
}

// P2 between every pixel and the one left of it, above left, above, and above right; 0 at the image's edge.
struct Steps {
  Steps(const uint8_t* image, const uint8_t* is_static, int height, int width, const Penalties& penalties)
      : width(width), pixels(static_cast<size_t>(height) * width), values(4 * pixels) {
    const int dy[4] = {0, -1, -1, -1}, dx[4] = {-1, -1, 0, 1};
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y)
      for (int way = 0; way < 4; ++way) {
        if (y + dy[way] < 0) continue;
        const int first = std::max(0, -dx[way]), last = width - std::max(0, dx[way]);
        for (int x = first; x < last; ++x) {
          const size_t p = static_cast<size_t>(y) * width + x, q = p + static_cast<ptrdiff_t>(dy[way]) * width + dx[way];
          const uint8_t *a = image + 3 * p, *b = image + 3 * q;
          const int step = std::abs(a[0] - b[0]) + std::abs(a[1] - b[1]) + std::abs(a[2] - b[2]);
          values[way * pixels + p] =
              is_static[p] & is_static[q] ? penalties.large[step] : static_cast<uint16_t>(penalties.dynamic);
        }
      }
  }
  const uint16_t* row(int way, int y) const { return values.data() + way * pixels + static_cast<size_t>(y) * width; }

  int width;
  size_t pixels;
  std::vector<uint16_t> values;
};

// Columns of one of the threads that share a row.
struct Share {
  Share(int width) {
#ifdef _OPENMP
    const int n = omp_get_num_threads(), i = omp_get_thread_num();
#else
    const int n = 1, i = 0;
#endif
    from = static_cast<int>(static_cast<int64_t>(width) * i / n);
    to = static_cast<int>(static_cast<int64_t>(width) * (i + 1) / n);
  }
  int from, to;
};

}  // namespace

void aggregate(const uint8_t* costs, const uint8_t* image, const uint8_t* is_static, int height, int width,
               const Grid& grid, const Penalties& penalties, uint16_t* scratch, uint16_t* out) {
  const Steps large(image, is_static, height, width, penalties);
  const size_t row_size = static_cast<size_t>(width) * grid.count;
  const uint16_t small = static_cast<uint16_t>(penalties.small);
  Paths down(width, grid.count), up(width, grid.count);
  down.begin(grid.count);
  up.begin(grid.count);
  const std::vector<uint16_t> none(width, 0);
#pragma omp parallel
  {
    const Share share(width);
    std::vector<uint16_t> line(3 * kGuard + 2 * static_cast<size_t>(grid.count), kBeyond), last(grid.count);
    for (int first = 0; first < height; first += kRowsAtOnce) {
      const int end = std::min(height, first + kRowsAtOnce);
#pragma omp for schedule(static, 1)
      for (int y = first; y < end; ++y)
        for (int direction : {1, -1})
          horizontal(costs + y * row_size, width, grid.count, direction, large.row(0, y), small, line.data(),
                     direction > 0, scratch + y * row_size);
      for (int y = first; y < end; ++y) {  // every thread its columns
        const uint16_t* ways[kDirections] = {large.row(1, y), large.row(2, y), large.row(3, y)};
        sweep_row(costs + y * row_size, share.from, share.to, grid, y, small, ways, down, scratch + y * row_size, nullptr,
                  nullptr);
#pragma omp barrier
      }
    }
    std::vector<uint16_t> left(width + 1), right(width + 1);
    for (int n = 0; n < height; ++n) {
      const int y = height - 1 - n;
      // from below: the step to (y + 1, x - 1) is stored there as "above right", to (y + 1, x + 1) as "above left"
      const uint16_t* ways[kDirections] = {none.data(), none.data(), none.data()};
      if (n) {
        for (int x = share.from; x < share.to; ++x) {
          left[x] = x > 0 ? large.row(3, y + 1)[x - 1] : 0;
          right[x] = x + 1 < width ? large.row(1, y + 1)[x + 1] : 0;
        }
        ways[0] = left.data();
        ways[1] = large.row(2, y + 1);
        ways[2] = right.data();
      }
      sweep_row(costs + y * row_size, share.from, share.to, grid, n, small, ways, up, scratch + y * row_size, last.data(),
                out + static_cast<size_t>(y) * width);
#pragma omp barrier
    }
  }
}

}  // namespace seepast
