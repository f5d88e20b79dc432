// The stages of the many-view method's cpu backend, one function per file, named as in backends/
// reference_multiview.py, which specifies them. Arrays are C-contiguous; "the view" is the camera that
// `array` is seen from.
#pragma once

#include "core.h"

namespace seepast {

constexpr int kChunk = 16;        // neighbouring candidates that are matched together: candidates.py CHUNK
constexpr int kUnits = 32;        // disparities of views: uint16 in 32nds of a pixel over the array
constexpr uint8_t kNoPair = 255;  // in costs: no two static rays
constexpr int kFullVote = 1280;   // many.py FULL_VOTE
constexpr int kBlock = 64;  // columns that are matched together, and empty columns on either side of a row

// Everything matching reads of a row of one camera: rows [K, H, kPlanes, stride] of bytes, column x at x +
// kBlock. The words of census and valid take 8 planes. Outside the image all is 0. Phase p is the sample at x
// + p / 4.
constexpr int kWord = 8;
constexpr int plane_census(int phase) { return phase * kWord; }
constexpr int plane_valid(int phase) { return 4 * kWord + (phase ? kWord : 0); }
constexpr int plane_colour(int phase) { return 6 * kWord + 3 * phase; }
constexpr int plane_static(int phase) { return 6 * kWord + 12 + (phase ? 1 : 0); }
constexpr int kPlanes = 6 * kWord + 14;

struct FeatureRows {
  const uint8_t* planes;  // [K, H, kPlanes, stride]
  const int32_t*
      unclear;  // [K, H, 2, stride + 1]: columns before it that lack a valid bit, whole and fractional
  int stride;

  const uint8_t* row(int camera, int height, int y) const {
    return planes + (static_cast<size_t>(camera) * height + y) * kPlanes * stride;
  }
  const int32_t* unclear_row(int camera, int height, int y, int phase) const {
    return unclear + ((static_cast<size_t>(camera) * height + y) * 2 + (phase ? 1 : 0)) * (stride + 1);
  }
};

// colour uint8 [K, H, W, 3]; is_static uint8 [K, H, W]; cubic int32 [4, 4] in 128ths; luma int32 [3] in
// 256ths.
void census(const Array& array, const uint8_t* colour, const uint8_t* is_static, const int32_t* cubic,
            const int32_t* luma, int stride, uint8_t* planes, int32_t* unclear);

struct PairCostParams {
  const uint16_t* census_scale;  // [64], by valid neighbours; 0: few
  int few, colour_weight, colour_cap, colour_limit, lone, unseen;
};
// pairs int32 [n, 2] of cameras: with the view's own ray, and without. out uint8 [H, W, grid.count].
void volume(const Array& array, const FeatureRows& features, int view, const Grid& grid,
            const int32_t* with_own, int with_own_count, const int32_t* others, int others_count,
            const PairCostParams& params, uint8_t* out);

struct Penalties {
  int small;
  const uint16_t* large;  // [766], by the colour step
  int dynamic;
};
// costs uint8 [n, kChunk], of `active` and `start` of Candidates (candidates.py). image uint8 [H, W, 3];
// paths 8 or
// 4. `scratch`: aggregate_scratch entries that need not be set. out uint16 [H, W], before the median.
size_t aggregate_scratch(int height, int width, int count, int paths, size_t chunks);
void aggregate(const uint8_t* costs, const uint8_t* image, const uint8_t* is_static, int height, int width,
               const Grid& grid, const uint64_t* active, const int32_t* start, const Penalties& penalties,
               int paths, uint16_t* scratch, uint16_t* out);

// disparities uint16 [K, H, W], is_static uint8 [K, H, W].
void witnesses(const Array& array, const uint16_t* d, const uint16_t* disparities, const uint8_t* is_static,
               int skip, int tolerance, uint8_t* agree, uint8_t* farther);
void labels(const Array& array, int reference, const uint16_t* d, const uint16_t* disparities,
            const uint8_t* is_static, int tolerance, uint16_t* shown, uint16_t* passing);

struct VoteWeights {
  int base, gain, hide, volume;
};
// confidence uint8 [K, H, W] in 20ths; is_static uint8 [H, W] of the view. out uint8 [H, W, count], may be
// `costs`.
void votes(const Array& array, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const Grid& grid, int skip, const VoteWeights& weights, uint8_t* out);

struct PlaneParams {
  int radius, stride, gate;
  float need;
  double ridge;
  const float* nearness;  // [taps, taps]
};
void planes(int height, int width, const uint16_t* d, const uint8_t* trusted, const uint8_t* wanted,
            const uint8_t* image, const uint8_t* is_static, const PlaneParams& params, uint16_t* out);

// clear float [K, H, W], near float [K].
void blend(const Array& array, int reference, const uint8_t* colour, const uint16_t* rays, const float* clear,
           const float* near, const uint16_t* d, const uint8_t* wanted, uint8_t* background);

// Calls use(first, last, offset) for the runs of columns in [from, to) that have the same rounded offset,
// which must be monotonic in x.
template <class Offset, class Use>
void for_each_run(int from, int to, Offset offset_at, Use use) {
  while (from < to) {
    const int offset = offset_at(from);
    int end = to;
    if (offset_at(to - 1) != offset) {
      int same = from;
      while (end - same > 1) {
        const int middle = same + (end - same) / 2;
        (offset_at(middle) == offset ? same : end) = middle;
      }
    }
    use(from, end, offset);
    from = end;
  }
}

// Transposes bytes: out[x * out_stride + i] = rows[i * row_stride + x], x < width, i < count.
void transpose(const uint8_t* rows, size_t row_stride, int count, int width, uint8_t* out, size_t out_stride);

}  // namespace seepast
