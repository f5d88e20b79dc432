// Stage "disparity", the M-step: argmin_d beta Var_S(f(x^1) .. f(x^K)) - log p(d | T, x) over the candidates.
//
// The loops run disparity by disparity over runs of a band of rows, not pixel by pixel over disparities: at
// one disparity a row of a camera is read with one constant shift, which vectorises; the candidates of a
// pixel only decide whether its energy may win.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

#include "core.h"

namespace seepast {
namespace {

constexpr int kCellRows = 16, kCellColumns = 32;  // candidates.py CELL
constexpr int kAnyDistance = 1 << 30;
constexpr int kReach = 2;  // of the descriptor's pattern

SEEPAST_CLONES
void phase_row(const int8_t* __restrict du, const int8_t* __restrict dv, const uint8_t* __restrict is_static,
               int width, int phase, int8_t* __restrict out_du, int8_t* __restrict out_dv,
               int8_t* __restrict out_static) {
  const int last = phase ? width - 1 : width;  // the pixel after the last one does not exist
  const int next = phase ? 1 : 0;
  for (int x = 0; x < last; ++x) {
    const int8_t known = static_cast<int8_t>(is_static[x] & is_static[x + next]);
    out_du[x] = static_cast<int8_t>(known * interpolate(du[x], du[x + next], phase));
    out_dv[x] = static_cast<int8_t>(known * interpolate(dv[x], dv[x + next], phase));
    out_static[x] = known;
  }
  for (int x = last; x < width; ++x) out_du[x] = out_dv[x] = out_static[x] = 0;
}

// Adds one camera's rays to the sums of a row: number of rays, sum and sum of squares of du and dv.
SEEPAST_CLONES
void add_rays(const int8_t* __restrict du, const int8_t* __restrict dv, const int8_t* __restrict known,
              int count, int16_t* __restrict n, int16_t* __restrict sum_du, int16_t* __restrict sum_dv,
              int32_t* __restrict sq_du, int32_t* __restrict sq_dv) {
  for (int x = 0; x < count; ++x) {
    const int16_t u = du[x], v = dv[x];
    n[x] = static_cast<int16_t>(n[x] + known[x]);
    sum_du[x] = static_cast<int16_t>(sum_du[x] + u);
    sum_dv[x] = static_cast<int16_t>(sum_dv[x] + v);
    sq_du[x] += static_cast<int16_t>(u * u);
    sq_dv[x] += static_cast<int16_t>(v * v);
  }
}

SEEPAST_CLONES
void pack_row(const int16_t* __restrict n, const int16_t* __restrict sum_du, const int16_t* __restrict sum_dv,
              const int32_t* __restrict sq_du, const int32_t* __restrict sq_dv, int count,
              int32_t* __restrict du, int32_t* __restrict dv, uint8_t* __restrict seen) {
  for (int x = 0; x < count; ++x) seen[x] = n[x] > 0;
  for (int x = 0; x < count; ++x) du[x] = packed_variance(n[x], sum_du[x], sq_du[x]);
  for (int x = 0; x < count; ++x) dv[x] = packed_variance(n[x], sum_dv[x], sq_dv[x]);
}

// Sums the packed variances over the descriptor's pattern. du and dv: the five rows around, starting kReach
// columns before the first pixel. Where there is no variance, `out` holds what stands for it, and keeps it.
SEEPAST_CLONES
void variance_row(const int32_t* const* __restrict du, const int32_t* const* __restrict dv, int count,
                  float* __restrict out) {
  const int32_t *u0 = du[0], *u1 = du[1], *u2 = du[2], *u3 = du[3], *u4 = du[4];
  const int32_t *v1 = dv[1], *v2 = dv[2], *v3 = dv[3];
  for (int x = 0; x < count; ++x) {
    const int packed = u0[x + 2] + u1[x] + u1[x + 2] + u1[x + 4] + u2[x + 1] + 2 * u2[x + 2] + u2[x + 3] +
                       u3[x] + u3[x + 2] + u3[x + 4] + u4[x + 2] + v1[x + 2] + v2[x + 1] + v2[x + 3] +
                       v3[x + 2];
    const float variance = descriptor_variance(packed), instead = out[x];
    out[x] = u2[x + 2] > 0 ? variance : instead;
  }
}

// Lets the pixels whose candidate this is compete: those whose prior mean is within their `reach` of it.
// `prior` is scratch.
SEEPAST_CLONES
void compete_row(const float* __restrict variance, int count, int candidate, const int32_t* __restrict mean,
                 const int32_t* __restrict reach, float beta, const float* __restrict table, int tail,
                 float value, float* __restrict prior, float* __restrict best, float* __restrict out) {
  for (int x = 0; x < count; ++x) {  // apart, since it is a gather
    const int away = std::abs(candidate - mean[x]);
    prior[x] = table[away < tail ? away : tail];
  }
  for (int x = 0; x < count; ++x) {
    const int away = std::abs(candidate - mean[x]);
    const float energy = beta * variance[x] + prior[x];
    const float lowest = best[x], current = out[x];
    const bool wins = (away <= reach[x]) & (energy < lowest);
    best[x] = wins ? energy : lowest;
    out[x] = wins ? value : current;
  }
}

// Calls run(a, b, quarter) for the pieces of columns [from, to) whose rays keep one quarter-pixel offset.
// Where the array is straight there is one piece.
template <class Run>
void constant_runs(const Array& array, const RayShift& shift, int from, int to, const Run& run) {
  for (int x = from; x < to;) {
    const int quarter = quarter_offset(ray_dx(shift, x, array.cx));
    int end = to;  // the offset is monotonic in x: search for the last column that has it
    if (quarter_offset(ray_dx(shift, to - 1, array.cx)) != quarter) {
      int same = x;
      while (end - same > 1) {
        const int middle = same + (end - same) / 2;
        (quarter_offset(ray_dx(shift, middle, array.cx)) == quarter ? same : end) = middle;
      }
    }
    run(x, end, quarter);
    x = end;
  }
}

// Everything one thread needs while it sweeps a band.
struct Sweep {
  Sweep(const Array& array, const int8_t* phases)
      : array(array), phases(phases), stride(array.width + 2 * kReach) {
    n.resize(3 * static_cast<size_t>(stride));
    squares.resize(2 * static_cast<size_t>(stride));
    variance.resize(stride);
    prior.resize(stride);
    reach.resize(stride);
    seen.resize((kCellRows + 2 * kReach) * static_cast<size_t>(stride));
    packed.resize(2 * (kCellRows + 2 * kReach) * static_cast<size_t>(stride));
  }

  int32_t* row(int plane, int j) {
    return packed.data() + (static_cast<size_t>(plane) * (kCellRows + 4) + j) * stride;
  }

  uint8_t* seen_row(int j) { return seen.data() + static_cast<size_t>(j) * stride; }

  // Packed variances of reference row y, columns [from, to), at disparity d; column 0 of the row is `from`.
  void variances(int y, int from, int to, float d, int32_t* du, int32_t* dv, uint8_t* seen_of_row) {
    const int count = to - from;
    std::fill_n(n.data(), 3 * static_cast<size_t>(stride), 0);
    std::fill_n(squares.data(), 2 * static_cast<size_t>(stride), 0);
    for (int k = 0; k < array.cameras; ++k) {
      const RayShift shift = array.shift(k, d);
      const int row = y + whole_offset(ray_dy(shift, y, array.cy));
      if (row < 0 || row >= array.height) continue;
      constant_runs(array, shift, from, to,
                    [&](int a, int b, int quarter) { add_run(k, row, from, a, b, quarter); });
    }
    pack_row(n.data(), n.data() + stride, n.data() + 2 * stride, squares.data(), squares.data() + stride,
             count, du, dv, seen_of_row);
  }

  // Adds camera k's rays of columns [a, b), which all lie `quarter` quarter pixels off.
  void add_run(int k, int row, int from, int a, int b, int quarter) {
    const int whole = quarter >> 2, phase = quarter & 3;
    a = std::max(a, -whole);
    b = std::min(b, array.width - whole);
    if (a >= b) return;
    const size_t pixels = array.pixels();
    const int8_t* plane = phases + static_cast<size_t>(k * 4 + phase) * 3 * pixels +
                          static_cast<size_t>(row) * array.width + (a + whole);
    const int at = a - from;
    add_rays(plane, plane + pixels, plane + 2 * pixels, b - a, n.data() + at, n.data() + stride + at,
             n.data() + 2 * stride + at, squares.data() + at, squares.data() + stride + at);
  }

  const Array& array;
  const int8_t* phases;
  int stride;
  std::vector<int16_t> n;        // rays, sum du, sum dv
  std::vector<int32_t> squares;  // of du, of dv
  std::vector<float> variance;   // of the row that competes
  std::vector<float> prior;      // energy of its pixels
  std::vector<int32_t> reach;    // of its pixels
  std::vector<uint8_t> seen;     // by any ray, kCellRows + 4 rows
  std::vector<int32_t> packed;   // variances of du, dv: kCellRows + 4 rows each
};

// Which candidates concern which cells of a band of rows.
struct Band {
  Band(const Array& array, const int32_t* mean, const uint8_t* cells, const Grid& grid, const uint8_t* wanted,
       int radius, int y0)
      : width(array.width), y0(y0), y1(std::min(y0 + kCellRows, array.height)), count(grid.count) {
    columns = (width + kCellColumns - 1) / kCellColumns;
    active.assign(static_cast<size_t>(count) * columns, -1);
    for (int c = 0; c < columns; ++c) {
      int low = std::numeric_limits<int>::max(), high = std::numeric_limits<int>::min();
      for (int y = y0; y < y1; ++y)
        for (int x = c * kCellColumns; x < std::min(width, (c + 1) * kCellColumns); ++x)
          if (const size_t at = static_cast<size_t>(y) * width + x; wanted[at]) {
            low = std::min(low, mean[at]);
            high = std::max(high, mean[at]);
          }
      if (low > high) continue;  // nothing wanted here
      const uint8_t* of_cell = cells + (static_cast<size_t>(y0 / kCellRows) * columns + c) * count;
      for (int i = 0; i < count; ++i) {
        const int d8 = grid.first + i * grid.step;
        const bool near_mean = d8 >= low - radius && d8 <= high + radius;
        active[static_cast<size_t>(i) * columns + c] = of_cell[i] ? kAnyDistance : (near_mean ? radius : -1);
      }
    }
  }

  // How far from its prior mean a pixel may take candidate i; -1 where it is not wanted.
  void reach_row(int i, int from, int to, const uint8_t* wanted, int32_t* reach) const {
    for (int x = from; x < to; x += kCellColumns) {
      const int32_t of_cell = active[static_cast<size_t>(i) * columns + x / kCellColumns];
      const int end = std::min(to, x + kCellColumns);
      for (int at = x; at < end; ++at) reach[at - from] = wanted[at - from] ? of_cell : -1;
    }
  }

  // Next run of columns of cells from `c` on that candidate i concerns; false if none is left.
  bool next_run(int i, int& c, int& end) const {
    const int32_t* row = active.data() + static_cast<size_t>(i) * columns;
    while (c < columns && row[c] < 0) ++c;
    end = c;
    while (end < columns && row[end] >= 0) ++end;
    return c < columns;
  }

  int width, y0, y1, count, columns;
  std::vector<int32_t> active;  // reach by [candidate, column of cells], -1: none of its pixels
};

// One candidate over columns [from, to) of a band.
void sweep_run(Sweep& sweep, const Band& band, int i, int from, int to, const Grid& grid, const int32_t* mean,
               const uint8_t* wanted, const DisparityParams& params, float* best, float* out) {
  const int width = sweep.array.width, left = std::max(0, from - kReach),
            right = std::min(width, to + kReach);
  for (int j = 0; j < band.y1 - band.y0 + 2 * kReach; ++j) {
    const int y = band.y0 + j - kReach, at = left - (from - kReach);
    for (int plane = 0; plane < 2; ++plane)  // pixels beyond the image count as unknown
      std::memset(sweep.row(plane, j), 0, sizeof(int32_t) * (to - from + 2 * kReach));
    if (y < 0 || y >= sweep.array.height) continue;
    sweep.variances(y, left, right, grid.value(i), sweep.row(0, j) + at, sweep.row(1, j) + at,
                    sweep.seen_row(j) + at);
  }
  const int candidate = grid.first + i * grid.step;
  for (int y = band.y0; y < band.y1; ++y) {
    const int j = y - band.y0;
    const size_t at = static_cast<size_t>(y) * width + from;
    const int32_t *du[5], *dv[5];
    for (int r = 0; r < 5; ++r) du[r] = sweep.row(0, j + r), dv[r] = sweep.row(1, j + r);
    const uint8_t* seen = sweep.seen_row(j + kReach) + kReach;
    for (int x = 0; x < to - from; ++x)
      sweep.variance[x] = seen[x] ? params.lone_variance : params.unseen_variance;
    band.reach_row(i, from, to, wanted + at, sweep.reach.data());
    variance_row(du, dv, to - from, sweep.variance.data());
    compete_row(sweep.variance.data(), to - from, candidate, mean + at, sweep.reach.data(), params.beta,
                params.table, params.table_size - 1, grid.value(i), sweep.prior.data(), best + at, out + at);
  }
}

// Changed labels as matching meets them: at a pixel or the one right of it. Rows carry one column before the
// first.
struct ChangedRows {
  ChangedRows(const Array& array, const uint8_t* changed)
      : stride(array.width + 1),
        line(static_cast<size_t>(array.cameras) * array.height * stride),
        any(static_cast<size_t>(array.cameras) * array.height) {
    for (size_t row = 0; row < any.size(); ++row) {
      const uint8_t* from = changed + row * array.width;
      uint8_t* to = line.data() + row * stride;
      for (int x = 0; x < array.width; ++x) to[x] |= from[x], to[x + 1] |= from[x];
      any[row] = std::any_of(from, from + array.width, [](uint8_t c) { return c != 0; });
    }
  }
  int stride;
  std::vector<uint8_t> line, any;
};

void or_row(const uint8_t* __restrict from, int count, uint8_t* __restrict to) {
  for (int x = 0; x < count; ++x) to[x] |= from[x];
}

// hit: whether a ray of the pixels of reference row y meets a change at disparity d. False if none does.
bool meets_change(const Array& array, const ChangedRows& changed, int y, int from, int to, float d,
                  uint8_t* hit) {
  bool any = false;
  for (int k = 0; k < array.cameras; ++k) {
    const RayShift shift = array.shift(k, d);
    const int row = y + whole_offset(ray_dy(shift, y, array.cy));
    if (row < 0 || row >= array.height) continue;
    const size_t at = static_cast<size_t>(k) * array.height + row;
    if (!changed.any[at]) continue;
    if (!any) std::fill_n(hit, to - from, uint8_t{0});
    any = true;
    const uint8_t* line = changed.line.data() + at * changed.stride + 1;
    constant_runs(array, shift, from, to, [&](int a, int b, int quarter) {
      const int whole = quarter >> 2;
      a = std::max(a, -1 - whole);
      b = std::min(b, array.width - whole);
      if (a < b) or_row(line + a + whole, b - a, hit + a - from);
    });
  }
  return any;
}

}  // namespace

void affected(const Array& array, const uint8_t* changed_labels, const int32_t* mean, const uint8_t* cells,
              const Grid& grid, const uint8_t* wanted, int radius, uint8_t* out) {
  const ChangedRows changed(array, changed_labels);
  std::fill_n(out, array.pixels(), uint8_t{0});
  const int bands = (array.height + kCellRows - 1) / kCellRows;
#pragma omp parallel for schedule(dynamic, 1)
  for (int b = 0; b < bands; ++b) {
    const Band band(array, mean, cells, grid, wanted, radius, b * kCellRows);
    std::vector<int32_t> reach(array.width);
    std::vector<uint8_t> hit(array.width);
    for (int i = 0; i < grid.count; ++i)
      for (int c = 0, end = 0; band.next_run(i, c, end); c = end) {
        const int from = c * kCellColumns, to = std::min(array.width, end * kCellColumns);
        for (int y = band.y0; y < band.y1; ++y) {
          if (!meets_change(array, changed, y, from, to, grid.value(i), hit.data())) continue;
          const size_t row = static_cast<size_t>(y) * array.width + from;
          band.reach_row(i, from, to, wanted + row, reach.data());
          const int candidate = grid.first + i * grid.step;
          for (int x = 0; x < to - from; ++x)
            out[row + x] |= hit[x] & static_cast<uint8_t>(std::abs(candidate - mean[row + x]) <= reach[x]);
        }
      }
  }
}

void phase_planes(const Array& array, const int8_t* gradients, const uint8_t* is_static, int8_t* phases) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(static)
  for (int line = 0; line < array.cameras * array.height; ++line) {
    const int k = line / array.height;
    const size_t row = static_cast<size_t>(line % array.height) * array.width;
    const int8_t* du = gradients + 2 * k * pixels + row;
    for (int phase = 0; phase < 4; ++phase) {
      int8_t* to = phases + static_cast<size_t>(k * 4 + phase) * 3 * pixels + row;
      phase_row(du, du + pixels, is_static + k * pixels + row, array.width, phase, to, to + pixels,
                to + 2 * pixels);
    }
  }
}

void disparity(const Array& array, const int8_t* phases, const int32_t* mean, const uint8_t* cells,
               const Grid& grid, const uint8_t* wanted, const DisparityParams& params, float* out) {
  std::vector<float> best(array.pixels(), std::numeric_limits<float>::infinity());
  std::fill_n(out, array.pixels(), 0.0f);
  const int bands = (array.height + kCellRows - 1) / kCellRows;
#pragma omp parallel
  {
    Sweep sweep(array, phases);
#pragma omp for schedule(dynamic, 1)
    for (int b = 0; b < bands; ++b) {
      const Band band(array, mean, cells, grid, wanted, params.prior_radius, b * kCellRows);
      for (int i = 0; i < grid.count; ++i)
        for (int c = 0, end = 0; band.next_run(i, c, end); c = end)
          sweep_run(sweep, band, i, c * kCellColumns, std::min(array.width, end * kCellColumns), grid, mean,
                    wanted, params, best.data(), out);
    }
  }
}

}  // namespace seepast
