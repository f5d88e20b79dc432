// The loops of the mask refinement (backends/reference_people.py is their specification; names are its).
#pragma once

#include "core.h"
#include "people_pixel.h"

namespace seepast {

// `views`: the array as seen from each of its K cameras.
void witnesses(const Array* views, const uint8_t* dynamic, const float* surfaces, float tolerance,
               uint8_t* saw);
// host_people.disagreement: sums [2] of the smaller and of the larger P, of saw uint8 [K, H, W, K].
void disagreement(const uint8_t* saw, int cameras, int height, int width, int step, int64_t* sums);
void sloping(int cameras, int height, int width, const float* surfaces, float least, int rows, int stride,
             uint16_t* out);
// floor uint16 [K, h, w] (`sloping`)
void object_grid(const Array* views, int reference, const uint8_t* saw, const float* surfaces,
                 const Cells& cells, int stride, const uint16_t* floor, uint16_t* mean, int64_t* sums);
void object_slice(const Array* views, int reference, const float* grid, const uint16_t* mean,
                  const float* surfaces, const Cells& cells, int stride, uint16_t* share);
void border_counts(int cameras, int height, int width, const uint16_t* share, const uint16_t* mean,
                   const float* surfaces, const int32_t* thresholds, int count, float step, int stride,
                   int64_t* counts);
// One camera; levels uint8 [766] by the colour step.
void surprise(size_t pixels, const uint8_t* colour, const uint8_t* behind, const uint16_t* rays,
              const uint8_t* wanted, const uint8_t* levels, uint8_t* out);
// counts int64 [K, 2, kLevels]
void surprise_counts(int cameras, int height, int width, const uint8_t* surprise, const int8_t* sure,
                     int stride, int64_t* counts);
void people_histograms(int cameras, int height, int width, int channels, const uint8_t* dynamic,
                       const uint8_t* colour, const uint8_t* person, int stride, int64_t* levels,
                       int64_t* colours);
void colour_moments(int cameras, int height, int width, int channels, const uint8_t* colour,
                    const int8_t* sure, int stride, int block, int32_t* moments);
void log_odds(int cameras, int height, int width, const uint8_t* saw, const float* levels, int stride,
              float* out);

struct Terms {
  const float* sure;     // [3]
  float said, local;     // factors
  const float* colours;  // [kColours]
  const float* behind;   // [kLevels], of the camera
};
// One camera.
void potential(int height, int width, int channels, const float* said, const uint8_t* dynamic,
               const uint8_t* colour, const float* linear, const int8_t* sure, int sure_height,
               int sure_width, const uint8_t* surprise, const Terms& terms, int stride, int cell, int16_t* u);

struct FieldCosts {
  const int16_t* contrast;
  int count;
  float depth_step;
  int cut;
};
// All cameras.
void field(int cameras, int height, int width, int channels, const int16_t* u, const uint8_t* colour,
           const float* surfaces, const FieldCosts& costs, int stride, int16_t* belief);

}  // namespace seepast
