// Metres from disparities.
#include <algorithm>

#include "core.h"

namespace seepast {
namespace {

constexpr size_t kPart = 1 << 14;  // pixels that a thread takes at once

SEEPAST_CLONES
void depth_of(const float* __restrict d, int count, float focal_baseline, float* __restrict out) {
  for (int x = 0; x < count; ++x) {
    const float z = focal_baseline / (d[x] > 0.0f ? d[x] : 1.0f);
    out[x] = d[x] > 0.0f ? z : 0.0f;
  }
}

}  // namespace

void depth(const float* d, size_t count, float focal_baseline, float* out) {
  const int parts = static_cast<int>((count + kPart - 1) / kPart);
#pragma omp parallel for schedule(static)
  for (int i = 0; i < parts; ++i) {
    const size_t from = i * kPart;
    depth_of(d + from, static_cast<int>(std::min(kPart, count - from)), focal_baseline, out + from);
  }
}

}  // namespace seepast
