// Stage "refocus": the mean of the static rays' colours, and the flagged guess where there are none.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
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

// Row y becomes that of the columns where it is seen.
SEEPAST_CLONES
void note_row(const uint8_t* __restrict seen, int width, int y, int32_t* __restrict row_of) {
  for (int x = 0; x < width; ++x) row_of[x] = seen[x] ? y : row_of[x];
}

// The pixels that no camera saw, row by row, and of each the nearest seen pixel to the left, right, above and
// below: how far it is, 0 = none.
struct Unseen {
  Unseen(int height, int width, const uint8_t* coverage) {
    std::vector<int32_t> row_of(width, -1);  // of the last seen pixel of every column
    std::vector<size_t> begin(height + 1, 0);
    for (int y = 0; y < height; ++y) {
      const uint8_t* seen = coverage + static_cast<size_t>(y) * width;
      note_row(seen, width, y, row_of.data());
      for (int x = 0, last = -1; (x = next(seen, x, width)) < width; ++x) {
        if (x && seen[x - 1]) last = x - 1;
        at.push_back(static_cast<size_t>(y) * width + x);
        far.push_back({last < 0 ? 0 : x - last, 0, row_of[x] < 0 ? 0 : y - row_of[x], 0});
      }
      begin[y + 1] = at.size();
    }
    std::fill(row_of.begin(), row_of.end(), -1);
    for (int y = height - 1; y >= 0; --y) {
      const size_t row = static_cast<size_t>(y) * width;
      note_row(coverage + row, width, y, row_of.data());
      int last = -1;
      for (size_t n = begin[y + 1]; n-- > begin[y];) {
        const int x = static_cast<int>(at[n] - row);
        if (x + 1 < width && coverage[row + x + 1]) last = x + 1;
        far[n][1] = last < 0 ? 0 : last - x;
        far[n][3] = row_of[x] < 0 ? 0 : row_of[x] - y;
      }
    }
  }
  static int next(const uint8_t* seen, int x, int width) {
    const void* found = x < width ? std::memchr(seen + x, 0, static_cast<size_t>(width - x)) : nullptr;
    return found ? static_cast<int>(static_cast<const uint8_t*>(found) - seen) : width;
  }
  std::vector<size_t> at;
  std::vector<std::array<int32_t, 4>> far;
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
  const Unseen unseen(height, width, coverage);
  const ptrdiff_t step[4] = {-1, 1, -width, width};
  for (size_t n = 0; n < unseen.at.size(); ++n) {
    const size_t at = unseen.at[n];
    float total[4] = {0, 0, 0, 0}, weights = 0;
    for (int j = 0; j < 4; ++j) {
      const int far = unseen.far[n][j];
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
