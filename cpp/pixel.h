// The per-pixel maths of every stage: the one place where C++ and CUDA agree with backends/reference.py.
// Nothing here may use the host's library or allocate; names and symbols are those of the reference.
#pragma once

#include <cstdint>

#ifdef __CUDACC__
#define SEEPAST_HD __host__ __device__ inline
#else
#define SEEPAST_HD inline
#endif

namespace seepast {

constexpr int kMaxCameras = 16;
constexpr int kSamples = 16;  // of one descriptor: 12 horizontal, 4 vertical gradients
constexpr int kHorizontal = 12;
constexpr int kSampleKnown = 1 << 24;  // variance below, number of known samples above
constexpr uint8_t kNoRay = 255;        // in `dynamic`: this view has no source pixel here
constexpr uint8_t kUnchanged = 255;    // in a posterior: the label is the one its prior suggested

// Where around the pixel the descriptor samples the Sobel responses (reference.py PATTERN_DU, PATTERN_DV).
constexpr int8_t kPatternY[kSamples] = {-2, -1, -1, -1, 0, 0, 0, 0, 1, 1, 1, 2, -1, 0, 0, 1};
constexpr int8_t kPatternX[kSamples] = {0, -2, 0, 2, -1, 0, 0, 1, -2, 0, 2, 0, 0, -1, 1, 0};

SEEPAST_HD int floor_int(float v) {
#ifdef __CUDA_ARCH__
  return __float2int_rd(v);  // the same in one instruction
#else
  const int i = static_cast<int>(v);
  return i - (static_cast<float>(i) > v);
#endif
}

SEEPAST_HD int clamp(int v, int low, int high) { return v < low ? low : (v > high ? high : v); }

// One camera's share of the warp W_k, at a fixed disparity: W_k(x, d) - x = (x - c) * zoom - parallax + view.
struct RayShift {
  float zoom, x, y, view_x, view_y;
};

constexpr int kOffsets = 5;  // of a camera: ax, ay, az, sx, sy

SEEPAST_HD RayShift ray_shift(const float* offset, float d) {
  const float s = 1.0f / (1.0f - d * offset[2]);
  return {s - 1.0f, d * offset[0] * s, d * offset[1] * s, offset[3], offset[4]};
}

SEEPAST_HD float ray_dx(const RayShift& r, int x, float cx) {
  return (static_cast<float>(x) - cx) * r.zoom - r.x + r.view_x;
}
SEEPAST_HD float ray_dy(const RayShift& r, int y, float cy) {
  return (static_cast<float>(y) - cy) * r.zoom - r.y + r.view_y;
}

// Matching of preset `paper` looks at quarter pixels in x, of the many-view method at half pixels ...
SEEPAST_HD int quarter_offset(float dx) { return floor_int(4.0f * dx + 0.5f); }
SEEPAST_HD int half_offset(float dx) { return floor_int(2.0f * dx + 0.5f); }
// ... and at whole rows in y.
SEEPAST_HD int whole_offset(float dy) { return floor_int(dy + 0.5f); }

// Both pixels that the quarter position interpolates between lie in the image.
SEEPAST_HD bool inside(int xq, int row, int width, int height) {
  return xq >= 0 && (xq >> 2) + ((xq & 3) > 0) < width && row >= 0 && row < height;
}

SEEPAST_HD int interpolate(int left, int right, int phase) {
  return (left * (4 - phase) + right * phase + 2) >> 2;
}

// (n sum f^2 - (sum f)^2) / n^2 in whole grey levels^2, tagged as known; 0 where fewer than two rays speak.
SEEPAST_HD int packed_variance(int n, int sum, int squares) {
  const float inverse = 1.0f / static_cast<float>(n > 1 ? n : 1);
  const int variance = static_cast<int>(static_cast<float>(n * squares - sum * sum) * (inverse * inverse));
  return n >= 2 ? variance + kSampleKnown : 0;
}

// Sum over the pattern -> variance of the whole descriptor, missing samples scaled up.
SEEPAST_HD float descriptor_variance(int packed) {
  const int count = packed >> 24;
  return static_cast<float>(packed & (kSampleKnown - 1)) *
         (static_cast<float>(kSamples) / static_cast<float>(count > 1 ? count : 1));
}

}  // namespace seepast
