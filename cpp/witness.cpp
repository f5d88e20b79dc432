// What the views say about a view's disparities: witnesses, their confidence, and the labels of its rays.
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

// One row's rays into one camera.
struct Landing {
  explicit Landing(int width) : at(width), expected(width), seen(width), there(width) {}
  std::vector<int32_t> at, expected;  // a pixel of the camera, 0 outside; the disparity expected there
  std::vector<uint16_t> seen;         // the disparity found there
  std::vector<uint8_t> there;         // 1 where the ray lands on a static pixel
};

SEEPAST_CLONES
void land(const Array& array, int k, int y, const uint16_t* __restrict d, int32_t* __restrict at,
          int32_t* __restrict expected, uint8_t* __restrict there) {
  const float* o = array.offsets + kOffsets * k;
  const float offset[kOffsets] = {o[0], o[1], o[2], o[3], o[4]};
  const float cx = array.cx, cy = array.cy;
  const int width = array.width, height = array.height;
  for (int x = 0; x < width; ++x) {
    const float units = static_cast<float>(d[x]);
    const RayShift shift = ray_shift(offset, units / static_cast<float>(kUnits));
    const int column = x + whole_offset(ray_dx(shift, x, cx)), row = y + whole_offset(ray_dy(shift, y, cy));
    const bool inside = (column >= 0) & (column < width) & (row >= 0) & (row < height);
    at[x] = inside ? row * width + column : 0;
    there[x] = inside;
    expected[x] = floor_int(units * (shift.zoom + 1.0f) + 0.5f);
  }
}

// Looks there: disparities uint16, is_static uint8 [H, W] of the camera.
void look(const Array& array, int k, int y, const uint16_t* d, const uint16_t* disparities,
          const uint8_t* is_static, Landing& landing) {
  land(array, k, y, d, landing.at.data(), landing.expected.data(), landing.there.data());
  const uint16_t* view = disparities + k * array.pixels();
  const uint8_t* open = is_static + k * array.pixels();
  const int32_t* at = landing.at.data();
  uint16_t* seen = landing.seen.data();
  uint8_t* there = landing.there.data();
  for (int x = 0; x < array.width; ++x) {
    seen[x] = view[at[x]];
    there[x] &= static_cast<uint8_t>(open[at[x]] != 0);
  }
}

SEEPAST_CLONES
void count_witnesses(const uint16_t* __restrict seen, const uint8_t* __restrict there,
                     const int32_t* __restrict expected, int count, int tolerance, uint8_t* __restrict agree,
                     uint8_t* __restrict farther) {
  for (int x = 0; x < count; ++x) {
    const int e = seen[x] - expected[x];
    const uint8_t same = std::abs(e) <= tolerance, beyond = e < -tolerance;
    agree[x] = static_cast<uint8_t>(agree[x] + (there[x] & same));
    farther[x] = static_cast<uint8_t>(farther[x] | (there[x] & beyond));
  }
}

SEEPAST_CLONES
void add_labels(const uint16_t* __restrict seen, const uint8_t* __restrict there,
                const int32_t* __restrict expected, int count, int tolerance, uint16_t bit,
                uint16_t* __restrict shown, uint16_t* __restrict passing) {
  for (int x = 0; x < count; ++x) {
    const int e = seen[x] - expected[x];
    const uint16_t open = there[x] ? bit : static_cast<uint16_t>(0);
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
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      std::fill_n(agree + row, array.width, 0);
      std::fill_n(farther + row, array.width, 0);
      for (int k = 0; k < array.cameras; ++k) {
        if (k == skip) continue;
        look(array, k, y, d + row, disparities, is_static, landing);
        count_witnesses(landing.seen.data(), landing.there.data(), landing.expected.data(), array.width,
                        tolerance, agree + row, farther + row);
      }
    }
  }
}

void labels(const Array& array, int reference, const uint16_t* d, const uint16_t* disparities,
            const uint8_t* is_static, int tolerance, uint16_t* shown, uint16_t* passing) {
#pragma omp parallel
  {
    Landing landing(array.width);
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      std::fill_n(shown + row, array.width, 0);
      std::fill_n(passing + row, array.width, 0);
      for (int k = 0; k < array.cameras; ++k) {
        look(array, k, y, d + row, disparities, is_static, landing);
        add_labels(landing.seen.data(), landing.there.data(), landing.expected.data(), array.width,
                   k == reference ? 1 << 30 : tolerance, static_cast<uint16_t>(1 << k), shown + row,
                   passing + row);
      }
    }
  }
}

void confidence_of(const uint8_t* agree, const uint8_t* farther, const uint8_t* is_static, size_t count,
                   const Grades& grades, uint8_t* out) {
  grade(agree, farther, is_static, count, grades.confident, grades.lone, grades.doubtful, out);
}

}  // namespace seepast
