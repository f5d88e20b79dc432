// Stage "support": textured, unique, left-right consistent matches of grid points between neighbouring
// cameras.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "rays.h"

namespace seepast {
namespace {

constexpr int kMargin = 5;  // reference.py SUPPORT_MARGIN
constexpr int kNoMatch = 1 << 20;

bool within_margin(int x, int y, int width, int height) {
  return x >= kMargin && x < width - kMargin && y >= kMargin && y < height - kMargin;
}

// Sum of absolute differences of the descriptors of the four pixels two up, down, left and right, diagonally.
SEEPAST_CLONES
int block_cost(const uint8_t* a, const uint8_t* b, int width) {
  const ptrdiff_t rows[2] = {-2 * static_cast<ptrdiff_t>(width) * kSamples,
                             2 * static_cast<ptrdiff_t>(width) * kSamples};
  int sum = 0;
  for (const ptrdiff_t row : rows)
    for (const ptrdiff_t column : {-2 * kSamples, 2 * kSamples}) {
      const uint8_t *p = a + row + column, *q = b + row + column;
      for (int m = 0; m < kSamples; ++m) sum += p[m] > q[m] ? p[m] - q[m] : q[m] - p[m];
    }
  return sum;
}

struct Point {
  int x, y;
};

// One direction of matching: points of `here` looked for in `there`.
struct Matcher {
  Matcher(const Array& array, const float* offsets, int here, int there, const uint8_t* descriptors,
          const uint8_t* is_static, const Grid& grid, const SupportParams& params)
      : array(array), offset(offsets + 3 * there), params(params) {
    const size_t pixels = array.pixels();
    from = descriptors + here * pixels * kSamples;
    to = descriptors + there * pixels * kSamples;
    to_static = is_static + there * pixels;
    const float step = 1.0f / std::fabs(offset[0]), first = grid.value(0), last = grid.value(grid.count - 1);
    const int count = static_cast<int>((last - first) / step) + 1;
    for (int i = 0; i < count; ++i) {
      disparities.push_back(first + step * static_cast<float>(i));
      shifts.push_back(ray_shift(offset, disparities.back()));
    }
  }

  Point land(Point p, int i) const {
    return {p.x + whole_offset(ray_dx(shifts[i], p.x, array.cx)),
            p.y + whole_offset(ray_dy(shifts[i], p.y, array.cy))};
  }

  // Index of the best disparity, or -1 if it is not sure. `costs` is scratch.
  int best(Point p, std::vector<int>& costs) const {
    const int count = static_cast<int>(disparities.size());
    const uint8_t* here = from + at(p) * kSamples;
    int lowest = kNoMatch, index = 0;
    for (int i = 0; i < count; ++i) {
      const Point q = land(p, i);
      const bool ok = within_margin(q.x, q.y, array.width, array.height) && to_static[at(q)];
      costs[i] = ok ? block_cost(here, to + at(q) * kSamples, array.width) : kNoMatch;
      if (costs[i] < lowest) lowest = costs[i], index = i;
    }
    int second = kNoMatch;
    for (int i = 0; i < count; ++i)
      if (i < index - 1 || i > index + 1) second = std::min(second, costs[i]);
    const bool sure = static_cast<float>(lowest) < params.uniqueness * static_cast<float>(second) &&
                      static_cast<float>(lowest) <= params.max_cost * (4 * kSamples);
    return sure ? index : -1;
  }

  size_t at(Point p) const { return static_cast<size_t>(p.y) * array.width + p.x; }

  const Array& array;
  const float* offset;
  const SupportParams& params;
  const uint8_t *from, *to, *to_static;
  std::vector<float> disparities;
  std::vector<RayShift> shifts;
};

// Var_S of the static rays' descriptors at one disparity; infinite with fewer than two.
SEEPAST_CLONES
float ray_variance(const Array& array, const uint8_t* descriptors, const uint8_t* is_static, int x, int y,
                   float d) {
  int16_t f[kMaxCameras][kSamples];
  const size_t pixels = array.pixels();
  int n = 0, spread = 0;
  for (int k = 0; k < array.cameras; ++k) {
    const QuarterPosition q = quarter_position(array, k, x, y, d);
    if (!inside(q.xq, q.row, array.width, array.height)) continue;
    const uint8_t* label = is_static + k * pixels + static_cast<size_t>(q.row) * array.width + (q.xq >> 2);
    if (!label[0] || ((q.xq & 3) && !label[1])) continue;
    ray_descriptor(descriptors + k * pixels * kSamples, array.width, q.xq, q.row, f[n]);
    for (int j = 0; j < n; ++j) spread += squared_distance(f[n], f[j]);
    ++n;
  }
  if (n < 2) return std::numeric_limits<float>::infinity();
  const float inverse = 1.0f / static_cast<float>(n);
  return static_cast<float>(spread) * (inverse * inverse);
}

// The candidate of the grid within one neighbour step of d that has the least variance.
SupportPoint refine(const Array& array, const uint8_t* descriptors, const uint8_t* is_static,
                    const Grid& grid, float partner_offset, Point p, float d) {
  const float reach = 1.0f / std::fabs(partner_offset);
  const int steps = static_cast<int>(std::ceil(reach / (static_cast<float>(grid.step) / 8.0f)));
  const int nearest =
      floor_int((d * 8.0f - static_cast<float>(grid.first)) / static_cast<float>(grid.step) + 0.5f);
  int best = clamp(nearest, 0, grid.count - 1);
  float lowest = std::numeric_limits<float>::infinity();
  for (int i = std::max(0, nearest - steps); i <= std::min(grid.count - 1, nearest + steps); ++i) {
    const float variance = ray_variance(array, descriptors, is_static, p.x, p.y, grid.value(i));
    if (variance < lowest) lowest = variance, best = i;
  }
  return {static_cast<float>(p.x), static_cast<float>(p.y), grid.value(best), lowest};
}

int texture(const uint8_t* descriptor) {
  int sum = 0;
  for (int m = 0; m < kSamples; ++m) sum += descriptor[m] > 128 ? descriptor[m] - 128 : 128 - descriptor[m];
  return sum;
}

}  // namespace

int support_of_camera(const Array& array, const float* back_offsets, int base, int partner,
                      const uint8_t* descriptors, const uint8_t* is_static, const Grid& grid,
                      const SupportParams& params, SupportPoint* points) {
  const Matcher forth(array, array.offsets, base, partner, descriptors, is_static, grid, params);
  const Matcher back(array, back_offsets, partner, base, descriptors, is_static, grid, params);
  const uint8_t* base_static = is_static + base * array.pixels();
  const int rows = (array.height + params.grid - 1) / params.grid;
  const int columns = (array.width + params.grid - 1) / params.grid;
  std::vector<std::vector<SupportPoint>> found(rows);  // by row, so that the order does not depend on threads
#pragma omp parallel
  {
    std::vector<int> costs(std::max(forth.disparities.size(), back.disparities.size()));
#pragma omp for schedule(dynamic, 4)
    for (int j = 0; j < rows; ++j)
      for (int i = 0; i < columns; ++i) {
        const Point p{i * params.grid, j * params.grid};
        if (!within_margin(p.x, p.y, array.width, array.height) || !base_static[forth.at(p)]) continue;
        if (texture(forth.from + forth.at(p) * kSamples) < params.texture) continue;
        const int there = forth.best(p, costs);
        if (there < 0) continue;
        const Point q = forth.land(p, there);
        const int again = back.best(q, costs);
        if (again < 0 || std::abs(back.land(q, again).x - p.x) > params.left_right) continue;
        found[j].push_back(
            refine(array, descriptors, is_static, grid, forth.offset[0], p, forth.disparities[there]));
      }
  }
  int count = 0;
  for (const auto& row : found)
    for (const SupportPoint& point : row) points[count++] = point;
  return count;
}

}  // namespace seepast
