// Keys' cubic (A = -1/2), shared by C++ and CUDA (many.py cubic_weights).
#pragma once

#include "pixel.h"

namespace seepast {

// Weights of the pixels at -1, 0, 1, 2 for the place t in [0, 1).
#ifndef __CUDACC__
[[gnu::always_inline]]  // or loops of an instruction set would call one of another
#endif
SEEPAST_HD void cubic_weights(float t, float* w) {
  const float near = 1.0f - t, far = 2.0f - t, beyond = 1.0f + t;
  w[0] = ((-0.5f * beyond + 2.5f) * beyond - 4.0f) * beyond + 2.0f;
  w[1] = (1.5f * t - 2.5f) * t * t + 1.0f;
  w[2] = (1.5f * near - 2.5f) * near * near + 1.0f;
  w[3] = ((-0.5f * far + 2.5f) * far - 4.0f) * far + 2.0f;
}

}  // namespace seepast
