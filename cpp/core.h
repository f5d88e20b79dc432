// The stages of the cpu backend, one function per file, named as in pipeline.py. Arrays are C-contiguous.
#pragma once

#include <cstddef>
#include <cstdint>

#include "pixel.h"
#include "simd.h"

namespace seepast {

// K rectified views of height x width pixels, and the warp from the reference into each (geometry.py).
struct Array {
  int cameras, height, width;
  float cx, cy;
  const float* offsets;  // [K, kOffsets]

  size_t pixels() const { return static_cast<size_t>(height) * width; }
  RayShift shift(int camera, float d) const { return ray_shift(offsets + kOffsets * camera, d); }
};

// Candidate disparities d_i = (first + i * step) / 8.
struct Grid {
  int first, step, count;
  float value(int i) const {
    return (static_cast<float>(first) + static_cast<float>(step) * static_cast<float>(i)) / 8.0f;
  }
};

// uint8 [height, width, 3], and a mask [height, width] or nullptr, sampled at `count` pixels, as cv2.remap
// with INTER_LINEAR and BORDER_REPLICATE: whole (x, y), and 32 y + x in 32nds between. height, width >= 2.
// no_ray [count], or nullptr: where the mask is to be 255; it is 254 at most elsewhere.
void sample_colour(const uint8_t* image, const uint8_t* mask, int height, int width, const int16_t* whole,
                   const uint16_t* fraction, const uint8_t* no_ray, size_t count, uint8_t* out,
                   uint8_t* mask_out);
void sample_plane(const uint8_t* plane, int height, int width, const int16_t* whole, const uint16_t* fraction,
                  size_t count, uint8_t* out);

// gradients int8 [K, 2, H, W]; descriptors uint8 [K, H, W, 16], biased by 128.
void describe(const uint8_t* grey, int cameras, int height, int width, int8_t* gradients,
              uint8_t* descriptors);

struct SupportParams {
  int grid, texture, left_right;
  float uniqueness, max_cost;
};
struct SupportPoint {
  float x, y, d, variance;
};
// Matches of the grid points of camera `base` in `partner`; `view` is the array as seen from base,
// `back_view` as seen from partner. Only points that land where `where` holds in `reference` are wanted (of
// another camera the pixels that the reference does not see, widened); others may be left out. Writes at most
// one point per grid position, returns how many.
int support_of_camera(const Array& view, const Array& back_view, int base, int partner,
                      const uint8_t* descriptors, const uint8_t* is_static, const uint8_t* where,
                      int reference, const Grid& grid, const SupportParams& params, SupportPoint* points);

// Rasterises the triangles' planes: mean int32 [H, W] in eighths of a pixel, `gap` outside all of them.
// Triangles whose corners differ by more than max_step px take the nearest corner instead.
void plane_means(const float* points, const int32_t* triangles, int count, int height, int width,
                 double max_step, int gap, int32_t* mean);
// uint8 [rows, columns, grid.count], zeroed by the caller.
void cell_candidates(const float* points, int count, int rows, int columns, const Grid& grid, float radius,
                     uint8_t* cells);

struct DisparityParams {
  float beta, lone_variance, unseen_variance;
  int prior_radius;    // eighths
  const float* table;  // prior energy by eighths of |d - mu|
  int table_size;
};
// phases int8 [K, 4, 3, H, W]: du, dv (0 where not static) and the static flag at quarter-pixel phases.
void phase_planes(const Array& array, const int8_t* gradients, const uint8_t* is_static, int8_t* phases);
void disparity(const Array& array, const int8_t* phases, const int32_t* mean, const uint8_t* cells,
               const Grid& grid, const uint8_t* wanted, const DisparityParams& params, float* out);
// Pixels with a candidate whose rays end on or beside a changed label: the others' argmin stays what it was.
void affected(const Array& array, const uint8_t* changed, const int32_t* mean, const uint8_t* cells,
              const Grid& grid, const uint8_t* wanted, int radius, uint8_t* out);

struct SegmentationParams {
  double beta;               // 1024ths of a nat per grey level^2
  double lone_variance;      // grey levels^2
  const int32_t* costs;      // [2, 255]
  const uint8_t* posterior;  // table
  int posterior_reach;       // its centre
  double posterior_scale;    // entries per 1024th of a nat
};
void segmentation(const Array& array, const uint8_t* descriptors, const uint8_t* dynamic, const float* d,
                  const uint8_t* wanted, const SegmentationParams& params, uint16_t* labels,
                  uint8_t* posterior);

// Metres by disparities in px: focal_baseline / d, 0 where d is not above 0.
void depth(const float* d, size_t count, float focal_baseline, float* out);

void masks(const Array& array, const uint16_t* labels, const uint8_t* posterior, const float* d,
           const uint8_t* wanted, uint8_t* dynamic, uint8_t* is_static);

void refocus(const Array& array, const uint8_t* colour, int channels, int reference, const uint16_t* labels,
             const float* d, const uint8_t* keep, uint8_t* background, uint8_t* coverage);
void fill_unseen(int height, int width, int channels, const uint8_t* coverage, const float* d, float nearer,
                 float foreground_weight, uint8_t* background);

}  // namespace seepast
