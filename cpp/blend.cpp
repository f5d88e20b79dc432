// Stage "refocus" of the many-view method: the weighted mean of the chosen rays' colours, sampled with Keys'
// cubic.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <vector>

#include "cubic.h"
#include "multiview.h"

namespace seepast {
namespace {

constexpr int kTaps = 4;
constexpr int kBlock = 64;  // pixels that are sampled together

// Pixels of a row that all have a ray of camera k, and what is sampled of them.
struct Batch {
  int count;
  int32_t place[kBlock], x[kBlock];  // in the row's list of wanted pixels; column
  float d[kBlock];                   // px
  int32_t left[kBlock], top[kBlock], column[kBlock],
      row[kBlock];  // of the taps, less one; of the nearest pixel
  float wx[kTaps][kBlock], wy[kTaps][kBlock];
  uint32_t words[kTaps][3][kBlock];  // of the rows, four pixels each
  float sample[3][kBlock];
};

[[gnu::always_inline]] inline void find_taps(const float* o, float cx, float cy, int y, Batch& batch) {
  const float offset[kOffsets] = {o[0], o[1], o[2], o[3], o[4]};
  for (int i = 0; i < kBlock; ++i) {
    const RayShift shift = ray_shift(offset, batch.d[i]);
    const float dx = ray_dx(shift, batch.x[i], cx), dy = ray_dy(shift, y, cy);
    const int left = floor_int(dx), top = floor_int(dy);
    float wx[kTaps], wy[kTaps];
    cubic_weights(dx - static_cast<float>(left), wx);
    cubic_weights(dy - static_cast<float>(top), wy);
    for (int j = 0; j < kTaps; ++j) batch.wx[j][i] = wx[j], batch.wy[j][i] = wy[j];
    batch.left[i] = batch.x[i] + left - 1;
    batch.top[i] = y + top - 1;
    batch.column[i] = batch.x[i] + whole_offset(dx);
    batch.row[i] = y + whole_offset(dy);
  }
}

// The bytes of 4 x 4 pixels each, of image [H, W, 3]; edges continued.
void fetch(const uint8_t* image, int height, int width, Batch& batch) {
  for (int i = 0; i < batch.count; ++i) {
    const int left = batch.left[i];
    const bool inside = left >= 0 && left + kTaps <= width;
    for (int j = 0; j < kTaps; ++j) {
      const uint8_t* line = image + 3 * static_cast<size_t>(clamp(batch.top[i] + j, 0, height - 1)) * width;
      uint8_t ends[12];
      if (!inside)
        for (int t = 0; t < kTaps; ++t)
          std::memcpy(ends + 3 * t, line + 3 * clamp(left + t, 0, width - 1), 3);
      const uint8_t* from = inside ? line + 3 * left : ends;
      for (int w = 0; w < 3; ++w) std::memcpy(&batch.words[j][w][i], from + 4 * w, 4);
    }
  }
}

[[gnu::always_inline]] inline void interpolate(Batch& batch) {
  for (int c = 0; c < 3; ++c) {
    float* __restrict total = batch.sample[c];
    for (int i = 0; i < kBlock; ++i) total[i] = 0;
    for (int j = 0; j < kTaps; ++j) {
      const uint32_t* words[kTaps];
      int bits[kTaps];
      for (int t = 0; t < kTaps; ++t)
        words[t] = batch.words[j][(3 * t + c) / 4], bits[t] = (3 * t + c) % 4 * 8;
      for (int i = 0; i < kBlock; ++i) {
        float line = 0;
        for (int t = 0; t < kTaps; ++t)
          line += batch.wx[t][i] * static_cast<float>(static_cast<int>(words[t][i] >> bits[t] & 255));
        total[i] += batch.wy[j][i] * line;
      }
    }
  }
}

SEEPAST_CLONES
void find(const float* offset, float cx, float cy, int y, Batch& batch) {
  find_taps(offset, cx, cy, y, batch);
}
SEEPAST_CLONES
void sample(Batch& batch) { interpolate(batch); }

// Of a row's wanted pixels, the sums over rays.
struct Sums {
  explicit Sums(int width) : x(width), total(width), weights(width), heaviest(width) {}
  std::vector<int32_t> x;
  std::vector<std::array<float, 3>> total;
  std::vector<float> weights, heaviest;
};

// The next of a row's wanted pixels, from `next` on, that have a ray of camera k which counts. Returns where
// to go on.
int gather(const uint16_t* rays, const uint16_t* d, int k, const RayWeights& weights, int next, int count,
           const Sums& sums, Batch& batch) {
  int n = 0;
  const float near = weights.near[k], light = weights.light;
  for (; next < count && n < kBlock; ++next) {
    const int x = sums.x[next];
    if (!(rays[x] >> k & 1) || near < light * sums.heaviest[next]) continue;
    batch.place[n] = next;
    batch.x[n] = x;
    batch.d[n] = static_cast<float>(d[x]) / static_cast<float>(kUnits);
    ++n;
  }
  batch.count = n;
  return next;
}

void add(const Array& array, int k, const RayWeights& weights, const Batch& batch, Sums& sums) {
  const uint8_t* const clear = weights.clear + k * array.pixels();
  for (int i = 0; i < batch.count; ++i) {
    const int column = clamp(batch.column[i], 0, array.width - 1);
    const int row = clamp(batch.row[i], 0, array.height - 1);
    const bool is_clear = clear[static_cast<size_t>(row) * array.width + column];
    const float weight = (is_clear ? 1.0f : weights.edge) * weights.near[k];
    const int n = batch.place[i];
    for (int c = 0; c < 3; ++c) sums.total[n][c] += weight * batch.sample[c][i];
    sums.weights[n] += weight;
    sums.heaviest[n] = std::max(sums.heaviest[n], weight);
  }
}

// The means of a row's wanted pixels.
SEEPAST_CLONES
void put_means(const Sums& sums, int count, uint8_t* row) {
  for (int n = 0; n < count; ++n) {
    const float weight = sums.weights[n];
    for (int c = 0; c < 3; ++c) {
      const float value = std::floor(sums.total[n][c] / (weight > 0 ? weight : 1.0f) + 0.5f);
      row[3 * sums.x[n] + c] = static_cast<uint8_t>(value < 0.0f ? 0.0f : (value > 255.0f ? 255.0f : value));
    }
  }
}

}  // namespace

void blend(const Array& array, int reference, const uint8_t* colour, const uint16_t* rays,
           const RayWeights& weights, const uint16_t* d, const uint8_t* wanted, uint8_t* background) {
  const size_t pixels = array.pixels();
#pragma omp parallel
  {
    Sums sums(array.width);
    Batch batch{};
#pragma omp for schedule(dynamic, 8)
    for (int y = 0; y < array.height; ++y) {
      const size_t line = static_cast<size_t>(y) * array.width;
      std::copy_n(colour + 3 * (reference * pixels + line), 3 * array.width, background + 3 * line);
      int count = 0;
      for (int x = 0; x < array.width; ++x) {
        sums.x[count] = x;
        count += wanted[line + x] != 0;
      }
      std::fill_n(sums.total.begin(), count, std::array<float, 3>{});
      std::fill_n(sums.weights.begin(), count, 0.0f);
      std::fill_n(sums.heaviest.begin(), count, 0.0f);
      for (int i = 0; i < array.cameras; ++i)
        for (int next = 0, k = weights.order[i]; next < count;) {
          next = gather(rays + line, d + line, k, weights, next, count, sums, batch);
          if (!batch.count) continue;
          find(array.offsets + kOffsets * k, array.cx, array.cy, y, batch);
          fetch(colour + 3 * k * pixels, array.height, array.width, batch);
          sample(batch);
          add(array, k, weights, batch, sums);
        }
      put_means(sums, count, background + 3 * line);
    }
  }
}

}  // namespace seepast
