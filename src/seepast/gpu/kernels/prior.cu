// Stage "prior": the planes of the triangulation, and the candidates that every cell's support points
// suggest.
#include "device.h"
#include "grid.h"

using namespace seepast;

constexpr int kAcross = 8, kDown = 4;  // pixels that a warp looks at together
constexpr int kTriangles = 4;          // of a block
constexpr int kBand = 64;              // rows of a block, lest one warp be busy with a large triangle alone
constexpr unsigned long long kUncovered = ~0ull;
constexpr int kCellRows = 16, kCellColumns = 32;  // candidates.py CELL

// A triangle; its corners lie at whole pixels, so that areas are whole numbers.
struct Corners {
  int x[3], y[3];
  float d[3];
  int area;

  __device__ Corners(const float* points, const int32_t* corners) {
    for (int j = 0; j < 3; ++j) {
      const float* p = points + 3 * static_cast<size_t>(corners[j]);
      x[j] = static_cast<int>(p[0]), y[j] = static_cast<int>(p[1]), d[j] = p[2];
    }
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
  }
  __device__ bool covers(int px, int py) const {
    const int e0 = (x[1] - x[0]) * (py - y[0]) - (y[1] - y[0]) * (px - x[0]);
    const int e1 = (x[2] - x[1]) * (py - y[1]) - (y[2] - y[1]) * (px - x[1]);
    const int e2 = (x[0] - x[2]) * (py - y[2]) - (y[0] - y[2]) * (px - x[2]);
    return area > 0 ? (e0 >= 0 && e1 >= 0 && e2 >= 0) : (e0 <= 0 && e1 <= 0 && e2 <= 0);
  }
  __device__ float nearest(int px, int py) const {
    int r[3];
    for (int j = 0; j < 3; ++j) r[j] = (px - x[j]) * (px - x[j]) + (py - y[j]) * (py - y[j]);
    const bool second = r[1] < r[0];
    return r[2] < (second ? r[1] : r[0]) ? d[2] : (second ? d[1] : d[0]);
  }
};

// Its disparities, as in cpp/prior.cpp in double precision.
struct Plane {
  double d0, slope_x, slope_y;
  bool bridges_edge;

  __device__ Plane(const Corners& c, double max_step) : d0(c.d[0]) {
    const double d1 = c.d[1], d2 = c.d[2];
    slope_x = ((d1 - d0) * (c.y[2] - c.y[0]) - (d2 - d0) * (c.y[1] - c.y[0])) / c.area;
    slope_y = ((d2 - d0) * (c.x[1] - c.x[0]) - (d1 - d0) * (c.x[2] - c.x[0])) / c.area;
    const double high = d0 > d1 ? d0 : d1, low = d0 < d1 ? d0 : d1;
    bridges_edge = (high > d2 ? high : d2) - (low < d2 ? low : d2) > max_step;
  }
  __device__ double at(const Corners& c, int px, int py) const {
    return bridges_edge ? c.nearest(px, py) : d0 + slope_x * (px - c.x[0]) + slope_y * (py - c.y[0]);
  }
};

// owners uint64 [H, W], all ones before: of the first triangle (points float [N, 3], triangles int32 [T, 3])
// that covers a pixel its number, and below it the plane's disparity there in eighths of a pixel. Blocks of 8
// x 4 x 4: a warp per triangle, in the rows of band blockIdx.y.
extern "C" __global__ void __launch_bounds__(kAcross * kDown * kTriangles)
    plane_means(const float* __restrict__ points, const int32_t* __restrict__ triangles, int count, int width,
                double max_step, unsigned long long* __restrict__ owners) {
  const int t = blockIdx.x * kTriangles + threadIdx.z, band = blockIdx.y * kBand;
  if (t >= count) return;
  const Corners corners(points, triangles + 3 * static_cast<size_t>(t));
  const int top = max(band, min(corners.y[0], min(corners.y[1], corners.y[2])));
  const int bottom = min(band + kBand - 1, max(corners.y[0], max(corners.y[1], corners.y[2])));
  if (top > bottom || corners.area == 0) return;
  const int left = min(corners.x[0], min(corners.x[1], corners.x[2]));
  const int right = max(corners.x[0], max(corners.x[1], corners.x[2]));
  const Plane plane(corners, max_step);
  for (int y = top + static_cast<int>(threadIdx.y); y <= bottom; y += kDown)
    for (int x = left + static_cast<int>(threadIdx.x); x <= right; x += kAcross) {
      if (!corners.covers(x, y)) continue;
      const int mean = static_cast<int>(floor(8.0 * plane.at(corners, x, y) + 0.5));
      atomicMin(owners + static_cast<size_t>(y) * width + x,
                static_cast<unsigned long long>(t) << 32 | static_cast<uint32_t>(mean));
    }
}

// Pixels that no triangle covers take the nearest covered one of their row, the left one of two; `gap` where
// it has none. Blocks of 32 x 8.
extern "C" __global__ void __launch_bounds__(256)
    fill_rows(const unsigned long long* __restrict__ owners, int height, int width, int gap,
              int32_t* __restrict__ mean) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const unsigned long long* row = owners + static_cast<size_t>(y) * width;
  unsigned long long found = row[x];
  for (int far = 1; found == kUncovered && (far <= x || x + far < width); ++far) {
    if (far <= x) found = row[x - far];
    if (found == kUncovered && x + far < width) found = row[x + far];
  }
  mean[static_cast<size_t>(y) * width + x] = found == kUncovered ? gap : static_cast<int32_t>(found);
}

// The same along columns for the rows without any, the upper of two; then within low .. high. Blocks of 32
// x 8.
extern "C" __global__ void __launch_bounds__(256)
    fill_columns(const int32_t* __restrict__ rows, int height, int width, int gap, int low, int high,
                 int32_t* __restrict__ mean) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  int found = rows[static_cast<size_t>(y) * width + x];
  for (int far = 1; found == gap && (far <= y || y + far < height); ++far) {
    if (far <= y) found = rows[static_cast<size_t>(y - far) * width + x];
    if (found == gap && y + far < height) found = rows[static_cast<size_t>(y + far) * width + x];
  }
  mean[static_cast<size_t>(y) * width + x] = clamp(found, low, high);
}

// cells uint8 [rows, columns, count], zero before: 1 for candidates (first + i * step) / 8 within `radius` of
// a support point of the 3x3 cells around. points [N, 3]. Nine threads per point, blocks of 256.
extern "C" __global__ void __launch_bounds__(256)
    cell_candidates(const float* __restrict__ points, int count_of_points, int rows, int columns, int first,
                    int step, int count, float radius, uint8_t* __restrict__ cells) {
  const int t = blockIdx.x * 256 + threadIdx.x;
  if (t >= 9 * count_of_points) return;
  const float* p = points + 3 * static_cast<size_t>(t / 9);
  const int row = static_cast<int>(p[1]) / kCellRows + t % 9 / 3 - 1;
  const int column = static_cast<int>(p[0]) / kCellColumns + t % 3 - 1;
  if (row < 0 || row >= rows || column < 0 || column >= columns) return;
  const Grid grid{first, step, count};
  const float d = p[2];
  const int nearest = floor_int((8.0f * d - static_cast<float>(first)) / static_cast<float>(step));
  const int around = static_cast<int>(8.0f * radius / static_cast<float>(step)) + 2;
  uint8_t* cell = cells + (static_cast<size_t>(row) * columns + column) * count;
  for (int i = max(0, nearest - around); i < min(count, nearest + around + 1); ++i) {
    if (fabsf(grid.value(i) - d) <= radius) cell[i] = 1;
  }
}
