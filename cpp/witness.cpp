// What the views say about a view's disparities: witnesses, their confidence, and the labels of its rays.
#include <algorithm>
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kLanes = 64;  // rows are rounded up to these, so that no loop over them has a remainder
constexpr int32_t kOutside = -(1 << 29);  // expected: no disparity agrees with it, and none is farther

// One row's rays into one camera.
struct Landing {
  explicit Landing(int width)
      : count((width + kLanes - 1) / kLanes * kLanes), d(count), at(count), expected(count), seen(count) {}
  int count;
  std::vector<uint16_t> d;
  std::vector<int32_t> at,
      expected;                // a pixel of the camera; the disparity expected there, kOutside beyond it
  std::vector<uint32_t> seen;  // the disparity found there, and above 16 bits what is static
};

SEEPAST_CLONES
void land(const uint16_t* __restrict d, int count, int y, int width, int height, float ax, float ay, float az,
          float sx, float sy, float cx, float cy, int32_t* __restrict at, int32_t* __restrict expected) {
  const float offset[kOffsets] = {ax, ay, az, sx, sy};
  for (int x = 0; x < count; ++x) {
    const float units = static_cast<float>(d[x]);
    const RayShift shift = ray_shift(offset, units / static_cast<float>(kUnits));
    const int column = x + whole_offset(ray_dx(shift, x, cx)), row = y + whole_offset(ray_dy(shift, y, cy));
    const int inside = -((column >= 0) & (column < width) & (row >= 0) & (row < height));
    at[x] = (row * width + column) & inside;
    expected[x] = (floor_int(units * (shift.zoom + 1.0f) + 0.5f) & inside) | (kOutside & ~inside);
  }
}

// Looks what camera k sees of the landing's d; disparities uint16, is_static uint8 [K, H, W].
void look(const Array& array, int k, int y, const uint16_t* disparities, const uint8_t* is_static,
          Landing& landing) {
  const float* o = array.offsets + kOffsets * k;
  land(landing.d.data(), landing.count, y, array.width, array.height, o[0], o[1], o[2], o[3], o[4], array.cx,
       array.cy, landing.at.data(), landing.expected.data());
  const uint16_t* view = disparities + k * array.pixels();
  const uint8_t* open = is_static + k * array.pixels();
  const int32_t* at = landing.at.data();
  uint32_t* seen = landing.seen.data();
  for (int x = 0; x < landing.count; x += 4)
    for (int i = x; i < x + 4; ++i) seen[i] = view[at[i]] | static_cast<uint32_t>(open[at[i]]) << 16;
}

SEEPAST_CLONES
void count_witnesses(const uint32_t* __restrict seen, const int32_t* __restrict expected, int count,
                     int tolerance, uint8_t* __restrict agree, uint8_t* __restrict farther) {
  for (int x = 0; x < count; ++x) {
    const int e = static_cast<int>(seen[x] & 0xffff) - expected[x];
    const uint8_t open = seen[x] > 0xffff, same = std::abs(e) <= tolerance, beyond = e < -tolerance;
    agree[x] = static_cast<uint8_t>(agree[x] + (open & same));
    farther[x] = static_cast<uint8_t>(farther[x] | (open & beyond));
  }
}

SEEPAST_CLONES
void add_labels(const uint32_t* __restrict seen, const int32_t* __restrict expected, int count, int tolerance,
                uint16_t bit, uint16_t* __restrict shown, uint16_t* __restrict passing) {
  for (int x = 0; x < count; ++x) {
    const int e = static_cast<int>(seen[x] & 0xffff) - expected[x];
    const uint16_t open = (seen[x] > 0xffff) & (expected[x] != kOutside) ? bit : static_cast<uint16_t>(0);
    const uint16_t same = std::abs(e) <= tolerance ? open : static_cast<uint16_t>(0);
    passing[x] = static_cast<uint16_t>(passing[x] | open);
    shown[x] = static_cast<uint16_t>(shown[x] | same);
  }
}

SEEPAST_CLONES
void grade(const uint8_t* __restrict agree, const uint8_t* __restrict farther,
           const uint8_t* __restrict is_static, size_t count, uint8_t confident, uint8_t lone,
           uint8_t doubtful, uint8_t* __restrict out) {
  for (size_t i = 0; i < count; ++i) {
    const uint8_t alone = farther[i] ? doubtful : lone;
    const uint8_t c = agree[i] ? confident : alone;
    out[i] = is_static[i] ? c : static_cast<uint8_t>(0);
  }
}

}  // namespace

void witnesses(const Array& array, const uint16_t* d, const uint16_t* disparities, const uint8_t* is_static,
               int skip, int tolerance, uint8_t* agree, uint8_t* farther) {
#pragma omp parallel
  {
    Landing landing(array.width);
    std::vector<uint8_t> same(landing.count), beyond(landing.count);
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      std::copy_n(d + row, array.width, landing.d.data());
      std::fill(same.begin(), same.end(), 0);
      std::fill(beyond.begin(), beyond.end(), 0);
      for (int k = 0; k < array.cameras; ++k) {
        if (k == skip) continue;
        look(array, k, y, disparities, is_static, landing);
        count_witnesses(landing.seen.data(), landing.expected.data(), landing.count, tolerance, same.data(),
                        beyond.data());
      }
      std::copy_n(same.data(), array.width, agree + row);
      std::copy_n(beyond.data(), array.width, farther + row);
    }
  }
}

void labels(const Array& array, int reference, const uint16_t* d, const uint16_t* disparities,
            const uint8_t* is_static, int tolerance, uint16_t* shown, uint16_t* passing) {
#pragma omp parallel
  {
    Landing landing(array.width);
    std::vector<uint16_t> same(landing.count), open(landing.count);
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      std::copy_n(d + row, array.width, landing.d.data());
      std::fill(same.begin(), same.end(), 0);
      std::fill(open.begin(), open.end(), 0);
      for (int k = 0; k < array.cameras; ++k) {
        look(array, k, y, disparities, is_static, landing);
        add_labels(landing.seen.data(), landing.expected.data(), landing.count,
                   k == reference ? 1 << 30 : tolerance, static_cast<uint16_t>(1 << k), same.data(),
                   open.data());
      }
      std::copy_n(same.data(), array.width, shown + row);
      std::copy_n(open.data(), array.width, passing + row);
    }
  }
}

void confidence_of(const uint8_t* agree, const uint8_t* farther, const uint8_t* is_static, size_t count,
                   const Grades& grades, uint8_t* out) {
  grade(agree, farther, is_static, count, grades.confident, grades.lone, grades.doubtful, out);
}

}  // namespace seepast
