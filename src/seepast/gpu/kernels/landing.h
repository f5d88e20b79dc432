// Rays of a view into the other cameras at disparities of views.
#pragma once

#include "device.h"

namespace seepast {

constexpr int kUnits = 32;  // disparities of views: uint16 in 32nds of a pixel over the array

// ray_shift without its division where a camera is no further forward: 1 / (1 - 0) is 1.
SEEPAST_HD RayShift shift_of(const float* offset, float d) {
  const float az = offset[2], s = az == 0.0f ? 1.0f : 1.0f / (1.0f - d * az);
  return {s - 1.0f, d * offset[0] * s, d * offset[1] * s, offset[3], offset[4]};
}

// Where a pixel of a view with disparity `units` (32nds of a pixel) lies in another camera, to whole pixels,
// and the disparity expected there.
struct Landing {
  int column, row, expected;
};

SEEPAST_HD Landing land(const float* offset, float cx, float cy, int x, int y, int units) {
  const float d = static_cast<float>(units);
  const RayShift shift = shift_of(offset, d / static_cast<float>(kUnits));
  return {x + whole_offset(ray_dx(shift, x, cx)), y + whole_offset(ray_dy(shift, y, cy)),
          floor_int(d * (shift.zoom + 1.0f) + 0.5f)};
}

// Whether 0 <= i < count.
SEEPAST_HD bool within(int i, int count) { return static_cast<uint32_t>(i) < static_cast<uint32_t>(count); }

}  // namespace seepast
