// What lies between the many-view stages: levels, masks moved between views and grown (backends/host.py). One
// view per blockIdx.z, one thread per pixel that is written.
#include "device.h"

using namespace seepast;

namespace {

constexpr int kAcross = 32, kDown = 8;

__device__ size_t index(int view, int height, int width, int y, int x) {
  return (static_cast<size_t>(view) * height + y) * width + x;
}

template <class T>
__device__ void enlarge(const T* __restrict__ in, int height, int width, int ratio, int factor,
                        int out_height, int out_width, T* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= out_width || y >= out_height) return;
  const T value = in[index(view, height, width, min(y / ratio, height - 1), min(x / ratio, width - 1))];
  out[index(view, out_height, out_width, y, x)] = static_cast<T>(value * factor);
}

}  // namespace

// Grey levels by tables uint8 [V, channels, 256]: colour uint8 [V, H, W, channels] -> out.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    mapped(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ tables, int height, int width,
           int channels, uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height) return;
  const size_t at = channels * index(view, height, width, y, x);
  for (int c = 0; c < channels; ++c) out[at + c] = tables[(view * channels + c) * 256 + colour[at + c]];
}

// Pixels of `scale` x `scale` each: colour uint8 [V, H, W, 3] -> small [V, h, w, 3], rounded as OpenCV's
// INTER_AREA; is_static uint8 [V, H, W] -> [V, h, w], all of them.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    averaged(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ is_static, int height, int width,
             int scale, int small_height, int small_width, uint8_t* __restrict__ small,
             uint8_t* __restrict__ small_static) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= small_width || y >= small_height) return;
  int sum[3] = {}, all = 1;
  for (int j = 0; j < scale; ++j)
    for (int i = 0; i < scale; ++i) {
      const size_t at =
          index(view, height, width, min(scale * y + j, height - 1), min(scale * x + i, width - 1));
      for (int c = 0; c < 3; ++c) sum[c] += colour[3 * at + c];
      all &= is_static[at];
    }
  const size_t out = index(view, small_height, small_width, y, x);
  const float share = 1.0f / static_cast<float>(scale * scale);
  for (int c = 0; c < 3; ++c)  // halves go up in the mean of four, to even in others
    small[3 * out + c] = static_cast<uint8_t>(
        scale == 2 ? (sum[c] + 2) >> 2 : __float2int_rn(static_cast<float>(sum[c]) * share));
  small_static[out] = static_cast<uint8_t>(all);
}

// Every two rows: colour uint8 [V, H, W, 3] -> small [V, H / 2, W, 3], halves up; is_static uint8 [V, H, W]
// -> [V, H / 2, W], both of them.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    half_rows(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ is_static, int height,
              int width, uint8_t* __restrict__ small, uint8_t* __restrict__ small_static) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height / 2) return;
  const size_t above = index(view, height, width, 2 * y, x), below = above + width,
               out = index(view, height / 2, width, y, x);
  for (int c = 0; c < 3; ++c)
    small[3 * out + c] = static_cast<uint8_t>((colour[3 * above + c] + colour[3 * below + c] + 1) >> 1);
  small_static[out] = is_static[above] & is_static[below];
}

// Every row of [V, h, W] twice, the last one to the end: [V, H, W].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    double_rows(const uint16_t* __restrict__ in, int rows, int width, int height,
                uint16_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height) return;
  out[index(view, height, width, y, x)] = in[index(view, rows, width, min(y / 2, rows - 1), x)];
}

// Every pixel of [V, h, w] repeated ratio x ratio times, the last ones as often as it takes; times `factor`.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    enlarge_bytes(const uint8_t* __restrict__ in, int height, int width, int ratio, int factor,
                  int out_height, int out_width, uint8_t* __restrict__ out) {
  enlarge(in, height, width, ratio, factor, out_height, out_width, out);
}
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    enlarge_words(const uint16_t* __restrict__ in, int height, int width, int ratio, int factor,
                  int out_height, int out_width, uint16_t* __restrict__ out) {
  enlarge(in, height, width, ratio, factor, out_height, out_width, out);
}

// Sets in out uint8 [K, H, W], zero before, where the rays of the pixels `hidden` end at disparities from low
// to high, px: the columns and rows between both ends. offsets [K, 5]. Rounded as ArrayGeometry.warp and
// numpy.rint do.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    landings(const float* __restrict__ offsets, float cx, float cy, const uint8_t* __restrict__ hidden,
             const float* __restrict__ low, const float* __restrict__ high, int cameras, int height,
             int width, uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y;
  if (x >= width || y >= height || !hidden[y * width + x]) return;
  const float d[2] = {low[y * width + x], high[y * width + x]};
  const float from_x = static_cast<float>(x) - cx, from_y = static_cast<float>(y) - cy;
  for (int k = 0; k < cameras; ++k) {
    const float* o = offsets + kOffsets * k;
    float u[2], v[2];
    for (int i = 0; i < 2; ++i) {
      const float scale = 1.0f / (1.0f - d[i] * o[2]);
      u[i] = cx + (from_x - d[i] * o[0]) * scale + o[3];
      v[i] = cy + (from_y - d[i] * o[1]) * scale + o[4];
    }
    const int left = static_cast<int>(fmaxf(rintf(fminf(u[0], u[1])), 0.0f)),
              right = static_cast<int>(fminf(rintf(fmaxf(u[0], u[1])), static_cast<float>(width - 1))),
              top = static_cast<int>(fmaxf(rintf(fminf(v[0], v[1])), 0.0f)),
              bottom = static_cast<int>(fminf(rintf(fmaxf(v[0], v[1])), static_cast<float>(height - 1)));
    for (int row = top; row <= bottom; ++row)
      for (int column = left; column <= right; ++column) out[index(k, height, width, row, column)] = 1;
  }
}

// Sets in out uint8 [K, H, W], zero before, where rays of the pixels `hidden` end in the views that are asked
// of them (host.witnessed). disparities uint16, is_static uint8 [K, H, W]; order int32 [K]: the reference,
// then the nearest.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    witnessed(const float* __restrict__ offsets, float cx, float cy, const uint8_t* __restrict__ hidden,
              const uint16_t* __restrict__ disparities, const uint8_t* __restrict__ is_static,
              const int32_t* __restrict__ order, int most, int tolerance, int cameras, int height, int width,
              uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y;
  if (x >= width || y >= height || !hidden[y * width + x]) return;
  const int units = disparities[index(order[0], height, width, y, x)];
  const float d = static_cast<float>(units) / 32.0f;
  out[index(order[0], height, width, y, x)] = 1;
  for (int i = 1, seen = 0; i < cameras && seen < most; ++i) {
    const float* o = offsets + kOffsets * order[i];
    const float scale = 1.0f / (1.0f - d * o[2]);
    const float u = rintf(cx + (static_cast<float>(x) - cx - d * o[0]) * scale + o[3]);
    const float v = rintf(cy + (static_cast<float>(y) - cy - d * o[1]) * scale + o[4]);
    if (!(u >= 0.0f && u < static_cast<float>(width) && v >= 0.0f && v < static_cast<float>(height)))
      continue;
    const size_t at = index(order[i], height, width, static_cast<int>(v), static_cast<int>(u));
    out[at] = 1;
    const int apart = static_cast<int>(disparities[at]) - units;
    seen += is_static[at] && apart <= tolerance && -apart <= tolerance;
  }
}

// uint8 [V, H, W]: any of in[v, y + j, x + i] with |i| <= reach[j + radius], |j| <= radius, -1 for none; what
// is outside never counts. With `invert` both masks are taken inverted, which makes it the erosion. Blocks of
// 32 x 8.
//
// A warp takes rows of 32 pixels: of what such a row needs every lane grows one line, as bits. radius <= 15.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    grow_disc(const uint8_t* __restrict__ in, const int32_t* __restrict__ reach, int radius, int height,
              int width, int invert, uint8_t* __restrict__ out) {
  constexpr int kTile = 32, kMost = 15;
  __shared__ uint64_t lines[kTile + 2 * kMost];  // columns left - 16 .. left + 47
  const int left = blockIdx.x * kTile, top = blockIdx.y * kTile, lane = threadIdx.x, view = blockIdx.z;
  for (int j = threadIdx.y; j < kTile + 2 * radius; j += kDown) {
    const int y = top + j - radius;
    uint64_t bits = 0;
    for (int half = 0; half < 2; ++half) {
      const int x = left - 16 + 32 * half + lane;
      const bool inside = x >= 0 && x < width && y >= 0 && y < height;
      const bool set = inside && (in[index(view, height, width, y, x)] != 0) != (invert != 0);
      bits |= static_cast<uint64_t>(__ballot_sync(0xffffffffu, set)) << 32 * half;
    }
    if (lane == 0) lines[j] = bits;
  }
  __syncthreads();
  const int mine = lane <= 2 * radius ? reach[lane] : -1;
  for (int j = threadIdx.y; j < kTile; j += kDown) {
    uint32_t grown = 0;
    if (mine >= 0) {
      uint64_t bits = lines[j + lane] >> (16 - mine);
      int have = 1;
      for (; 2 * have <= 2 * mine + 1; have *= 2) bits |= bits >> have;
      grown = static_cast<uint32_t>(bits | bits >> (2 * mine + 1 - have));
    }
    for (int step = 16; step > 0; step /= 2) grown |= __shfl_xor_sync(0xffffffffu, grown, step);
    const int x = left + lane, y = top + j;
    if (x < width && y < height)
      out[index(view, height, width, y, x)] = static_cast<uint8_t>((grown >> lane & 1) ^ invert);
  }
}

// The same for any radius, pixel by pixel.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    grow_large_disc(const uint8_t* __restrict__ in, const int32_t* __restrict__ reach, int radius, int height,
                    int width, int invert, uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, view = blockIdx.z;
  if (x >= width || y >= height) return;
  bool found = false;
  for (int j = max(-radius, -y); j <= min(radius, height - 1 - y) && !found; ++j) {
    const int side = reach[j + radius];
    for (int i = max(-side, -x); i <= min(side, width - 1 - x) && !found; ++i)
      found = (in[index(view, height, width, y + j, x + i)] != 0) != (invert != 0);
  }
  out[index(view, height, width, y, x)] = found != (invert != 0);
}

// Number of rays of every label set: uint16 -> uint8 [count].
extern "C" __global__ void __launch_bounds__(256)
    ray_count(const uint16_t* __restrict__ labels, int count, uint8_t* __restrict__ out) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i < count) out[i] = static_cast<uint8_t>(__popc(labels[i]));
}
