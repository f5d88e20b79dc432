// Stage "prior": the planes of the triangulation, and the candidates that every cell's support points
// suggest.
#include <algorithm>
#include <cmath>

#include "core.h"

namespace seepast {
namespace {

// One triangle: its edges as signed areas, and the disparity inside.
struct Triangle {
  Triangle(const float* a, const float* b, const float* c, double max_step)
      : x{a[0], b[0], c[0]}, y{a[1], b[1], c[1]}, d{a[2], b[2], c[2]} {
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    slope_x = ((d[1] - d[0]) * (y[2] - y[0]) - (d[2] - d[0]) * (y[1] - y[0])) / area;
    slope_y = ((d[2] - d[0]) * (x[1] - x[0]) - (d[1] - d[0]) * (x[2] - x[0])) / area;
    bridges_edge = std::max({d[0], d[1], d[2]}) - std::min({d[0], d[1], d[2]}) > max_step;
  }
  bool covers(double px, double py) const {
    const double e0 = (x[1] - x[0]) * (py - y[0]) - (y[1] - y[0]) * (px - x[0]);
    const double e1 = (x[2] - x[1]) * (py - y[1]) - (y[2] - y[1]) * (px - x[1]);
    const double e2 = (x[0] - x[2]) * (py - y[2]) - (y[0] - y[2]) * (px - x[2]);
    return e0 * area >= 0 && e1 * area >= 0 && e2 * area >= 0;
  }
  double at(double px, double py) const {
    return bridges_edge ? d[nearest(px, py)] : d[0] + slope_x * (px - x[0]) + slope_y * (py - y[0]);
  }
  int nearest(double px, double py) const {
    double r[3];
    for (int j = 0; j < 3; ++j) r[j] = (px - x[j]) * (px - x[j]) + (py - y[j]) * (py - y[j]);
    const int first = r[1] < r[0] ? 1 : 0;
    return r[2] < r[first] ? 2 : first;
  }

  double x[3], y[3], d[3], area, slope_x, slope_y;
  bool bridges_edge;
};

}  // namespace

void plane_means(const float* points, const int32_t* triangles, int count, int height, int width,
                 double max_step, int gap, int32_t* mean) {
  constexpr int kBand =
      32;  // rows of one task; within it triangles come in order, the earlier one wins an edge
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
      const Triangle triangle(corner[0], corner[1], corner[2], max_step);
      if (triangle.area == 0) continue;
      const int first = std::max(top, static_cast<int>(low_y)),
                last = std::min(bottom - 1, static_cast<int>(high_y));
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
    const int nearest =
        floor_int((8.0f * d - static_cast<float>(grid.first)) / static_cast<float>(grid.step));
    const int around = static_cast<int>(8.0f * radius / static_cast<float>(grid.step)) + 2;
    for (int i = std::max(0, nearest - around); i < std::min(grid.count, nearest + around + 1); ++i) {
      if (!(std::fabs(grid.value(i) - d) <= radius)) continue;
      for (int r = std::max(0, row - 1); r <= std::min(rows - 1, row + 1); ++r)
        for (int c = std::max(0, column - 1); c <= std::min(columns - 1, column + 1); ++c)
          cells[(static_cast<size_t>(r) * columns + c) * grid.count + i] = 1;
    }
  }
}

}  // namespace seepast
