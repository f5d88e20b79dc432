// Stage "refocus": the mean of the static rays' colours, the flagged guess where there are none, and the 3x3
// median.
#include "device.h"

using namespace seepast;

constexpr int kMostChannels = 4;

// Adds image [H, W, channels] at (x + dx, y + dy), bilinear, edges continued.
static __device__ void add_bilinear(const uint8_t* image, int height, int width, int channels, int x, int y,
                                    float dx, float dy, float* total) {
  const int left = floor_int(dx), top = floor_int(dy);
  const float fx = dx - static_cast<float>(left), fy = dy - static_cast<float>(top);
  const int x0 = clamp(x + left, 0, width - 1), x1 = clamp(x + left + 1, 0, width - 1);
  const uint8_t* upper_row = image + static_cast<size_t>(clamp(y + top, 0, height - 1)) * width * channels;
  const uint8_t* lower_row =
      image + static_cast<size_t>(clamp(y + top + 1, 0, height - 1)) * width * channels;
#pragma unroll
  for (int c = 0; c < kMostChannels; ++c) {
    if (c >= channels) break;
    const float a = upper_row[x0 * channels + c], b = upper_row[x1 * channels + c];
    const float e = lower_row[x0 * channels + c], f = lower_row[x1 * channels + c];
    const float upper = a + (b - a) * fx, lower = e + (f - e) * fx;
    total[c] += upper + (lower - upper) * fy;
  }
}

// Blocks of 32 x 8. colour [K, H, W, channels]; labels uint16, d, keep [H, W]. background [H, W, channels];
// coverage [H, W].
extern "C" __global__ void __launch_bounds__(256)
    refocus(const uint8_t* __restrict__ colour, const uint16_t* __restrict__ labels,
            const float* __restrict__ offsets, int height, int width, int channels, int reference, float cx,
            float cy, const float* __restrict__ d, const uint8_t* __restrict__ keep,
            uint8_t* __restrict__ background, uint8_t* __restrict__ coverage) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t pixels = static_cast<size_t>(height) * width, at = static_cast<size_t>(y) * width + x;
  const unsigned rays = labels[at];
  const int n = __popc(rays);
  coverage[at] = static_cast<uint8_t>(n);
  if (keep[at]) {
    for (int c = 0; c < channels; ++c)
      background[at * channels + c] = colour[(reference * pixels + at) * channels + c];
    return;
  }
  float total[kMostChannels] = {0, 0, 0, 0};
  for (unsigned rest = rays; rest; rest &= rest - 1) {
    const int k = __ffs(static_cast<int>(rest)) - 1;
    const RayShift shift = ray_shift(offsets + kOffsets * k, d[at]);
    add_bilinear(colour + k * pixels * channels, height, width, channels, x, y, ray_dx(shift, x, cx),
                 ray_dy(shift, y, cy), total);
  }
#pragma unroll
  for (int c = 0; c < kMostChannels; ++c)
    if (c < channels)
      background[at * channels + c] =
          static_cast<uint8_t>(floorf(total[c] / static_cast<float>(n > 1 ? n : 1) + 0.5f));
}

// How far the nearest pixel with coverage is in direction (step_x, step_y); 0 = none.
static __device__ int nearest_seen(const uint8_t* coverage, int height, int width, int x, int y, int step_x,
                                   int step_y) {
  for (int far = 1;; ++far) {
    x += step_x, y += step_y;
    if (x < 0 || x >= width || y < 0 || y >= height) return 0;
    if (coverage[static_cast<size_t>(y) * width + x]) return far;
  }
}

// In place: pixels of coverage 0 from the nearest seen ones of the four directions. Blocks of 32 x 8.
extern "C" __global__ void __launch_bounds__(256)
    fill_unseen(const uint8_t* __restrict__ coverage, const float* __restrict__ d, int height, int width,
                int channels, float nearer, float foreground_weight, uint8_t* __restrict__ background) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t at = static_cast<size_t>(y) * width + x;
  if (coverage[at]) return;
  float total[kMostChannels] = {0, 0, 0, 0}, weights = 0;
  for (int j = 0; j < 4; ++j) {  // left, right, up, down
    const int step_x = j == 0 ? -1 : j == 1, step_y = j == 2 ? -1 : j == 3;
    const int far = nearest_seen(coverage, height, width, x, y, step_x, step_y);
    if (!far) continue;
    const size_t seen = static_cast<size_t>(y + far * step_y) * width + (x + far * step_x);
    float weight = 1.0f / static_cast<float>(far * far);
    if (d[seen] > d[at] + nearer) weight *= foreground_weight;
#pragma unroll
    for (int c = 0; c < kMostChannels; ++c)
      if (c < channels) total[c] += weight * static_cast<float>(background[seen * channels + c]);
    weights += weight;
  }
  if (!(weights > 0)) return;
#pragma unroll
  for (int c = 0; c < kMostChannels; ++c)
    if (c < channels) background[at * channels + c] = static_cast<uint8_t>(floorf(total[c] / weights + 0.5f));
}

static __device__ __forceinline__ void sort_two(int& a, int& b) {
  const int low = min(a, b);
  b = max(a, b);
  a = low;
}

static __device__ __forceinline__ void sort_three(int& a, int& b, int& c) {
  sort_two(a, b);
  sort_two(b, c);
  sort_two(a, b);
}

// Columns of three are sorted; then the median of nine is that of the largest of the least, the median of the
// middle ones, and the least of the largest.
static __device__ int median9(int (&v)[9]) {
  for (int j = 0; j < 3; ++j) sort_three(v[j], v[3 + j], v[6 + j]);
  int low = max(v[0], max(v[1], v[2])), high = min(v[6], min(v[7], v[8]));
  sort_three(v[3], v[4], v[5]);
  sort_three(low, v[4], high);
  return v[4];
}

// 3x3 medians of every channel, edges continued, but where `keep`. Blocks of 32 x 8.
extern "C" __global__ void __launch_bounds__(256)
    median3(const uint8_t* __restrict__ image, const uint8_t* __restrict__ keep, int height, int width,
            int channels, uint8_t* __restrict__ out) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t at = (static_cast<size_t>(y) * width + x) * channels;
  const bool same = keep[static_cast<size_t>(y) * width + x];
  for (int c = 0; c < channels; ++c) {
    if (same) {
      out[at + c] = image[at + c];
      continue;
    }
    int v[9];
#pragma unroll
    for (int i = 0; i < 9; ++i)
      v[i] = image[(static_cast<size_t>(clamp(y + i / 3 - 1, 0, height - 1)) * width +
                    clamp(x + i % 3 - 1, 0, width - 1)) *
                       channels +
                   c];
    out[at + c] = static_cast<uint8_t>(median9(v));
  }
}
