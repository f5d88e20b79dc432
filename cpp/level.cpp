// Views reduced to a level (levels.Level), several pixels averaged into one; and back.
#include <algorithm>
#include <cmath>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

SEEPAST_CLONES
void add_row(const uint8_t* __restrict row, int count, uint16_t* __restrict sum) {
  for (int i = 0; i < count; ++i) sum[i] = static_cast<uint16_t>(sum[i] + row[i]);
}

SEEPAST_CLONES
void keep_row(const uint8_t* __restrict row, int count, uint8_t* __restrict all) {
  for (int i = 0; i < count; ++i) all[i] = all[i] & row[i];
}

// Rounded as OpenCV's INTER_AREA: halves go up in the mean of four, to even in others.
template <int kScale>
void mean_of_columns(const uint16_t* sum, int width, int scale, uint8_t* out) {
  const int across = kScale ? kScale : scale;
  const float share = 1.0f / static_cast<float>(across * across);
  for (int x = 0; x < width; ++x, sum += 3 * across)
    for (int c = 0; c < 3; ++c) {
      int total = 0;
      for (int i = 0; i < across; ++i) total += sum[3 * i + c];
      out[3 * x + c] = static_cast<uint8_t>(across == 2 ? (total + 2) >> 2
                                                        : std::lrintf(static_cast<float>(total) * share));
    }
}

void all_of_columns(const uint8_t* all, int width, int scale, uint8_t* out) {
  for (int x = 0; x < width; ++x, all += scale) {
    uint8_t every = all[0];
    for (int i = 1; i < scale; ++i) every &= all[i];
    out[x] = every;
  }
}

SEEPAST_CLONES
void mean_of_rows(const uint8_t* __restrict a, const uint8_t* __restrict b, int count,
                  uint8_t* __restrict out) {
  for (int i = 0; i < count; ++i) out[i] = static_cast<uint8_t>((a[i] + b[i] + 1) >> 1);
}

// Every value twice, times `factor`.
template <class Value>
[[gnu::always_inline]] inline void twice(const Value* __restrict from, int count, int factor,
                                         Value* __restrict to) {
  for (int x = 0; x < count; ++x)
    for (int i = 0; i < 2; ++i) to[2 * x + i] = static_cast<Value>(from[x] * factor);
}
SEEPAST_CLONES
void twice_each(const uint8_t* from, int count, int factor, uint8_t* to) { twice(from, count, factor, to); }
SEEPAST_CLONES
void twice_each(const uint16_t* from, int count, int factor, uint16_t* to) { twice(from, count, factor, to); }

}  // namespace

void half_rows(int views, int height, int width, const uint8_t* colour, const uint8_t* is_static,
               uint8_t* small, uint8_t* small_static) {
  const int rows = height / 2;
#pragma omp parallel for schedule(static)
  for (int row = 0; row < views * rows; ++row) {
    const size_t from = (static_cast<size_t>(row / rows) * height + row % rows * 2) * width,
                 to = static_cast<size_t>(row) * width;
    mean_of_rows(colour + 3 * from, colour + 3 * (from + width), 3 * width, small + 3 * to);
    std::copy_n(is_static + from, width, small_static + to);
    keep_row(is_static + from + width, width, small_static + to);
  }
}

void double_rows(const uint16_t* views, int count, int rows, int width, int height, uint16_t* out) {
#pragma omp parallel for schedule(static)
  for (int row = 0; row < count * height; ++row) {
    const int from = row / height * rows + std::min(row % height / 2, rows - 1);
    std::copy_n(views + static_cast<size_t>(from) * width, width, out + static_cast<size_t>(row) * width);
  }
}

void averaged(int views, int height, int width, const uint8_t* colour, const uint8_t* is_static, int scale,
              int small_height, int small_width, uint8_t* small, uint8_t* small_static) {
  const int across = small_width * scale;
  const auto mean = scale == 2 ? mean_of_columns<2> : scale == 4 ? mean_of_columns<4> : mean_of_columns<0>;
#pragma omp parallel
  {
    std::vector<uint16_t> sum(3 * static_cast<size_t>(across));
    std::vector<uint8_t> all(across);
#pragma omp for schedule(static)
    for (int row = 0; row < views * small_height; ++row) {
      const size_t from = static_cast<size_t>(row / small_height) * height + row % small_height * scale;
      std::fill(sum.begin(), sum.end(), uint16_t{0});
      std::fill(all.begin(), all.end(), uint8_t{1});
      for (int j = 0; j < scale; ++j) {
        add_row(colour + 3 * (from + j) * width, 3 * across, sum.data());
        keep_row(is_static + (from + j) * width, across, all.data());
      }
      const size_t to = static_cast<size_t>(row) * small_width;
      mean(sum.data(), small_width, scale, small + 3 * to);
      all_of_columns(all.data(), small_width, scale, small_static + to);
    }
  }
}

template <class Value>
void enlarged(const Value* views, int count, int rows, int columns, int ratio, int factor, int height,
              int width, Value* out) {
#pragma omp parallel for schedule(static)
  for (int line = 0; line < count * rows; ++line) {
    const int row = line % rows, first = row * ratio;
    const int last = row + 1 == rows ? height : std::min(height, first + ratio);
    if (first >= last) continue;
    const Value* from = views + static_cast<size_t>(line) * columns;
    Value* to = out + (static_cast<size_t>(line / rows) * height + first) * width;
    const int whole = ratio == 2 ? std::min(columns, width / 2) : 0;
    twice_each(from, whole, factor, to);
    for (int i = whole, x = 2 * whole; x < width; ++i) {
      const Value value = static_cast<Value>(from[std::min(i, columns - 1)] * factor);
      for (const int end = std::min(x + ratio, width); x < end; ++x) to[x] = value;
    }
    for (int y = first + 1; y < last; ++y)
      std::copy_n(to, width, to + static_cast<size_t>(y - first) * width);
  }
}
template void enlarged(const uint8_t*, int, int, int, int, int, int, int, uint8_t*);
template void enlarged(const uint16_t*, int, int, int, int, int, int, int, uint16_t*);

}  // namespace seepast
