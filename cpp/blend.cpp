// Stage "refocus" of the many-view method: the weighted mean of the chosen rays' colours, sampled with Keys'
// cubic.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "cubic.h"
#include "multiview.h"

namespace seepast {
namespace {

constexpr int kTaps = 4;
// Of four rows, four bytes of one of their pixels each: three are colours.
typedef uint8_t Bytes __attribute__((vector_size(16)));
typedef uint16_t Words __attribute__((vector_size(16)));
typedef int32_t Longs __attribute__((vector_size(16)));
typedef float Floats __attribute__((vector_size(16)));

// The colours of the four rows. Spelt out, since compilers make a bad job of converting all at once.
inline void spread(const Bytes& bytes, Floats* rows) {
  static_assert(std::endian::native == std::endian::little);
  const Bytes none = {};
  const Bytes low =
      __builtin_shufflevector(bytes, none, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const Bytes high =
      __builtin_shufflevector(bytes, none, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
  const Words pair[2] = {reinterpret_cast<Words>(low), reinterpret_cast<Words>(high)}, zero = {};
  for (int j = 0; j < 2; ++j) {
    const Words first = __builtin_shufflevector(pair[j], zero, 0, 8, 1, 9, 2, 10, 3, 11);
    const Words second = __builtin_shufflevector(pair[j], zero, 4, 12, 5, 13, 6, 14, 7, 15);
    rows[2 * j] = __builtin_convertvector(reinterpret_cast<Longs>(first), Floats);
    rows[2 * j + 1] = __builtin_convertvector(reinterpret_cast<Longs>(second), Floats);
  }
}

// image [H, W, 3] at (x + dx, y + dy), edges continued.
void bicubic(const Array& array, const uint8_t* image, int x, int y, float dx, float dy, float* out) {
  const int left = floor_int(dx), top = floor_int(dy), first = x + left - 1;
  float wx[kTaps], wy[kTaps];
  cubic_weights(dx - static_cast<float>(left), wx);
  cubic_weights(dy - static_cast<float>(top), wy);
  const bool inside = first >= 0 && first + kTaps < array.width;  // and a byte beyond the last colour
  alignas(16) uint32_t taps[kTaps][kTaps] = {};                   // [column][row]: the pixel's colours
  for (int j = 0; j < kTaps; ++j) {
    const size_t line = static_cast<size_t>(clamp(y + top + j - 1, 0, array.height - 1)) * array.width;
    for (int i = 0; i < kTaps; ++i)
      if (inside)
        std::memcpy(&taps[i][j], image + 3 * (line + first + i), 4);
      else
        std::memcpy(&taps[i][j], image + 3 * (line + clamp(first + i, 0, array.width - 1)), 3);
  }
  Floats line[kTaps] = {};
  for (int i = 0; i < kTaps; ++i) {
    Bytes bytes;
    std::memcpy(&bytes, taps[i], sizeof bytes);
    Floats rows[kTaps];
    spread(bytes, rows);
    for (int j = 0; j < kTaps; ++j) line[j] += wx[i] * rows[j];
  }
  Floats total = {};
  for (int j = 0; j < kTaps; ++j) total += wy[j] * line[j];
  for (int c = 0; c < 3; ++c) out[c] = total[c];
}

}  // namespace

void blend(const Array& array, int reference, const uint8_t* colour, const uint16_t* rays,
           const uint8_t* clear, const float* near, float edge, const uint16_t* d, const uint8_t* wanted,
           uint8_t* background) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 8)
  for (int y = 0; y < array.height; ++y) {
    const size_t line = static_cast<size_t>(y) * array.width;
    std::copy_n(colour + 3 * (reference * pixels + line), 3 * array.width, background + 3 * line);
    for (int x = 0; x < array.width; ++x) {
      const size_t at = line + x;
      if (!wanted[at]) continue;
      uint8_t* out = background + 3 * at;
      const float disparity = static_cast<float>(d[at]) / static_cast<float>(kUnits);
      float total[3] = {0, 0, 0}, weights = 0;
      for (unsigned rest = rays[at]; rest; rest &= rest - 1) {
        const int k = std::countr_zero(rest);
        const RayShift shift = array.shift(k, disparity);
        const float dx = ray_dx(shift, x, array.cx), dy = ray_dy(shift, y, array.cy);
        const int column = clamp(x + whole_offset(dx), 0, array.width - 1);
        const int row = clamp(y + whole_offset(dy), 0, array.height - 1);
        const bool is_clear = clear[k * pixels + static_cast<size_t>(row) * array.width + column];
        const float weight = (is_clear ? 1.0f : edge) * near[k];
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
}

}  // namespace seepast
