// What the views say about a view's disparities: witnesses, their confidence, and the labels of its rays.
#include <algorithm>
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kLanes = 64;  // rows are rounded up to these, so that no loop over them has a remainder
constexpr int32_t kOutside = -(1 << 29);  // expected: no disparity agrees with it, and none is farther

SEEPAST_CLONES
void span(const uint16_t* __restrict d, int count, uint16_t* low, uint16_t* high) {
  uint16_t least = d[0], most = d[0];
  for (int x = 0; x < count; ++x) {
    least = d[x] < least ? d[x] : least;
    most = d[x] > most ? d[x] : most;
  }
  *low = least, *high = most;
}

// One row's rays into one camera.
struct Landing {
  Landing(int width, float cx)
      : count((width + kLanes - 1) / kLanes * kLanes),
        d(count),
        off(count),
        at(count),
        expected(count),
        seen(count) {
    for (int x = 0; x < count; ++x) off[x] = static_cast<float>(x) - cx;
  }
  void start(const uint16_t* row, int width) {
    std::copy_n(row, width, d.data());
    std::fill(d.begin() + width, d.end(), row[width - 1]);
    span(d.data(), count, &low, &high);
  }
  int count;
  uint16_t low, high;  // of d
  std::vector<uint16_t> d;
  std::vector<float> off;  // of the columns from the centre
  std::vector<int32_t> at,
      expected;                // a pixel of the camera; the disparity expected there, kOutside beyond it
  std::vector<uint32_t> seen;  // the disparity found there, and above 16 bits what is static
};

struct Camera {
  float offset[kOffsets];
  int width, height;
};

// Where all of a row's rays are moved by as many rows `level` says so, and `down` by how many.
template <bool level>
[[gnu::always_inline]] inline void land_all(const uint16_t* __restrict d, const float* __restrict off,
                                            int count, const Camera& camera, int y, float cy, int down,
                                            int32_t* __restrict at, int32_t* __restrict expected) {
  const int width = camera.width, height = camera.height;
  const float o[kOffsets] = {camera.offset[0], camera.offset[1], camera.offset[2], camera.offset[3],
                             camera.offset[4]};
  for (int x = 0; x < count; ++x) {
    const float units = static_cast<float>(d[x]);
    const RayShift shift = ray_shift(o, units / static_cast<float>(kUnits));
    const int column = x + whole_offset(off[x] * shift.zoom - shift.x + shift.view_x);
    const int row = y + (level ? down : whole_offset(ray_dy(shift, y, cy)));
    int inside = (column >= 0) & (column < width);
    if (!level) inside &= (row >= 0) & (row < height);
    inside = -inside;
    at[x] = (row * width + column) & inside;
    expected[x] = (floor_int(units * (shift.zoom + 1.0f) + 0.5f) & inside) | (kOutside & ~inside);
  }
}

SEEPAST_CLONES
void land_level(const uint16_t* d, const float* off, int count, const Camera& camera, int y, float cy,
                int down, int32_t* at, int32_t* expected) {
  land_all<true>(d, off, count, camera, y, cy, down, at, expected);
}
SEEPAST_CLONES
void land(const uint16_t* d, const float* off, int count, const Camera& camera, int y, float cy, int32_t* at,
          int32_t* expected) {
  land_all<false>(d, off, count, camera, y, cy, 0, at, expected);
}

// By how many rows all rays of disparities low .. high are moved, if it is the same for all: the way down
// changes only one way with disparity, short of the pole. Rounding of that moves rays by less than kRounding
// rows.
constexpr float kRounding = 0.01f;
bool moved_alike(const float* offset, const Landing& landing, int y, float cy, int* down) {
  float way[2];
  const uint16_t ends[2] = {landing.low, landing.high};
  for (int i = 0; i < 2; ++i) {
    const float d = static_cast<float>(ends[i]) / static_cast<float>(kUnits);
    if (!(1.0f - d * offset[2] > 0.5f && std::abs(static_cast<float>(y) - cy) < 8192.0f)) return false;
    way[i] = ray_dy(ray_shift(offset, d), y, cy);
  }
  const auto [least, most] = std::minmax(way[0], way[1]);
  *down = whole_offset(least - kRounding);
  return *down == whole_offset(most + kRounding);
}

// Looks what camera k sees of the landing's d; disparities uint16, is_static uint8 [K, H, W].
void look(const Array& array, int k, int y, const uint16_t* disparities, const uint8_t* is_static,
          Landing& landing) {
  Camera camera{{}, array.width, array.height};
  std::copy_n(array.offsets + kOffsets * k, kOffsets, camera.offset);
  int32_t* at = landing.at.data();
  int down = 0;
  if (!moved_alike(camera.offset, landing, y, array.cy, &down)) {
    land(landing.d.data(), landing.off.data(), landing.count, camera, y, array.cy, at,
         landing.expected.data());
  } else if (y + down >= 0 && y + down < array.height) {
    land_level(landing.d.data(), landing.off.data(), landing.count, camera, y, array.cy, down, at,
               landing.expected.data());
  } else {
    std::fill(landing.at.begin(), landing.at.end(), 0);
    std::fill(landing.expected.begin(), landing.expected.end(), kOutside);
  }
  const uint16_t* view = disparities + k * array.pixels();
  const uint8_t* open = is_static + k * array.pixels();
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
    Landing landing(array.width, array.cx);
    std::vector<uint8_t> same(landing.count), beyond(landing.count);
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      landing.start(d + row, array.width);
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
    Landing landing(array.width, array.cx);
    std::vector<uint16_t> same(landing.count), open(landing.count);
#pragma omp for schedule(static)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      landing.start(d + row, array.width);
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
