// The two-label scanline field of the mask refinement. On a chain of two labels the whole min-sum message is
// one number, t = u + clip(t_before, -w, w), so eight directions are two sweeps over 16-bit rows.
#include <algorithm>
#include <cmath>
#include <vector>

#include "people.h"

namespace seepast {
namespace {

constexpr int kDirections = 4;  // from the left, upper left, upper, upper right; then the same backwards
constexpr int kStepX[kDirections] = {-1, -1, 0, 1};

inline int16_t clip(int16_t t, int16_t w) {
  const int16_t low = static_cast<int16_t>(-w);
  return t < low ? low : (t > w ? w : t);
}

// One row of a lattice, packed, so that neighbours are next to each other.
struct Row {
  std::vector<uint8_t> colour;
  std::vector<float> surface;
};

void load_row(const Lattice& grid, int width, int channels, int j, const uint8_t* colour,
              const float* surface, Row& row) {
  const size_t at = static_cast<size_t>(grid.image(j)) * width;
  for (int i = 0; i < grid.width; ++i) {
    const size_t x = at + grid.image(i);
    for (int c = 0; c < channels; ++c)
      row.colour[static_cast<size_t>(c) * grid.width + i] = colour[x * channels + c];
    row.surface[i] = surface[x];
  }
}

// Cost of a label change between `count` pixels from p of row a and those from q of row b. `scratch` int32.
SEEPAST_CLONES
void change_costs(const uint8_t* __restrict ca, const uint8_t* __restrict cb, int plane, int channels,
                  const float* __restrict da, const float* __restrict db, int count,
                  const int16_t* __restrict table, int last, float depth_step, int cut, bool diagonal,
                  int32_t* __restrict scratch, int16_t* __restrict w) {
  for (int i = 0; i < count; ++i) scratch[i] = 0;
  for (int c = 0; c < channels; ++c)
    for (int i = 0; i < count; ++i) {
      const int step = ca[c * plane + i] - cb[c * plane + i];
      scratch[i] += step * step;
    }
  const int scale = 3 / channels;
  for (int i = 0; i < count; ++i) {
    const int contrast = scratch[i] * scale;
    scratch[i] = contrast < last ? contrast : last;
  }
  for (int i = 0; i < count; ++i) scratch[i] = table[scratch[i]];
  for (int i = 0; i < count; ++i) {
    w[i] = static_cast<int16_t>(change_cost(scratch[i], da[i] - db[i], depth_step, cut, diagonal));
  }
}

// Messages that arrive from a neighbouring row: t_new = u + clip(t_before, w), added to the belief.
SEEPAST_CLONES
void arrive_row(const int16_t* __restrict before, const int16_t* __restrict w, const int16_t* __restrict u,
                int count, int16_t* __restrict t, int16_t* __restrict belief) {
  for (int i = 0; i < count; ++i) {
    const int16_t m = clip(before[i], w[i]);
    belief[i] = static_cast<int16_t>(belief[i] + m);
    t[i] = static_cast<int16_t>(u[i] + m);
  }
}

// One camera's field.
struct Field {
  Field(const Lattice& grid, int width, int channels, const FieldCosts& costs)
      : grid(grid), width(width), channels(channels), costs(costs), scratch(grid.width) {
    for (auto& w : cost) w.resize(grid.pixels());
    for (Row& row : rows) {
      row.colour.resize(static_cast<size_t>(channels) * grid.width);
      row.surface.resize(grid.width);
    }
    for (auto& pair : message)
      for (auto& t : pair) t.resize(grid.width + 2);
  }

  // cost[q][y, x]: between (y, x) and its neighbour before it in direction q; 0 where there is none.
  void all_costs(const uint8_t* colour, const float* surface) {
    for (int j = 0; j < grid.height; ++j) {
      Row &here = rows[j & 1], &above = rows[(j & 1) ^ 1];
      load_row(grid, width, channels, j, colour, surface, here);
      for (int q = 0; q < kDirections; ++q) {
        int16_t* w = cost[q].data() + static_cast<size_t>(j) * grid.width;
        if (q && !j) {
          std::fill_n(w, grid.width, 0);
          continue;
        }
        const Row& other = q ? above : here;
        const int first = kStepX[q] < 0 ? 1 : 0, end = grid.width - (kStepX[q] > 0);
        if (first) w[0] = 0;
        if (end < grid.width) w[grid.width - 1] = 0;
        if (end > first)
          change_costs(here.colour.data() + first, other.colour.data() + first + kStepX[q], grid.width,
                       channels, here.surface.data() + first, other.surface.data() + first + kStepX[q],
                       end - first, costs.contrast, costs.count - 1, costs.depth_step, costs.cut,
                       q == 1 || q == 3, scratch.data(), w + first);
      }
    }
  }

  void along_row(const int16_t* w, const int16_t* u, int16_t* belief) const {
    int16_t t = u[0];
    for (int x = 1; x < grid.width; ++x) {
      const int16_t m = clip(t, w[x]);
      belief[x] = static_cast<int16_t>(belief[x] + m);
      t = static_cast<int16_t>(u[x] + m);
    }
    t = u[grid.width - 1];
    for (int x = grid.width - 2; x >= 0; --x) {
      const int16_t m = clip(t, w[x + 1]);
      belief[x] = static_cast<int16_t>(belief[x] + m);
      t = static_cast<int16_t>(u[x] + m);
    }
  }

  // Messages down the rows (sign 1) or up (-1). Backwards, a pixel's cost is stored with its later neighbour.
  void across_rows(const int16_t* u, int sign, int16_t* belief) {
    const int n = grid.width, start = sign > 0 ? 0 : grid.height - 1;
    for (int step = 0; step < grid.height; ++step) {
      const int y = start + sign * step, now = step & 1;
      const size_t row = static_cast<size_t>(y) * n;
      for (int q = 1; q < kDirections; ++q) {
        int16_t* t = message[q - 1][now].data() + 1;
        if (!step) {
          std::copy_n(u + row, n, t);
          continue;
        }
        const int dx = sign * kStepX[q];  // where the message comes from
        const int16_t* before = message[q - 1][now ^ 1].data() + 1 + dx;
        const int16_t* w = cost[q].data() + (sign > 0 ? row : row + n + dx);
        const int first = sign < 0 && dx < 0 ? 1 : 0, end = n - (sign < 0 && dx > 0);
        // beyond the ends there is no neighbour, hence no cost to look up
        if (first) t[0] = u[row];
        if (end < n) t[n - 1] = u[row + n - 1];
        if (end > first)
          arrive_row(before + first, w + first, u + row + first, end - first, t + first,
                     belief + row + first);
      }
    }
  }

  void run(const int16_t* u, const uint8_t* colour, const float* surface, int16_t* belief) {
    all_costs(colour, surface);
    std::copy_n(u, grid.pixels(), belief);
    for (int y = 0; y < grid.height; ++y) {
      const size_t row = static_cast<size_t>(y) * grid.width;
      along_row(cost[0].data() + row, u + row, belief + row);
    }
    across_rows(u, 1, belief);
    across_rows(u, -1, belief);
  }

  const Lattice& grid;
  int width, channels;
  const FieldCosts& costs;
  std::vector<int16_t> cost[kDirections];
  Row rows[2];
  std::vector<int32_t> scratch;
  std::vector<int16_t> message[kDirections - 1][2];  // one pixel wider at either end
};

}  // namespace

void field(int cameras, int height, int width, int channels, const int16_t* u, const uint8_t* colour,
           const float* surfaces, const FieldCosts& costs, int stride, int16_t* belief) {
  const Lattice grid(height, width, stride);
  const size_t pixels = static_cast<size_t>(height) * width;
#pragma omp parallel
  {
    Field own(grid, width, channels, costs);
#pragma omp for schedule(dynamic, 1)
    for (int k = 0; k < cameras; ++k)
      own.run(u + k * grid.pixels(), colour + k * pixels * channels, surfaces + k * pixels,
              belief + k * grid.pixels());
  }
}

}  // namespace seepast
