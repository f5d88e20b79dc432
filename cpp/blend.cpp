// Stage "refocus" of the many-view method: the weighted mean of the chosen rays' colours, sampled with Keys'
// cubic.
#include <bit>
#include <cmath>

#include "multiview.h"

namespace seepast {
namespace {

// many.py cubic_weights.
void cubic_weights(float t, float* w) {
  const float near = 1.0f - t, far = 2.0f - t, beyond = 1.0f + t;
  w[0] = ((-0.5f * beyond + 2.5f) * beyond - 4.0f) * beyond + 2.0f;
  w[1] = (1.5f * t - 2.5f) * t * t + 1.0f;
  w[2] = (1.5f * near - 2.5f) * near * near + 1.0f;
  w[3] = ((-0.5f * far + 2.5f) * far - 4.0f) * far + 2.0f;
}

// image [H, W, 3] at (x + dx, y + dy), edges continued.
void bicubic(const Array& array, const uint8_t* image, int x, int y, float dx, float dy, float* out) {
  const int left = floor_int(dx), top = floor_int(dy);
  float wx[4], wy[4];
  cubic_weights(dx - static_cast<float>(left), wx);
  cubic_weights(dy - static_cast<float>(top), wy);
  for (int c = 0; c < 3; ++c) out[c] = 0.0f;
  for (int j = 0; j < 4; ++j) {
    const uint8_t* row =
        image + static_cast<size_t>(clamp(y + top + j - 1, 0, array.height - 1)) * array.width * 3;
    float line[3] = {0, 0, 0};
    for (int i = 0; i < 4; ++i) {
      const uint8_t* pixel = row + 3 * clamp(x + left + i - 1, 0, array.width - 1);
      for (int c = 0; c < 3; ++c) line[c] += wx[i] * static_cast<float>(pixel[c]);
    }
    for (int c = 0; c < 3; ++c) out[c] += wy[j] * line[c];
  }
}

}  // namespace

void blend(const Array& array, int reference, const uint8_t* colour, const uint16_t* rays, const float* clear,
           const float* near, const uint16_t* d, const uint8_t* wanted, uint8_t* background) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 8)
  for (int y = 0; y < array.height; ++y)
    for (int x = 0; x < array.width; ++x) {
      const size_t at = static_cast<size_t>(y) * array.width + x;
      uint8_t* out = background + 3 * at;
      if (!wanted[at]) {
        for (int c = 0; c < 3; ++c) out[c] = colour[3 * (reference * pixels + at) + c];
        continue;
      }
      float total[3] = {0, 0, 0}, weights = 0;
      for (unsigned rest = rays[at]; rest; rest &= rest - 1) {
        const int k = std::countr_zero(rest);
        const RayShift shift = array.shift(k, static_cast<float>(d[at]) / static_cast<float>(kUnits));
        const float dx = ray_dx(shift, x, array.cx), dy = ray_dy(shift, y, array.cy);
        const int column = clamp(x + whole_offset(dx), 0, array.width - 1);
        const int row = clamp(y + whole_offset(dy), 0, array.height - 1);
        const float weight = clear[k * pixels + static_cast<size_t>(row) * array.width + column] * near[k];
        float sample[3];
        bicubic(array, colour + 3 * k * pixels, x, y, dx, dy, sample);
        for (int c = 0; c < 3; ++c) total[c] += weight * sample[c];
        weights += weight;
      }
      for (int c = 0; c < 3; ++c) {
        const float value = std::floor(total[c] / (weights > 0 ? weights : 1.0f) + 0.5f);
        out[c] = static_cast<uint8_t>(value < 0.0f ? 0.0f : (value > 255.0f ? 255.0f : value));
      }
    }
}

}  // namespace seepast
