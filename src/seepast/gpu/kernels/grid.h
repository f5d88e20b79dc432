// Candidate disparities, as candidates.py DisparityGrid has them.
#pragma once

namespace seepast {

// d_i = (first + i * step) / 8 px, i < count.
struct Grid {
  int first, step, count;

  __device__ inline int eighths(int i) const { return first + i * step; }
  __device__ inline float value(int i) const {
    return (static_cast<float>(first) + static_cast<float>(step) * static_cast<float>(i)) / 8.0f;
  }
};

}  // namespace seepast
