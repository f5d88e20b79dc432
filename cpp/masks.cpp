// Stage "masks": labels of (reference pixel, camera) pairs carried into each camera's own pixels, nearest
// first.
#include <vector>

#include "core.h"

namespace seepast {

void masks(const Array& array, const uint16_t* labels, const uint8_t* posterior, const float* d,
           const uint8_t* wanted, uint8_t* dynamic, uint8_t* is_static) {
  const size_t pixels = array.pixels();
#pragma omp parallel for schedule(dynamic, 1)
  for (int k = 0; k < array.cameras; ++k) {
    std::vector<float> nearest(pixels, -1.0f);
    const std::vector<uint8_t> prior(dynamic + k * pixels, dynamic + (k + 1) * pixels);
    for (int y = 0; y < array.height; ++y)
      for (int x = 0; x < array.width; ++x) {
        const size_t from = static_cast<size_t>(y) * array.width + x;
        if (!wanted[from]) continue;
        const RayShift shift = array.shift(k, d[from]);
        const int px = x + whole_offset(ray_dx(shift, x, array.cx)),
                  py = y + whole_offset(ray_dy(shift, y, array.cy));
        if (px < 0 || px >= array.width || py < 0 || py >= array.height) continue;
        const size_t to = static_cast<size_t>(py) * array.width + px;
        if (prior[to] == kNoRay || d[from] <= nearest[to]) continue;
        nearest[to] = d[from];
        is_static[k * pixels + to] = labels[from] >> k & 1;
        const uint8_t value = posterior[k * pixels + from];
        dynamic[k * pixels + to] = value == kUnchanged ? prior[to] : value;
      }
  }
}

}  // namespace seepast
