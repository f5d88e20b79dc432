// Stage "describe": 3x3 Sobel responses and the 16-sample descriptors made of them.
#include <algorithm>
#include <vector>

#include "core.h"

namespace seepast {
namespace {

// One row of (du, dv) / 4 from the three grey rows around it. The rows carry one replicated pixel at both
// ends.
SEEPAST_CLONES
void sobel_row(const int16_t* __restrict above, const int16_t* __restrict here,
               const int16_t* __restrict below, int width, int8_t* __restrict du, int8_t* __restrict dv) {
  for (int x = 0; x < width; ++x) {
    const int16_t h = (above[x + 2] - above[x]) + 2 * (here[x + 2] - here[x]) + (below[x + 2] - below[x]);
    const int16_t v =
        (below[x] - above[x]) + 2 * (below[x + 1] - above[x + 1]) + (below[x + 2] - above[x + 2]);
    const int16_t hq = h >> 1, vq = v >> 1;
    du[x] = static_cast<int8_t>(std::min<int16_t>(127, std::max<int16_t>(-127, hq)));
    dv[x] = static_cast<int8_t>(std::min<int16_t>(127, std::max<int16_t>(-127, vq)));
  }
}

void widen_row(const uint8_t* row, int width, int16_t* out) {
  out[0] = row[0];
  for (int x = 0; x < width; ++x) out[x + 1] = row[x];
  out[width + 1] = row[width - 1];
}

// 16 samples per pixel, one after the other; `rows` are du and dv rows y - 2 .. y + 2 with two replicated
// pixels.
SEEPAST_CLONES
void descriptor_row(const int8_t* const* __restrict rows, int width, uint8_t* __restrict out) {
  for (int m = 0; m < kSamples; ++m) {
    const int8_t* row = rows[(m < kHorizontal ? 0 : 5) + kPatternY[m] + 2] + 2 + kPatternX[m];
    for (int x = 0; x < width; ++x) out[x * kSamples + m] = static_cast<uint8_t>(row[x] + 128);
  }
}

}  // namespace

void describe(const uint8_t* grey, int cameras, int height, int width, int8_t* gradients,
              uint8_t* descriptors) {
  const size_t pixels = static_cast<size_t>(height) * width;
  const int padded = width + 4;
#pragma omp parallel
  {
    std::vector<int16_t> grey_rows(3 * static_cast<size_t>(width + 2));
#pragma omp for schedule(static)
    for (int line = 0; line < cameras * height; ++line) {
      const int k = line / height, y = line % height;
      int16_t* rows[3];
      for (int j = 0; j < 3; ++j) {
        rows[j] = grey_rows.data() + static_cast<size_t>(j) * (width + 2);
        widen_row(grey + k * pixels + static_cast<size_t>(clamp(y + j - 1, 0, height - 1)) * width, width,
                  rows[j]);
      }
      int8_t* du = gradients + 2 * k * pixels + static_cast<size_t>(y) * width;
      sobel_row(rows[0], rows[1], rows[2], width, du, du + pixels);
    }
    std::vector<int8_t> gradient_rows(10 * static_cast<size_t>(padded));
#pragma omp for schedule(static)
    for (int line = 0; line < cameras * height; ++line) {
      const int k = line / height, y = line % height;
      const int8_t* rows[10];
      for (int j = 0; j < 10; ++j) {
        const int source = clamp(y + j % 5 - 2, 0, height - 1);
        const int8_t* from = gradients + (2 * k + j / 5) * pixels + static_cast<size_t>(source) * width;
        int8_t* to = gradient_rows.data() + static_cast<size_t>(j) * padded;
        to[0] = to[1] = from[0];
        std::copy(from, from + width, to + 2);
        to[width + 2] = to[width + 3] = from[width - 1];
        rows[j] = to;
      }
      descriptor_row(rows, width, descriptors + (k * pixels + static_cast<size_t>(y) * width) * kSamples);
    }
  }
}

}  // namespace seepast
