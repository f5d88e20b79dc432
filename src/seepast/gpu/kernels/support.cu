// Stage "support": textured, unique, left-right consistent matches of grid points between neighbouring
// cameras, refined over all static rays, in the reference. One warp per point.
#include "grid.h"
#include "rays.h"

using namespace seepast;

constexpr int kMargin = 5;  // reference.py SUPPORT_MARGIN
constexpr int kNoMatch = 1 << 20;
constexpr int kNone = 0x7fffffff;
constexpr int kInfinity = 0x7f800000;  // bits of the float
constexpr int kPoints = 4;             // of a block: warps
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr uint64_t kNoPoint = ~0ull;

// All cameras, as seen from one of them.
struct View {
  const float* offsets;  // [K, kOffsets]
  float cx, cy;
};

struct Point {
  int x, y;
};

static __device__ Point landing(const View& view, int camera, Point p, float d) {
  const RayShift shift = ray_shift(view.offsets + kOffsets * camera, d);
  return {p.x + whole_offset(ray_dx(shift, p.x, view.cx)), p.y + whole_offset(ray_dy(shift, p.y, view.cy))};
}

static __device__ bool within_margin(Point p, int width, int height) {
  return p.x >= kMargin && p.x < width - kMargin && p.y >= kMargin && p.y < height - kMargin;
}

static __device__ unsigned difference(const uint4& a, const uint4& b, unsigned sum) {
  constexpr unsigned kOnes = 0x01010101u;
  sum = __dp4a(__vabsdiffu4(a.x, b.x), kOnes, sum);
  sum = __dp4a(__vabsdiffu4(a.y, b.y), kOnes, sum);
  sum = __dp4a(__vabsdiffu4(a.z, b.z), kOnes, sum);
  return __dp4a(__vabsdiffu4(a.w, b.w), kOnes, sum);
}

static __device__ int texture(const uint4& descriptor) {
  constexpr unsigned kFlat = 0x80808080u;
  return static_cast<int>(difference(descriptor, make_uint4(kFlat, kFlat, kFlat, kFlat), 0));
}

// One direction of matching: candidates d = first + step * i, i < count, of points of `view` in `camera`.
struct Search {
  View view;
  int camera, count;
  float first, step;
  const uint4 *from, *to;
  const uint8_t* clear;  // of `camera`
};

struct Sureness {
  float uniqueness, max_cost;
};

// The lowest of all lanes' values, and the least index that has it.
static __device__ void lowest_of_warp(int& lowest, int& index) {
  int least = lowest;
  for (int step = 16; step > 0; step /= 2) least = min(least, __shfl_xor_sync(kAllLanes, least, step));
  index = lowest == least ? index : kNone;
  lowest = least;
  for (int step = 16; step > 0; step /= 2) index = min(index, __shfl_xor_sync(kAllLanes, index, step));
}

// Index of the best candidate, or -1 if it is not sure; the same in all lanes. A lane has every 32nd
// candidate, so that of the best and the two beside it, which do not compete with it, no two are of one lane.
static __device__ int best_match(const Search& search, Point p, int height, int width, Sureness need) {
  uint4 here[4];
  const int corner[4] = {-2 * width - 2, -2 * width + 2, 2 * width - 2, 2 * width + 2};
  const uint4* own = search.from + (p.y * width + p.x);
  for (int j = 0; j < 4; ++j) here[j] = own[corner[j]];
  int lowest = kNone, index = kNone, second = kNoMatch;
  for (int i = threadIdx.x; i < search.count; i += 32) {
    const Point q =
        landing(search.view, search.camera, p, search.first + search.step * static_cast<float>(i));
    int cost = kNoMatch;
    if (within_margin(q, width, height)) {
      const int at = q.y * width + q.x;
      if (search.clear[at]) {
        unsigned sum = 0;
        for (int j = 0; j < 4; ++j) sum = difference(here[j], search.to[at + corner[j]], sum);
        cost = static_cast<int>(sum);
      }
    }
    second = min(second, max(cost, lowest));
    if (cost < lowest) lowest = cost, index = i;
  }
  int best = index, least = lowest;
  lowest_of_warp(least, best);
  int other = abs(index - best) > 1 ? lowest : second;
  for (int step = 16; step > 0; step /= 2) other = min(other, __shfl_xor_sync(kAllLanes, other, step));
  const bool sure = static_cast<float>(least) < need.uniqueness * static_cast<float>(min(other, kNoMatch)) &&
                    static_cast<float>(least) <= need.max_cost;
  return sure ? best : -1;
}

// Var_S of the static rays' descriptors at one disparity; infinite with fewer than two.
static __device__ float ray_variance(const View& view, const uint4* descriptors, const uint8_t* clear,
                                     int cameras, int height, int width, Point p, float d) {
  const size_t pixels = static_cast<size_t>(height) * width;
  Spread spread;
  for (int k = 0; k < cameras; ++k) {
    const QuarterPosition q = quarter_position(view.offsets + kOffsets * k, view.cx, view.cy, p.x, p.y, d);
    if (!inside(q.xq, q.row, width, height)) continue;
    const uint8_t* label = clear + k * pixels + static_cast<size_t>(q.row) * width + (q.xq >> 2);
    if (!label[0] || ((q.xq & 3) && !label[1])) continue;
    spread.add(samples_at(descriptors + k * pixels, width, q));
  }
  if (spread.n < 2) return __int_as_float(kInfinity);
  const float inverse = 1.0f / static_cast<float>(spread.n);
  return static_cast<float>(spread.of_pairs()) * (inverse * inverse);
}

// A point's bits: variances are not negative, so that their bits are ordered as they are; then the order of
// finding.
static __device__ uint64_t rank(float variance, unsigned order) {
  return static_cast<uint64_t>(__float_as_uint(variance)) << 32 | order;
}

// Where points of other cameras are of use in the reference: where it is blind. seeing [H, W]: pixels that it
// sees, as all others within `reach` px, at least 3.
struct Targets {
  const uint8_t* seeing;
  int reach, height, width;

  __device__ bool near(int x, int y) const {
    return !seeing[clamp(y, 0, height - 1) * width + clamp(x, 0, width - 1)];
  }
  // False only if no disparity between the two takes the point of the view there; the same in all lanes. On
  // its way it is looked for every so many pixels, two less than the reach, which rounding may take.
  __device__ bool reachable(const View& view, int reference, Point p, float farthest, float nearest) const {
    const Point a = landing(view, reference, p, farthest), b = landing(view, reference, p, nearest);
    if (abs(b.y - a.y) > reach - 2) return true;  // too crooked an array to say from one row
    const int first = min(a.x, b.x), last = max(a.x, b.x);
    bool found = false;
    for (int x = first + static_cast<int>(threadIdx.x) * (reach - 2); x < last + reach - 2;
         x += 32 * (reach - 2))
      found |= near(min(x, last), (a.y + b.y) / 2);
    return __any_sync(kAllLanes, found);
  }
};

// Blocks of 32 x 4 threads: four grid points in a row of camera blockIdx.z.
//   descriptors [K, H, W] of 16 bytes; clear, is_static [K, H, W]; near [H, W], or anything if not use_near
//   seeing, reach: of Targets
//   offsets [K, K, 5] and centers [K, 2]: the array as seen from every camera
//   pairs int32 [K, 4]: the neighbour, candidates there and back, steps of refinement either way
//   spacing [K, 2] px of the candidates there and back; disparities are (first + i * step) / 8, i < count
// Out: found [K, rows, columns] of (x, y, d, -) in the reference, where there is a point, and per bin of
// `grid` px of the reference the least rank of its points, bins [rows, columns], which the caller fills with
// ones.
extern "C" __global__ void __launch_bounds__(32 * kPoints)
    support(const uint4* __restrict__ descriptors, const uint8_t* __restrict__ clear,
            const uint8_t* __restrict__ is_static, const uint8_t* __restrict__ near, int use_near,
            const uint8_t* __restrict__ seeing, int reach, const float* __restrict__ offsets,
            const float* __restrict__ centers, const int32_t* __restrict__ pairs,
            const float* __restrict__ spacing, int cameras, int height, int width, int reference, int grid,
            int rows, int columns, int texture_needed, int left_right, float uniqueness, float max_cost,
            int first, int step, int count, float4* __restrict__ found,
            unsigned long long* __restrict__ bins) {
  const int base = blockIdx.z, i = blockIdx.x * kPoints + threadIdx.y, j = blockIdx.y;
  const Point p{i * grid, j * grid};
  if (i >= columns || !within_margin(p, width, height)) return;
  const size_t pixels = static_cast<size_t>(height) * width, at = static_cast<size_t>(p.y) * width + p.x;
  const uint4* own = descriptors + base * pixels;
  if (!clear[base * pixels + at] || texture(own[at]) < texture_needed) return;
  if (use_near && base == reference && !near[at]) return;
  const View view{offsets + base * cameras * kOffsets, centers[2 * base], centers[2 * base + 1]};
  const Grid disparities{first, step, count};
  const Targets targets{seeing, reach, height, width};
  if (base != reference &&
      !targets.reachable(view, reference, p, disparities.value(0), disparities.value(count - 1)))
    return;
  const int partner = pairs[4 * base], refinements = pairs[4 * base + 3];
  const float farthest = static_cast<float>(first) / 8.0f;
  const Sureness need{uniqueness, max_cost};
  const View back_view{offsets + partner * cameras * kOffsets, centers[2 * partner],
                       centers[2 * partner + 1]};
  const uint4* theirs = descriptors + partner * pixels;

  const Search forth{view, partner, pairs[4 * base + 1],     farthest, spacing[2 * base],
                     own,  theirs,  clear + partner * pixels};
  const int there = best_match(forth, p, height, width, need);
  if (there < 0) return;
  const float matched = farthest + forth.step * static_cast<float>(there);
  // what refinement chooses from: the candidates of the grid near that
  const int nearest =
      floor_int((matched * 8.0f - static_cast<float>(first)) / static_cast<float>(step) + 0.5f);
  const int low = clamp(nearest - refinements, 0, count - 1),
            high = clamp(nearest + refinements, 0, count - 1);
  if (base != reference &&
      !targets.reachable(view, reference, p, disparities.value(low), disparities.value(high)))
    return;
  const Point q = landing(view, partner, p, matched);
  const Search back{back_view, base, pairs[4 * base + 2],  farthest, spacing[2 * base + 1],
                    theirs,    own,  clear + base * pixels};
  const int again = best_match(back, q, height, width, need);
  if (again < 0) return;
  const Point home = landing(back_view, base, q, farthest + back.step * static_cast<float>(again));
  if (abs(home.x - p.x) > left_right) return;

  int best = kNone,
      lowest = kInfinity;  // that of least variance over all static rays, the farthest of equals
  for (int c = low + static_cast<int>(threadIdx.x); c <= high; c += 32) {
    const int variance = __float_as_int(
        ray_variance(view, descriptors, clear, cameras, height, width, p, disparities.value(c)));
    if (variance < lowest) lowest = variance, best = c;
  }
  lowest_of_warp(lowest, best);
  if (threadIdx.x != 0) return;
  if (best == kNone) best = clamp(nearest, 0, count - 1);
  float d = disparities.value(best);
  Point in_reference = p;
  if (base != reference) {  // only where the reference is blind
    in_reference = landing(view, reference, p, d);
    d = d / (1.0f - d * view.offsets[kOffsets * reference + 2]);
    if (in_reference.x < 0 || in_reference.x >= width || in_reference.y < 0 || in_reference.y >= height)
      return;
    const size_t to = static_cast<size_t>(in_reference.y) * width + in_reference.x;
    if (is_static[reference * pixels + to]) return;
  }
  const unsigned order = (base * rows + j) * columns + i;
  found[order] = make_float4(static_cast<float>(in_reference.x), static_cast<float>(in_reference.y), d, 0.0f);
  atomicMin(bins + (in_reference.y / grid) * columns + in_reference.x / grid,
            static_cast<unsigned long long>(rank(__int_as_float(lowest), order)));
}

// Drops points that too few of the bins within `reach` agree with: kept [rows, columns, 3] of (x, y, d), x <
// 0 where there is none. Blocks of 32 x 8.
extern "C" __global__ void __launch_bounds__(256)
    consistent(const float4* __restrict__ found, const unsigned long long* __restrict__ bins, int rows,
               int columns, int reach, float similar, int min_agreeing, float* __restrict__ kept) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= columns || y >= rows) return;
  const int bin = y * columns + x;
  int agreeing = -1;  // a point agrees with itself
  float4 own = make_float4(-1.0f, -1.0f, 0.0f, 0.0f);
  if (bins[bin] != kNoPoint) {
    own = found[static_cast<uint32_t>(bins[bin])];
    for (int j = max(0, y - reach); j <= min(rows - 1, y + reach); ++j)
      for (int i = max(0, x - reach); i <= min(columns - 1, x + reach); ++i) {
        const unsigned long long other = bins[j * columns + i];
        if (other != kNoPoint && fabsf(found[static_cast<uint32_t>(other)].z - own.z) <= similar) ++agreeing;
      }
  }
  kept[3 * bin] = agreeing >= min_agreeing ? own.x : -1.0f;
  kept[3 * bin + 1] = own.y;
  kept[3 * bin + 2] = own.z;
}
