// Stage "segmentation", the E-step: argmin over the 2^K label sets S of beta Var_S - sum_k log p(S^k |
// S_P^k).
//
// Not all sets need looking at. The set S_0 of every ray's cheaper label has the least prior cost there is,
// so a set can only win by saving variance: rays whose other label costs more than beta Var_{S_0} on top can
// never flip. Mostly none is left, and the result is still the exact minimum.
#include <algorithm>
#include <bit>
#include <cmath>
#include <vector>

#include "rays.h"

namespace seepast {
namespace {

// The rays of one reference pixel at its disparity.
struct Rays {
  Descriptor f[kMaxCameras];
  int distance[kMaxCameras][kMaxCameras];
  int cost[2][kMaxCameras];  // of calling the ray dynamic, static
  uint8_t p[kMaxCameras];
  uint32_t exist;
};

// Where the rays of a reference row are sampled in one camera: quarter positions, row -1 where there is no
// ray.
SEEPAST_CLONES
void positions_row(const Array& array, int k, int y, const float* __restrict d, int32_t* __restrict xq,
                   int32_t* __restrict row) {
  const int width = array.width, height = array.height;
  const float cx = array.cx, cy = array.cy;
  const float* offset = array.offsets + kOffsets * k;
  const float o[kOffsets] = {offset[0], offset[1], offset[2], offset[3], offset[4]};
  for (int x = 0; x < width; ++x) {
    const RayShift shift = ray_shift(o, d[x]);
    const int at = 4 * x + quarter_offset(ray_dx(shift, x, cx)),
              line = y + whole_offset(ray_dy(shift, y, cy));
    const bool in = (at >= 0) & ((at >> 2) + ((at & 3) > 0) < width) & (line >= 0) & (line < height);
    xq[x] = at;
    row[x] = in ? line : -1;
  }
}

SEEPAST_CLONES
void gather(const Array& array, const uint8_t* descriptors, const uint8_t* dynamic, const int32_t* costs,
            int x, const int32_t* xq, const int32_t* row, Rays& rays) {
  const size_t pixels = array.pixels();
  rays.exist = 0;
  for (int k = 0; k < array.cameras; ++k) {
    const int at = xq[k * array.width + x], line = row[k * array.width + x];
    if (line < 0) continue;
    const uint8_t* prior = dynamic + k * pixels + static_cast<size_t>(line) * array.width + (at >> 2);
    const uint8_t p = (at & 3) && prior[1] > prior[0] ? prior[1] : prior[0];
    if (p == kNoRay) continue;
    rays.p[k] = p;
    rays.cost[0][k] = costs[p];
    rays.cost[1][k] = costs[255 + p];
    rays.f[k] = ray_descriptor(descriptors + k * pixels * kSamples, array.width, at, line);
    for (int j = 0; j < k; ++j)
      if (rays.exist >> j & 1)
        rays.distance[k][j] = rays.distance[j][k] = squared_distance(rays.f[k], rays.f[j]);
    rays.exist |= 1u << k;
  }
}

int spread_to(const Rays& rays, uint32_t set, int k) {
  int sum = 0;
  for (uint32_t rest = set; rest; rest &= rest - 1) sum += rays.distance[k][std::countr_zero(rest)];
  return sum;
}

int spread_of(const Rays& rays, uint32_t set) {
  int sum = 0;
  for (uint32_t rest = set; rest; rest &= rest - 1)
    sum += spread_to(rays, rest & (rest - 1), std::countr_zero(rest));
  return sum;
}

int64_t prior_of(const Rays& rays, uint32_t set) {
  int64_t sum = 0;
  for (uint32_t rest = rays.exist; rest; rest &= rest - 1) {
    const int k = std::countr_zero(rest);
    sum += rays.cost[set >> k & 1][k];
  }
  return sum;
}

double data_energy(const SegmentationParams& params, int spread, int n) {
  const double variance = n > 1 ? spread * (1.0 / (n * n)) : params.lone_variance;
  return params.beta * variance;
}

double energy_of(const Rays& rays, const SegmentationParams& params, uint32_t set) {
  return data_energy(params, spread_of(rays, set), std::popcount(set)) +
         static_cast<double>(prior_of(rays, set));
}

// Rays whose dearer label could pay for itself against S_0.
uint32_t flippable(const Rays& rays, double slack) {
  uint32_t set = 0;
  for (uint32_t rest = rays.exist; rest; rest &= rest - 1) {
    const int k = std::countr_zero(rest);
    if (std::abs(rays.cost[0][k] - rays.cost[1][k]) <= slack) set |= 1u << k;
  }
  return set;
}

// Walks through all subsets of `flips` in Gray-code order, one ray at a time; ties go to the smaller label
// number.
uint32_t best_set(const Rays& rays, const SegmentationParams& params, uint32_t start, uint32_t flips) {
  uint32_t set = start, best = start;
  int spread = spread_of(rays, set);
  int64_t prior = prior_of(rays, set);
  double lowest = data_energy(params, spread, std::popcount(set)) + static_cast<double>(prior);
  int toggles[kMaxCameras], m = 0;
  for (uint32_t rest = flips; rest; rest &= rest - 1) toggles[m++] = std::countr_zero(rest);
  for (uint32_t step = 1; step < 1u << m; ++step) {
    const int k = toggles[std::countr_zero(step)];
    const uint32_t bit = 1u << k;
    const bool leaves = set & bit;
    set ^= bit;
    spread += (leaves ? -1 : 1) * spread_to(rays, set & ~bit, k);
    prior += leaves ? rays.cost[0][k] - rays.cost[1][k] : rays.cost[1][k] - rays.cost[0][k];
    const double energy = data_energy(params, spread, std::popcount(set)) + static_cast<double>(prior);
    if (energy < lowest || (energy == lowest && set < best)) lowest = energy, best = set;
  }
  return best;
}

uint32_t label_set(const Rays& rays, const SegmentationParams& params) {
  uint32_t start = 0;
  for (uint32_t rest = rays.exist; rest; rest &= rest - 1) {
    const int k = std::countr_zero(rest);
    if (rays.cost[1][k] < rays.cost[0][k]) start |= 1u << k;
  }
  const double slack = data_energy(params, spread_of(rays, start), std::popcount(start));
  const uint32_t flips = flippable(rays, slack);
  return flips ? best_set(rays, params, start, flips) : start;
}

uint8_t posterior_of(const Rays& rays, const SegmentationParams& params, uint32_t set, int k) {
  const uint32_t bit = 1u << k;
  const double gain = energy_of(rays, params, set & ~bit) - energy_of(rays, params, set | bit);
  const double reach = params.posterior_reach, fine = std::floor(gain * params.posterior_scale + 0.5);
  const double index = fine < -reach ? -reach : (fine > reach ? reach : fine);
  return params.posterior[static_cast<int>(index) + params.posterior_reach];
}

}  // namespace

void segmentation(const Array& array, const uint8_t* descriptors, const uint8_t* dynamic, const float* d,
                  const uint8_t* wanted, const SegmentationParams& params, uint16_t* labels,
                  uint8_t* posterior) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 8)
  for (int y = 0; y < array.height; ++y) {
    Rays rays;
    std::vector<int32_t> xq(static_cast<size_t>(array.cameras) * array.width), line(xq.size());
    const size_t row = static_cast<size_t>(y) * array.width;
    for (int k = 0; k < array.cameras; ++k)
      std::fill_n(posterior + k * pixels + row, array.width, kUnchanged);
    std::fill_n(labels + row, array.width, uint16_t{0});
    if (std::none_of(wanted + row, wanted + row + array.width, [](uint8_t w) { return w != 0; })) continue;
    for (int k = 0; k < array.cameras; ++k)
      positions_row(array, k, y, d + row, xq.data() + k * array.width, line.data() + k * array.width);
    for (int x = 0; x < array.width; ++x) {
      const size_t at = row + x;
      if (!wanted[at]) continue;
      gather(array, descriptors, dynamic, params.costs, x, xq.data(), line.data(), rays);
      const uint32_t set = label_set(rays, params);
      labels[at] = static_cast<uint16_t>(set);
      for (uint32_t rest = rays.exist; rest; rest &= rest - 1) {
        const int k = std::countr_zero(rest);
        if ((set >> k & 1) != (rays.p[k] < 127))
          posterior[k * pixels + at] = posterior_of(rays, params, set, k);
      }
    }
  }
}

}  // namespace seepast
