// The plane of stage "planes": what C++ and CUDA share (reference_multiview.plane_height).
#pragma once

#include "pixel.h"

namespace seepast {

// Weighted sums over the neighbours of a pixel: of 1, x, y, x^2, x y, y^2, the step e of the disparity, e x,
// e y.
struct PlaneSums {
  float w, x, y, xx, xy, yy, e, ex, ey;
};

// Height of the least-squares plane over its pixel, 32nds of a pixel.
SEEPAST_HD double plane_height(const PlaneSums& sums, double ridge) {
  const double one = 1.0 / static_cast<double>(sums.w);
  const double mx = sums.x * one, my = sums.y * one, me = sums.e * one;
  const double a = sums.xx * one - mx * mx + ridge, b = sums.xy * one - mx * my,
               c = sums.yy * one - my * my + ridge;
  const double u = sums.ex * one - mx * me, v = sums.ey * one - my * me;
  const double det = a * c - b * b;
  return me - (c * u - b * v) / det * mx - (a * v - b * u) / det * my;
}

}  // namespace seepast
