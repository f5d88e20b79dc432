// Stage "segmentation", the E-step: argmin over the 2^K label sets S of beta Var_S - sum_k log p(S^k |
// S_P^k).
//
// As in cpp/segmentation.cpp: the set S_0 of every ray's cheaper label has the least prior cost, so a ray
// whose dearer label costs more than S_0's whole data term never flips. Kernel `segmentation` settles the
// pixels where none can, most of them, with one thread each; the few others go on a list, and `flips` gives a
// warp to each.
#include "rays.h"

using namespace seepast;

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarps = 4;  // of a block of `flips`

struct Camera {
  QuarterPosition at;
  int p;  // kNoRay: no ray
};

// Where camera k is looked at, and its prior there.
static __device__ Camera camera_of(const float* offset, float cx, float cy, const uint8_t* dynamic,
                                   int height, int width, int x, int y, float d) {
  Camera c;
  c.at = quarter_position(offset, cx, cy, x, y, d);
  c.p = kNoRay;
  if (!inside(c.at.xq, c.at.row, width, height)) return c;
  const uint8_t* prior = dynamic + static_cast<size_t>(c.at.row) * width + (c.at.xq >> 2);
  c.p = prior[0];
  if (c.at.xq & 3) c.p = max(c.p, static_cast<int>(prior[1]));
  return c;
}

// 1024ths of a nat; `spread` = n sum f^2 - (sum f)^2 of a set of n rays. In the order of
// cpp/segmentation.cpp.
static __device__ double data_energy(double beta, double lone_variance, int spread, int n) {
  const double variance = n > 1 ? spread * (1.0 / (n * n)) : lone_variance;
  return beta * variance;
}

// One thread per pixel, blocks of 32 x 8.
//   descriptors [K, H, W] of 16 bytes; dynamic [K, H, W]; offsets [K, kOffsets]; d, wanted [H, W]
//   costs int32 [2, 255]: of calling a ray dynamic, static
// labels uint16 [H, W], posterior uint8 [K, H, W]; hard int32 [H W], the pixels for `flips`, as many as
// `hard_count` says, which is zero before.
extern "C" __global__ void __launch_bounds__(256)
    segmentation(const uint4* __restrict__ descriptors, const uint8_t* __restrict__ dynamic,
                 const float* __restrict__ offsets, int cameras, int height, int width, float cx, float cy,
                 const float* __restrict__ d, const uint8_t* __restrict__ wanted, double beta,
                 double lone_variance, const int32_t* __restrict__ costs, uint16_t* __restrict__ labels,
                 uint8_t* __restrict__ posterior, int32_t* __restrict__ hard,
                 int32_t* __restrict__ hard_count) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y;
  if (x >= width || y >= height) return;
  const size_t pixels = static_cast<size_t>(height) * width;
  const int at = y * width + x;
  for (int k = 0; k < cameras; ++k) posterior[k * pixels + at] = kUnchanged;
  if (!wanted[at]) {
    labels[at] = 0;
    return;
  }
  Spread spread;
  int set = 0, least = 0x7fffffff;  // what the cheapest other label costs on top
  bool sides_differ = false;        // of the label and its prior
  for (int k = 0; k < cameras; ++k) {
    const Camera c =
        camera_of(offsets + kOffsets * k, cx, cy, dynamic + k * pixels, height, width, x, y, d[at]);
    if (c.p == kNoRay) continue;
    const int dearer = costs[c.p] - costs[255 + c.p];
    const bool is_static = dearer > 0;
    least = min(least, abs(dearer));
    sides_differ |= is_static != (c.p < 127);
    if (!is_static) continue;
    set |= 1 << k;
    spread.add(samples_at(descriptors + k * pixels, width, c.at));
  }
  labels[at] = static_cast<uint16_t>(set);
  if (sides_differ || least <= data_energy(beta, lone_variance, spread.of_pairs(), spread.n))
    hard[atomicAdd(hard_count, 1)] = at;
}

// The rays of one reference pixel.
struct Rays {
  uint32_t f[kMaxCameras][4];  // descriptors
  int distance[kMaxCameras][kMaxCameras + 1];
  int cost[2][kMaxCameras];
  uint8_t p[kMaxCameras];
};

static __device__ int lowest_bit(uint32_t set) { return __ffs(static_cast<int>(set)) - 1; }

static __device__ int spread_to(const Rays& rays, uint32_t set, int k) {
  int sum = 0;
  for (uint32_t rest = set; rest; rest &= rest - 1) sum += rays.distance[k][lowest_bit(rest)];
  return sum;
}

static __device__ int spread_of(const Rays& rays, uint32_t set) {
  int sum = 0;
  for (uint32_t rest = set; rest; rest &= rest - 1)
    sum += spread_to(rays, rest & (rest - 1), lowest_bit(rest));
  return sum;
}

static __device__ int prior_of(const Rays& rays, uint32_t exist, uint32_t set) {
  int sum = 0;
  for (uint32_t rest = exist; rest; rest &= rest - 1)
    sum += rays.cost[set >> lowest_bit(rest) & 1][lowest_bit(rest)];
  return sum;
}

// A set's energy; of two alike the smaller set number goes first.
struct Energy {
  double value;
  uint32_t set;
  __device__ bool beats(const Energy& other) const {
    return value < other.value || (value == other.value && set < other.set);
  }
};

static __device__ Energy energy_of(const Rays& rays, uint32_t exist, uint32_t set, double beta,
                                   double lone_variance) {
  return {data_energy(beta, lone_variance, spread_of(rays, set), __popc(set)) +
              static_cast<double>(prior_of(rays, exist, set)),
          set};
}

// `set` with the rays of `flips` that the bits of `number` name flipped.
static __device__ uint32_t with_flips(uint32_t set, uint32_t flips, uint32_t number) {
  for (; number; number >>= 1, flips &= flips - 1)
    if (number & 1) set ^= flips & (0 - flips);
  return set;
}

// The best of `start` with any of `flips` flipped. A lane takes its number for five of the flips, the last,
// and goes through the others in Gray-code order, one ray at a time.
static __device__ uint32_t best_set(const Rays& rays, uint32_t exist, uint32_t start, uint32_t flips,
                                    double beta, double lone_variance) {
  const int m = __popc(flips), own = max(0, m - 5);  // flips that a lane goes through itself
  uint32_t mine = 0, lanes = flips;
  for (int j = 0; j < own; ++j) mine |= lanes & (0 - lanes), lanes &= lanes - 1;
  uint32_t set = with_flips(start, lanes, threadIdx.x & ((1u << (m - own)) - 1));
  Energy best = energy_of(rays, exist, set, beta, lone_variance);
  int spread = spread_of(rays, set), prior = prior_of(rays, exist, set);
  for (uint32_t step = 1; step < 1u << own; ++step) {
    uint32_t bit = mine;
    for (int skip = lowest_bit(step); skip > 0; --skip) bit &= bit - 1;
    const int k = lowest_bit(bit);
    bit = 1u << k;
    const bool leaves = set & bit;
    set ^= bit;
    const int change = spread_to(rays, set & ~bit, k), dearer = rays.cost[0][k] - rays.cost[1][k];
    spread += leaves ? -change : change;
    prior += leaves ? dearer : -dearer;
    const Energy energy{data_energy(beta, lone_variance, spread, __popc(set)) + static_cast<double>(prior),
                        set};
    if (energy.beats(best)) best = energy;
  }
  for (int step = 16; step > 0; step /= 2) {
    const Energy other{__shfl_xor_sync(kAllLanes, best.value, step),
                       __shfl_xor_sync(kAllLanes, best.set, step)};
    if (other.beats(best)) best = other;
  }
  return best.set;
}

// Fills `rays` with those of a pixel, one per lane, then the squared distances of all pairs. Returns which
// exist.
static __device__ uint32_t gather(const uint4* descriptors, const uint8_t* dynamic, const float* offsets,
                                  int cameras, int height, int width, float cx, float cy, int x, int y,
                                  float d, const int32_t* costs, Rays& rays) {
  const int k = threadIdx.x;
  const size_t pixels = static_cast<size_t>(height) * width;
  bool exists = false;
  if (k < cameras) {
    const Camera c = camera_of(offsets + kOffsets * k, cx, cy, dynamic + k * pixels, height, width, x, y, d);
    exists = c.p != kNoRay;
    rays.p[k] = static_cast<uint8_t>(c.p);
    if (exists) {
      rays.cost[0][k] = costs[c.p];
      rays.cost[1][k] = costs[255 + c.p];
      const Samples s = samples_at(descriptors + k * pixels, width, c.at);
      for (int j = 0; j < 4; ++j) rays.f[k][j] = s.pairs[2 * j] | s.pairs[2 * j + 1] << 8;
    }
  }
  const uint32_t exist = __ballot_sync(kAllLanes, exists);
  __syncwarp(kAllLanes);  // a ballot alone does not order memory
  for (int pair = threadIdx.x; pair < cameras * cameras; pair += 32) {
    const int i = pair / cameras, j = pair % cameras;
    if (j >= i || !(exist >> i & exist >> j & 1)) continue;
    unsigned sum = 0;
    for (int w = 0; w < 4; ++w) {
      const unsigned difference = __vabsdiffu4(rays.f[i][w], rays.f[j][w]);
      sum = __dp4a(difference, difference, sum);
    }
    rays.distance[i][j] = rays.distance[j][i] = static_cast<int>(sum);
  }
  __syncwarp(kAllLanes);
  return exist;
}

// One warp per pixel of `hard` of kernel `segmentation`, blocks of 32 x 4 threads, any number of them.
// table: the posterior by 1 / scale of energy, [2 reach + 1]. The rest as there.
extern "C" __global__ void __launch_bounds__(32 * kWarps, 8)
    flips(const uint4* __restrict__ descriptors, const uint8_t* __restrict__ dynamic,
          const float* __restrict__ offsets, int cameras, int height, int width, float cx, float cy,
          const float* __restrict__ d, double beta, double lone_variance, const int32_t* __restrict__ costs,
          const uint8_t* __restrict__ table, int reach, double scale, const int32_t* __restrict__ hard,
          const int32_t* __restrict__ hard_count, uint16_t* __restrict__ labels,
          uint8_t* __restrict__ posterior) {
  __shared__ Rays all_rays[kWarps];
  Rays& rays = all_rays[threadIdx.y];
  const size_t pixels = static_cast<size_t>(height) * width;
  const int count = *hard_count;
  for (int n = blockIdx.x * kWarps + threadIdx.y; n < count; n += gridDim.x * kWarps) {
    const int at = hard[n], k = threadIdx.x;
    const uint32_t exist = gather(descriptors, dynamic, offsets, cameras, height, width, cx, cy, at % width,
                                  at / width, d[at], costs, rays);
    const bool mine = exist >> k & 1;
    const int dearer = mine ? rays.cost[0][k] - rays.cost[1][k] : 0;
    uint32_t set = __ballot_sync(kAllLanes, dearer > 0);
    const double slack = data_energy(beta, lone_variance, spread_of(rays, set), __popc(set));
    const uint32_t may_flip = __ballot_sync(kAllLanes, mine && abs(dearer) <= slack);
    if (may_flip) set = best_set(rays, exist, set, may_flip, beta, lone_variance);
    if (k == 0) labels[at] = static_cast<uint16_t>(set);
    if (mine && (set >> k & 1) != (rays.p[k] < 127)) {
      const uint32_t bit = 1u << k;
      const double gain = energy_of(rays, exist, set & ~bit, beta, lone_variance).value -
                          energy_of(rays, exist, set | bit, beta, lone_variance).value;
      const double fine = floor(gain * scale + 0.5), most = reach;
      const double index = fine < -most ? -most : (fine > most ? most : fine);
      posterior[k * pixels + at] = table[static_cast<int>(index) + reach];
    }
    __syncwarp(kAllLanes);  // before the next pixel's rays come in the place of these
  }
}
