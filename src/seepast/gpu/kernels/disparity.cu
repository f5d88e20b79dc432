// Stage "disparity", the M-step: argmin_d beta Var_S(f(x^1) .. f(x^K)) - log p(d | T, x) over the candidates,
// and which pixels a change of labels concerns.
//
// A block has one cell of 32 x 16 pixels, which share most of their candidates. It goes through them one by
// one: the variances of single gradients of all its pixels, and two around, into shared memory; then every
// pixel adds up those of its descriptor's pattern.
#include "device.h"
#include "grid.h"

using namespace seepast;

constexpr int kCellRows = 16, kCellColumns = 32;  // candidates.py CELL
constexpr int kReach = 2;                         // of the descriptor's pattern
constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr int kPlaceColumns = kCellColumns + 2 * kReach, kPlaceRows = kCellRows + 2 * kReach;
constexpr int kGroups =
    kThreads / kPlaceColumns;  // of threads with places of one row; four threads are left over
constexpr int kPlacesEach = (kPlaceRows + kGroups - 1) / kGroups;
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr uint32_t kStatic = 1u << 31;   // in a pair of gradients
constexpr uint32_t kBoth = 0x00ff00ffu;  // du and dv in it
constexpr int kSeen = 1 << 19;  // in packed variances of du: at least one ray; 16 of them stay below 2^24

// Two pixels of a thread, one above the other, and whether they take part.
struct Pixels {
  int x, y;
  bool wanted[2];
  int mean[2];
};

static __device__ Pixels pixels_of_thread(const uint8_t* wanted, const int32_t* mean, int height, int width) {
  Pixels p;
  p.x = blockIdx.x * kCellColumns + threadIdx.x;
  p.y = blockIdx.y * kCellRows + 2 * threadIdx.y;
  for (int j = 0; j < 2; ++j) {
    const bool there = p.x < width && p.y + j < height;
    const size_t at = static_cast<size_t>(p.y + j) * width + p.x;
    p.wanted[j] = there && wanted[at];
    p.mean[j] = p.wanted[j] ? mean[at] : 0;
  }
  return p;
}

// Bits of the candidates that any pixel of the block may take, into `active`: those of the cell, and those
// within `radius` eighths of a pixel's prior mean. False, in all threads alike, if no pixel is wanted.
static __device__ bool candidates_of_cell(const Pixels& p, const Grid& grid, const uint8_t* cell, int radius,
                                          uint32_t* active) {
  __shared__ int lows[kWarps], highs[kWarps];
  constexpr int kMost = 0x3fffffff;
  int low = kMost, high = -kMost;
  for (int j = 0; j < 2; ++j)
    if (p.wanted[j]) low = min(low, p.mean[j]), high = max(high, p.mean[j]);
  for (int step = 16; step > 0; step /= 2) {
    low = min(low, __shfl_xor_sync(kAllLanes, low, step));
    high = max(high, __shfl_xor_sync(kAllLanes, high, step));
  }
  if (threadIdx.x == 0) lows[threadIdx.y] = low, highs[threadIdx.y] = high;
  __syncthreads();
  for (int w = 0; w < kWarps; ++w) low = min(low, lows[w]), high = max(high, highs[w]);
  for (int word = threadIdx.y; 32 * word < grid.count; word += kWarps) {
    const int i = 32 * word + threadIdx.x, d8 = grid.eighths(i);
    const bool takes = i < grid.count && (cell[i] || (d8 >= low - radius && d8 <= high + radius));
    const uint32_t bits = __ballot_sync(kAllLanes, takes);
    if (threadIdx.x == 0) active[word] = bits;
  }
  __syncthreads();
  return low <= high;
}

static __device__ const uint8_t* cell_of_block(const uint8_t* cells, int count) {
  return cells + (static_cast<size_t>(blockIdx.y) * gridDim.x + blockIdx.x) * count;
}

// Warp of camera k at candidate i: shifts [count, K, 3] are zoom and parallax of ray_shift.
static __device__ RayShift shift_of(const float* shifts, const float* offsets, int cameras, int i, int k) {
  const float* of_candidate = shifts + (i * cameras + k) * 3;
  const float* of_camera = offsets + kOffsets * k;
  return {of_candidate[0], of_candidate[1], of_candidate[2], of_camera[3], of_camera[4]};
}

// Gradients as matching reads them, uint32 [K H W + 1]: (du + 128) | (dv + 128) << 16 | kStatic,
// or 0 where not static, and at the end, which is read beside the last pixel. gradients [K, H, W] of two
// signed bytes. One thread per pixel.
extern "C" __global__ void __launch_bounds__(kThreads)
    static_gradients(const uchar2* __restrict__ gradients, const uint8_t* __restrict__ is_static, int count,
                     uint32_t* __restrict__ out) {
  const int i = blockIdx.x * kThreads + threadIdx.x;
  if (i > count) return;
  uint32_t pair = 0;
  if (i < count && is_static[i]) pair = (gradients[i].x ^ 128u) | (gradients[i].y ^ 128u) << 16 | kStatic;
  out[i] = pair;
}

// Where the rays of a column of places end in one camera: left of two pixels, the weight of the right one.
struct Column {
  int left;
  uint32_t phase, without_right;  // all ones where the right pixel does not count
  bool inside;

  __device__ Column(int xq, int width) : left(xq >> 2), phase(xq & 3), without_right(xq & 3 ? 0 : ~0u) {
    inside = xq >= 0 && left + (phase > 0) < width;
  }
};

// Rays of one place added up: n, the sums of du and dv in 16 bits each, the sums of their squares. The bias
// of 128 leaves variances as they are.
struct Sums {
  uint32_t n = 0, both = 0, du = 0, dv = 0;

  __device__ void add(uint32_t left, uint32_t right, const Column& column, bool exists) {
    const uint32_t labels = left & (right | column.without_right);
    const uint32_t known = exists ? static_cast<uint32_t>(static_cast<int32_t>(labels) >> 31) : 0;
    const uint32_t f =
        (((left & kBoth) * (4 - column.phase) + (right & kBoth) * column.phase + 0x00020002u) >> 2) & kBoth &
        known;
    const uint32_t u = f & 0xffffu, v = f >> 16;
    n -= known;
    both += f;
    du += u * u;
    dv += v * v;
  }
};

// pixel.h packed_variance; inverse_squares[n] = (1 / n)^2.
static __device__ int packed(uint32_t n, uint32_t sum, uint32_t squares, const float* inverse_squares) {
  const int variance =
      static_cast<int>(static_cast<float>(static_cast<int>(n * squares - sum * sum)) * inverse_squares[n]);
  return n >= 2 ? variance + kSampleKnown : 0;
}

// The two pixels' sums of packed variances over the descriptor's pattern; row 0 is two rows above the upper
// one.
struct Pattern {
  int upper, lower;
};
static __device__ Pattern pattern_sums(const int (*du)[kPlaceColumns], const int (*dv)[kPlaceColumns],
                                       int x) {
  Pattern sum;
  const int r1 = du[1][x + 2], r4 = du[4][x + 2];
  const int r2 = du[2][x + 2], r3 = du[3][x + 2];
  const int wide2 = du[2][x] + du[2][x + 4], near2 = du[2][x + 1] + du[2][x + 3];
  const int wide3 = du[3][x] + du[3][x + 4], near3 = du[3][x + 1] + du[3][x + 3];
  sum.upper = du[0][x + 2] + (du[1][x] + r1 + du[1][x + 4]) + (near2 + 2 * r2) + (wide3 + r3) + r4;
  sum.lower = r1 + (wide2 + r2) + (near3 + 2 * r3) + (du[4][x] + r4 + du[4][x + 4]) + du[5][x + 2];
  sum.upper += dv[1][x + 2] + dv[2][x + 1] + dv[2][x + 3] + dv[3][x + 2];
  sum.lower += dv[2][x + 2] + dv[3][x + 1] + dv[3][x + 3] + dv[4][x + 2];
  return sum;
}

// What the pixels of a thread have found so far.
struct Best {
  float energy[2];
  int candidate[2];
};

// Blocks of 32 x 8 threads, one per cell; 4 bytes of shared memory per 32 candidates.
//   gradients [K, H, W] of static_gradients; shifts [count, K, 3] of shift_of; offsets [K, kOffsets]
//   mean int32 [H, W]; cells uint8 [.., .., count]; wanted [H, W]
//   table float [tail + 1]: prior energies by eighths of |d - mu|; radius in eighths
// out [H, W] px, 0 where not wanted.
extern "C" __global__ void __launch_bounds__(kThreads, 4)
    disparity(const uint32_t* __restrict__ gradients, const float* __restrict__ shifts,
              const float* __restrict__ offsets, int cameras, int height, int width, float cx, float cy,
              const int32_t* __restrict__ mean, const uint8_t* __restrict__ cells, int first, int step,
              int count, const uint8_t* __restrict__ wanted, float beta, float lone_variance,
              float unseen_variance, int radius, const float* __restrict__ table, int tail,
              float* __restrict__ out) {
  SEEPAST_SHARED(uint32_t, active);
  __shared__ int du[2][kPlaceRows][kPlaceColumns], dv[2][kPlaceRows][kPlaceColumns];
  __shared__ float inverse_squares[kMaxCameras + 1], scales[kSamples + 1];
  const int t = threadIdx.y * 32 + threadIdx.x;
  if (t <= kMaxCameras) {
    const float inverse = 1.0f / static_cast<float>(t > 1 ? t : 1);
    inverse_squares[t] = inverse * inverse;
    scales[t] = static_cast<float>(kSamples) / static_cast<float>(t > 1 ? t : 1);
  }
  const Grid grid{first, step, count};
  const Pixels p = pixels_of_thread(wanted, mean, height, width);
  const uint8_t* cell = cell_of_block(cells, count);
  const bool any = candidates_of_cell(p, grid, cell, radius, active);
  Best best{{__int_as_float(0x7f800000), __int_as_float(0x7f800000)}, {-1, -1}};

  // A thread has places of one column, every kGroups-th from a row on.
  const int place_column = t % kPlaceColumns, place_row = t / kPlaceColumns;
  const int x = static_cast<int>(blockIdx.x) * kCellColumns - kReach + place_column;
  const int y = static_cast<int>(blockIdx.y) * kCellRows - kReach + place_row;
  const bool has_places = place_row < kGroups;
  uint32_t rows_open[kPlacesEach];  // to the place's rays: all of an image, or none where there is no pixel
  for (int r = 0; r < kPlacesEach; ++r) {
    const int of_place = y + r * kGroups;
    rows_open[r] = has_places && x >= 0 && x < width && of_place >= 0 && of_place < height ? height : 0;
  }
  int half = 0;
  for (int word = 0; any && 32 * word < count; ++word)
    for (uint32_t rest = active[word]; rest; rest &= rest - 1, half ^= 1) {
      const int i = 32 * word + __ffs(static_cast<int>(rest)) - 1;
      Sums sums[kPlacesEach];
      const uint32_t* image = gradients;
      for (int k = 0; k < cameras; ++k, image += static_cast<size_t>(height) * width) {
        const RayShift shift = shift_of(shifts, offsets, cameras, i, k);
        const Column column(4 * x + quarter_offset(ray_dx(shift, x, cx)), width);
        uint32_t left[kPlacesEach], right[kPlacesEach];
        bool exists[kPlacesEach];
#pragma unroll
        for (int r = 0; r < kPlacesEach; ++r) {  // all loads, then all sums: they wait together
          const int of_place = y + r * kGroups, row = of_place + whole_offset(ray_dy(shift, of_place, cy));
          exists[r] = column.inside && static_cast<uint32_t>(row) < rows_open[r];
          const uint32_t* at = image + static_cast<uint32_t>(exists[r] ? row * width + column.left : 0);
          left[r] = at[0], right[r] = at[1];
        }
#pragma unroll
        for (int r = 0; r < kPlacesEach; ++r) sums[r].add(left[r], right[r], column, exists[r]);
      }
#pragma unroll
      for (int r = 0; r < kPlacesEach; ++r) {
        const int row = place_row + r * kGroups;
        if (!has_places || row >= kPlaceRows) continue;
        const Sums& s = sums[r];
        du[half][row][place_column] =
            packed(s.n, s.both & 0xffffu, s.du, inverse_squares) + (s.n ? kSeen : 0);
        dv[half][row][place_column] = packed(s.n, s.both >> 16, s.dv, inverse_squares);
      }
      __syncthreads();  // the one before the next candidate but one writes here again is the next candidate's
      const int column = threadIdx.x, row = 2 * threadIdx.y;
      const Pattern pattern = pattern_sums(du[half] + row, dv[half] + row, column);
      const int d8 = grid.eighths(i);
#pragma unroll
      for (int j = 0; j < 2; ++j) {
        const int own = du[half][row + j + kReach][column + kReach], sum = j ? pattern.lower : pattern.upper;
        const int variances = sum & (kSeen - 1);
        const float variance = own >= kSampleKnown ? static_cast<float>(variances) * scales[sum >> 24]
                                                   : (own ? lone_variance : unseen_variance);
        const int away = abs(d8 - p.mean[j]);
        const float energy = beta * variance + table[min(away, tail)];
        if (p.wanted[j] && (away <= radius || cell[i]) && energy < best.energy[j])
          best.energy[j] = energy, best.candidate[j] = i;
      }
    }
  for (int j = 0; j < 2; ++j)
    if (p.x < width && p.y + j < height)
      out[static_cast<size_t>(p.y + j) * width + p.x] =
          best.candidate[j] < 0 ? 0.0f : grid.value(best.candidate[j]);
}

// Whether the pixel, or the one right of it, of row `row` is set in `changed` [H, W].
static __device__ bool meets(const uint8_t* changed, int xq, int row, int height, int width) {
  if (row < 0 || row >= height) return false;
  const int left = xq >> 2;
  const uint8_t* line = changed + static_cast<size_t>(row) * width;
  return (left >= 0 && left < width && line[left]) || (left >= -1 && left + 1 < width && line[left + 1]);
}

// out [H, W]: pixels with a candidate whose rays end on or beside a pixel of changed [K, H, W]. The rest as
// above.
extern "C" __global__ void __launch_bounds__(kThreads, 4)
    affected(const uint8_t* __restrict__ changed, const float* __restrict__ shifts,
             const float* __restrict__ offsets, int cameras, int height, int width, float cx, float cy,
             const int32_t* __restrict__ mean, const uint8_t* __restrict__ cells, int first, int step,
             int count, const uint8_t* __restrict__ wanted, int radius, uint8_t* __restrict__ out) {
  SEEPAST_SHARED(uint32_t, active);
  const Grid grid{first, step, count};
  const Pixels p = pixels_of_thread(wanted, mean, height, width);
  const uint8_t* cell = cell_of_block(cells, count);
  const bool any = candidates_of_cell(p, grid, cell, radius, active);
  bool open[2] = {p.wanted[0], p.wanted[1]};  // might yet be affected
  for (int word = 0; any && 32 * word < count; ++word)
    for (uint32_t rest = active[word]; rest && (open[0] || open[1]); rest &= rest - 1) {
      const int i = 32 * word + __ffs(static_cast<int>(rest)) - 1, d8 = grid.eighths(i);
      for (int k = 0; k < cameras; ++k) {
        const RayShift shift = shift_of(shifts, offsets, cameras, i, k);
        const int xq = 4 * p.x + quarter_offset(ray_dx(shift, p.x, cx));
        const uint8_t* view = changed + static_cast<size_t>(k) * height * width;
        for (int j = 0; j < 2; ++j) {
          if (!open[j] || (abs(d8 - p.mean[j]) > radius && !cell[i])) continue;
          const int row = p.y + j + whole_offset(ray_dy(shift, p.y + j, cy));
          if (meets(view, xq, row, height, width)) open[j] = false;
        }
      }
    }
  for (int j = 0; j < 2; ++j)
    if (p.x < width && p.y + j < height)
      out[static_cast<size_t>(p.y + j) * width + p.x] = p.wanted[j] && !open[j];
}
