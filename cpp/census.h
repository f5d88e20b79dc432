// Everything that matching reads of the cameras, made row by row: a thread keeps the rows that it is at, so
// that they are still in its cache when they are matched.
#pragma once

#include <algorithm>
#include <vector>

#include "multiview.h"

namespace seepast {

// What matching reads of a row of one camera begins with kPlanes rows of `stride` bytes, column x at x +
// kBlock. The 24 bits of census and valid are three planes each. Outside the image nothing is valid or static
// and the rest is not set. Phase p is the sample at x + p / 2.
constexpr int kPhases = 2;
constexpr int kBytes = 3;
constexpr int kPlanesOfPhase = 3 * kBytes + 1;
constexpr int plane_census(int phase) { return kPlanesOfPhase * phase; }
constexpr int plane_colour(int phase) { return plane_census(phase) + kBytes; }
constexpr int plane_valid(int phase) { return plane_census(phase) + 2 * kBytes; }
constexpr int plane_static(int phase) { return plane_valid(phase) + kBytes; }
constexpr int kPlanes = kPhases * kPlanesOfPhase;

constexpr int feature_stride(int width) { return (width + kBlock - 1) / kBlock * kBlock + 2 * kBlock; }

// Behind the planes of a row: a bit per column, [kPhases, bit_stride(stride)] bytes each. Four bytes may be
// read from any column's on.
constexpr int bit_stride(int stride) { return stride / 8 + 8; }
constexpr int bits_unclear(int stride) { return kPlanes * stride; }  // not static, or lacks a valid bit
constexpr int bits_seen(int stride) { return bits_unclear(stride) + kPhases * bit_stride(stride); }  // static
constexpr int bytes_of_row(int stride) {
  return (bits_seen(stride) + kPhases * bit_stride(stride) + kBlock - 1) / kBlock * kBlock;
}

// The last `slots` rows of every camera, and one that lies outside every image.
struct FeatureRing {
  FeatureRing(int cameras, int width, int rows)
      : cameras(cameras),
        stride(feature_stride(width)),
        slots(rows),
        bytes((static_cast<size_t>(cameras) * slots + 1) * bytes_of_row(stride)) {
    for (size_t slot = 0; slot <= static_cast<size_t>(cameras) * slots; ++slot)
      std::fill_n(at(slot) + bits_unclear(stride), kPhases * bit_stride(stride), uint8_t{255});
  }

  uint8_t* row(int camera, int y) {
    return at(static_cast<size_t>(camera) * slots + static_cast<size_t>(y + slots) % slots);
  }
  uint8_t* outside() { return at(static_cast<size_t>(cameras) * slots); }

  int cameras, stride, slots;

 private:
  uint8_t* at(size_t slot) { return bytes.data() + slot * bytes_of_row(stride); }

  std::vector<uint8_t> bytes;
};

// One camera's picture.
struct DescribedView {
  int height, width;
  const uint8_t* colour;     // [H, W, 3]
  const uint8_t* is_static;  // [H, W]
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
  uint8_t* full_row(int y, int phase);
  uint8_t* plane(int y, int number) const;
  uint8_t* bits(int y, int phase, int from) const;
  void sample(int y);
  void census_row(int y, int phase);
  void valid_row(int y, int phase);
  void valid_block(int y, int phase, int from);
  bool clear_block(int y, int phase, int block);

  const DescribedView& view;
  FeatureRing& ring;
  int camera;
  const bool wide = simd() >= Simd::avx512;
  int begun = 0, next = 0,
      sampled = -kReach;  // rows: the first in the ring, those to describe and sample next
  size_t line;
  std::vector<uint16_t> luma;      // [kRows, kPhases, line]
  std::vector<uint8_t> is_static;  // [kRows, kPhases, line]
  std::vector<uint8_t> full;       // [kRows, kPhases, blocks]: static, and kReach columns beside it too
};

}  // namespace seepast
