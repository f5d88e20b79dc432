// Descriptors at the ends of rays of single pixels, for the stages support and segmentation.
#pragma once

#include "device.h"

namespace seepast {

struct QuarterPosition {
  int xq, row;
};

// Where matching looks in a camera of these offsets: pixel (x, y) of the view with principal point (cx, cy).
static __device__ inline QuarterPosition quarter_position(const float* offset, float cx, float cy, int x,
                                                          int y, float d) {
  const RayShift shift = ray_shift(offset, d);
  return {4 * x + quarter_offset(ray_dx(shift, x, cx)), y + whole_offset(ray_dy(shift, y, cy))};
}

// Sixteen samples, each in 16 bits: samples 0 2, 1 3, 4 6, 5 7 ... of a descriptor interpolated at a quarter
// position.
struct Samples {
  uint32_t pairs[8];
};

static __device__ inline Samples ray_samples(const uint4& left, const uint4& right, uint32_t phase) {
  const uint32_t a[4] = {left.x, left.y, left.z, left.w}, b[4] = {right.x, right.y, right.z, right.w};
  constexpr uint32_t kEven = 0x00ff00ffu, kHalf = 0x00020002u;
  Samples s;
  for (int i = 0; i < 4; ++i) {  // a product has 10 bits at most, so that pairs do not meet
    s.pairs[2 * i] = (((a[i] & kEven) * (4 - phase) + (b[i] & kEven) * phase + kHalf) >> 2) & kEven;
    s.pairs[2 * i + 1] =
        (((a[i] >> 8 & kEven) * (4 - phase) + (b[i] >> 8 & kEven) * phase + kHalf) >> 2) & kEven;
  }
  return s;
}

// The descriptor of a camera at a quarter position inside its image.
static __device__ inline Samples samples_at(const uint4* descriptors, int width, QuarterPosition q) {
  const uint4* left = descriptors + static_cast<size_t>(q.row) * width + (q.xq >> 2);
  const uint32_t phase = q.xq & 3;
  return ray_samples(left[0], left[phase ? 1 : 0], phase);
}

// Descriptors added up, for the sum of squared differences of all pairs: n sum f^2 - (sum f)^2. Up to 16
// rays.
struct Spread {
  uint32_t sums[8] = {0, 0, 0, 0, 0, 0, 0, 0};  // of two samples each
  uint32_t squares = 0;
  int n = 0;

  __device__ inline void add(const Samples& s) {
    for (int i = 0; i < 8; i += 2) {
      const uint32_t four = s.pairs[i] | s.pairs[i + 1] << 8;
      squares = __dp4a(four, four, squares);
      sums[i] += s.pairs[i];
      sums[i + 1] += s.pairs[i + 1];
    }
    ++n;
  }
  __device__ inline int of_pairs() const {
    uint32_t of_sums = 0;
    for (int i = 0; i < 8; ++i) {
      const uint32_t low = sums[i] & 0xffffu, high = sums[i] >> 16;
      of_sums += low * low + high * high;
    }
    return static_cast<int>(static_cast<uint32_t>(n) * squares - of_sums);
  }
};

}  // namespace seepast
