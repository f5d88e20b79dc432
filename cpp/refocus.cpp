// Stage "refocus": the mean of the static rays' colours, and the flagged guess where there are none.
#include <bit>
#include <cmath>
#include <vector>

#include "core.h"

namespace seepast {
namespace {

// Adds image[K] at (x + dx, y + dy), bilinear, edges continued.
void add_bilinear(const Array& array, const uint8_t* image, int channels, int x, int y, float dx, float dy,
                  float* total) {
  const int left = floor_int(dx), top = floor_int(dy);
  const float fx = dx - static_cast<float>(left), fy = dy - static_cast<float>(top);
  const uint8_t* pixel[2][2];
  for (int j = 0; j < 2; ++j)
    for (int i = 0; i < 2; ++i)
      pixel[j][i] = image + (static_cast<size_t>(clamp(y + top + j, 0, array.height - 1)) * array.width +
                             clamp(x + left + i, 0, array.width - 1)) *
                                channels;
  for (int c = 0; c < channels; ++c) {
    const float upper = pixel[0][0][c] + (static_cast<float>(pixel[0][1][c]) - pixel[0][0][c]) * fx;
    const float lower = pixel[1][0][c] + (static_cast<float>(pixel[1][1][c]) - pixel[1][0][c]) * fx;
    total[c] += upper + (lower - upper) * fy;
  }
}

// Per pixel the distance to the nearest seen pixel of its row on the left and right, column above and below;
// 0 = none.
struct Distances {
  Distances(int height, int width, const uint8_t* coverage) {
    for (auto& d : to) d.assign(static_cast<size_t>(height) * width, 0);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y) {
      const size_t row = static_cast<size_t>(y) * width;
      scan(coverage + row, width, 1, to[0].data() + row, to[1].data() + row);
    }
#pragma omp parallel for schedule(static)
    for (int x = 0; x < width; ++x) scan(coverage + x, height, width, to[2].data() + x, to[3].data() + x);
  }
  static void scan(const uint8_t* seen, int count, size_t stride, int32_t* before, int32_t* after) {
    int last = -1;
    for (int i = 0; i < count; ++i) {
      if (seen[i * stride]) last = i;
      before[i * stride] = last < 0 ? 0 : i - last;
    }
    last = -1;
    for (int i = count - 1; i >= 0; --i) {
      if (seen[i * stride]) last = i;
      after[i * stride] = last < 0 ? 0 : last - i;
    }
  }
  std::vector<int32_t> to[4];
};

}  // namespace

void refocus(const Array& array, const uint8_t* colour, int channels, int reference, const uint16_t* labels,
             const float* d, const uint8_t* keep, uint8_t* background, uint8_t* coverage) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 8)
  for (int y = 0; y < array.height; ++y)
    for (int x = 0; x < array.width; ++x) {
      const size_t at = static_cast<size_t>(y) * array.width + x;
      const int n = std::popcount(labels[at]);
      coverage[at] = static_cast<uint8_t>(n);
      uint8_t* out = background + at * channels;
      if (keep[at]) {
        for (int c = 0; c < channels; ++c) out[c] = colour[(reference * pixels + at) * channels + c];
        continue;
      }
      float total[4] = {0, 0, 0, 0};
      for (unsigned rest = labels[at]; rest; rest &= rest - 1) {
        const int k = std::countr_zero(rest);
        const RayShift shift = array.shift(k, d[at]);
        add_bilinear(array, colour + k * pixels * channels, channels, x, y, ray_dx(shift, x, array.cx),
                     ray_dy(shift, y, array.cy), total);
      }
      for (int c = 0; c < channels; ++c)
        out[c] = static_cast<uint8_t>(std::floor(total[c] / static_cast<float>(n > 1 ? n : 1) + 0.5f));
    }
}

void fill_unseen(int height, int width, int channels, const uint8_t* coverage, const float* d, float nearer,
                 float foreground_weight, uint8_t* background) {
  const Distances distance(height, width, coverage);
  const ptrdiff_t step[4] = {-1, 1, -width, width};
#pragma omp parallel for schedule(dynamic, 8)
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const size_t at = static_cast<size_t>(y) * width + x;
      if (coverage[at]) continue;
      float total[4] = {0, 0, 0, 0}, weights = 0;
      for (int j = 0; j < 4; ++j) {
        const int far = distance.to[j][at];
        if (!far) continue;
        const size_t seen = at + far * step[j];
        float weight = 1.0f / static_cast<float>(far * far);
        if (d[seen] > d[at] + nearer) weight *= foreground_weight;
        for (int c = 0; c < channels; ++c)
          total[c] += weight * static_cast<float>(background[seen * channels + c]);
        weights += weight;
      }
      if (!(weights > 0)) continue;
      for (int c = 0; c < channels; ++c)
        background[at * channels + c] = static_cast<uint8_t>(std::floor(total[c] / weights + 0.5f));
    }
}

}  // namespace seepast
