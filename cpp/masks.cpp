// Stage "masks": labels of (reference pixel, camera) pairs carried into each camera's own pixels, nearest
// first.
#include <vector>

#include "core.h"

namespace seepast {

namespace {

// Offsets in the camera's image of the pixels that the rays of a reference row end on; -1 outside.
SEEPAST_CLONES
void land_row(const Array& array, int k, int y, const float* __restrict d, int32_t* __restrict to) {
  const int width = array.width, height = array.height;
  const float cx = array.cx, cy = array.cy;
  const float* offset = array.offsets + kOffsets * k;
  const float o[kOffsets] = {offset[0], offset[1], offset[2], offset[3], offset[4]};
  for (int x = 0; x < width; ++x) {
    const RayShift shift = ray_shift(o, d[x]);
    const int px = x + whole_offset(ray_dx(shift, x, cx)), py = y + whole_offset(ray_dy(shift, y, cy));
    const bool in = (px >= 0) & (px < width) & (py >= 0) & (py < height);
    to[x] = in ? py * width + px : -1;
  }
}

}  // namespace

void masks(const Array& array, const uint16_t* labels, const uint8_t* posterior, const float* d,
           const uint8_t* wanted, uint8_t* dynamic, uint8_t* is_static) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 1)
  for (int k = 0; k < array.cameras; ++k) {
    std::vector<float> nearest(pixels, -1.0f);
    std::vector<int32_t> land(array.width);
    const std::vector<uint8_t> prior(dynamic + k * pixels, dynamic + (k + 1) * pixels);
    for (int y = 0; y < array.height; ++y) {
      const size_t row = static_cast<size_t>(y) * array.width;
      land_row(array, k, y, d + row, land.data());
      for (int x = 0; x < array.width; ++x) {
        const size_t from = row + x;
        if (!wanted[from] || land[x] < 0) continue;
        const size_t to = static_cast<size_t>(land[x]);
        if (prior[to] == kNoRay || d[from] <= nearest[to]) continue;
        nearest[to] = d[from];
        is_static[k * pixels + to] = labels[from] >> k & 1;
        const uint8_t value = posterior[k * pixels + from];
        dynamic[k * pixels + to] = value == kUnchanged ? prior[to] : value;
      }
    }
  }
}

}  // namespace seepast
