// Descriptors at the ends of rays, shared by the stages that look at single pixels: support and segmentation.
#pragma once

#include "core.h"

namespace seepast {

// Sum of squared differences of two 16-sample descriptors.
inline int squared_distance(const int16_t* a, const int16_t* b) {
  int sum = 0;
  for (int m = 0; m < kSamples; ++m) {
    const int difference = a[m] - b[m];
    sum += difference * difference;
  }
  return sum;
}

// The descriptor at a quarter position that lies inside the image.
inline void ray_descriptor(const uint8_t* descriptors, int width, int xq, int row, int16_t* out) {
  const int phase = xq & 3;
  const uint8_t* left = descriptors + (static_cast<size_t>(row) * width + (xq >> 2)) * kSamples;
  const uint8_t* right = left + (phase ? kSamples : 0);
  for (int m = 0; m < kSamples; ++m) out[m] = static_cast<int16_t>(interpolate(left[m], right[m], phase));
}

// Where ray k of reference pixel (x, y) at disparity d is sampled for matching.
struct QuarterPosition {
  int xq, row;
};
inline QuarterPosition quarter_position(const Array& array, int k, int x, int y, float d) {
  const RayShift shift = array.shift(k, d);
  return {4 * x + quarter_offset(ray_dx(shift, x, array.cx)), y + whole_offset(ray_dy(shift, y, array.cy))};
}

}  // namespace seepast
