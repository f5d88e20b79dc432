// Completion of unconfirmed disparities: reference_multiview.planes.
//
// Sixteen columns from a wanted pixel on are fitted together, neighbour by neighbour, so that the sums
// vectorise.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <vector>

#include "multiview.h"
#include "planes.h"

namespace seepast {
namespace {

constexpr int kFitted = 16;  // columns at once

constexpr float kUntrusted = 1e9f;  // a disparity beyond every gate

SEEPAST_CLONES
void fill_row(const uint16_t* __restrict disparity, const uint8_t* __restrict image,
              const uint8_t* __restrict trusted, int count, float* __restrict trust, float* __restrict b,
              float* __restrict g, float* __restrict r) {
  for (int x = 0; x < count; ++x) {
    b[x] = image[3 * x];
    g[x] = image[3 * x + 1];
    r[x] = image[3 * x + 2];
  }
  for (int x = 0; x < count; ++x) {
    const float d = disparity[x];
    trust[x] = trusted[x] ? d : kUntrusted;
  }
}

// A view in separate planes of one type with an empty margin, so that no neighbour needs a test.
struct Padded {
  void fill(int height, int width, int radius, const uint16_t* disparity, const uint8_t* image,
            const uint8_t* trusted) {
    const int wide = width + 2 * radius + kFitted;
    const size_t size = static_cast<size_t>(wide) * (height + 2 * radius);
    if (size != trust.size() || wide != stride || radius != margin) {
      margin = radius;
      stride = wide;
      trust.assign(size, kUntrusted);
      for (auto& c : colour) c.assign(size, 0.0f);
    }
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y) {
      const size_t from = static_cast<size_t>(y) * width, to = at(y, 0);
      fill_row(disparity + from, image + 3 * from, trusted + from, width, trust.data() + to,
               colour[0].data() + to, colour[1].data() + to, colour[2].data() + to);
    }
  }
  size_t at(int y, int x) const { return static_cast<size_t>(y + margin) * stride + x + margin; }

  int margin = 0, stride = 0;
  std::vector<float> trust, colour[3];  // disparity of the trusted pixels; B, G, R
};

struct Sums {
  float w[kFitted], x[kFitted], y[kFitted], xx[kFitted], xy[kFitted], yy[kFitted], e[kFitted], ex[kFitted],
      ey[kFitted];
};

// The pixels that are fitted together.
struct Pixels {
  const float *trust, *b, *g, *r;
  float d[kFitted];
  float coloured[kFitted];  // 0 where the colour says nothing, else 1 / 256
  bool plain;               // it does so everywhere
};

// Adds the neighbours of one line of offsets, `j` below, to the sums.
template <bool kPlain>
inline __attribute__((always_inline)) void add_line(const Pixels& pixels, ptrdiff_t line, int j,
                                                    const PlaneParams& params, const float* nearness,
                                                    Sums& sums) {
  float w_[kFitted] = {}, x_[kFitted] = {}, xx_[kFitted] = {}, e_[kFitted] = {}, ex_[kFitted] = {};
  const float gate = static_cast<float>(params.gate);
  const float* __restrict b = pixels.b, * __restrict g = pixels.g, * __restrict r = pixels.r;
  for (int i = -params.radius, n = 0; i <= params.radius; i += params.stride, ++n) {
    const ptrdiff_t to = line + i;
    const float fi = static_cast<float>(i), near = nearness[n];
#pragma GCC unroll 1
    for (int x = 0; x < kFitted; ++x) {
      const float e = pixels.trust[to + x] - pixels.d[x];
      float weight = near;
      if (!kPlain) {
        const float step =
            std::fabs(b[to + x] - b[x]) + std::fabs(g[to + x] - g[x]) + std::fabs(r[to + x] - r[x]);
        float t = 1.0f - (step < 256.0f ? step : 256.0f) * pixels.coloured[x];
        t = t * t;
        t = t * t;
        t = t * t;
        weight = t * near;
      }
      weight = std::fabs(e) <= gate ? weight : 0.0f;
      const float we = weight * e, wi = weight * fi;
      w_[x] += weight;
      x_[x] += wi;
      xx_[x] += wi * fi;
      e_[x] += we;
      ex_[x] += we * fi;
    }
  }
  const float fj = static_cast<float>(j), fjj = static_cast<float>(j * j);
#pragma GCC unroll 1
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

// Sums over all neighbours of the pixels; `stride` of the padded planes.
SEEPAST_CLONES
void add_neighbours(const Pixels& pixels, ptrdiff_t stride, const PlaneParams& params, Sums& sums) {
  const int taps = 2 * params.radius / params.stride + 1;
  for (int j = -params.radius, n = 0; j <= params.radius; j += params.stride, ++n) {
    if (pixels.plain)
      add_line<true>(pixels, j * stride, j, params, params.nearness + n * taps, sums);
    else
      add_line<false>(pixels, j * stride, j, params, params.nearness + n * taps, sums);
  }
}

PlaneSums of_pixel(const Sums& s, int n) {
  return {s.w[n], s.x[n], s.y[n], s.xx[n], s.xy[n], s.yy[n], s.e[n], s.ex[n], s.ey[n]};
}

}  // namespace

void planes(int height, int width, const uint16_t* d, const uint8_t* trusted, const uint8_t* wanted,
            const uint8_t* image, const uint8_t* is_static, const PlaneParams& params, uint16_t* out) {
  thread_local Padded view;  // the same memory for every call of a thread
  view.fill(height, width, params.radius, d, image, trusted);
  const Padded& padded = view;
#pragma omp parallel for schedule(dynamic, 4)
  for (int y = 0; y < height; ++y) {
    const size_t row = static_cast<size_t>(y) * width;
    std::copy_n(d + row, width, out + row);
    for (int from = 0; from < width; from += kFitted) {
      from = static_cast<int>(
          std::find_if(wanted + row + from, wanted + row + width, [](uint8_t w) { return w != 0; }) - wanted -
          row);
      if (from == width) break;
      const int to = std::min(width, from + kFitted);
      const size_t at = padded.at(y, from);
      Pixels pixels{padded.trust.data() + at,
                    padded.colour[0].data() + at,
                    padded.colour[1].data() + at,
                    padded.colour[2].data() + at,
                    {},
                    {},
                    true};
      for (int x = from; x < to; ++x) {
        pixels.d[x - from] = d[row + x];
        pixels.coloured[x - from] = is_static[row + x] ? 1.0f / 256.0f : 0.0f;
        pixels.plain &= !wanted[row + x] || !is_static[row + x];
      }
      Sums sums{};
      add_neighbours(pixels, padded.stride, params, sums);
      for (int x = from; x < to; ++x) {
        if (!wanted[row + x] || !(sums.w[x - from] >= params.need)) continue;
        const double moved = std::floor(plane_height(of_pixel(sums, x - from), params.ridge) + 0.5);
        if (std::fabs(moved) <= params.gate)
          out[row + x] = static_cast<uint16_t>(std::max(0, d[row + x] + static_cast<int>(moved)));
      }
    }
  }
}

}  // namespace seepast
