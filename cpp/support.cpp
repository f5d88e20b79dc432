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
constexpr float kRefineReach =
    0.75f;  // px in the partner: a whole-pixel match is off by half of one, or a little more

bool within_margin(int x, int y, int width, int height) {
  return x >= kMargin && x < width - kMargin && y >= kMargin && y < height - kMargin;
}

// Sum of absolute differences of the descriptors of the four pixels two up, down, left and right, diagonally.
inline int block_cost(const uint8_t* a, const uint8_t* b, ptrdiff_t two_rows) {
  Words sums = {};
  for (int corner = 0; corner < 4; ++corner) {
    const ptrdiff_t at = (corner < 2 ? -two_rows : two_rows) + (corner & 1 ? 2 * kSamples : -2 * kSamples);
    sums += absolute_difference(load(a + at), load(b + at));
  }
  int sum = 0;
  for (int m = 0; m < kSamples; ++m) sum += sums[m];
  return sum;
}

// Costs of one block against those at `offsets` from `to`; a negative offset is not allowed to match.
SEEPAST_CLONES
void block_costs(const uint8_t* here, const uint8_t* to, const int* offsets, int count, int width,
                 int* costs) {
  const ptrdiff_t two_rows = 2 * static_cast<ptrdiff_t>(width) * kSamples;
  for (int i = 0; i < count; ++i)
    costs[i] = offsets[i] < 0
                   ? kNoMatch
                   : block_cost(here, to + static_cast<ptrdiff_t>(offsets[i]) * kSamples, two_rows);
}

struct Point {
  int x, y;
};

struct Scratch {
  explicit Scratch(size_t count) : costs(count), offsets(count) {}
  std::vector<int> costs, offsets;
};

// One direction of matching: points of camera `here`, from which `array` is seen, looked for in `there`.
struct Matcher {
  Matcher(const Array& array, int here, int there, const uint8_t* descriptors, const uint8_t* is_static,
          const Grid& grid, const SupportParams& params)
      : array(array), params(params) {
    const size_t pixels = array.pixels();
    from = descriptors + here * pixels * kSamples;
    to = descriptors + there * pixels * kSamples;
    to_static = is_static + there * pixels;
    parallax = std::fabs(array.offsets[kOffsets * there]);
    const float step = 1.0f / parallax, first = grid.value(0), last = grid.value(grid.count - 1);
    const int count = static_cast<int>((last - first) / step) + 1;
    for (int i = 0; i < count; ++i) {
      disparities.push_back(first + step * static_cast<float>(i));
      shifts.push_back(array.shift(there, disparities.back()));
    }
  }

  Point land(Point p, int i) const {
    return {p.x + whole_offset(ray_dx(shifts[i], p.x, array.cx)),
            p.y + whole_offset(ray_dy(shifts[i], p.y, array.cy))};
  }

  // Index of the best disparity, or -1 if it is not sure.
  int best(Point p, Scratch& scratch) const {
    const int count = static_cast<int>(disparities.size());
    for (int i = 0; i < count; ++i) {
      const Point q = land(p, i);
      const bool ok = within_margin(q.x, q.y, array.width, array.height) && to_static[at(q)];
      scratch.offsets[i] = ok ? static_cast<int>(at(q)) : -1;
    }
    block_costs(from + at(p) * kSamples, to, scratch.offsets.data(), count, array.width,
                scratch.costs.data());
    const auto& costs = scratch.costs;
    const int index =
        static_cast<int>(std::min_element(costs.begin(), costs.begin() + count) - costs.begin());
    const int lowest = costs[index];
    int second = kNoMatch;
    for (int i = 0; i < count; ++i)
      if (i < index - 1 || i > index + 1) second = std::min(second, costs[i]);
    const bool sure = static_cast<float>(lowest) < params.uniqueness * static_cast<float>(second) &&
                      static_cast<float>(lowest) <= params.max_cost * (4 * kSamples);
    return sure ? index : -1;
  }

  size_t at(Point p) const { return static_cast<size_t>(p.y) * array.width + p.x; }

  const Array& array;
  const SupportParams& params;
  const uint8_t *from, *to, *to_static;
  float parallax;  // |a| of `there`: px per px of disparity
  std::vector<float> disparities;
  std::vector<RayShift> shifts;
};

// Var_S of the static rays' descriptors at one disparity; infinite with fewer than two.
SEEPAST_CLONES
float ray_variance(const Array& array, const uint8_t* descriptors, const uint8_t* is_static, int x, int y,
                   float d) {
  Descriptor f[kMaxCameras];
  const size_t pixels = array.pixels();
  int n = 0, spread = 0;
  for (int k = 0; k < array.cameras; ++k) {
    const QuarterPosition q = quarter_position(array, k, x, y, d);
    if (!inside(q.xq, q.row, array.width, array.height)) continue;
    const uint8_t* label = is_static + k * pixels + static_cast<size_t>(q.row) * array.width + (q.xq >> 2);
    if (!label[0] || ((q.xq & 3) && !label[1])) continue;
    f[n] = ray_descriptor(descriptors + k * pixels * kSamples, array.width, q.xq, q.row);
    for (int j = 0; j < n; ++j) spread += squared_distance(f[n], f[j]);
    ++n;
  }
  if (n < 2) return std::numeric_limits<float>::infinity();
  const float inverse = 1.0f / static_cast<float>(n);
  return static_cast<float>(spread) * (inverse * inverse);
}

// The candidate of the grid near d that has the least variance.
SupportPoint refine(const Array& array, const uint8_t* descriptors, const uint8_t* is_static,
                    const Grid& grid, float parallax, Point p, float d) {
  const float reach = kRefineReach / parallax;
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

// Where points must land in the reference to be wanted: of other cameras where it is blind, so that most need
// no matching at all.
struct Targets {
  // where: widened by kMargin, which covers what refinement and residual row offsets still move.
  Targets(const Array& view, int reference, const Grid& grid, const uint8_t* where)
      : view(view),
        where(where),
        reference(reference),
        far_end(view.shift(reference, grid.value(0))),
        near_end(view.shift(reference, grid.value(grid.count - 1))) {
    sums.assign(static_cast<size_t>(view.height) * (view.width + 1), 0);
    for (int y = 0; y < view.height; ++y) {
      int* row = sums.data() + static_cast<size_t>(y) * (view.width + 1);
      for (int x = 0; x < view.width; ++x)
        row[x + 1] = row[x] + where[static_cast<size_t>(y) * view.width + x];
    }
  }

  // False only if no disparity of the grid takes the point to a target.
  bool reachable(Point p) const {
    const int x0 = p.x + whole_offset(ray_dx(far_end, p.x, view.cx)), y0 = row(far_end, p);
    const int x1 = p.x + whole_offset(ray_dx(near_end, p.x, view.cx)), y1 = row(near_end, p);
    if (std::abs(y1 - y0) > kMargin - 2) return true;  // too crooked an array to say from one row
    const int y = clamp((y0 + y1) / 2, 0, view.height - 1);
    const int* sum = sums.data() + static_cast<size_t>(y) * (view.width + 1);
    return sum[clamp(std::max(x0, x1) + 1, 0, view.width)] > sum[clamp(std::min(x0, x1), 0, view.width)];
  }

  // False only if refining d cannot take the point to a target.
  bool reached(Point p, float d, float moves) const {
    if (moves > kMargin - 2) return true;
    const RayShift shift = view.shift(reference, d);
    const int x = p.x + whole_offset(ray_dx(shift, p.x, view.cx)), y = row(shift, p);
    return x < -kMargin || x >= view.width + kMargin || y < -kMargin || y >= view.height + kMargin
               ? false
               : where[static_cast<size_t>(clamp(y, 0, view.height - 1)) * view.width +
                       clamp(x, 0, view.width - 1)];
  }

  int row(const RayShift& shift, Point p) const { return p.y + whole_offset(ray_dy(shift, p.y, view.cy)); }

  const Array& view;
  const uint8_t* where;
  int reference;
  RayShift far_end, near_end;
  std::vector<int> sums;
};

int texture(const uint8_t* descriptor) {
  int sum = 0;
  for (int m = 0; m < kSamples; ++m) sum += descriptor[m] > 128 ? descriptor[m] - 128 : 128 - descriptor[m];
  return sum;
}

}  // namespace

int support_of_camera(const Array& view, const Array& back_view, int base, int partner,
                      const uint8_t* descriptors, const uint8_t* is_static, const uint8_t* where,
                      int reference, const Grid& grid, const SupportParams& params, SupportPoint* points) {
  const Targets targets(view, reference, grid, where);
  const Matcher forth(view, base, partner, descriptors, is_static, grid, params);
  const Matcher back(back_view, partner, base, descriptors, is_static, grid, params);
  const uint8_t* base_static = is_static + base * view.pixels();
  const int rows = (view.height + params.grid - 1) / params.grid;
  const int columns = (view.width + params.grid - 1) / params.grid;
  std::vector<std::vector<SupportPoint>> found(rows);  // by row, so that the order does not depend on threads
#pragma omp parallel
  {
    Scratch scratch(std::max(forth.disparities.size(), back.disparities.size()));
#pragma omp for schedule(dynamic, 4)
    for (int j = 0; j < rows; ++j)
      for (int i = 0; i < columns; ++i) {
        const Point p{i * params.grid, j * params.grid};
        if (!within_margin(p.x, p.y, view.width, view.height) || !base_static[forth.at(p)]) continue;
        if (!targets.reachable(p)) continue;
        if (texture(forth.from + forth.at(p) * kSamples) < params.texture) continue;
        const int there = forth.best(p, scratch);
        if (there < 0) continue;
        const float moves = kRefineReach * std::fabs(view.offsets[kOffsets * reference]) / forth.parallax;
        if (!targets.reached(p, forth.disparities[there], moves)) continue;
        const Point q = forth.land(p, there);
        const int again = back.best(q, scratch);
        if (again < 0 || std::abs(back.land(q, again).x - p.x) > params.left_right) continue;
        found[j].push_back(
            refine(view, descriptors, is_static, grid, forth.parallax, p, forth.disparities[there]));
      }
  }
  int count = 0;
  for (const auto& row : found)
    for (const SupportPoint& point : row) points[count++] = point;
  return count;
}

}  // namespace seepast
