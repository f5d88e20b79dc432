// What the views say about each other: witnesses of a view's disparities, labels, and votes on its
// candidates.
#include <algorithm>
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

// Rays of a row of pixels at their own disparities: where each lands (-1: outside), and what it expects
// there.
SEEPAST_CLONES
void land_row(const uint16_t* __restrict d, int y, int width, int height, float ax, float ay, float az,
              float sx, float sy, float cx, float cy, int32_t* __restrict at, int32_t* __restrict expected) {
  for (int x = 0; x < width; ++x) {
    const float units = static_cast<float>(d[x]);
    const float offset[kOffsets] = {ax, ay, az, sx, sy};
    const RayShift shift = ray_shift(offset, units / static_cast<float>(kUnits));
    const int column = x + whole_offset(ray_dx(shift, x, cx)), row = y + whole_offset(ray_dy(shift, y, cy));
    const bool there = (column >= 0) & (column < width) & (row >= 0) & (row < height);
    at[x] = there ? row * width + column : -1;
    expected[x] = floor_int(units * (shift.zoom + 1.0f) + 0.5f);
  }
}

// One row's rays into one camera.
struct Landing {
  explicit Landing(int width) : at(width), expected(width) {}
  void row(const Array& array, int k, int y, const uint16_t* d) {
    const float* o = array.offsets + kOffsets * k;
    land_row(d, y, array.width, array.height, o[0], o[1], o[2], o[3], o[4], array.cx, array.cy, at.data(),
             expected.data());
  }
  std::vector<int32_t> at, expected;
};

// Sums of the votes for and against a row of candidates, from one camera's run of pixels.
SEEPAST_CLONES
void add_votes(const uint16_t* __restrict disparity, const uint8_t* __restrict confidence, int count,
               int expected, int16_t* __restrict support, int16_t* __restrict violation) {
  // u16 arithmetic wraps, so that one subtraction gives e + 4 px in range wherever |e| <= 4 px
  constexpr int16_t kReach = 4 * kUnits;
  const uint16_t low = static_cast<uint16_t>(std::max(0, expected - kReach));
  const uint16_t high = static_cast<uint16_t>(expected + kReach);
  const uint16_t middle = static_cast<uint16_t>(expected);
  for (int x = 0; x < count; ++x) {
    uint16_t seen = disparity[x];
    seen = seen < low ? low : seen;
    seen = seen > high ? high : seen;
    const int16_t e = static_cast<int16_t>(seen - middle), c = confidence[x];
    const int16_t size = e < 0 ? static_cast<int16_t>(-e) : e;
    const int16_t near = static_cast<int16_t>(std::max<int16_t>(0, static_cast<int16_t>(kUnits - size)));
    const int16_t beyond = static_cast<int16_t>(std::max<int16_t>(0, static_cast<int16_t>(-e - kUnits)));
    const int16_t against = std::min<int16_t>(beyond, 2 * kUnits);
    support[x] = static_cast<int16_t>(support[x] + static_cast<int16_t>(c * near) * 2);
    violation[x] = static_cast<int16_t>(violation[x] + static_cast<int16_t>(c * against));
  }
}

SEEPAST_CLONES
void vote_energy(const int16_t* __restrict support, const int16_t* __restrict violation,
                 const uint8_t* __restrict is_static, int count, const VoteWeights& weights,
                 const int16_t* hidden_by, int16_t* __restrict nearer, int16_t* __restrict margin,
                 uint8_t* __restrict out) {
  const int16_t base = static_cast<int16_t>(weights.base), gain = static_cast<int16_t>(weights.gain),
                hide = static_cast<int16_t>(weights.hide);
  constexpr int16_t kTwo = 2 * kFullVote, kOne = kFullVote;
  if (hidden_by)
    for (int x = 0; x < count; ++x) nearer[x] = std::max(nearer[x], hidden_by[x]);
  for (int x = 0; x < count; ++x) {
    const int16_t s = support[x], v = violation[x];
    const int16_t votes = static_cast<int16_t>(std::min(v, kTwo) - std::min(s, kTwo));
    const int16_t weight = is_static[x] ? static_cast<int16_t>(0) : hide;
    const int16_t hidden = static_cast<int16_t>(weight * std::min(nearer[x], kOne));
    const int16_t energy = static_cast<int16_t>(base + static_cast<int16_t>(gain * votes) + hidden);
    const int16_t whole = static_cast<int16_t>((std::max<int16_t>(0, energy) + 64) >> 7);
    out[x] = static_cast<uint8_t>(std::min<int16_t>(255, whole));
    margin[x] = static_cast<int16_t>(std::max<int16_t>(0, static_cast<int16_t>(s - v)));
  }
}

// out += weight * costs, in 128ths.
SEEPAST_CLONES
void add_costs(const uint8_t* votes, const uint8_t* costs, size_t count, uint16_t weight, uint8_t* out) {
#pragma GCC ivdep
  for (size_t i = 0; i < count; ++i) {
    const uint16_t part = static_cast<uint16_t>(static_cast<uint16_t>(costs[i] * weight + 64) >> 7);
    const uint16_t sum = static_cast<uint16_t>(votes[i] + part);
    out[i] = static_cast<uint8_t>(sum < 255 ? sum : 255);
  }
}

// The votes on one row of pixels.
struct Ballot {
  Ballot(const Array& array, const Grid& grid, int skip)
      : array(array), grid(grid), skip(skip), lag((16 + grid.step - 1) / grid.step) {
    for (int i = 0; i < grid.count; ++i)
      for (int k = 0; k < array.cameras; ++k) {
        const RayShift shift = array.shift(k, grid.value(i));
        shifts.push_back(shift);
        expected.push_back(
            floor_int(grid.value(i) * static_cast<float>(kUnits) * (shift.zoom + 1.0f) + 0.5f));
      }
    support.resize(array.width);
    violation.resize(array.width);
    nearer.resize(array.width);
    margins.resize(static_cast<size_t>(lag + 1) * array.width);
    tile.resize(static_cast<size_t>(grid.count) * array.width);
    turned.resize(tile.size());
  }

  void row(int y, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const VoteWeights& weights, uint8_t* out) {
    const int width = array.width;
    std::fill(nearer.begin(), nearer.end(), 0);
    for (int i = grid.count - 1; i >= 0; --i) {
      candidate(i, y, disparities, confidence);
      const int16_t* hidden_by = i + lag < grid.count
                                     ? margins.data() + static_cast<size_t>((i + lag) % (lag + 1)) * width
                                     : nullptr;
      vote_energy(support.data(), violation.data(), is_static, width, weights, hidden_by, nearer.data(),
                  margins.data() + static_cast<size_t>(i % (lag + 1)) * width,
                  tile.data() + static_cast<size_t>(i) * width);
    }
    transpose(tile.data(), width, grid.count, width, turned.data(), grid.count);
    add_costs(turned.data(), costs, tile.size(), static_cast<uint16_t>(weights.volume), out);
  }

  void candidate(int i, int y, const uint16_t* disparities, const uint8_t* confidence) {
    std::fill(support.begin(), support.end(), 0);
    std::fill(violation.begin(), violation.end(), 0);
    for (int k = 0; k < array.cameras; ++k) {
      if (k == skip) continue;
      const RayShift& shift = shifts[static_cast<size_t>(i) * array.cameras + k];
      const int row = y + whole_offset(ray_dy(shift, y, array.cy));
      if (row < 0 || row >= array.height) continue;
      const size_t at = k * array.pixels() + static_cast<size_t>(row) * array.width;
      for_each_run(
          0, array.width, [&](int x) { return whole_offset(ray_dx(shift, x, array.cx)); },
          [&](int first, int last, int offset) {
            first = std::max(first, -offset);
            last = std::min(last, array.width - offset);
            if (first < last)
              add_votes(disparities + at + first + offset, confidence + at + first + offset, last - first,
                        expected[static_cast<size_t>(i) * array.cameras + k], support.data() + first,
                        violation.data() + first);
          });
    }
  }

  const Array& array;
  const Grid& grid;
  int skip, lag;                 // lag: candidates to the first that hides, 2 px nearer
  std::vector<RayShift> shifts;  // [candidate][camera]
  std::vector<int> expected;     // likewise: what a view that agrees has there, 32nds of a pixel
  std::vector<int16_t> support, violation, nearer;
  std::vector<int16_t> margins;       // max(0, s - v) of the last lag + 1 candidates
  std::vector<uint8_t> tile, turned;  // [candidate][x], [x][candidate]
};

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
        landing.row(array, k, y, d + row);
        const size_t view = k * array.pixels();
        for (int x = 0; x < array.width; ++x) {
          if (landing.at[x] < 0 || !is_static[view + landing.at[x]]) continue;
          const int e = disparities[view + landing.at[x]] - landing.expected[x];
          agree[row + x] = static_cast<uint8_t>(agree[row + x] + (std::abs(e) <= tolerance));
          farther[row + x] = static_cast<uint8_t>(farther[row + x] | (e < -tolerance));
        }
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
        landing.row(array, k, y, d + row);
        const size_t view = k * array.pixels();
        for (int x = 0; x < array.width; ++x) {
          if (landing.at[x] < 0 || !is_static[view + landing.at[x]]) continue;
          const int e = disparities[view + landing.at[x]] - landing.expected[x];
          passing[row + x] = static_cast<uint16_t>(passing[row + x] | 1 << k);
          if (k == reference || std::abs(e) <= tolerance)
            shown[row + x] = static_cast<uint16_t>(shown[row + x] | 1 << k);
        }
      }
    }
  }
}

void votes(const Array& array, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const Grid& grid, int skip, const VoteWeights& weights, uint8_t* out) {
#pragma omp parallel
  {
    Ballot ballot(array, grid, skip);
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      ballot.row(y, costs + row * grid.count, disparities, confidence, is_static + row, weights,
                 out + row * grid.count);
    }
  }
}

}  // namespace seepast
