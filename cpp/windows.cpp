// Stage "candidates" of the many-view method: where a coarser level says to look.
#include <algorithm>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

// Quotient rounded down; C++ rounds towards zero.
inline int floor_div(int a, int b) { return a / b - (a % b != 0 && (a % b < 0) != (b < 0)); }

// The chunks within reach of each pixel of a coarse row.
void row_bits(const uint16_t* d, int width, int ratio, const Grid& grid, int reach, uint64_t* bits) {
  const int origin = kUnits / 8 * grid.first, spacing = kUnits / 8 * grid.step;
  const auto chunk = [&](int candidate) { return std::clamp(candidate, 0, grid.count - 1) / kChunk; };
  for (int x = 0; x < width; ++x) {
    const int centre = d[x] * ratio - origin;
    const int low = chunk(floor_div(centre - reach, spacing)),
              high = chunk(-floor_div(-(centre + reach), spacing));
    bits[x] = (~uint64_t{0} >> (63 - (high - low))) << low;
  }
}

}  // namespace

void windows(const uint16_t* disparity, const uint8_t* where, int rows, int columns, int ratio,
             const Grid& grid, int reach, int spread, int height, int width, uint64_t* active) {
  std::vector<uint64_t> bits(static_cast<size_t>(rows) * columns);
#pragma omp parallel for schedule(static)
  for (int y = 0; y < rows; ++y) {
    const size_t row = static_cast<size_t>(y) * columns;
    row_bits(disparity + row, columns, ratio, grid, reach, bits.data() + row);
  }
#pragma omp parallel
  {
    std::vector<uint64_t> column(columns), around(columns);
#pragma omp for schedule(static)
    for (int y = 0; y < rows; ++y) {
      std::fill(column.begin(), column.end(), 0);
      for (int j = std::max(0, y - spread); j <= std::min(rows - 1, y + spread); ++j)
        for (int x = 0; x < columns; ++x) column[x] |= bits[static_cast<size_t>(j) * columns + x];
      around = column;
      for (int i = 1; i <= std::min(spread, columns - 1); ++i) {
        for (int x = i; x < columns; ++x) around[x] |= column[x - i];
        for (int x = 0; x < columns - i; ++x) around[x] |= column[x + i];
      }
      for (int x = 0; x < columns; ++x)
        if (!where[static_cast<size_t>(y) * columns + x]) around[x] = 0;
      const int first = y * ratio, last = y + 1 < rows ? std::min(height, first + ratio) : height;
      for (int fine = first; fine < last; ++fine)
        for (int x = 0; x < width; ++x)
          active[static_cast<size_t>(fine) * width + x] = around[std::min(x / ratio, columns - 1)];
    }
  }
}

}  // namespace seepast
