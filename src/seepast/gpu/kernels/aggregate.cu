// Stage "aggregate" of the many-view method, for all views at once: semi-global matching along 4 or 8 paths
// (Hirschmueller 2008), the winners, and their 5x5 median.
//
// Half a warp walks along one line of one path, a lane for every two candidates of two chunks. What a path
// adds to the costs is never more than P2, so it is stored in a byte where that fits; no path waits for
// another, and the sum is taken where the winner is.
#include "device.h"
#include "matching.h"

using namespace seepast;

constexpr unsigned kAll = 0xffffffffu;
constexpr int kLanes = 16;                                // that walk along a line
constexpr int kThreads = 64, kLines = kThreads / kLanes;  // of a block of paths

// One view: device addresses, as the host tables them.
struct View {
  const uint64_t* active;     // [H, W]
  const int32_t* start;       // [H W + 1]
  const uint8_t* costs;       // [chunks, 16]
  const uint8_t* image;       // [H, W, 3]
  const uint8_t* is_static;   // [H, W]
  const uint16_t* otherwise;  // [H, W], or null
  size_t first;               // row of the first chunk among those of all views
};
constexpr int kAddresses = 7;

__device__ inline View view_at(const uint64_t* addresses, int n) {
  const uint64_t* a = addresses + kAddresses * n;
  return {reinterpret_cast<const uint64_t*>(a[0]),
          reinterpret_cast<const int32_t*>(a[1]),
          reinterpret_cast<const uint8_t*>(a[2]),
          reinterpret_cast<const uint8_t*>(a[3]),
          reinterpret_cast<const uint8_t*>(a[4]),
          reinterpret_cast<const uint16_t*>(a[5]),
          static_cast<size_t>(a[6])};
}

// A line of pixels along which a path goes. Diagonals that leave the image at a side go on at the other, as
// new paths: so all of them are as long as the image is high.
struct Line {
  int x, y, dx, dy, height, width;
  bool exists;

  __device__ int steps() const { return dy ? height : width; }
  __device__ int column(int t) const {
    if (dy == 0) return dx > 0 ? t : width - 1 - t;
    if (dx == 0) return x;
    const int at = (x + t % width * dx) % width;
    return at < 0 ? at + width : at;
  }
  __device__ int row(int t) const { return dy == 0 ? y : dy > 0 ? t : height - 1 - t; }
  __device__ int pixel(int t) const { return row(t) * width + column(t); }
  __device__ bool begins(int t) const {
    return t == 0 || (dy != 0 && dx != 0 && column(t) == (dx > 0 ? 0 : width - 1));
  }
};

// The paths in order: left to right, right to left, down, up, and the diagonals.
__device__ inline Line line_of(int path, int number, int height, int width, bool exists) {
  const int dy = path < 2 ? 0 : path == 2 || path == 4 || path == 5 ? 1 : -1;
  const int dx = path < 2 ? 1 - 2 * path : path < 4 ? 0 : path == 4 || path == 6 ? 1 : -1;
  return {number, number, dx, dy, height, width, exists};
}

__device__ inline int difference(const uint8_t* a, const uint8_t* b, int channel) {
  const int d = static_cast<int>(a[channel]) - b[channel];
  return d < 0 ? -d : d;
}

// P2 on the way into the line's pixel t; -1 where a path begins.
__device__ inline int large_at(const View& v, const Line& line, int t, int p,
                               const uint16_t* __restrict__ large, int dynamic) {
  if (line.begins(t)) return -1;
  const int q = p - line.dy * line.width - line.dx;
  if (!v.active[q]) return -1;
  if (!v.is_static[p] || !v.is_static[q]) return dynamic;
  const uint8_t *a = v.image + 3 * p, *b = v.image + 3 * q;
  return large[difference(a, b, 0) + difference(a, b, 1) + difference(a, b, 2)];
}

// Position of the lowest bit, 63 if there is none.
__device__ inline int lowest_bit(uint64_t bits) { return (__ffsll(static_cast<long long>(bits)) - 1) & 63; }

// What a path needs to know of a pixel, in few words. Lanes look 16 pixels up at a time.
struct Place {
  uint32_t word;
  int start;

  // Bits 0..5, 6..11: the two lowest chunks; 12..18: how many there are; 19: they follow each other; 20..31:
  // P2 + 1.
  __device__ static Place of(uint64_t active, int start, int large) {
    const uint64_t others = active & (active - 1), run = active >> lowest_bit(active);
    const unsigned in_a_row = (run & (run + 1)) == 0;
    return {static_cast<uint32_t>(lowest_bit(active) | lowest_bit(others) << 6 | __popcll(active) << 12 |
                                  in_a_row << 19 | static_cast<unsigned>(large + 1) << 20),
            start};
  }
};

__device__ inline int chunks_of(uint32_t word) { return word >> 12 & 127; }
__device__ inline bool in_a_row(uint32_t word) { return word >> 19 & 1; }
__device__ inline int large_of(uint32_t word) { return static_cast<int>(word >> 20) - 1; }

__device__ inline Place place_at(const View& v, const Line& line, int t, const uint16_t* __restrict__ large,
                                 int dynamic) {
  if (t >= line.steps() || !line.exists) return Place::of(0, 0, -1);
  const int p = line.pixel(t);
  return Place::of(v.active[p], v.start[p], large_at(v, line, t, p, large, dynamic));
}

__device__ inline unsigned lowest_of_line(unsigned value) {
#pragma unroll
  for (int step = kLanes / 2; step > 0; step /= 2)
    value = min(value, __shfl_xor_sync(kAll, value, step, kLanes));
  return value;
}

// Takes the two lowest chunks out of `rest`; the lane's.
__device__ inline int next_chunk(uint64_t& rest, int half) {
  const int first = lowest_bit(rest);
  rest &= rest - 1;
  const int second = lowest_bit(rest);
  rest &= rest - 1;
  return half ? second : first;
}

// A path's costs at the pixel before and at this one lie in shared memory, entry d + kGuard for candidate d,
// below a mark that falls from pixel to pixel: so what was left there by earlier ones is above all that
// counts, and loses every comparison.
constexpr unsigned kMark = 1u << 16, kUnwritten = 0xffffu * kMark;
constexpr int kGuard = 2;

__device__ inline void put(uint8_t* to, unsigned first, unsigned second) {
  *reinterpret_cast<uint16_t*>(to) = static_cast<uint16_t>(first | second << 8);
}
__device__ inline void put(uint16_t* to, unsigned first, unsigned second) {
  *reinterpret_cast<uint32_t*>(to) = first | second << 16;
}
__device__ inline unsigned two_at(const uint8_t* costs) { return *reinterpret_cast<const uint16_t*>(costs); }

// L(p, d) - C(p, d) = min(L(q, d), L(q, d +- 1) + P1, min L(q) + P2) - min L(q).
struct Step {
  unsigned lowest, far, small, mark;
  const uint32_t* before;
  uint32_t* here;

  // Of two candidates and their two costs; returns the lower cost of the path.
  template <typename Way>
  __device__ unsigned take(int entry, unsigned costs, Way* ways) const {
    const uint2 same = *reinterpret_cast<const uint2*>(before + entry);
    const unsigned left = min(before[entry - 1], same.y) + small,
                   right = min(same.x, before[entry + 2]) + small;
    const unsigned first = min(min(same.x, far), left) - lowest,
                   second = min(min(same.y, far), right) - lowest;
    put(ways, first, second);
    const uint2 found = make_uint2(mark + first + (costs & 255), mark + second + (costs >> 8));
    *reinterpret_cast<uint2*>(here + entry) = found;
    return min(found.x, found.y);
  }

  // Of all chunks but the first two, which are in `all`, or follow each other from `entry` on if that is 0.
  template <typename Way>
  __device__ unsigned take_rest(uint64_t all, int chunks, int half, int entry, int first_entry,
                                const uint8_t* costs, Way* ways) const {
    const bool run = !all;
    unsigned least = kUnwritten;
    next_chunk(all, half);
#pragma unroll 1
    for (int done = 2; done < chunks; done += 2) {
      entry = run ? entry + 2 * kChunk : kChunk * next_chunk(all, half) + first_entry;
      const int64_t row = kChunk * done;
      if (done + half < chunks) least = min(least, take(entry, two_at(costs + row), ways + row));
    }
    return least;
  }

  __device__ void turn() {
    uint32_t* const swapped = here;
    here = const_cast<uint32_t*>(before);
    before = swapped;
  }
};

// All pixels of a line, into `ways` [rows, 16] of the path. Both halves of a warp walk in step.
template <typename Way>
__device__ inline void walk(const View& v, const Line& line, unsigned small,
                            const uint16_t* __restrict__ large, int dynamic, Way* __restrict__ ways,
                            uint32_t* path_costs, int pitch) {
  const int lane = threadIdx.x % kLanes, half = lane / (kChunk / 2), steps = line.steps();
  const int first_entry = 2 * (lane % (kChunk / 2)) + kGuard;
  const uint8_t* const costs = v.costs + 2 * lane;  // a lane's chunk is the first or the second
  ways += 2 * lane;
  for (int i = lane; i < 2 * pitch; i += kLanes) path_costs[i] = kUnwritten;
  Step step{0, 0, small, kUnwritten, path_costs, path_costs + pitch};
  Place mine = place_at(v, line, lane, large, dynamic),
        later = place_at(v, line, kLanes + lane, large, dynamic);
  uint32_t next = 0;
  int next_start = 0;
  unsigned next_costs = 0;
  bool prepared = false;
  const auto look_ahead = [&](uint32_t word, int start, int at) {
    next = __shfl_sync(kAll, word, at, kLanes);
    next_start = __shfl_sync(kAll, start, at, kLanes);
    next_costs = half < chunks_of(next) ? two_at(costs + kChunk * static_cast<int64_t>(next_start)) : 0;
  };
  __syncwarp();
  for (int first = 0; first < steps; first += kLanes) {
    const bool matched = __any_sync(kAll, chunks_of(mine.word));
    if (matched) {  // else paths begin anew behind these pixels
      if (!prepared) look_ahead(mine.word, mine.start, 0);
      const int many = min(kLanes, steps - first);
#pragma unroll 1
      for (int i = 0; i < many; ++i) {
        const uint32_t place = next;
        const unsigned costs_here = next_costs;
        const int64_t at = kChunk * static_cast<int64_t>(next_start);
        // the costs of the next pixel are on their way meanwhile
        const bool in_here = i + 1 < kLanes;
        look_ahead(in_here ? mine.word : later.word, in_here ? mine.start : later.start, (i + 1) % kLanes);
        const int into = large_of(place);
        if (into < 0) step.lowest = 0;
        step.far = step.lowest + max(into, 0);
        step.mark -= kMark;
        unsigned least = kUnwritten;
        const int chunks = chunks_of(place), entry = kChunk * (place >> 6 * half & 63) + first_entry;
        if (half < chunks) least = step.take(entry, costs_here, ways + at);
        if (chunks > 2) {  // rare, but for whole ranges
          const uint64_t all = in_a_row(place) ? 0 : v.active[line.pixel(first + i)];
          least = min(least, step.take_rest(all, chunks, half, entry, first_entry, costs + at, ways + at));
        }
        step.lowest = lowest_of_line(least);
        __syncwarp();
        step.turn();
      }
    }
    prepared = matched;
    mine = later;
    later = place_at(v, line, first + 2 * kLanes + lane, large, dynamic);
  }
}

template <typename Way>
__device__ inline void paths_of(const uint64_t* addresses, int height, int width, int count, size_t rows,
                                int small, const uint16_t* large, int dynamic, Way* ways,
                                uint32_t* path_costs) {
  const int in_block = threadIdx.x / kLanes, number = blockIdx.x * kLines + in_block, path = blockIdx.y;
  const int lines = path < 2 ? height : width;
  if (number - in_block % 2 >= lines) return;  // the whole warp
  const int pitch = count + 2 * kGuard;
  const View v = view_at(addresses, blockIdx.z);
  walk(v, line_of(path, number, height, width, number < lines), static_cast<unsigned>(small), large, dynamic,
       ways + kChunk * (path * rows + v.first), path_costs + in_block * 2 * pitch, pitch);
}

// addresses [n, 7]: View. rows of all views together; large uint16 [766], and dynamic: below 4095; ways
// [paths, rows, 16]. Blocks of 64 threads for 4 lines each; y is the path, z the view. Shared: 4 x 2 x (count
// + 4) uint32.
extern "C" __global__ void __launch_bounds__(kThreads, 16)
    paths_in_bytes(const uint64_t* __restrict__ addresses, int height, int width, int count, int64_t rows,
                   int small, const uint16_t* __restrict__ large, int dynamic, uint8_t* __restrict__ ways) {
  SEEPAST_SHARED(uint32_t, path_costs);
  paths_of(addresses, height, width, count, rows, small, large, dynamic, ways, path_costs);
}

// The same where P2 may be more than 255.
extern "C" __global__ void __launch_bounds__(kThreads, 16)
    paths_in_words(const uint64_t* __restrict__ addresses, int height, int width, int count, int64_t rows,
                   int small, const uint16_t* __restrict__ large, int dynamic, uint16_t* __restrict__ ways) {
  SEEPAST_SHARED(uint32_t, path_costs);
  paths_of(addresses, height, width, count, rows, small, large, dynamic, ways, path_costs);
}

// Sums of two candidates, one in each half of a word, for the 16 of a chunk.
struct Sums {
  unsigned pairs[kChunk / 2];

  __device__ void add(unsigned times, const uint8_t* from) {
    const uint4 v = *reinterpret_cast<const uint4*>(from);
    const unsigned words[4] = {v.x, v.y, v.z, v.w};
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      pairs[2 * i] += times * __byte_perm(words[i], 0, 0x4140);
      pairs[2 * i + 1] += times * __byte_perm(words[i], 0, 0x4342);
    }
  }
  __device__ void add(unsigned times, const uint16_t* from) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const uint4 v = reinterpret_cast<const uint4*>(from)[half];
      pairs[4 * half] += times * v.x, pairs[4 * half + 1] += times * v.y;
      pairs[4 * half + 2] += times * v.z, pairs[4 * half + 3] += times * v.w;
    }
  }
  __device__ int of(int candidate) const { return pairs[candidate / 2] >> 16 * (candidate % 2) & 0xffff; }
};

// The first lowest candidate, in 32nds of a pixel, moved to the vertex of the parabola through it and those
// beside it where both are active.
template <typename Way>
__device__ inline int winner(const View& v, int p, uint64_t active, int first, int step, int paths,
                             size_t rows, const Way* __restrict__ ways) {
  constexpr int kNone = 1 << 20;
  int best = 0, lowest = kNone, left = kNone, right = kNone, before = kNone, chunk_before = -2;
  bool just_found = false;  // the candidate before is the best: what follows is right of it
  size_t row = v.start[p];
  for (uint64_t rest = active; rest; rest &= rest - 1, ++row) {
    const int chunk = __ffsll(static_cast<long long>(rest)) - 1;
    if (chunk != chunk_before + 1) before = kNone, just_found = false;
    chunk_before = chunk;
    Sums sums{};
    sums.add(paths, v.costs + kChunk * row);
    for (int path = 0; path < paths; ++path) sums.add(1, ways + kChunk * (path * rows + v.first + row));
#pragma unroll
    for (int i = 0; i < kChunk; ++i) {
      const int total = sums.of(i);
      if (just_found) right = total;
      just_found = total < lowest;
      if (just_found) best = kChunk * chunk + i, lowest = total, left = before, right = kNone;
      before = total;
    }
  }
  int place = kUnits / 8 * (first + step * best);
  const int half = kUnits / 16 * step, bend = left + right - 2 * lowest;
  if (left < kNone && right < kNone && bend > 0)
    place += (2 * half * (left - right + bend) + bend) / (2 * bend) - half;
  return place;
}

template <typename Way>
__device__ inline void winners_of(const uint64_t* addresses, int pixels, int first, int step, int paths,
                                  size_t rows, const Way* ways, uint16_t* out) {
  const int p = blockIdx.x * blockDim.x + threadIdx.x;
  if (p >= pixels) return;
  const View v = view_at(addresses, blockIdx.y);
  const uint64_t active = v.active[p];
  out[blockIdx.y * static_cast<size_t>(pixels) + p] =
      active || !v.otherwise ? static_cast<uint16_t>(winner(v, p, active, first, step, paths, rows, ways))
                             : v.otherwise[p];
}

// out uint16 [n, pixels]; pixels that are not matched take what `otherwise` has. Blocks of 256; y is the
// view.
extern "C" __global__ void __launch_bounds__(256)
    winners_of_bytes(const uint64_t* __restrict__ addresses, int pixels, int first, int step, int paths,
                     int64_t rows, const uint8_t* __restrict__ ways, uint16_t* __restrict__ out) {
  winners_of(addresses, pixels, first, step, paths, rows, ways, out);
}

extern "C" __global__ void __launch_bounds__(256)
    winners_of_words(const uint64_t* __restrict__ addresses, int pixels, int first, int step, int paths,
                     int64_t rows, const uint16_t* __restrict__ ways, uint16_t* __restrict__ out) {
  winners_of(addresses, pixels, first, step, paths, rows, ways, out);
}

__device__ inline void order(int& a, int& b) {
  const int low = min(a, b);
  b = max(a, b);
  a = low;
}

// Brings the lowest of v[0 .. kCount - 1] to its beginning and the highest to its end.
template <int kCount>
__device__ inline void part(int* v) {
#pragma unroll
  for (int i = 0; i < kCount / 2; ++i) order(v[i], v[kCount - 1 - i]);
#pragma unroll
  for (int i = 1; i < (kCount + 1) / 2; ++i) order(v[0], v[i]);
#pragma unroll
  for (int i = kCount / 2; i < kCount - 1; ++i) order(v[i], v[kCount - 1]);
}

// Median of v[0 .. kCount - 1] and kCount - 3 values more, which `next` gives: as there are not more to come
// than that, neither the lowest nor the highest can be it, and both are forgotten for the next value.
template <int kCount>
struct Forget {
  template <typename Next>
  __device__ static int median(int* v, Next next) {
    part<kCount>(v);
    v[0] = next();
    return Forget<kCount - 1>::median(v, next);
  }
};
template <>
struct Forget<3> {
  template <typename Next>
  __device__ static int median(int* v, Next) {
    part<3>(v);
    return v[1];
  }
};

constexpr int kMedianX = 32, kMedianY = 8, kMedianReach = 2;

// in, out uint16 [n, height, width]: the median of 5x5 pixels; edges repeat. active [n]: addresses of the
// views' chunks, uint64 [height, width]; pixels without any stay as they are. 0: there are none such. Blocks
// 32 x 8; z is the view.
extern "C" __global__ void __launch_bounds__(kMedianX* kMedianY)
    median(const uint16_t* __restrict__ in, const uint64_t* __restrict__ active, int height, int width,
           uint16_t* __restrict__ out) {
  constexpr int kSpanX = kMedianX + 2 * kMedianReach, kSpanY = kMedianY + 2 * kMedianReach;
  __shared__ uint16_t tile[kSpanY][kSpanX];
  const int left = blockIdx.x * kMedianX, top = blockIdx.y * kMedianY;
  const size_t view = blockIdx.z * static_cast<size_t>(height) * width;
  for (int i = threadIdx.y * kMedianX + threadIdx.x; i < kSpanX * kSpanY; i += kMedianX * kMedianY) {
    const int x = clamp(left + i % kSpanX - kMedianReach, 0, width - 1),
              y = clamp(top + i / kSpanX - kMedianReach, 0, height - 1);
    tile[i / kSpanX][i % kSpanX] = in[view + static_cast<size_t>(y) * width + x];
  }
  __syncthreads();
  const int x = left + threadIdx.x, y = top + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t pixel = static_cast<size_t>(y) * width + x;
  const uint64_t* const chunks = reinterpret_cast<const uint64_t*>(active[blockIdx.z]);
  if (chunks && !chunks[pixel]) {
    out[view + pixel] = in[view + pixel];
    return;
  }
  int values[14], taken = 0;
  const auto next = [&]() -> int {
    const int i = taken++;
    return tile[threadIdx.y + i / 5][threadIdx.x + i % 5];
  };
#pragma unroll
  for (int i = 0; i < 14; ++i) values[i] = next();
  out[view + pixel] = static_cast<uint16_t>(Forget<14>::median(values, next));
}
