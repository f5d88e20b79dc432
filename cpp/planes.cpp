// Completion of unconfirmed disparities: reference_multiview.planes.
//
// Blocks of columns that hold a wanted pixel are fitted together, neighbour by neighbour, so that the sums
// vectorise.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr int kFitted = 32;  // columns at once

// A view in separate planes with an empty margin, so that no neighbour needs a test.
struct Padded {
  Padded(int height, int width, int margin, const uint16_t* disparity, const uint8_t* image,
         const uint8_t* trust)
      : margin(margin), stride(width + 2 * margin + kFitted) {
    const size_t size = static_cast<size_t>(stride) * (height + 2 * margin);
    d.resize(size);
    for (auto& c : colour) c.resize(size);
    trusted.resize(size);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y) {
      const size_t from = static_cast<size_t>(y) * width, to = at(y, 0);
      for (int x = 0; x < width; ++x) {
        d[to + x] = disparity[from + x];
        trusted[to + x] = trust[from + x];
        for (int c = 0; c < 3; ++c) colour[c][to + x] = image[3 * (from + x) + c];
      }
    }
  }
  size_t at(int y, int x) const { return static_cast<size_t>(y + margin) * stride + x + margin; }

  int margin, stride;
  std::vector<int32_t> d;
  std::vector<int16_t> colour[3];
  std::vector<uint8_t> trusted;
};

struct Sums {
  float w[kFitted], x[kFitted], y[kFitted], xx[kFitted], xy[kFitted], yy[kFitted], e[kFitted], ex[kFitted],
      ey[kFitted];
};

// Adds the neighbours of one line of offsets, `j` below, to the sums.
SEEPAST_CLONES
void add_line(const int32_t* d, const int16_t* b, const int16_t* g, const int16_t* r, const uint8_t* trusted,
              const float* flat, ptrdiff_t line, int j, const PlaneParams& params, const float* nearness,
              Sums& sums) {
  float w_[kFitted] = {}, x_[kFitted] = {}, xx_[kFitted] = {}, e_[kFitted] = {}, ex_[kFitted] = {};
  for (int i = -params.radius, n = 0; i <= params.radius; i += params.stride, ++n) {
    const ptrdiff_t to = line + i;
    const float fi = static_cast<float>(i), near = nearness[n];
    for (int x = 0; x < kFitted; ++x) {
      const int32_t e = d[to + x] - d[x];
      const int step = std::abs(b[to + x] - b[x]) + std::abs(g[to + x] - g[x]) + std::abs(r[to + x] - r[x]);
      float t = 1.0f - static_cast<float>(step < 256 ? step : 256) * (1.0f / 256.0f);
      t = t * t;
      t = t * t;
      t = t * t;
      const float likeness = flat[x] > 0.0f ? 1.0f : t;
      const bool usable = (trusted[to + x] != 0) & (std::abs(e) <= params.gate);
      const float weight = usable ? likeness * near : 0.0f;
      const float we = weight * static_cast<float>(e), wi = weight * fi;
      w_[x] += weight;
      x_[x] += wi;
      xx_[x] += wi * fi;
      e_[x] += we;
      ex_[x] += we * fi;
    }
  }
  const float fj = static_cast<float>(j), fjj = static_cast<float>(j * j);
  for (int x = 0; x < kFitted; ++x) {
    sums.w[x] += w_[x];
    sums.x[x] += x_[x];
    sums.xx[x] += xx_[x];
    sums.e[x] += e_[x];
    sums.ex[x] += ex_[x];
    sums.y[x] += w_[x] * fj;
    sums.yy[x] += w_[x] * fjj;
    sums.xy[x] += x_[x] * fj;
    sums.ey[x] += e_[x] * fj;
  }
}

// Height of the plane of the n-th sums over its pixel, 32nds of a pixel.
double plane_height(const Sums& sums, int n, double ridge) {
  const double one = 1.0 / static_cast<double>(sums.w[n]);
  const double mx = sums.x[n] * one, my = sums.y[n] * one, me = sums.e[n] * one;
  const double a = sums.xx[n] * one - mx * mx + ridge, b = sums.xy[n] * one - mx * my,
               c = sums.yy[n] * one - my * my + ridge;
  const double u = sums.ex[n] * one - mx * me, v = sums.ey[n] * one - my * me;
  const double det = a * c - b * b;
  return me - (c * u - b * v) / det * mx - (a * v - b * u) / det * my;
}

}  // namespace

void planes(int height, int width, const uint16_t* d, const uint8_t* trusted, const uint8_t* wanted,
            const uint8_t* image, const uint8_t* is_static, const PlaneParams& params, uint16_t* out) {
  const Padded view(height, width, params.radius, d, image, trusted);
  const int taps = 2 * params.radius / params.stride + 1;
#pragma omp parallel for schedule(dynamic, 4)
  for (int y = 0; y < height; ++y) {
    const size_t row = static_cast<size_t>(y) * width;
    std::copy_n(d + row, width, out + row);
    for (int from = 0; from < width; from += kFitted) {
      const int to = std::min(width, from + kFitted);
      if (std::none_of(wanted + row + from, wanted + row + to, [](uint8_t w) { return w != 0; })) continue;
      float flat[kFitted] = {};  // where the colour says nothing
      for (int x = from; x < to; ++x) flat[x - from] = is_static[row + x] ? 0.0f : 1.0f;
      Sums sums{};
      const size_t at = view.at(y, from);
      for (int j = -params.radius, n = 0; j <= params.radius; j += params.stride, ++n)
        add_line(view.d.data() + at, view.colour[0].data() + at, view.colour[1].data() + at,
                 view.colour[2].data() + at, view.trusted.data() + at, flat,
                 static_cast<ptrdiff_t>(j) * view.stride, j, params, params.nearness + n * taps, sums);
      for (int x = from; x < to; ++x) {
        if (!wanted[row + x] || !(sums.w[x - from] >= params.need)) continue;
        const double moved = std::floor(plane_height(sums, x - from, params.ridge) + 0.5);
        if (std::fabs(moved) <= params.gate)
          out[row + x] = static_cast<uint16_t>(std::max(0, d[row + x] + static_cast<int>(moved)));
      }
    }
  }
}

}  // namespace seepast
