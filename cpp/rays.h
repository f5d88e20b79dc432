// Descriptors at the ends of rays, shared by the stages that look at single pixels: support and segmentation.
// Written with vectors of 16 samples, a GCC and Clang extension: compilers do not find them in plain loops.
#pragma once

#include <cstring>

#include "core.h"

namespace seepast {

typedef uint8_t Descriptor __attribute__((vector_size(kSamples)));  // biased by 128
typedef uint16_t Words __attribute__((vector_size(2 * kSamples)));
typedef uint32_t Longs __attribute__((vector_size(4 * kSamples)));

inline Descriptor load(const uint8_t* samples) {
  Descriptor d;
  std::memcpy(&d, samples, sizeof d);
  return d;
}

// |a - b| of every sample.
inline Words absolute_difference(const Descriptor& a, const Descriptor& b) {
  return __builtin_convertvector(a > b ? a - b : b - a, Words);
}

// Sum of squared differences of two descriptors.
inline int squared_distance(const Descriptor& a, const Descriptor& b) {
  const Words difference = absolute_difference(a, b);
  const Longs squares = __builtin_convertvector(difference * difference, Longs);  // 255^2 fits a word
  uint32_t sum = 0;
  for (int m = 0; m < kSamples; ++m) sum += squares[m];
  return static_cast<int>(sum);
}

// The descriptor at a quarter position that lies inside the image (pixel.h interpolate, on all samples).
inline Descriptor ray_descriptor(const uint8_t* descriptors, int width, int xq, int row) {
  const uint16_t phase = xq & 3;
  const uint8_t* left = descriptors + (static_cast<size_t>(row) * width + (xq >> 2)) * kSamples;
  const Words a = __builtin_convertvector(load(left), Words);
  const Words b = __builtin_convertvector(load(left + (phase ? kSamples : 0)), Words);
  return __builtin_convertvector((a * static_cast<uint16_t>(4 - phase) + b * phase + 2) >> 2, Descriptor);
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
