// The per-pixel maths of the mask refinement, shared by C++ and CUDA (backends/reference_people.py specifies
// it).
#pragma once

#include "pixel.h"

namespace seepast {

constexpr uint8_t kNoSay = 255;
constexpr uint16_t kUnknown = 65535;
constexpr int kPooled = 64, kShare = 4096, kLevels = 16, kColours = 4096, kNats = 256, kMoments = 14;
constexpr float kMaxPotential = 30.0f;

// Every stride-th pixel of both axes, from stride / 2 on.
struct Lattice {
  int stride, height, width;  // of the lattice
  SEEPAST_HD Lattice(int image_height, int image_width, int stride)
      : stride(stride), height(count(image_height, stride)), width(count(image_width, stride)) {}
  SEEPAST_HD static int count(int n, int stride) {
    return n > stride / 2 ? (n - stride / 2 + stride - 1) / stride : 0;
  }
  SEEPAST_HD size_t pixels() const { return static_cast<size_t>(height) * width; }
  SEEPAST_HD int image(int i) const { return i * stride + stride / 2; }
};

// Disparity in a camera of these offsets of a surface that the view has at d.
SEEPAST_HD float seen_disparity(const float* offset, float d) { return d * (1.0f / (1.0f - d * offset[2])); }

SEEPAST_HD float between(float v, float low, float high) {
  const float raised = v < low ? low : v;
  return high < raised ? high : raised;
}

// The objects' grid; axes disparity, y, x.
struct Cells {
  float low[3], inverse[3], last[3];
  int count[3];

  SEEPAST_HD size_t index(int d, int y, int x) const {
    return (static_cast<size_t>(d) * count[1] + y) * count[2] + x;
  }
};

struct GridPosition {
  float at[3];  // in cells
};

// Of pixel (x, y) of a view; `offset` of the reference camera from there.
SEEPAST_HD GridPosition grid_position(const float* offset, float cx, float cy, const Cells& cells, int x,
                                      int y, float d) {
  const RayShift shift = ray_shift(offset, d);
  const float v[3] = {seen_disparity(offset, d), static_cast<float>(y) + ray_dy(shift, y, cy),
                      static_cast<float>(x) + ray_dx(shift, x, cx)};
  GridPosition g;
  for (int i = 0; i < 3; ++i)
    g.at[i] = between((v[i] - cells.low[i]) * cells.inverse[i] + 0.5f, 0.0f, cells.last[i]);
  return g;
}

SEEPAST_HD float lerp(float a, float b, float t) { return a + (b - a) * t; }

SEEPAST_HD float trilinear(const float* plane, const Cells& cells, const int* i, const float* f) {
  float layer[2];
  for (int a = 0; a < 2; ++a) {
    const float* p = plane + cells.index(i[0] + a, i[1], i[2]);
    const float* q = p + cells.count[2];
    layer[a] = lerp(lerp(p[0], p[1], f[2]), lerp(q[0], q[1], f[2]), f[1]);
  }
  return lerp(layer[0], layer[1], f[0]);
}

// P of the objects at a grid position, kShare ths: the slice of the sums of P over that of their counts.
SEEPAST_HD uint16_t object_share(const float* sums, const float* counts, const Cells& cells,
                                 const GridPosition& g) {
  int whole[3];
  float part[3];
  for (int a = 0; a < 3; ++a) {
    whole[a] = floor_int(g.at[a]);
    part[a] = g.at[a] - static_cast<float>(whole[a]);
  }
  const float count = trilinear(counts, cells, whole, part);
  const float of = between(trilinear(sums, cells, whole, part) / (count < 1e-6f ? 1e-6f : count), 0.0f, 1.0f);
  return static_cast<uint16_t>(floor_int(of * static_cast<float>(kShare) + 0.5f));
}

SEEPAST_HD void bgr(const uint8_t* pixel, int channels, int* c) {
  for (int i = 0; i < 3; ++i) c[i] = pixel[channels == 3 ? i : 0];
}

SEEPAST_HD int colour_bin(const int* c) { return (c[0] >> 4) << 8 | (c[1] >> 4) << 4 | c[2] >> 4; }

// The label as a linear function of the colour.
SEEPAST_HD float local_of(const float* linear, const int* c) {
  return linear[0] * static_cast<float>(c[0]) + linear[1] * static_cast<float>(c[1]) +
         linear[2] * static_cast<float>(c[2]) + linear[3];
}

// Whether a disparity changes by more than `least` from above to here and from here to below, the same way.
SEEPAST_HD bool slopes(float above, float here, float below, float least) {
  const float before = here - above, after = below - here;
  return (before > least && after > least) || (before < -least && after < -least);
}

// Sum of the steps of the three channels.
SEEPAST_HD int colour_step(const uint8_t* a, const uint8_t* b) {
  int sum = 0;
  for (int i = 0; i < 3; ++i) sum += a[i] < b[i] ? b[i] - a[i] : a[i] - b[i];
  return sum;
}

// Log-odds of its terms, kNats ths of a nat.
SEEPAST_HD int16_t potential_of(float sure, float said, float local, float colour, float unlike,
                                float said_weight, float local_weight) {
  const float label = between(local - 0.5f, -0.5f, 0.5f) * local_weight;
  const float sum = sure + said * said_weight + label + colour + unlike;
  const float cut = between(sum, -kMaxPotential, kMaxPotential);
  return static_cast<int16_t>(floor_int(cut * static_cast<float>(kNats) + 0.5f));
}

// The cost of a label change between pixels whose surfaces are `step` px apart, of that which their contrast
// asks for.
SEEPAST_HD int change_cost(int contrast_cost, float step, float depth_step, int cut, bool diagonal) {
  const float apart = step < 0.0f ? -step : step;
  const int here = apart > depth_step ? (contrast_cost * cut) >> 8 : contrast_cost;
  return diagonal ? (here * 181) >> 8 : here;  // 181 / 256: 1 / sqrt 2 for the longer step
}

}  // namespace seepast
