// Stage "volume" of the many-view method: what every pixel's candidates cost, by the pairs of rays that see
// them.
//
// A thread has a pixel and does one of its chunks at a time; neighbouring threads have neighbouring pixels,
// mostly at the same chunk, so that a warp reads a run of a camera's samples. Costs of pairs go one by one
// into a short sorted list, which is all that the mean of the smaller half needs; rays are not kept.
#include "device.h"
#include "matching.h"

using namespace seepast;

constexpr int kColumns = 32, kRows = 8;  // of a tile: one thread per pixel
constexpr int kThreads = kColumns * kRows;

// W_k at one candidate, and the camera's own shift: pixel.h RayShift in two reads.
struct __align__(16) Shift {
  float zoom, x, y, view_x, view_y, unused[3];
};

// offsets float [n, K, 5]; shifts [n, count, K]: of every view, candidate and camera.
extern "C" __global__ void __launch_bounds__(kThreads)
    volume_shifts(const float* __restrict__ offsets, int first, int step, int count, int cameras, int views,
                  float* __restrict__ shifts) {
  const int i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= views * count * cameras) return;
  const int k = i % cameras, candidate = i / cameras % count, view = i / cameras / count;
  const float d =
      (static_cast<float>(first) + static_cast<float>(step) * static_cast<float>(candidate)) / 8.0f;
  const float* offset = offsets + (view * cameras + k) * kOffsets;
  RayShift shift = ray_shift(offset, d);
  const bool finite = shift.zoom > -1e30f && shift.zoom < 1e30f;
  if (!finite) shift = {0, 0, 0, -1e30f, -1e30f};  // the point lies beside the camera: no pixel sees it
  reinterpret_cast<float4*>(shifts)[2 * i] = make_float4(shift.zoom, shift.x, shift.y, shift.view_x);
  reinterpret_cast<float4*>(shifts)[2 * i + 1] = make_float4(shift.view_y, 0, 0, 0);
}

// What matching needs of all cameras; one view's geometry.
struct Cameras {
  const uint2* samples;   // [K, 4, H, W]
  const uint32_t* valid;  // [K, 2, H, W]
  const Shift* shifts;    // [count, K] of the view
  const uint8_t* census_scale;
  int count, height, width;
  float cx, cy;
  unsigned few, colour_cap;
};

struct Ray {
  uint2 sample;
  int valid;  // index
};

__device__ inline Ray no_ray() { return {make_uint2(0, 0), 0}; }

// Camera k's sample at x^k.
__device__ inline Ray ray_at(const Cameras& c, int candidate, int k, int x, int y) {
  const Shift* shift = c.shifts + candidate * c.count + k;
  const float4 s = *reinterpret_cast<const float4*>(shift);
  const RayShift r{s.x, s.y, s.z, s.w, shift->view_y};
  const int quarter = 4 * x + __float2int_rd(4.0f * ray_dx(r, x, c.cx) + 0.5f);
  const int row = y + __float2int_rd(ray_dy(r, y, c.cy) + 0.5f);
  const int column = quarter >> 2, phase = quarter & 3;
  if (static_cast<unsigned>(column) >= static_cast<unsigned>(c.width) ||
      static_cast<unsigned>(row) >= static_cast<unsigned>(c.height))
    return no_ray();
  return {c.samples[static_cast<unsigned>(((4 * k + phase) * c.height + row) * c.width + column)],
          ((2 * k + (phase > 0)) * c.height + row) * c.width + column};
}

// 96 hamming / n + min(mean colour step, cap); kNoPair unless both are static.
__device__ inline unsigned pair_cost(const Cameras& c, const Ray& a, const Ray& b) {
  const unsigned both = a.sample.y & b.sample.y;
  if (!(both & kStatic)) return kNoPair;
  unsigned differing = a.sample.x ^ b.sample.x, census;
  if (both & kClear) {
    census = 4 * __popc(differing);
  } else {
    const unsigned known = c.valid[a.valid] & c.valid[b.valid];
    const unsigned scale = c.census_scale[__popc(known)];
    census = scale ? (__popc(differing & known) * scale + 4) >> 3 : c.few;
  }
  const unsigned apart = __vabsdiffu4(a.sample.y, b.sample.y);
  const unsigned blue = apart & 255, green = apart >> 8 & 255, red = apart >> 16 & 255;
  const unsigned step = (((blue + red + 1) >> 1) + green + 1) >> 1;
  return census + min(step, c.colour_cap);
}

// The smallest kSlots of the costs so far, in order.
template <int kSlots>
struct SmallerHalf {
  unsigned least[kSlots], known;

  __device__ void clear() {
    known = 0;
#pragma unroll
    for (int q = 0; q < kSlots; ++q) least[q] = kNoPair;
  }
  __device__ void add(unsigned cost) {
    known += cost != kNoPair;
#pragma unroll
    for (int q = 0; q < kSlots; ++q) {
      const unsigned low = min(least[q], cost);
      cost = max(least[q], cost);
      least[q] = low;
    }
  }
  // Their mean, rounded to the nearest; kNoPair if there is none. Division by products of 16 bits: exact up
  // to 14 costs of a byte.
  __device__ unsigned mean() const {
    const unsigned half = (known + 1) >> 1;
    unsigned sum = (half >> 1) + least[0], share = 65536;
#pragma unroll
    for (int q = 1; q < kSlots; ++q)
      if (q < half) sum += least[q], share = 65535 / (q + 1) + 1;
    return half ? sum * share >> 16 : kNoPair;
  }
};

// What one candidate costs a pixel that the view sees itself: its own ray with every other.
template <int kOthers, int kSlots>
__device__ inline unsigned own_cost(const Cameras& c, int view, const Ray& own, int candidate, int x, int y) {
  SmallerHalf<kSlots> costs;
  costs.clear();
#pragma unroll(kOthers <= 5 ? kOthers : 4)
  for (int i = 0; i < kOthers; ++i)
    if (i < c.count - 1) costs.add(pair_cost(c, own, ray_at(c, candidate, i < view ? i : i + 1, x, y)));
  return costs.mean();
}

// And one that it does not: all others' rays, each with the kWindow cameras before it (many.py camera_pairs).
template <int kSlots, int kWindow>
__device__ inline unsigned others_cost(const Cameras& c, int view, int candidate, int x, int y, bool& any) {
  SmallerHalf<kSlots> costs;
  costs.clear();
  Ray before[kWindow];
#pragma unroll
  for (int w = 0; w < kWindow; ++w) before[w] = no_ray();
  any = false;
#pragma unroll 1
  for (int k = 0; k < c.count; ++k) {
    const Ray ray = k == view ? no_ray() : ray_at(c, candidate, k, x, y);
    any = any || ray.sample.y & kStatic;
#pragma unroll
    for (int w = 0; w < kWindow; ++w) costs.add(pair_cost(c, ray, before[w]));
#pragma unroll
    for (int w = kWindow - 1; w > 0; --w) before[w] = before[w - 1];
    before[0] = ray;
  }
  return costs.mean();
}

template <int kOthers, int kOwnSlots, int kSlots, int kWindow>
__device__ inline void match(const Cameras& c, const uint64_t* __restrict__ addresses, int view, int slices,
                             unsigned lone, unsigned unseen) {
  const int x = blockIdx.x * kColumns + threadIdx.x, y = blockIdx.y * kRows + threadIdx.y;
  const int slice = blockIdx.z % slices, pixel = y * c.width + x, plane = c.height * c.width;
  if (x >= c.width || y >= c.height) return;
  uint64_t rest = reinterpret_cast<const uint64_t*>(addresses[0])[pixel];
  if (!rest) return;
  uint4* out = reinterpret_cast<uint4*>(addresses[2]) + reinterpret_cast<const int32_t*>(addresses[1])[pixel];
  const Ray own{c.samples[static_cast<size_t>(4 * view) * plane + pixel], 2 * view * plane + pixel};
  const bool sees = own.sample.y & kStatic;
  for (int turn = 0; rest; rest &= rest - 1, ++turn) {
    if (turn % slices != slice) continue;
    const int first = kChunk * (__ffsll(static_cast<long long>(rest)) - 1);
    unsigned words[4];
#pragma unroll 1
    for (int q = 0; q < 4; ++q) {
      unsigned word = 0;
#pragma unroll 1
      for (int i = 0; i < 4; ++i) {
        bool any = true;
        unsigned cost = sees ? own_cost<kOthers, kOwnSlots>(c, view, own, first + 4 * q + i, x, y)
                             : others_cost<kSlots, kWindow>(c, view, first + 4 * q + i, x, y, any);
        if (cost == kNoPair) cost = any ? lone : unseen;
        word |= cost << 8 * i;
      }
#pragma unroll
      for (int to = 0; to < 4; ++to)
        if (q == to) words[to] = word;
    }
    out[turn] = make_uint4(words[0], words[1], words[2], words[3]);
  }
}

// What the entry points below take. samples, valid: as census leaves them, of `cameras`; addresses [n, 3] of
// each view's active uint64 [H, W], start int32 [H W + 1] and costs uint8 [chunks, 16], which are written;
// which int32 [n]: the view's camera; shifts [n, candidates, cameras]; centres float [n, 2]; census_scale
// uint8 [32]. Blocks 32 x 8: tiles; z = n slices + slice: chunks slice, slice + slices, ... of every pixel of
// view n.
#define SEEPAST_MATCHED                                                                                      \
  const uint2 *__restrict__ samples, const uint32_t *__restrict__ valid, int cameras, int height, int width, \
      const uint64_t *__restrict__ addresses, const int32_t *__restrict__ which,                             \
      const float *__restrict__ centres, const float *__restrict__ shifts, int candidates, int slices,       \
      const uint8_t *__restrict__ census_scale, int few, int colour_cap, int lone, int unseen
#define SEEPAST_MATCH(others, own_slots, slots, window)                                                   \
  const int n = blockIdx.z / slices;                                                                      \
  const Cameras c{samples,                                                                                \
                  valid,                                                                                  \
                  reinterpret_cast<const Shift*>(shifts) + static_cast<size_t>(n) * candidates * cameras, \
                  census_scale,                                                                           \
                  cameras,                                                                                \
                  height,                                                                                 \
                  width,                                                                                  \
                  centres[2 * n],                                                                         \
                  centres[2 * n + 1],                                                                     \
                  static_cast<unsigned>(few),                                                             \
                  static_cast<unsigned>(colour_cap)};                                                     \
  match<others, own_slots, slots, window>(c, addresses + 3 * n, which[n], slices, lone, unseen)

// For arrays of up to 5 cameras: 4 pairs with the view's own ray, 6 without it.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_5(SEEPAST_MATCHED) {
  SEEPAST_MATCH(4, 2, 3, 4);
}
// Of 6: 5 and 10.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_6(SEEPAST_MATCHED) {
  SEEPAST_MATCH(5, 3, 5, 5);
}
// Of 7 to 9: 8 and 13, which are never more than two cameras apart.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_9(SEEPAST_MATCHED) {
  SEEPAST_MATCH(8, 4, 7, 2);
}
// Of 10 to 16: 15 and 27.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_16(SEEPAST_MATCHED) {
  SEEPAST_MATCH(15, 8, 14, 2);
}
