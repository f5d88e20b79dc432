// First include of every .cu file here: what NVRTC, nvcc and the emulation of the tests (tests/cuda_on_cpu)
// share.
#pragma once

#include "pixel.h"

// Shared memory whose size the launch says (shared=bytes): SEEPAST_SHARED(uint16_t, name);
#ifdef __CUDACC__
#define SEEPAST_SHARED(type, name)                          \
  extern __shared__ __align__(16) unsigned char g_shared[]; \
  type* const name = reinterpret_cast<type*>(g_shared)
#else
#define SEEPAST_SHARED(type, name) type* const name = reinterpret_cast<type*>(emulated::shared())
#endif
