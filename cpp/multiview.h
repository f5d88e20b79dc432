// The stages of the many-view method's cpu backend, one function per file, named as in backends/
// reference_multiview.py, which specifies them. Arrays are C-contiguous; "the view" is the camera that
// `array` is seen from.
#pragma once

#include <vector>

#include "core.h"

namespace seepast {

constexpr int kUnits = 32;        // disparities of views: uint16 in 32nds of a pixel over the array
constexpr uint8_t kNoPair = 255;  // in costs: no two static rays
constexpr int kFew = 8;           // many.py FEW
constexpr int kFullVote = 1280;   // many.py FULL_VOTE
constexpr int kBlock = 64;  // pixels that are matched together, and empty columns on either side of a row

// What of the grid every pixel is matched at (candidates.py Candidates).
constexpr int kChunk = 16;
constexpr int kMostChunks = 64;  // bits of a pixel's active chunks
struct Chunks {
  const uint64_t* active;  // [H, W]
  const int32_t* start;    // [H W + 1]
};

// disparity uint16, where uint8 [views, rows, columns], `ratio` times smaller; within uint8 [views, height,
// width], or null: everywhere, as it is in view `whole`; active uint64 [views, height, width] and start int32
// [views, height width + 1] are Chunks.
void windows(int views, const uint16_t* disparity, const uint8_t* where, int rows, int columns, int ratio,
             const Grid& grid, int reach, int spread, const uint8_t* within, int whole, int height, int width,
             uint64_t* active, int32_t* start);

// colour uint8 [V, H, W, 3], is_static uint8 [V, H, W] -> [V, h, w] of them, scale x scale pixels averaged
// into one, which is static if all of them are. h scale <= H, w scale <= W.
void averaged(int views, int height, int width, const uint8_t* colour, const uint8_t* is_static, int scale,
              int small_height, int small_width, uint8_t* small, uint8_t* small_static);

// views [count, rows, columns] with every pixel repeated `ratio` times, and the last ones further, in words
// times `factor`: out [count, height, width].
template <class Value>
void enlarged(const Value* views, int count, int rows, int columns, int ratio, int factor, int height,
              int width, Value* out);

// Every two rows averaged into one, halves up, and static where both are: [V, H, W] -> [V, H / 2, W].
void half_rows(int views, int height, int width, const uint8_t* colour, const uint8_t* is_static,
               uint8_t* small, uint8_t* small_static);
// Every row twice, the last one to the end: [count, rows, width] -> [count, height, width].
void double_rows(const uint16_t* views, int count, int rows, int width, int height, uint16_t* out);

// Where the rays of the reference's pixels `hidden` uint8 [H, W] end at disparities from low to high, px [H,
// W], to the nearest pixel (host.landings): out uint8 [K, H, W], zeroed by the caller.
void landings(const Array& array, const uint8_t* hidden, const float* low, const float* high, uint8_t* out);

// Where they end in the views that are asked of them (host.witnessed), at their own disparities: uint16,
// is_static uint8, out uint8 [K, H, W], zeroed by the caller; order int32 [K]: the reference, then the
// nearest.
void witnessed(const Array& array, const uint8_t* hidden, const uint16_t* disparities,
               const uint8_t* is_static, const int32_t* order, int most, int tolerance, uint8_t* out);

struct PairCostParams {
  const uint8_t* census_scale;  // [32] in 8ths, by valid neighbours; 0 below kFew
  uint8_t few, colour_cap, lone, unseen;
};
struct Pairs {
  const int32_t* cameras;  // [count, 2]
  int count;
};
// A view that is matched: the array as seen from camera `number`, whose own offsets are 0.
struct MatchedView {
  Array array;
  int number;
  Chunks chunks;
  Pairs with_own, others;  // with the view's own ray, and without
  uint8_t* out;            // [n, kChunk]
};
// colour uint8 [K, H, W, 3]; is_static uint8 [K, H, W]; luma int32 [3] in 256ths.
void volumes(const MatchedView* views, int count, const uint8_t* colour, const uint8_t* is_static,
             const int32_t* luma, const Grid& grid, const PairCostParams& params);

struct Penalties {
  int small;
  const uint16_t* large;  // [766], by the colour step
  int dynamic;
};
// costs uint8 [n, kChunk], of `active` and `start` of Candidates (candidates.py); image uint8 [H, W, 3]; out
// uint16 [H, W]: at first the disparities of pixels without a chunk, then the 5 x 5 medians of the others.
struct AggregatedView {
  const uint8_t *costs, *image, *is_static;
  const uint64_t* active;
  const int32_t* start;
  uint16_t* out;
};
// paths 8 or 4. everywhere: medians of pixels without a chunk too. `scratch`: for every view
// aggregate_scratch entries that need not be set.
size_t aggregate_scratch(int height, int width, int count, int paths, int most, size_t chunks);
void aggregates(const AggregatedView* views, int count, int height, int width, const Grid& grid,
                const Penalties& penalties, int paths, bool everywhere, uint16_t* scratch);

// Medians of 5 x 5 pixels; the image's edges continue outside.
class MedianOfRows {
 public:
  MedianOfRows(int height, int width);
  // Of the columns [from, to) of row y of image [height, width]; there until the next are made.
  const uint16_t* of(const uint16_t* image, int y, int from, int to);

 private:
  int height, width;
  std::vector<uint16_t> memory, medians;
  uint16_t* sorted[5];
};

// disparities uint16 [K, H, W], is_static uint8 [K, H, W].
void witnesses(const Array& array, const uint16_t* d, const uint16_t* disparities, const uint8_t* is_static,
               int skip, int tolerance, uint8_t* agree, uint8_t* farther);
// `wanted` uint8 [H, W], or null: all pixels; others have their own ray alone. rays: `shown`, or every static
// ray where that is none. close uint8 [H, W]: how many others differ by `near` at most.
void labels(const Array& array, int reference, const uint16_t* d, const uint16_t* disparities,
            const uint8_t* is_static, const uint8_t* wanted, int tolerance, int near, uint16_t* shown,
            uint16_t* rays, uint8_t* close);

struct Grades {
  uint8_t confident, lone, doubtful;  // in 20ths
};
// d uint16 [H, W] of camera `number`, and what witnesses make of it: sure where any other agrees. Pixels
// without chunks (`start` of Chunks; null: none is) get 0 of both.
struct GradedView {
  Array array;
  int number;
  const uint16_t* d;
  const int32_t* start;
  uint8_t *confidence, *sure;
};
void graded(const GradedView* views, int count, const uint16_t* disparities, const uint8_t* is_static,
            int tolerance, const Grades& grades);

struct VoteWeights {
  int base, gain, hide, volume;
  bool visible;  // else there are no votes on static pixels, whose energies are not written
};
// confidence uint8 [K, H, W] in 20ths; is_static uint8 [H, W] of the view. costs uint8 [n, kChunk]; out
// likewise, may be `costs`.
void votes(const Array& array, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const Grid& grid, const Chunks& chunks, int skip,
           const VoteWeights& weights, uint8_t* out);

struct PlaneParams {
  int radius, stride, gate;
  float need;
  double ridge;
  const float* nearness;  // [taps, taps]
};
void planes(int height, int width, const uint16_t* d, const uint8_t* trusted, const uint8_t* wanted,
            const uint8_t* image, const uint8_t* is_static, const PlaneParams& params, uint16_t* out);

// confidence.py of_views, all [H, W]; steps [7].
void evidence(int height, int width, const uint16_t* d, const uint8_t* is_static, const uint8_t* close,
              const uint16_t* shown, const uint16_t* steps, uint8_t* out);
// host.told: what results say of `count` pixels. table [256]; keep uint8, or null: where the own ray is all.
void told(const uint16_t* d, const uint8_t* evidence, const float* table, const uint16_t* labels,
          const uint8_t* keep, size_t count, float* disparity, float* confidence, uint8_t* coverage);
// host.clear_of_masks: uint8 [views, H, W], 0 or 1.
void clear_of_masks(int views, int height, int width, const uint8_t* is_static, uint8_t* clear);

// What rays weigh in the picture.
struct RayWeights {
  const uint8_t* clear;  // [K, H, W], 0: such pixels weigh `edge`
  const float* near;     // [K]
  const int32_t* order;  // [K]: the nearest camera first, and so the greatest of `near`
  float light, edge;     // rays of cameras that weigh less than `light` of the heaviest so far are left out
};
void blend(const Array& array, int reference, const uint8_t* colour, const uint16_t* rays,
           const RayWeights& weights, const uint16_t* d, const uint8_t* wanted, uint8_t* background);

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

// Sixteen bytes, and the 16 x 16 transpose of them.
typedef uint8_t Sixteen __attribute__((vector_size(16)));
inline Sixteen low_halves(Sixteen a, Sixteen b) {  // a0 b0 a1 b1 ..
#if defined(__clang__)
  return __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
#else
  return __builtin_shuffle(a, b, Sixteen{0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23});
#endif
}
inline Sixteen high_halves(Sixteen a, Sixteen b) {  // a8 b8 a9 b9 ..
#if defined(__clang__)
  return __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
#else
  return __builtin_shuffle(a, b, Sixteen{8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31});
#endif
}
// out[x][i] = rows[i * row_stride + x]: row i is interleaved with row i + 8 four times over.
inline void transpose_16x16(const uint8_t* rows, size_t row_stride, Sixteen* out) {
  Sixteen a[16], b[16];
  for (int i = 0; i < 16; ++i) __builtin_memcpy(a + i, rows + i * row_stride, 16);
  for (int i = 0; i < 8; ++i)
    b[2 * i] = low_halves(a[i], a[i + 8]), b[2 * i + 1] = high_halves(a[i], a[i + 8]);
  for (int i = 0; i < 8; ++i)
    a[2 * i] = low_halves(b[i], b[i + 8]), a[2 * i + 1] = high_halves(b[i], b[i + 8]);
  for (int i = 0; i < 8; ++i)
    b[2 * i] = low_halves(a[i], a[i + 8]), b[2 * i + 1] = high_halves(a[i], a[i + 8]);
  for (int i = 0; i < 8; ++i)
    out[2 * i] = low_halves(b[i], b[i + 8]), out[2 * i + 1] = high_halves(b[i], b[i + 8]);
}

}  // namespace seepast
