// The loops of the mask refinement but for the field: backends/reference_people.py specifies them, names are
// its.
//
// dynamic uint8, surfaces float [K, H, W]; colour uint8 [K, H, W, C]; saw uint8 [K, H, W, K]. Tables of the
// array as seen from each camera: offsets [K, K, 5], centers [K, 2]. Blocks of 32 x 8 threads, blockIdx.z the
// camera, unless said otherwise; of lattices, a thread has a lattice pixel.
#include "landing.h"
#include "people_pixel.h"

using namespace seepast;

namespace {

constexpr int kAcross = 32, kDown = 8;
constexpr uint32_t kAll = 0xffffffffu;

// A pixel of a lattice, and of the image.
struct Place {
  int k, j, i;  // camera, row and column of the lattice
  bool there;
  size_t lattice, image;  // indices

  __device__ Place(const Lattice& grid, int height, int width)
      : k(blockIdx.z),
        j(blockIdx.y * kDown + threadIdx.y),
        i(blockIdx.x * kAcross + threadIdx.x),
        there(j < grid.height && i < grid.width),
        lattice((static_cast<size_t>(k) * grid.height + j) * grid.width + i),
        image((static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i)) {}
};

struct Pooled {
  int n, total;
};

__device__ Pooled pooled(const uint8_t* __restrict__ says, int cameras) {
  Pooled p{0, 0};
  for (int j = 0; j < cameras; ++j) {
    const int say = says[j];
    p.n += say != kNoSay;
    p.total += say != kNoSay ? say : 0;
  }
  return p;
}

template <class T>
__device__ T warp_sum(T value) {
  for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(kAll, value, step);
  return value;
}

__device__ void add_long(int64_t* sum, int64_t value) {
  atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(value));
}

}  // namespace

extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    witnesses(const float* __restrict__ offsets, const float* __restrict__ centers,
              const uint8_t* __restrict__ dynamic, const float* __restrict__ surfaces, float tolerance,
              int cameras, int height, int width, uint8_t* __restrict__ saw) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y, k = blockIdx.z;
  if (x >= width || y >= height) return;
  const size_t pixels = static_cast<size_t>(height) * width, pixel = static_cast<size_t>(y) * width + x;
  const size_t own = k * pixels + pixel;
  const float d = surfaces[own], cx = centers[2 * k], cy = centers[2 * k + 1];
  const uint8_t mine = dynamic[own];
  for (int j = 0; j < cameras; ++j) {
    const float* offset = offsets + kOffsets * (cameras * k + j);
    const RayShift shift = ray_shift(offset, d);
    const int column = x + whole_offset(ray_dx(shift, x, cx)), row = y + whole_offset(ray_dy(shift, y, cy));
    const bool there = mine != kNoRay && within(column, width) && within(row, height);
    const size_t at = j * pixels + (there ? static_cast<size_t>(row) * width + column : 0);
    const float apart = surfaces[at] - seen_disparity(offset, d);
    const uint8_t say = there && fabsf(apart) <= tolerance ? dynamic[at] : kNoSay;
    saw[own * cameras + j] = j == k ? mine : say;
  }
}

// Of every step-th pixel of saw: sums uint64 [2], zero before, of the least and the largest that the camera
// itself and another say. h, w: of those pixels.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    disagreement(const uint8_t* __restrict__ saw, int cameras, int height, int width, int step, int h, int w,
                 unsigned long long* __restrict__ sums) {
  const int i = blockIdx.x * kAcross + threadIdx.x, j = blockIdx.y * kDown + threadIdx.y, k = blockIdx.z;
  int low = 0, high = 0;
  if (i < w && j < h) {
    const uint8_t* says = saw + ((static_cast<size_t>(k) * height + j * step) * width + i * step) * cameras;
    const int own = says[k];
    for (int n = 0; n < cameras; ++n) {
      const int other = says[n];
      const bool both = n != k && own != kNoSay && other != kNoSay;
      low += both ? min(own, other) : 0;
      high += both ? max(own, other) : 0;
    }
  }
  low = warp_sum(low);
  high = warp_sum(high);
  if (threadIdx.x == 0 && high) {
    atomicAdd(&sums[0], static_cast<unsigned long long>(low));
    atomicAdd(&sums[1], static_cast<unsigned long long>(high));
  }
}

// out uint16 [K, h, w]: kUnknown on floors and ceilings, else 0.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    sloping(const float* __restrict__ surfaces, float least, int rows, int height, int width, int stride,
            uint16_t* __restrict__ out) {
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (!at.there) return;
  const int y = grid.image(at.j);
  const size_t away = static_cast<size_t>(rows) * width;
  const bool floor = y >= rows && y + rows < height &&
                     slopes(surfaces[at.image - away], surfaces[at.image], surfaces[at.image + away], least);
  out[at.lattice] = floor ? kUnknown : static_cast<uint16_t>(0);
}

// places float [9]: low, inverse and last of Cells; sums int64 [2, cells], zero before, without the pixels of
// floor; floor, mean uint16 [K, h, w].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    object_grid(const float* __restrict__ offsets, const float* __restrict__ centers,
                const uint8_t* __restrict__ saw, const float* __restrict__ surfaces,
                const float* __restrict__ places, int in_d, int in_y, int in_x, int reference, int cameras,
                int height, int width, int stride, const uint16_t* __restrict__ floor,
                uint16_t* __restrict__ mean, int64_t* __restrict__ sums) {
  const Cells cells{{places[0], places[1], places[2]},
                    {places[3], places[4], places[5]},
                    {places[6], places[7], places[8]},
                    {in_d, in_y, in_x}};
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  int cell = -1, value = 0;
  if (at.there) {
    const Pooled p = pooled(saw + at.image * cameras, cameras);
    value = p.n ? (kPooled * p.total + p.n / 2) / p.n : kUnknown;
    mean[at.lattice] = static_cast<uint16_t>(value);
    if (p.n && !floor[at.lattice]) {
      const GridPosition g =
          grid_position(offsets + kOffsets * (cameras * at.k + reference), centers[2 * at.k],
                        centers[2 * at.k + 1], cells, grid.image(at.i), grid.image(at.j), surfaces[at.image]);
      cell = static_cast<int>(
          cells.index(floor_int(g.at[0] + 0.5f), floor_int(g.at[1] + 0.5f), floor_int(g.at[2] + 0.5f)));
    }
  }
  // neighbours mostly share a cell: one atomic sum for all of a warp that do
  for (uint32_t rest = __ballot_sync(kAll, cell >= 0); rest;) {
    const int first = __shfl_sync(kAll, cell, __ffs(static_cast<int>(rest)) - 1);
    const uint32_t same = __ballot_sync(kAll, cell == first);
    const int sum = warp_sum(cell == first ? value : 0);
    if (threadIdx.x == 0) {
      add_long(&sums[first], sum);
      add_long(&sums[cells.index(in_d, 0, 0) + first], __popc(same));
    }
    rest &= ~same;
  }
}

// values float [2, cells]; share uint16 [K, h, w].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    object_slice(const float* __restrict__ offsets, const float* __restrict__ centers,
                 const float* __restrict__ values, const uint16_t* __restrict__ mean,
                 const float* __restrict__ surfaces, const float* __restrict__ places, int in_d, int in_y,
                 int in_x, int reference, int cameras, int height, int width, int stride,
                 uint16_t* __restrict__ share) {
  const Cells cells{{places[0], places[1], places[2]},
                    {places[3], places[4], places[5]},
                    {places[6], places[7], places[8]},
                    {in_d, in_y, in_x}};
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (!at.there) return;
  uint16_t found = kUnknown;
  if (mean[at.lattice] != kUnknown) {
    const GridPosition g =
        grid_position(offsets + kOffsets * (cameras * at.k + reference), centers[2 * at.k],
                      centers[2 * at.k + 1], cells, grid.image(at.i), grid.image(at.j), surfaces[at.image]);
    found = object_share(values, values + cells.index(in_d, 0, 0), cells, g);
  }
  share[at.lattice] = found;
}

// By share of every step-th lattice pixel: int64 [2, kShare + 1], zero before, how many, and the sum of mean.
// h, w: of the lattice; `wide`, `high`: of every step-th pixel.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    share_histograms(const uint16_t* __restrict__ share, const uint16_t* __restrict__ mean, int h, int w,
                     int step, int high, int wide, int64_t* __restrict__ bins) {
  const int i = blockIdx.x * kAcross + threadIdx.x, j = blockIdx.y * kDown + threadIdx.y;
  int bin = kUnknown, value = 0;
  if (i < wide && j < high) {
    const size_t at = (static_cast<size_t>(blockIdx.z) * h + j * step) * w + i * step;
    bin = share[at];
    value = mean[at];
  }
  const uint32_t some = __ballot_sync(kAll, bin != kUnknown);
  if (!some) return;
  // most have no share at all, in one bin: what the first of a warp has is summed up before
  const int first = __shfl_sync(kAll, bin, __ffs(static_cast<int>(some)) - 1);
  const uint32_t same = __ballot_sync(kAll, bin == first);
  const int sum = warp_sum(bin == first ? value : 0);
  if (threadIdx.x == 0) {
    add_long(&bins[first], __popc(same));
    add_long(&bins[kShare + 1 + first], sum);
  }
  if (bin == kUnknown || bin == first) return;
  add_long(&bins[bin], 1);
  add_long(&bins[kShare + 1 + bin], value);
}

// rank uint8 [kShare + 1]: how many of the T thresholds lie below a share. totals int64 [4, T + 1], zero
// before, are differences: their running sums are border_counts. Shared: 8 (T + 1) ints.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    border_counts(const uint16_t* __restrict__ share, const uint16_t* __restrict__ mean,
                  const float* __restrict__ surfaces, const uint8_t* __restrict__ rank, int thresholds,
                  float depth_step, int height, int width, int stride, int64_t* __restrict__ totals) {
  SEEPAST_SHARED(int, own);
  const int row = thresholds + 1, t = threadIdx.y * kAcross + threadIdx.x;
  for (int n = t; n < 4 * row; n += kAcross * kDown) own[n] = 0;
  __syncthreads();
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  const int mine = at.there ? share[at.lattice] : kUnknown;
  if (mine != kUnknown) {
    const int here = rank[mine], weight = mean[at.lattice];
    atomicAdd(&own[2 * row], weight);
    atomicAdd(&own[2 * row + here], -weight);
    atomicAdd(&own[3 * row], 1);
    atomicAdd(&own[3 * row + here], -1);
    for (int down = 0; down < 2; ++down) {
      if (down ? at.j + 1 >= grid.height : at.i + 1 >= grid.width) continue;
      const int other = share[at.lattice + (down ? grid.width : 1)];
      if (other == kUnknown) continue;
      const int there = rank[other], low = min(here, there), high = max(here, there);
      if (low == high) continue;
      const float d = surfaces[at.image],
                  e = surfaces[at.image + (down ? static_cast<size_t>(stride) * width : stride)];
      atomicAdd(&own[row + low], 1);
      atomicAdd(&own[row + high], -1);
      if ((here > there ? d - e : e - d) > depth_step) {
        atomicAdd(&own[low], 1);
        atomicAdd(&own[high], -1);
      }
    }
  }
  __syncthreads();
  for (int n = t; n < 4 * row; n += kAcross * kDown)
    if (own[n]) add_long(&totals[n], own[n]);
}

// Levels, uint8 [766] by the colour step, of pixels bool wanted [K, H, W] that some ray, uint16 [K, H, W],
// shows; colour, behind uint8 [K, H, W, 3]; out uint8 [K, H, W].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    surprises(const uint8_t* __restrict__ colour, const uint8_t* __restrict__ behind,
              const uint16_t* __restrict__ rays, const uint8_t* __restrict__ wanted,
              const uint8_t* __restrict__ levels, int height, int width, uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t at = (static_cast<size_t>(blockIdx.z) * height + y) * width + x;
  out[at] = wanted[at] && rays[at] ? levels[colour_step(colour + 3 * at, behind + 3 * at)] : kNoSay;
}

// surprise uint8 [K, H, W], sure int8 [K, h, w]; counts int64 [K, 2, kLevels], zero before.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    surprise_counts(const uint8_t* __restrict__ surprise, const int8_t* __restrict__ sure, int height,
                    int width, int stride, int64_t* __restrict__ counts) {
  __shared__ int own[2 * kLevels];  // of this camera
  const int t = threadIdx.y * kAcross + threadIdx.x;
  if (t < 2 * kLevels) own[t] = 0;
  __syncthreads();
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (at.there) {
    const int label = sure[at.lattice], level = surprise[at.image];
    if (label && level != kNoSay) atomicAdd(&own[(label > 0) * kLevels + level], 1);
  }
  __syncthreads();
  if (t < 2 * kLevels && own[t]) add_long(&counts[2 * kLevels * at.k + t], own[t]);
}

// person uint8 [K, h, w]; levels int64 [K, 2, kLevels], colours int64 [2, kColours], both zero before.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    histograms(const uint8_t* __restrict__ dynamic, const uint8_t* __restrict__ colour,
               const uint8_t* __restrict__ person, int channels, int height, int width, int stride,
               int64_t* __restrict__ levels, int64_t* __restrict__ colours) {
  __shared__ int own[2 * kLevels];  // of this camera
  const int t = threadIdx.y * kAcross + threadIdx.x;
  if (t < 2 * kLevels) own[t] = 0;
  __syncthreads();
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (at.there && dynamic[at.image] != kNoRay) {
    const int label = person[at.lattice];
    int c[3];
    bgr(colour + at.image * channels, channels, c);
    atomicAdd(&own[label * kLevels + (dynamic[at.image] >> 4)], 1);
    add_long(&colours[label * kColours + colour_bin(c)], 1);
  }
  __syncthreads();
  if (t < 2 * kLevels && own[t]) add_long(&levels[2 * kLevels * at.k + t], own[t]);
}

// A warp per block x block lattice pixels: blockIdx (column, row, camera) of them, 32 threads. sure int8 [K,
// h, w]; moments int32 [K, rows, columns, kMoments].
extern "C" __global__ void __launch_bounds__(32)
    colour_moments(const uint8_t* __restrict__ colour, const int8_t* __restrict__ sure, int channels,
                   int height, int width, int stride, int block, int32_t* __restrict__ moments) {
  const Lattice grid(height, width, stride);
  const int k = blockIdx.z, lane = threadIdx.x;
  int sums[kMoments] = {};
  for (int n = lane; n < block * block; n += 32) {
    const int j = blockIdx.y * block + n / block, i = blockIdx.x * block + n % block;
    if (j >= grid.height || i >= grid.width) continue;
    const int label = sure[(static_cast<size_t>(k) * grid.height + j) * grid.width + i];
    if (!label) continue;
    int c[3];
    bgr(colour + ((static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i)) * channels,
        channels, c);
    const int terms[10] = {1,           c[0],        c[1],        c[2],        c[0] * c[0],
                           c[0] * c[1], c[0] * c[2], c[1] * c[1], c[1] * c[2], c[2] * c[2]};
#pragma unroll
    for (int t = 0; t < 10; ++t) sums[t] += terms[t];
#pragma unroll
    for (int t = 0; t < 4; ++t) sums[10 + t] += label > 0 ? terms[t] : 0;
  }
  int mine = 0;
#pragma unroll
  for (int t = 0; t < kMoments; ++t) {
    const int sum = warp_sum(sums[t]);
    if (lane == t) mine = sum;
  }
  if (lane < kMoments)
    moments[((static_cast<size_t>(k) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x) * kMoments + lane] =
        mine;
}

// levels float [K, kLevels]; out float [K, h, w].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    log_odds(const uint8_t* __restrict__ saw, const float* __restrict__ levels, int cameras, int height,
             int width, int stride, float* __restrict__ out) {
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (!at.there) return;
  int n = 0;
  float total = 0;
  for (int j = 0; j < cameras; ++j) {
    const int say = saw[at.image * cameras + j];
    total += say != kNoSay ? levels[j * kLevels + (say >> 4)] : 0.0f;
    n += say != kNoSay;
  }
  out[at.lattice] = total * (1.0f / static_cast<float>(max(n, 1)));
}

// 1 where deep inside the region and said > least, -1 where well outside: int8 [count].
extern "C" __global__ void __launch_bounds__(256)
    sure_labels(const uint8_t* __restrict__ deep, const uint8_t* __restrict__ around,
                const float* __restrict__ said, float least, int count, int8_t* __restrict__ out) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i < count) out[i] = static_cast<int8_t>(!around[i] ? -1 : (deep[i] && said[i] > least));
}

// said float, u int16 [K, h, w]; sure int8 [K, sure_height, sure_width]. The local label is linear between
// four of blocks float4 [K, rows, columns]: of every row and column of the image the block before it, above
// int32 [H] and left [W], and the share of the next, down and right. Steps are added in one rounding, as
// OpenCV does. surprise uint8 [K, H, W], behind float [K, kLevels].
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    potentials(const float* __restrict__ said, const uint8_t* __restrict__ dynamic,
               const uint8_t* __restrict__ colour, const float* __restrict__ blocks,
               const int32_t* __restrict__ above, const float* __restrict__ down,
               const int32_t* __restrict__ left, const float* __restrict__ right,
               const int8_t* __restrict__ sure, const float* __restrict__ sure_terms,
               const uint8_t* __restrict__ surprise, const float* __restrict__ behind,
               const float* __restrict__ colours, float said_weight, float local_weight, int rows,
               int columns, int channels, int height, int width, int sure_height, int sure_width, int stride,
               int cell, int16_t* __restrict__ u) {
  const Lattice grid(height, width, stride);
  const Place at(grid, height, width);
  if (!at.there) return;
  const int y = grid.image(at.j), x = grid.image(at.i);
  const float4* upper = reinterpret_cast<const float4*>(blocks) + (at.k * rows + above[y]) * columns;
  const float4* lower = upper + (above[y] + 1 < rows ? columns : 0);
  const int first = left[x], next = min(first + 1, columns - 1);
  const float4 a = upper[first], b = upper[next], c = lower[first], d = lower[next];
  const auto between_four = [&](float a, float b, float c, float d) {
    const float high = fmaf(b - a, right[x], a), low = fmaf(d - c, right[x], c);
    return fmaf(low - high, down[y], high);
  };
  const float linear[4] = {between_four(a.x, b.x, c.x, d.x), between_four(a.y, b.y, c.y, d.y),
                           between_four(a.z, b.z, c.z, d.z), between_four(a.w, b.w, c.w, d.w)};
  int bgr_here[3];
  bgr(colour + at.image * channels, channels, bgr_here);
  const int row = min(at.j / cell, sure_height - 1), column = min(at.i / cell, sure_width - 1);
  const int label = sure[(static_cast<size_t>(at.k) * sure_height + row) * sure_width + column];
  const int level = surprise[at.image];
  const float unlike = level == kNoSay || label < 0 ? 0.0f : behind[at.k * kLevels + level];
  const int16_t found = potential_of(sure_terms[label + 1], said[at.lattice], local_of(linear, bgr_here),
                                     colours[colour_bin(bgr_here)], unlike, said_weight, local_weight);
  u[at.lattice] = dynamic[at.image] == kNoRay ? static_cast<int16_t>(0) : found;
}

// belief int16, dynamic, out uint8 [K, H, W]; table uint8 [256]: host_people.probability.
extern "C" __global__ void __launch_bounds__(kAcross* kDown)
    probability(const int16_t* __restrict__ belief, const uint8_t* __restrict__ dynamic,
                const uint8_t* __restrict__ table, int height, int width, int grow,
                uint8_t* __restrict__ out) {
  const int x = blockIdx.x * kAcross + threadIdx.x, y = blockIdx.y * kDown + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t at = (static_cast<size_t>(blockIdx.z) * height + y) * width + x;
  const auto of = [&](size_t pixel) {
    return static_cast<int>(table[clamp((belief[pixel] - 1) >> 6, -128, 127) + 128]);
  };
  int p = of(at);
  if (grow) {
    if (x > 0) p = max(p, of(at - 1));
    if (x + 1 < width) p = max(p, of(at + 1));
    if (y > 0) p = max(p, of(at - width));
    if (y + 1 < height) p = max(p, of(at + width));
  }
  out[at] = dynamic[at] == kNoRay ? kNoRay : static_cast<uint8_t>(p);
}
