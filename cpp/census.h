// Everything that matching reads of the cameras, made row by row: a thread keeps the rows that it is at, so
// that they are still in its cache when they are matched.
#pragma once

#include <vector>

#include "multiview.h"

namespace seepast {

// What matching reads of a row of one camera: kPlanes rows of `stride` bytes, column x at x + kBlock. The 24
// bits of census and valid are three planes each. Outside the image nothing is valid or static and the rest
// is not set. Phase p is the sample at x + p / 4.
constexpr int kBytes = 3;
constexpr int plane_census(int phase) { return 2 * kBytes * phase; }
constexpr int plane_colour(int phase) { return plane_census(phase) + kBytes; }
constexpr int plane_valid(int phase) { return 8 * kBytes + (phase ? kBytes + 1 : 0); }
constexpr int plane_static(int phase) { return plane_valid(phase) + kBytes; }
constexpr int kPlanes = 10 * kBytes + 2;

constexpr int feature_stride(int width) { return (width + kBlock - 1) / kBlock * kBlock + 2 * kBlock; }

struct FeatureRow {
  uint8_t* planes;  // [kPlanes, stride]
  uint64_t*
      unclear;  // [2, words]: bit per column that is not static or lacks a valid bit, whole and fractional
};

// The last `slots` rows of every camera.
struct FeatureRing {
  FeatureRing(int cameras, int width, int rows)
      : cameras(cameras),
        stride(feature_stride(width)),
        words(stride / 64 + 1),
        slots(rows),
        planes(static_cast<size_t>(cameras) * slots * kPlanes * stride),
        unclear(static_cast<size_t>(cameras) * slots * 2 * words) {}

  FeatureRow row(int camera, int y) {
    const size_t slot = static_cast<size_t>(camera) * slots + static_cast<size_t>(y + slots) % slots;
    return {planes.data() + slot * kPlanes * stride, unclear.data() + slot * 2 * words};
  }

  int cameras, stride, words, slots;
  std::vector<uint8_t> planes;
  std::vector<uint64_t> unclear;
};

// One camera's picture.
struct DescribedView {
  int height, width;
  const uint8_t* colour;     // [H, W, 3]
  const uint8_t* is_static;  // [H, W]
  const int32_t* cubic;      // [4, 4] in 128ths
  const int32_t* luma;       // [3] in 256ths
};

// Fills the rows of one camera in a ring, in order.
class Describer {
 public:
  static constexpr int kReach = 3;  // rows and columns that the census looks away

  Describer(const DescribedView& view, FeatureRing& ring, int camera);

  // Rows [from, to) of the image are in the ring afterwards, which has kReach slots more than that. Rows that
  // were described before are taken to be there still: `from` and `to` rise from call to call.
  void describe(int from, int to);

 private:
  static constexpr int kRows = 8;  // at least 2 kReach + 1, a power of two

  uint16_t* luma_row(int y, int phase);
  uint8_t* static_row(int y, int phase);
  uint8_t* plane(int y, int number) const;
  void sample(int y);
  void census_row(int y, int phase);
  void valid_row(int y, int phase);

  const DescribedView& view;
  FeatureRing& ring;
  int camera;
  const bool wide = simd() >= Simd::avx512;
  int next = 0, sampled = -kReach;  // rows that come next: to describe, to sample
  size_t line;
  std::vector<uint16_t> luma;      // [kRows, 4, line]
  std::vector<uint8_t> is_static;  // [kRows, 2, line]
  std::vector<int16_t> channels;
  std::vector<int32_t> bright;
  std::vector<uint8_t> flags;
};

}  // namespace seepast
