// The instruction sets that the hot loops are compiled for, and which of them this machine is given.
#pragma once

// Functions marked SEEPAST_CLONES are compiled for several levels of x86-64 and chosen when the library is
// loaded. Tests build the library for one level: -march=x86-64[-v3|-v4] -DSEEPAST_LEVEL=1|3|4.
#if defined(SEEPAST_LEVEL)
#define SEEPAST_CLONES
#if SEEPAST_LEVEL == 4
#define SEEPAST_V4
#elif SEEPAST_LEVEL == 3
#define SEEPAST_V3
#endif
#elif defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define SEEPAST_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#define SEEPAST_V4
#define SEEPAST_V3
#define SEEPAST_V4_BYTES
#else
#define SEEPAST_CLONES
#endif

namespace seepast {

enum class Simd {
  baseline,
  avx2,
  avx512,
  avx512_bytes
};  // the last also counts bits in, and permutes, bytes

inline Simd simd() {
#if defined(SEEPAST_LEVEL)
  return SEEPAST_LEVEL == 4 ? Simd::avx512 : SEEPAST_LEVEL == 3 ? Simd::avx2 : Simd::baseline;
#elif defined(SEEPAST_V4)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v4")) {
    const bool bytes = __builtin_cpu_supports("avx512bitalg") && __builtin_cpu_supports("avx512vbmi");
    return bytes ? Simd::avx512_bytes : Simd::avx512;
  }
  return __builtin_cpu_supports("x86-64-v3") ? Simd::avx2 : Simd::baseline;
#else
  return Simd::baseline;
#endif
}

inline const char* simd_name() {
#if defined(__aarch64__)
  return "NEON";
#else
  return simd() >= Simd::avx512 ? "AVX-512" : simd() == Simd::avx2 ? "AVX2" : "baseline";
#endif
}

}  // namespace seepast
