// Stage "aggregate" of the many-view method: semi-global matching along 8 paths (Hirschmueller 2008).
//
// Two sweeps over the rows, four paths each: one goes down with the paths from the left and from the three
// pixels above, the other goes up with the rest. They start at once, on two threads; each stores its sums in
// its first half of the image, and in its second half finds the other's there, adds them and picks each
// pixel's candidate. Paths over pixels outside the image have cost 0, which lets a path that enters the image
// begin with the matching cost alone.
#include <algorithm>
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr uint16_t kBeyond = 20000;  // cost of candidates outside the range; sums of two stay below 2^16
constexpr int kGuard = 32;           // entries of it between two pixels' candidates
constexpr int kPaths = 4;  // of a sweep: from the row before at x - 1, x, x + 1, and from the same row

inline __attribute__((always_inline)) uint16_t least(uint16_t a, uint16_t b) { return a < b ? a : b; }

// One pixel's step of one path.
struct Step {
  const uint16_t* before;
  uint16_t lowest, large;  // min of before; P2
  uint16_t* to;
};

inline __attribute__((always_inline)) uint16_t next(uint8_t cost, const uint16_t* before, int i,
                                                    uint16_t lowest, uint16_t far, uint16_t small) {
  const uint16_t beside = static_cast<uint16_t>(least(before[i - 1], before[i + 1]) + small);
  return static_cast<uint16_t>(static_cast<uint16_t>(least(least(before[i], beside), far) - lowest) + cost);
}

// Four paths' steps into one pixel: total = their costs, plus `sum` if given. Writes the paths' new minima.
template <bool kAdd>
inline __attribute__((always_inline)) void four_steps(const uint8_t* costs, int count, uint16_t small,
                                                      const Step* steps, const uint16_t* sum, uint16_t* total,
                                                      uint16_t* minima) {
  const uint16_t *b0 = steps[0].before, *b1 = steps[1].before, *b2 = steps[2].before, *b3 = steps[3].before;
  uint16_t *t0 = steps[0].to, *t1 = steps[1].to, *t2 = steps[2].to, *t3 = steps[3].to;
  const uint16_t l0 = steps[0].lowest, l1 = steps[1].lowest, l2 = steps[2].lowest, l3 = steps[3].lowest;
  const uint16_t f0 = static_cast<uint16_t>(l0 + steps[0].large),
                 f1 = static_cast<uint16_t>(l1 + steps[1].large),
                 f2 = static_cast<uint16_t>(l2 + steps[2].large),
                 f3 = static_cast<uint16_t>(l3 + steps[3].large);
  uint16_t m0 = 65535, m1 = 65535, m2 = 65535, m3 = 65535;
#pragma GCC ivdep
  for (int i = 0; i < count; ++i) {
    const uint8_t c = costs[i];
    const uint16_t v0 = next(c, b0, i, l0, f0, small), v1 = next(c, b1, i, l1, f1, small),
                   v2 = next(c, b2, i, l2, f2, small), v3 = next(c, b3, i, l3, f3, small);
    t0[i] = v0;
    t1[i] = v1;
    t2[i] = v2;
    t3[i] = v3;
    m0 = least(m0, v0);
    m1 = least(m1, v1);
    m2 = least(m2, v2);
    m3 = least(m3, v3);
    total[i] = static_cast<uint16_t>((kAdd ? sum[i] : 0) + v0 + v1 + v2 + v3);
  }
  minima[0] = m0;
  minima[1] = m1;
  minima[2] = m2;
  minima[3] = m3;
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
          const size_t p = static_cast<size_t>(y) * width + x,
                       q = p + static_cast<ptrdiff_t>(dy[way]) * width + dx[way];
          const uint8_t *a = image + 3 * p, *b = image + 3 * q;
          const int step = std::abs(a[0] - b[0]) + std::abs(a[1] - b[1]) + std::abs(a[2] - b[2]);
          values[way * pixels + p] =
              is_static[p] & is_static[q] ? penalties.large[step] : static_cast<uint16_t>(penalties.dynamic);
        }
      }
  }
  const uint16_t* row(int way, int y) const {
    return values.data() + way * pixels + static_cast<size_t>(y) * width;
  }

  int width;
  size_t pixels;
  std::vector<uint16_t> values;
};

// One sweep: direction 1 goes down and right, -1 up and left.
struct Sweep {
  Sweep(const uint8_t* costs, int height, int width, const Grid& grid, int small, const Steps& large,
        int direction)
      : costs(costs),
        height(height),
        width(width),
        grid(grid),
        small(small),
        large(large),
        direction(direction) {
    pitch = grid.count + kGuard;
    columns = width + 2;
    entries.assign(2 * size(), kBeyond);
    lowest.assign(2 * static_cast<size_t>(kPaths) * columns, 0);
    for (int path = 0; path < kPaths; ++path)
      for (int x = -1; x <= width; ++x)
        for (int n = 0; n < 2; ++n)
          if (n == 1 || x < 0 || x == width) std::fill_n(entry(n, path, x), grid.count, 0);
    last.resize(grid.count);
    for (auto& row : p2) row.assign(width, 0);
  }

  size_t size() const { return static_cast<size_t>(kPaths) * columns * pitch + kGuard; }
  // Path costs of the pixel at column x of the sweep's n-th row; columns -1 and width, and the row before the
  // first, lie outside the image.
  uint16_t* entry(int n, int path, int x) {
    return entries.data() + (n & 1) * size() + kGuard + (static_cast<size_t>(path) * columns + x + 1) * pitch;
  }
  uint16_t& low(int n, int path, int x) {
    return lowest[static_cast<size_t>((n & 1) * kPaths + path) * columns + x + 1];
  }

  // Penalties between the pixels of row y and those before them on every path.
  void prepare(int y) {
    const int from =
        direction > 0 ? y : y + 1;  // steps are stored with the lower, or right, of the two pixels
    const bool first = from <= 0 || from >= height;
    for (int x = 0; x < width; ++x) {
      p2[3][x] = direction > 0 ? large.row(0, y)[x] : (x + 1 < width ? large.row(0, y)[x + 1] : 0);
      if (first) continue;
      p2[0][x] = direction > 0 ? large.row(1, from)[x] : (x > 0 ? large.row(3, from)[x - 1] : 0);
      p2[1][x] = large.row(2, from)[x];
      p2[2][x] = direction > 0 ? large.row(3, from)[x] : (x + 1 < width ? large.row(1, from)[x + 1] : 0);
    }
  }

  // The sweep's rows [from, to): sums are stored, or, with `out`, added to and their winners written.
  void rows(int from, int to, uint16_t* sums, uint16_t* out) {
    for (int n = from; n < to; ++n) {
      const int y = direction > 0 ? n : height - 1 - n;
      prepare(y);
      const size_t at = static_cast<size_t>(y) * width;
      run(*this, n, costs + at * grid.count, sums + at * grid.count, out ? out + at : nullptr);
    }
  }

  SEEPAST_CLONES static void run(Sweep& sweep, int n, const uint8_t* costs, uint16_t* sums, uint16_t* out);

  const uint8_t* costs;
  int height, width;
  const Grid& grid;
  int small;
  const Steps& large;
  int direction;
  int pitch, columns;
  std::vector<uint16_t> entries, lowest, last;
  std::vector<uint16_t> p2[kPaths];
};

void Sweep::run(Sweep& sweep, int n, const uint8_t* costs, uint16_t* sums, uint16_t* out) {
  const int count = sweep.grid.count;
  const uint16_t small = static_cast<uint16_t>(sweep.small);
  for (int i = 0; i < sweep.width; ++i) {
    const int x = sweep.direction > 0 ? i : sweep.width - 1 - i;
    Step steps[kPaths];
    for (int path = 0; path < kPaths; ++path) {
      const int row = path < 3 ? n - 1 : n, column = path < 3 ? x + path - 1 : x - sweep.direction;
      steps[path] = {sweep.entry(row, path, column), sweep.low(row, path, column), sweep.p2[path][x],
                     sweep.entry(n, path, x)};
    }
    uint16_t minima[kPaths];
    uint16_t* sum = sums + static_cast<size_t>(x) * count;
    const uint8_t* cost = costs + static_cast<size_t>(x) * count;
    if (out) {
      four_steps<true>(cost, count, small, steps, sum, sweep.last.data(), minima);
      out[x] = winner(sweep.last.data(), sweep.grid);
    } else {
      four_steps<false>(cost, count, small, steps, nullptr, sum, minima);
    }
    for (int path = 0; path < kPaths; ++path) sweep.low(n, path, x) = minima[path];
  }
}

}  // namespace

void aggregate(const uint8_t* costs, const uint8_t* image, const uint8_t* is_static, int height, int width,
               const Grid& grid, const Penalties& penalties, uint16_t* scratch, uint16_t* out) {
  const Steps large(image, is_static, height, width, penalties);
  const int half = height / 2;
  Sweep sweeps[2] = {{costs, height, width, grid, penalties.small, large, 1},
                     {costs, height, width, grid, penalties.small, large, -1}};
  const int met[2] = {half, height - half};  // rows that each has done when they meet
#pragma omp parallel for schedule(static, 1)
  for (int s = 0; s < 2; ++s) sweeps[s].rows(0, met[s], scratch, nullptr);
#pragma omp parallel for schedule(static, 1)
  for (int s = 0; s < 2; ++s) sweeps[s].rows(met[s], height, scratch, out);
}

}  // namespace seepast
