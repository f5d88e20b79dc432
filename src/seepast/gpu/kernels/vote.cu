// Votes of the other cameras on the candidates of views: reference_multiview.votes.
//
// A block takes 32 neighbouring pixels of a row, chunk by chunk from the nearest on over the chunks that any
// of them has. A warp takes one candidate of a chunk at a time: its lanes look at neighbouring pixels of
// every camera, with the same shift, computed once per block. The chunk's energies go through shared memory,
// so that rows of the volume are read and written whole.
#include "landing.h"

using namespace seepast;

namespace {

constexpr int kChunk = 16;       // candidates of one row of a volume
constexpr int kFullVote = 1280;  // many.py FULL_VOTE
constexpr int kPixels = 32, kThreads = 256, kWarps = kThreads / kPixels, kEach = kChunk / kWarps;
constexpr int kPitch = kChunk / 4 + 1;  // words per pixel of the energies: an odd number, for the banks
constexpr float kNowhere = 1e8f;        // a parallax that leaves every image
static_assert(kThreads == kChunk * kMaxCameras, "one thread aims at one candidate with one camera");

// How all pixels of a row look at a candidate with one camera: where, and what disparity agrees with it
// there.
struct alignas(16) Aim {
  float zoom, parallax, side;
  int expected;
};

struct Shared {
  Aim aims[kChunk][kMaxCameras];
  int lines[kChunk][kMaxCameras];       // where the row of that camera's image begins
  int16_t margins[2][kChunk][kPixels];  // max(0, s - v) of this chunk and the one before
  uint32_t energies[kPixels * kPitch];  // bytes
  int rows[kPixels];                    // of the volume, -1: none
};

__device__ uint64_t any_of(uint64_t bits) {
  for (int step = 16; step > 0; step /= 2) bits |= __shfl_xor_sync(0xffffffffu, bits, step);
  return bits;
}

// Support and violation by one camera that has confidence c in a disparity lower than the candidate's by
// `behind`.
__device__ void add_vote(int behind, int c, int& support, int& violation) {
  support += c * max(0, kUnits - abs(behind));
  violation += c * min(2 * kUnits, max(0, behind - kUnits));
}

// What there is of every view, as the addresses of arrays.
struct View {
  const uint8_t *costs, *is_static;  // [n, kChunk], [H, W]
  const uint64_t* active;            // [H, W]
  const int32_t* start;              // [H W + 1]
  uint8_t* out;  // [n, kChunk], may be `costs`; only rows that there are votes on are written
};

// A thread's pixel and candidates: first, first + kWarps .. of a chunk.
struct Own {
  int x, lane, first;
  float from_center;

  __device__ int candidate(int n) const { return first + n * kWarps; }
};

// One thread: how row y looks at disparity d with camera k of the view; cy its centre.
__device__ void aim(Shared& shared, int i, int k, const float* offset, float d, float cy, int y, bool asked,
                    int height, int width) {
  const RayShift shift = shift_of(offset, d);
  const int row = y + whole_offset(ray_dy(shift, y, cy));
  const bool looks = asked && within(row, height);
  shared.aims[i][k] = {shift.zoom, looks ? shift.x : kNowhere, shift.view_x,
                       floor_int(d * static_cast<float>(kUnits) * (shift.zoom + 1.0f) + 0.5f)};
  shared.lines[i][k] = (k * height + row) * width;
}

// Support and violation of a thread's candidates by all cameras.
__device__ void collect(const Shared& shared, const Own& own, const uint16_t* __restrict__ disparities,
                        const uint8_t* __restrict__ confidence, int cameras, int width, int* support,
                        int* violation) {
#pragma unroll 2
  for (int k = 0; k < cameras; ++k)
#pragma unroll
    for (int n = 0; n < kEach; ++n) {  // no branches: the loads of several votes are on their way together
      const int i = own.candidate(n), line = shared.lines[i][k];
      const Aim aim = shared.aims[i][k];
      const int column = own.x + whole_offset(own.from_center * aim.zoom - aim.parallax + aim.side);
      const bool there = within(column, width);
      const uint32_t seen = there ? static_cast<uint32_t>(line + column) : 0, c = confidence[seen];
      add_vote(aim.expected - disparities[seen], there ? static_cast<int>(c) : 0, support[n], violation[n]);
    }
}

// The largest margin from candidate `from` of a chunk on.
__device__ int largest(const int16_t (&margins)[kChunk][kPixels], int from, int lane) {
  int found = 0;
  for (int j = max(0, from); j < kChunk; ++j) found = max(found, static_cast<int>(margins[j][lane]));
  return found;
}

// Adds their costs to the energies of the pixels that have the chunk: four bytes per thread.
__device__ void add_costs(const Shared& shared, const View& view, int volume) {
  const int t = threadIdx.x, pixel = t / 4, row = t < 4 * kPixels ? shared.rows[pixel] : -1;
  if (row < 0) return;
  const uint32_t energies = shared.energies[kPitch * pixel + t % 4];
  const size_t word = 4 * static_cast<size_t>(row) + t % 4;
  const uint32_t costs = reinterpret_cast<const uint32_t*>(view.costs)[word];
  uint32_t sums = 0;
#pragma unroll
  for (int shift = 0; shift < 32; shift += 8) {
    const int part = (static_cast<int>(costs >> shift & 255) * volume + 64) >> 7;
    sums |= static_cast<uint32_t>(min(255, static_cast<int>(energies >> shift & 255) + part)) << shift;
  }
  reinterpret_cast<uint32_t*>(view.out)[word] = sums;
}

}  // namespace

// blockIdx.z: the view, of V. offsets [V, K, 5], centers [V, 2]; addresses uint64 [V, 5], see View;
// disparities uint16, confidence uint8 [K, H, W]; skips int32 [V]: the camera without a vote, or -1.
extern "C" __global__ void __launch_bounds__(kThreads)
    votes(const float* __restrict__ offsets, const float* __restrict__ centers,
          const uint64_t* __restrict__ addresses, const int32_t* __restrict__ skips,
          const uint16_t* __restrict__ disparities, const uint8_t* __restrict__ confidence, int cameras,
          int height, int width, int first, int step, int base, int gain, int hide, int volume, int visible) {
  __shared__ Shared shared;
  const int t = threadIdx.x, view = blockIdx.z, y = blockIdx.y;
  const int x = blockIdx.x * kPixels + t % kPixels;
  const Own own{x, t % kPixels, t / kPixels, static_cast<float>(x) - centers[2 * view]};
  const View of = reinterpret_cast<const View*>(addresses)[view];
  const bool inside = x < width;
  const int at = y * width + (inside ? x : 0);
  const bool seen = inside && of.is_static[at];
  const uint64_t mine = inside && (visible || !seen) ? of.active[at] : 0;
  uint64_t wanted = any_of(mine);
  const bool blind = __any_sync(0xffffffffu, inside && !seen);
  const int weight = seen ? 0 : hide, lag = (2 * 8 + step - 1) / step;
  int older = 0;  // the largest margin of the chunks before the one before
  int now = 0;

  for (int before = -1; wanted; now ^= 1) {  // the same in all threads of a block
    const int chunk = 63 - __clzll(static_cast<long long>(wanted));
    wanted ^= uint64_t{1} << chunk;
    if (t % kMaxCameras < cameras) {
      const int i = t / kMaxCameras, k = t % kMaxCameras;
      const float steps = static_cast<float>(step) * static_cast<float>(chunk * kChunk + i);
      aim(shared, i, k, offsets + kOffsets * (cameras * view + k), (static_cast<float>(first) + steps) / 8.0f,
          centers[2 * view + 1], y, k != skips[view], height, width);
    }
    __syncthreads();

    const bool has = mine >> chunk & 1;
    if (t < kPixels) shared.rows[t] = has ? of.start[at] + __popcll(mine & ((uint64_t{1} << chunk) - 1)) : -1;
    int support[kEach] = {}, violation[kEach] = {};
    collect(shared, own, disparities, confidence, cameras, width, support, violation);

    int nearest[kEach] = {};  // margins of candidates that hide this one
    if (blind) {
#pragma unroll
      for (int n = 0; n < kEach; ++n)
        shared.margins[now][own.candidate(n)][own.lane] =
            static_cast<int16_t>(has ? max(0, 2 * support[n] - violation[n]) : 0);
      __syncthreads();
      const bool next = before == chunk + 1;
      const int last = before < 0 ? 0 : largest(shared.margins[now ^ 1], 0, own.lane);
#pragma unroll
      for (int n = 0; n < kEach; ++n) {
        const int from = own.candidate(n) + lag;
        const int near = next ? largest(shared.margins[now ^ 1], from - kChunk, own.lane) : last;
        nearest[n] = max(max(older, near), largest(shared.margins[now], from, own.lane));
      }
      older = max(older, last);
    }
    before = chunk;

#pragma unroll
    for (int n = 0; n < kEach; ++n) {
      const int s = min(2 * support[n], 2 * kFullVote), v = min(violation[n], 2 * kFullVote);
      const int energy = base + gain * (v - s) + weight * min(nearest[n], kFullVote);
      reinterpret_cast<uint8_t*>(shared.energies)[4 * kPitch * own.lane + own.candidate(n)] =
          static_cast<uint8_t>(min(255, (max(0, energy) + 64) >> 7));
    }
    __syncthreads();
    add_costs(shared, of, volume);
  }
}
