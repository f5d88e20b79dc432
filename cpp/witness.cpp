// What the views say about a view's disparities: witnesses, their confidence, and the labels of its rays.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <numeric>
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
  explicit Landing(int width)
      : room((width + kLanes - 1) / kLanes * kLanes),
        count(room),
        x(room),
        at(room),
        expected(room),
        d(room),
        seen(room) {
    std::iota(x.begin(), x.end(), 0);
  }
  // All of the row.
  void start(const uint16_t* row, int width) {
    std::copy_n(row, width, d.data());
    std::fill(d.begin() + width, d.end(), row[width - 1]);
    span(d.data(), room, &low, &high);
  }
  // Only the first `many` of x.
  void pick(const uint16_t* row, int many) {
    for (int i = 0; i < many; ++i) d[i] = row[x[i]];
    pad(many, d[many - 1]);
    span(d.data(), count, &low, &high);
  }
  // Of the first `many` only those that nothing was found of, and what is `said` of them; `found` is 0 or 1.
  // Returns how many they are.
  int leave(int many, const uint8_t* found, uint8_t* said) {
    int n = 0;
    for (int first = 0; first < many; first += 8) {  // there is room for as many
      uint64_t eight;
      std::memcpy(&eight, found + first, sizeof eight);
      if (eight == 0x0101010101010101u) continue;
      for (int i = first; i < std::min(first + 8, many); ++i) {
        x[n] = x[i], d[n] = d[i], said[n] = said[i];
        n += !found[i];
      }
    }
    pad(n, low);
    return n;
  }
  void pad(int many, uint16_t disparity) {
    count = (many + kLanes - 1) / kLanes * kLanes;
    std::fill(x.begin() + many, x.begin() + count, 0);
    std::fill(d.begin() + many, d.begin() + count, disparity);
  }
  int room, count;
  uint16_t low = 0, high = 0;  // of d
  std::vector<int32_t> x, at,
      expected;  // column; a pixel of the camera; the disparity expected there, kOutside beyond
  std::vector<uint16_t> d;
  std::vector<uint32_t> seen;  // the disparity found there, and above 16 bits what is static
};

// A row y, and the camera that its rays go to.
struct Way {
  float offset[kOffsets];
  int width, height, y;
  float cx, cy;
};

// `level`: all of the rays are moved by `down` rows, and end inside the image.
template <bool level>
[[gnu::always_inline]] inline void land_all(const int32_t* __restrict x, const uint16_t* __restrict d,
                                            int count, const Way& way, int down, int32_t* __restrict at,
                                            int32_t* __restrict expected) {
  const int width = way.width, height = way.height, y = way.y;
  const float cx = way.cx, cy = way.cy;
  const float o[kOffsets] = {way.offset[0], way.offset[1], way.offset[2], way.offset[3], way.offset[4]};
  for (int i = 0; i < count; ++i) {
    const float units = static_cast<float>(d[i]);
    const RayShift shift = ray_shift(o, units / static_cast<float>(kUnits));
    const int column = x[i] + whole_offset(ray_dx(shift, x[i], cx));
    const int row = y + (level ? down : whole_offset(ray_dy(shift, y, cy)));
    int inside = (column >= 0) & (column < width);
    if (!level) inside &= (row >= 0) & (row < height);
    inside = -inside;
    at[i] = (row * width + column) & inside;
    expected[i] = (floor_int(units * (shift.zoom + 1.0f) + 0.5f) & inside) | (kOutside & ~inside);
  }
}

SEEPAST_CLONES
void land_level(const int32_t* x, const uint16_t* d, int count, const Way& way, int down, int32_t* at,
                int32_t* expected) {
  land_all<true>(x, d, count, way, down, at, expected);
}
SEEPAST_CLONES
void land(const int32_t* x, const uint16_t* d, int count, const Way& way, int32_t* at, int32_t* expected) {
  land_all<false>(x, d, count, way, 0, at, expected);
}

// By how many rows all rays of disparities low .. high are moved, if it is the same for all: the way down
// changes only one way with disparity, short of the pole. Rounding of that moves rays by less than kRounding
// rows.
constexpr float kRounding = 0.01f;
bool moved_alike(const Way& way, uint16_t low, uint16_t high, int* down) {
  float moved[2];
  const uint16_t ends[2] = {low, high};
  for (int i = 0; i < 2; ++i) {
    const float d = static_cast<float>(ends[i]) / static_cast<float>(kUnits);
    if (!(1.0f - d * way.offset[2] > 0.5f && std::abs(static_cast<float>(way.y) - way.cy) < 8192.0f))
      return false;
    moved[i] = ray_dy(ray_shift(way.offset, d), way.y, way.cy);
  }
  const auto [least, most] = std::minmax(moved[0], moved[1]);
  *down = whole_offset(least - kRounding);
  return *down == whole_offset(most + kRounding);
}

// Looks what camera k sees of the landing's d; disparities uint16, is_static uint8 [K, H, W].
void look(const Array& array, int k, int y, const uint16_t* disparities, const uint8_t* is_static,
          Landing& landing) {
  Way way{{}, array.width, array.height, y, array.cx, array.cy};
  std::copy_n(array.offsets + kOffsets * k, kOffsets, way.offset);
  int32_t *at = landing.at.data(), *expected = landing.expected.data(), down = 0;
  if (!moved_alike(way, landing.low, landing.high, &down)) {
    land(landing.x.data(), landing.d.data(), landing.count, way, at, expected);
  } else if (y + down >= 0 && y + down < array.height) {
    land_level(landing.x.data(), landing.d.data(), landing.count, way, down, at, expected);
  } else {
    std::fill_n(at, landing.count, 0);
    std::fill_n(expected, landing.count, kOutside);
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
                int near, uint16_t bit, uint16_t* __restrict shown, uint16_t* __restrict passing,
                uint8_t* __restrict close) {
  for (int x = 0; x < count; ++x) {
    const int e = std::abs(static_cast<int>(seen[x] & 0xffff) - expected[x]);
    const uint16_t open = (seen[x] > 0xffff) & (expected[x] != kOutside) ? bit : static_cast<uint16_t>(0);
    const uint16_t same = e <= tolerance ? open : static_cast<uint16_t>(0);
    passing[x] = static_cast<uint16_t>(passing[x] | open);
    shown[x] = static_cast<uint16_t>(shown[x] | same);
    close[x] = static_cast<uint8_t>(close[x] + ((open != 0) & (e <= near)));
  }
}

// The columns of a row that are wanted. Returns how many they are.
int chosen(const uint8_t* wanted, int width, int32_t* columns) {
  int n = 0;
  for (int x = 0; x < width; ++x) {
    columns[n] = x;
    n += wanted[x] != 0;
  }
  return n;
}

// The columns of a row that have chunks, which start at start[x]. Returns how many they are.
int matched(const int32_t* start, int width, int32_t* columns) {
  constexpr int kRun = 64;
  int n = 0;
  for (int first = 0; first < width; first += kRun) {
    const int last = std::min(first + kRun, width);
    if (start[first] == start[last]) continue;
    for (int x = first; x < last; ++x) {
      columns[n] = x;
      n += start[x] != start[x + 1];
    }
  }
  return n;
}

}  // namespace

void witnesses(const Array& array, const uint16_t* d, const uint16_t* disparities, const uint8_t* is_static,
               int skip, int tolerance, uint8_t* agree, uint8_t* farther) {
#pragma omp parallel
  {
    Landing landing(array.width);
    std::vector<uint8_t> same(landing.room), beyond(landing.room);
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
            const uint8_t* is_static, const uint8_t* wanted, int tolerance, int near, uint16_t* shown,
            uint16_t* rays, uint8_t* close) {
  const int width = array.width;
#pragma omp parallel
  {
    Landing landing(width);
    std::vector<uint16_t> same(landing.room), open(landing.room);
    std::vector<uint8_t> nearly(landing.room);
#pragma omp for schedule(dynamic, 8)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * width;
      std::iota(landing.x.begin(), landing.x.begin() + width, 0);
      int many = width;
      if (wanted) {
        many = chosen(wanted + row, width, landing.x.data());
        std::fill_n(shown + row, width, static_cast<uint16_t>(1 << reference));
        std::fill_n(rays + row, width, static_cast<uint16_t>(1 << reference));
        std::fill_n(close + row, width, uint8_t{0});
        if (!many) continue;
      }
      landing.pick(d + row, many);
      const uint8_t* own = is_static + reference * array.pixels() + row;
      for (int i = 0; i < many; ++i) same[i] = static_cast<uint16_t>(own[landing.x[i]] << reference);
      std::copy_n(same.begin(), many, open.begin());
      std::fill_n(nearly.begin(), landing.count, uint8_t{0});
      for (int k = 0; k < array.cameras; ++k) {
        if (k == reference) continue;
        look(array, k, y, disparities, is_static, landing);
        add_labels(landing.seen.data(), landing.expected.data(), landing.count, tolerance, near,
                   static_cast<uint16_t>(1 << k), same.data(), open.data(), nearly.data());
      }
      for (int i = 0; i < many; ++i) open[i] = same[i] ? same[i] : open[i];
      if (many == width) {
        std::copy_n(same.data(), width, shown + row);
        std::copy_n(open.data(), width, rays + row);
        std::copy_n(nearly.data(), width, close + row);
        continue;
      }
      for (int i = 0; i < many; ++i) {
        const size_t at = row + landing.x[i];
        shown[at] = same[i], rays[at] = open[i], close[at] = nearly[i];
      }
    }
  }
}

namespace {

// The other cameras, nearest first: most pixels agree with that, and need no other.
std::vector<int> others_of(const GradedView& view) {
  std::vector<int> others;
  for (int k = 0; k < view.array.cameras; ++k)
    if (k != view.number) others.push_back(k);
  std::stable_sort(others.begin(), others.end(),
                   [&](int a, int b) { return std::abs(a - view.number) < std::abs(b - view.number); });
  return others;
}

// What witnesses make of rows, one after the other.
struct Grader {
  Grader(const uint16_t* disparities, const uint8_t* is_static, int tolerance, const Grades& grades,
         int width)
      : disparities(disparities),
        is_static(is_static),
        tolerance(tolerance),
        grades(grades),
        rest(width),
        agree(rest.room),
        farther(rest.room) {}

  void grade_row(const GradedView& view, const std::vector<int>& others, int y) {
    const Array& array = view.array;
    const int width = array.width;
    const size_t row = static_cast<size_t>(y) * width;
    uint8_t *grade = view.confidence + row, *known = view.sure + row;
    std::fill_n(grade, width, uint8_t{0});
    std::fill_n(known, width, uint8_t{0});
    std::iota(rest.x.begin(), rest.x.begin() + width, 0);
    int left = view.start ? matched(view.start + row, width, rest.x.data()) : width;
    if (!left) return;
    for (int i = 0; i < left; ++i) grade[rest.x[i]] = grades.confident, known[rest.x[i]] = 1;
    rest.pick(view.d + row, left);
    std::fill_n(farther.begin(), rest.count, uint8_t{0});
    for (size_t j = 0; left && j < others.size(); ++j) {
      look(array, others[j], y, disparities, is_static, rest);
      std::fill_n(agree.begin(), rest.count, uint8_t{0});
      count_witnesses(rest.seen.data(), rest.expected.data(), rest.count, tolerance, agree.data(),
                      farther.data());
      left = rest.leave(left, agree.data(), farther.data());
    }
    for (int i = 0; i < left; ++i)
      grade[rest.x[i]] = farther[i] ? grades.doubtful : grades.lone, known[rest.x[i]] = 0;
    const uint8_t* open = is_static + view.number * array.pixels() + row;
    for (int x = 0; x < width; ++x) grade[x] = open[x] ? grade[x] : uint8_t{0};
  }

  const uint16_t* disparities;
  const uint8_t* is_static;
  int tolerance;
  const Grades& grades;
  Landing rest;
  std::vector<uint8_t> agree, farther;
};

}  // namespace

void graded(const GradedView* views, int count, const uint16_t* disparities, const uint8_t* is_static,
            int tolerance, const Grades& grades) {
  std::vector<std::vector<int>> others;
  for (int i = 0; i < count; ++i) others.push_back(others_of(views[i]));
  const int height = views[0].array.height;
#pragma omp parallel
  {
    Grader grader(disparities, is_static, tolerance, grades, views[0].array.width);
#pragma omp for schedule(dynamic, 16)
    for (int line = 0; line < count * height; ++line)
      grader.grade_row(views[line / height], others[line / height], line % height);
  }
}

}  // namespace seepast
