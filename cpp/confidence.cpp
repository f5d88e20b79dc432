// What is counted of every pixel at a method's end: evidence on disparities (confidence.py), rays, and what
// is clear of people.
#include <algorithm>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr size_t kPart = 1 << 14;  // pixels that a thread takes at once

constexpr int kReach = 4;  // confidence.py REACH = 9 pixels across
constexpr int kAcross = 2 * kReach + 1;
constexpr int kSteps = 7;
constexpr int kClear = 2;  // px beside a mask

// Extremes of `rows` rows of d.
SEEPAST_CLONES
void of_columns(const uint16_t* __restrict d, int rows, int width, uint16_t* __restrict low,
                uint16_t* __restrict high) {
  std::copy_n(d, width, low);
  std::copy_n(d, width, high);
  for (int j = 1; j < rows; ++j) {
    const uint16_t* __restrict row = d + static_cast<size_t>(j) * width;
    for (int x = 0; x < width; ++x) {
      low[x] = row[x] < low[x] ? row[x] : low[x];
      high[x] = row[x] > high[x] ? row[x] : high[x];
    }
  }
}

// What kAcross columns from x on differ by.
SEEPAST_CLONES
void spread(const uint16_t* __restrict low, const uint16_t* __restrict high, int width,
            uint16_t* __restrict out) {
  for (int x = 0; x < width; ++x) {
    uint16_t least = low[x], most = high[x];
    for (int i = 1; i < kAcross; ++i) {
      least = low[x + i] < least ? low[x + i] : least;
      most = high[x + i] > most ? high[x + i] : most;
    }
    out[x] = static_cast<uint16_t>(most - least);
  }
}

[[gnu::always_inline]] inline uint8_t bits(uint16_t set) {
  unsigned n = set;
  n -= n >> 1 & 0x5555;
  n = (n & 0x3333) + (n >> 2 & 0x3333);
  n = (n + (n >> 4)) & 0x0f0f;
  return static_cast<uint8_t>((n + (n >> 8)) & 31);
}

SEEPAST_CLONES
void count_rays(const uint16_t* __restrict labels, int count, uint8_t* __restrict out) {
  for (int i = 0; i < count; ++i) out[i] = bits(labels[i]);
}

SEEPAST_CLONES
void pack(const uint16_t* __restrict differs, const uint8_t* __restrict is_static,
          const uint8_t* __restrict close, const uint16_t* __restrict shown, const uint16_t* steps, int width,
          uint8_t* __restrict out) {
  const uint16_t step[kSteps] = {steps[0], steps[1], steps[2], steps[3], steps[4], steps[5], steps[6]};
  for (int x = 0; x < width; ++x) {
    int flat = 0;
    for (int i = 0; i < kSteps; ++i) flat += differs[x] <= step[i];
    const int own = is_static[x], loose = bits(shown[x]) - own - close[x];
    out[x] =
        static_cast<uint8_t>(128 * own + 32 * std::min<int>(close[x], 3) + 8 * clamp(loose, 0, 3) + flat);
  }
}

SEEPAST_CLONES
void tell(const uint16_t* __restrict d, const uint8_t* __restrict evidence, const float* __restrict table,
          const uint8_t* keep, int count, float* __restrict disparity, float* __restrict confidence) {
  for (int x = 0; x < count; ++x) disparity[x] = static_cast<float>(d[x]) / static_cast<float>(kUnits);
  for (int x = 0; x < count; ++x) confidence[x] = table[evidence[x]];
  if (!keep) return;
  for (int x = 0; x < count; ++x) disparity[x] = keep[x] ? 0.0f : disparity[x];
  for (int x = 0; x < count; ++x) confidence[x] = keep[x] ? 0.0f : confidence[x];
}

// Rows beyond the image count as clear.
SEEPAST_CLONES
void erode(const uint8_t* const* rows, int width, uint8_t* __restrict three, uint8_t* __restrict out) {
  const uint8_t *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4];
  for (int x = 0; x < width; ++x) three[kClear + x] = b[x] & c[x] & d[x];
  for (int x = 0; x < width; ++x)
    out[x] = three[x] & three[x + 1] & three[x + 2] & three[x + 3] & three[x + 4] & a[x] & e[x];
}

}  // namespace

void evidence(int height, int width, const uint16_t* d, const uint8_t* is_static, const uint8_t* close,
              const uint16_t* shown, const uint16_t* steps, uint8_t* out) {
#pragma omp parallel
  {
    const size_t room = width + 2 * kReach;
    std::vector<uint16_t> low(room, 0xffff), high(room, 0), differs(width);
#pragma omp for schedule(static)
    for (int y = 0; y < height; ++y) {
      const int first = std::max(0, y - kReach), last = std::min(height - 1, y + kReach);
      of_columns(d + static_cast<size_t>(first) * width, last - first + 1, width, low.data() + kReach,
                 high.data() + kReach);
      spread(low.data(), high.data(), width, differs.data());
      const size_t row = static_cast<size_t>(y) * width;
      pack(differs.data(), is_static + row, close + row, shown + row, steps, width, out + row);
    }
  }
}

void told(const uint16_t* d, const uint8_t* evidence, const float* table, const uint16_t* labels,
          const uint8_t* keep, size_t count, float* disparity, float* confidence, uint8_t* coverage) {
  const int parts = static_cast<int>((count + kPart - 1) / kPart);
#pragma omp parallel for schedule(static)
  for (int i = 0; i < parts; ++i) {
    const size_t from = i * kPart;
    const int n = static_cast<int>(std::min(kPart, count - from));
    tell(d + from, evidence + from, table, keep ? keep + from : nullptr, n, disparity + from,
         confidence + from);
    count_rays(labels + from, n, coverage + from);
  }
}

void clear_of_masks(int views, int height, int width, const uint8_t* is_static, uint8_t* clear) {
#pragma omp parallel
  {
    std::vector<uint8_t> three(width + 2 * kClear, 1), beyond(width, 1);
#pragma omp for schedule(static)
    for (int line = 0; line < views * height; ++line) {
      const int y = line % height;
      const size_t row = static_cast<size_t>(line) * width;
      const uint8_t* rows[2 * kClear + 1];
      for (int j = -kClear; j <= kClear; ++j)
        rows[kClear + j] = y + j < 0 || y + j >= height ? beyond.data()
                                                        : is_static + row + static_cast<ptrdiff_t>(j) * width;
      erode(rows, width, three.data(), clear + row);
    }
  }
}

}  // namespace seepast
