// Stage "prior": the planes of the triangulation, and the candidates that every cell's support points suggest.
#include <algorithm>
#include <cmath>

#include "core.h"

namespace seepast {
namespace {

// The plane d(x, y) over one triangle, and its edges as signed areas.
struct Triangle {
  Triangle(const float* a, const float* b, const float* c)
      : x0(a[0]), y0(a[1]), d0(a[2]), x1(b[0]), y1(b[1]), x2(c[0]), y2(c[1]) {
    const double d1 = b[2], d2 = c[2];
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0);
    slope_x = ((d1 - d0) * (y2 - y0) - (d2 - d0) * (y1 - y0)) / area;
    slope_y = ((d2 - d0) * (x1 - x0) - (d1 - d0) * (x2 - x0)) / area;
  }
  bool covers(double x, double y) const {
    const double e0 = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0);
    const double e1 = (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1);
    const double e2 = (x0 - x2) * (y - y2) - (y0 - y2) * (x - x2);
    return e0 * area >= 0 && e1 * area >= 0 && e2 * area >= 0;
  }
  double at(double x, double y) const { return d0 + slope_x * (x - x0) + slope_y * (y - y0); }

  double x0, y0, d0, x1, y1, x2, y2, area, slope_x, slope_y;
};

}  // namespace

void plane_means(const float* points, const int32_t* triangles, int count, int height, int width, int gap,
                 int32_t* mean) {
  constexpr int kBand = 32;  // rows of one task; within it triangles come in order, the earlier one wins an edge
#pragma omp parallel for schedule(dynamic, 1)
  for (int top = 0; top < height; top += kBand) {
    const int bottom = std::min(height, top + kBand);
    std::fill(mean + static_cast<size_t>(top) * width, mean + static_cast<size_t>(bottom) * width, gap);
    for (int t = 0; t < count; ++t) {
      const float* corner[3];
      for (int j = 0; j < 3; ++j) corner[j] = points + 3 * static_cast<size_t>(triangles[3 * t + j]);
      const auto [low_y, high_y] = std::minmax({corner[0][1], corner[1][1], corner[2][1]});
      if (high_y < static_cast<float>(top) || low_y >= static_cast<float>(bottom)) continue;
      const auto [low_x, high_x] = std::minmax({corner[0][0], corner[1][0], corner[2][0]});
      const Triangle triangle(corner[0], corner[1], corner[2]);
      if (triangle.area == 0) continue;
      const int first = std::max(top, static_cast<int>(low_y)), last = std::min(bottom - 1, static_cast<int>(high_y));
      for (int y = first; y <= last; ++y)
        for (int x = static_cast<int>(low_x); x <= static_cast<int>(high_x); ++x) {
          int32_t& m = mean[static_cast<size_t>(y) * width + x];
          if (m == gap && triangle.covers(x, y))
            m = static_cast<int32_t>(std::floor(8.0 * triangle.at(x, y) + 0.5));
        }
    }
  }
}

void cell_candidates(const float* points, int count, int rows, int columns, const Grid& grid, float radius,
                     uint8_t* cells) {
  for (int p = 0; p < count; ++p) {
    const int row = static_cast<int>(points[3 * p + 1]) / 16, column = static_cast<int>(points[3 * p]) / 32;
    const float d = points[3 * p + 2];
    for (int i = 0; i < grid.count; ++i) {
      if (!(std::fabs(grid.value(i) - d) <= radius)) continue;
      for (int r = std::max(0, row - 1); r <= std::min(rows - 1, row + 1); ++r)
        for (int c = std::max(0, column - 1); c <= std::min(columns - 1, column + 1); ++c)
          cells[(static_cast<size_t>(r) * columns + c) * grid.count + i] = 1;
    }
  }
}

}  // namespace seepast
