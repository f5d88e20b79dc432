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

// W_k at one candidate (pixel.h RayShift), and the camera's first row among the samples: two reads of 16
// bytes.
struct __align__(16) Shift {
  float zoom, x, y, view_x, view_y;
  int first, unused[2];
};

// offsets float [n, K, 5], which int32 [n]: the views' cameras; shifts [n, count, K]: of every view,
// candidate and camera, the view's own last.
extern "C" __global__ void __launch_bounds__(kThreads)
    volume_shifts(const float* __restrict__ offsets, const int32_t* __restrict__ which, int first, int step,
                  int count, int cameras, int views, int height, float* __restrict__ shifts) {
  const int i = blockIdx.x * kThreads + threadIdx.x;
  if (i >= views * count * cameras) return;
  const int place = i % cameras, candidate = i / cameras % count, view = i / cameras / count,
            own = which[view];
  const int k = place == cameras - 1 ? own : place < own ? place : place + 1;
  const float d =
      (static_cast<float>(first) + static_cast<float>(step) * static_cast<float>(candidate)) / 8.0f;
  RayShift shift = ray_shift(offsets + (view * cameras + k) * kOffsets, d);
  const bool finite = shift.zoom > -1e30f && shift.zoom < 1e30f;
  if (!finite) shift = {0, 0, 0, -1e30f, -1e30f};  // the point lies beside the camera: no pixel sees it
  reinterpret_cast<Shift*>(shifts)[i] = {shift.zoom,   shift.x,        shift.y, shift.view_x,
                                         shift.view_y, 2 * k * height, {0, 0}};
}

// What matching needs of all cameras; one view's geometry.
struct Cameras {
  const uint2* samples;   // [K, 2, H, W]
  const uint32_t* valid;  // [K, 2, H, W]
  const Shift* shifts;    // [count, K] of the view
  const uint8_t* census_scale;
  int count, height, width;
  float cx, cy;
  unsigned few, colour_cap;
};

// The sample at x^k, and where it is; not static where there is none.
struct Ray {
  unsigned census, colour;  // and flags
  int index;
};

// No branches, so that several rays are on their way from memory at once: where there is no sample another is
// read.
__device__ inline Ray ray_at(const Cameras& c, const Shift* __restrict__ shift, int x, int y, bool wanted) {
  const float4* words = reinterpret_cast<const float4*>(shift);
  const float4 s = words[0], more = words[1];
  const RayShift r{s.x, s.y, s.z, s.w, more.x};
  // Times two is exact, so that this is half_offset. Sums of what is far outside wrap, and stay outside.
  const unsigned dx = __float2int_rd(__fmaf_rn(2.0f, ray_dx(r, x, c.cx), 0.5f));
  const unsigned dy = __float2int_rd(ray_dy(r, y, c.cy) + 0.5f);
  const int half = static_cast<int>(2u * x + dx), row = static_cast<int>(y + dy);
  const int column = half >> 1;
  const bool there = static_cast<unsigned>(column) < static_cast<unsigned>(c.width) &&
                     static_cast<unsigned>(row) < static_cast<unsigned>(c.height) && wanted;
  const int index = there ? (__float_as_int(more.y) + (half & 1) * c.height + row) * c.width + column : 0;
  const uint2 sample = c.samples[static_cast<unsigned>(index)];
  return {sample.x, there ? sample.y : 0, index};
}

__device__ inline unsigned colour_cost(const Cameras& c, const Ray& a, const Ray& b) {
  const unsigned apart = __vabsdiffu4(a.colour, b.colour);
  const unsigned blue = apart & 255, green = apart >> 8 & 255, red = apart >> 16 & 255;
  const unsigned step = (((blue + red + 1) >> 1) + green + 1) >> 1;
  return min(step, c.colour_cap);
}

// 96 hamming / n of rays that are static but have neighbours that are not; kNoPair where no neighbour is
// static in both.
__device__ inline unsigned unclear_census(const Cameras& c, const Ray& a, const Ray& b) {
  const unsigned known = c.valid[a.index] & c.valid[b.index], scale = c.census_scale[__popc(known)];
  return scale ? (__popc((a.census ^ b.census) & known) * scale + 4) >> 3 : known ? c.few : kNoPair;
}

__device__ inline bool is_unclear(const Ray& a, const Ray& b) {
  return (a.colour & b.colour & (kStatic | kClear)) == kStatic;
}

// Of two rays that are clear, or not both static.
__device__ inline unsigned clear_cost(const Cameras& c, const Ray& a, const Ray& b) {
  const unsigned cost = 4 * __popc(a.census ^ b.census) + colour_cost(c, a, b);
  return a.colour & b.colour & kStatic ? cost : kNoPair;
}

// The smallest kSlots of the costs so far, in order.
template <int kSlots>
struct SmallerHalf {
  unsigned least[kSlots], known;  // known: how many

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
    const unsigned half = (known + 1) / 2;
    unsigned sum = (half >> 1) + least[0], share = 65536;
#pragma unroll
    for (int q = 1; q < kSlots; ++q)
      if (q < half) sum += least[q], share = 65535 / (q + 1) + 1;
    return half ? sum * share >> 16 : kNoPair;
  }
};

// Costs of one ray with others, of `first` .. count - 1: 96 hamming / n + min(mean colour step, cap); kNoPair
// unless both are static.
template <int kMost, int kSlots>
__device__ inline void add_pairs(const Cameras& c, const Ray& one, const Ray* several, int first, int count,
                                 SmallerHalf<kSlots>& costs) {
  unsigned found[kMost];
  bool unclear = false;
#pragma unroll
  for (int i = 0; i < kMost; ++i) {
    if (i < first || i >= count) continue;
    found[i] = clear_cost(c, one, several[i]);
    unclear = unclear || is_unclear(one, several[i]);
  }
  if (unclear) {
#pragma unroll
    for (int i = 0; i < kMost; ++i)
      if (i >= first && i < count && is_unclear(one, several[i])) {
        const unsigned census = unclear_census(c, one, several[i]);
        found[i] = census == kNoPair ? kNoPair : census + colour_cost(c, one, several[i]);
      }
  }
#pragma unroll
  for (int i = 0; i < kMost; ++i)
    if (i >= first && i < count) costs.add(found[i]);
}

// What one candidate costs a pixel that the view sees itself: its own ray with every other.
template <int kOthers, int kSlots>
__device__ inline unsigned own_cost(const Cameras& c, const Ray& own, const Shift* __restrict__ shifts, int x,
                                    int y) {
  constexpr int kAtOnce = kOthers <= 5 ? kOthers : kOthers % 5 ? 4 : 5;
  SmallerHalf<kSlots> costs;
  costs.clear();
#pragma unroll 1
  for (int first = 0; first < kOthers; first += kAtOnce) {
    Ray rays[kAtOnce];
#pragma unroll
    for (int i = 0; i < kAtOnce; ++i) rays[i] = ray_at(c, shifts + first + i, x, y, first + i < c.count - 1);
    add_pairs<kAtOnce>(c, own, rays, 0, kAtOnce, costs);
  }
  return costs.mean();
}

// And one that it does not: pairs of the others' rays that are at most `apart` places apart (many.py
// camera_pairs) ...
template <int kOthers, int kSlots>
__device__ inline unsigned others_cost(const Cameras& c, const Shift* __restrict__ shifts, int x, int y,
                                       int apart, bool& any) {
  SmallerHalf<kSlots> costs;
  costs.clear();
  Ray rays[kOthers];
  any = false;
#pragma unroll
  for (int i = 0; i < kOthers; ++i) {
    rays[i] = ray_at(c, shifts + i, x, y, i < c.count - 1);
    any = any || rays[i].colour & kStatic;
  }
#pragma unroll
  for (int i = 1; i < kOthers; ++i) add_pairs<kOthers - 1>(c, rays[i], rays, i - apart, i, costs);
  return costs.mean();
}

// ... which are at most two where there are more than six cameras.
template <int kSlots>
__device__ inline unsigned others_cost_of_many(const Cameras& c, const Shift* __restrict__ shifts, int x,
                                               int y, int apart, bool& any) {
  SmallerHalf<kSlots> costs;
  costs.clear();
  Ray before[2] = {{0, 0, 0}, {0, 0, 0}};
  any = false;
#pragma unroll 1
  for (int i = 0; i < c.count - 1; ++i) {
    const Ray ray = ray_at(c, shifts + i, x, y, true);
    any = any || ray.colour & kStatic;
    add_pairs<2>(c, ray, before, 0, apart, costs);
    before[1] = before[0], before[0] = ray;
  }
  return costs.mean();
}

template <int kOthers, int kOwnSlots, int kSlots>
__device__ inline void match(const Cameras& c, const uint64_t* __restrict__ addresses, int view, int apart,
                             int slices, unsigned lone, unsigned unseen) {
  const int x = blockIdx.x * kColumns + threadIdx.x, y = blockIdx.y * kRows + threadIdx.y;
  const int slice = blockIdx.z & (slices - 1), pixel = y * c.width + x, plane = c.height * c.width;
  if (x >= c.width || y >= c.height) return;
  uint64_t rest = reinterpret_cast<const uint64_t*>(addresses[0])[pixel];
  if (!rest) return;
  uint4* out = reinterpret_cast<uint4*>(addresses[2]) + reinterpret_cast<const int32_t*>(addresses[1])[pixel];
  const int at = 2 * view * plane + pixel;
  const uint2 sample = c.samples[static_cast<unsigned>(at)];
  const Ray own{sample.x, sample.y, at};
  const bool sees = own.colour & kStatic;
  for (int turn = 0; rest; rest &= rest - 1, ++turn) {
    if ((turn & (slices - 1)) != slice) continue;
    const Shift* shifts =
        c.shifts + static_cast<size_t>(kChunk * (__ffsll(static_cast<long long>(rest)) - 1)) * c.count;
    unsigned words[4];
#pragma unroll 1
    for (int q = 0; q < 4; ++q) {
      unsigned word = 0;
#pragma unroll 1
      for (int i = 0; i < 4; ++i, shifts += c.count) {
        bool any = true;
        unsigned cost;
        if (sees)
          cost = own_cost<kOthers, kOwnSlots>(c, own, shifts, x, y);
        else if constexpr (kOthers < 6)
          cost = others_cost<kOthers, kSlots>(c, shifts, x, y, apart, any);
        else
          cost = others_cost_of_many<kSlots>(c, shifts, x, y, apart, any);
        if (cost == kNoPair) cost = any ? lone : unseen;
        word = __funnelshift_r(word, cost, 8);
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
// which int32 [n]: the view's camera; aparts int32 [n]; shifts [n, candidates, cameras]; centres float [n,
// 2]; census_scale uint8 [32]. Blocks 32 x 8: tiles; z = n slices + slice, slices 1, 2 or 4: chunks slice,
// slice + slices, ... of every pixel of view n.
#define SEEPAST_MATCHED                                                                                      \
  const uint2 *__restrict__ samples, const uint32_t *__restrict__ valid, int cameras, int height, int width, \
      const uint64_t *__restrict__ addresses, const int32_t *__restrict__ which,                             \
      const int32_t *__restrict__ aparts, const float *__restrict__ centres,                                 \
      const float *__restrict__ shifts, int candidates, int slices,                                          \
      const uint8_t *__restrict__ census_scale, int few, int colour_cap, int lone, int unseen
#define SEEPAST_MATCH(others, own_slots, slots)                                                           \
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
  match<others, own_slots, slots>(c, addresses + 3 * n, which[n], aparts[n], slices, lone, unseen)

// For arrays of up to 5 cameras: 4 pairs with the view's own ray, 6 without it.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_5(SEEPAST_MATCHED) {
  SEEPAST_MATCH(4, 2, 3);
}
// Of 6: 5 and 10.
extern "C" __global__ void __launch_bounds__(kThreads, 3) volume_6(SEEPAST_MATCHED) {
  SEEPAST_MATCH(5, 3, 5);
}
// Of 7 to 9: 8 and 13, which are never more than two places apart.
extern "C" __global__ void __launch_bounds__(kThreads, 4) volume_9(SEEPAST_MATCHED) {
  SEEPAST_MATCH(8, 4, 7);
}
// Of 10 to 16: 15 and 27.
extern "C" __global__ void __launch_bounds__(kThreads, 3) volume_16(SEEPAST_MATCHED) {
  SEEPAST_MATCH(15, 8, 14);
}
