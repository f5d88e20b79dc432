// The subset of CUDA that the kernels use, on the CPU: one fiber per CUDA thread, switched at barriers only, always in
// the same order. Kernels that never wait run as a plain loop over the threads, on one fiber.
#pragma once

#include <csetjmp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <cmath>
#include <ucontext.h>
#include <type_traits>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __constant__ static
#define __shared__ static
#define __forceinline__ inline __attribute__((always_inline))
#define __noinline__ __attribute__((noinline))
#define __launch_bounds__(...)
#define __restrict__ __restrict
#define __align__(n) __attribute__((aligned(n)))

struct uint3 { unsigned x, y, z; };
struct dim3 { unsigned x, y, z; };
struct uchar2 { uint8_t x, y; };
struct uchar4 { uint8_t x, y, z, w; };
struct ushort2 { uint16_t x, y; };
struct ushort4 { uint16_t x, y, z, w; };
struct short2 { int16_t x, y; };
struct int2 { int x, y; };
struct alignas(16) int4 { int x, y, z, w; };
struct alignas(8) uint2 { unsigned x, y; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
struct alignas(8) float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline uchar4 make_uchar4(uint8_t x, uint8_t y, uint8_t z, uint8_t w) { return {x, y, z, w}; }
inline int2 make_int2(int x, int y) { return {x, y}; }
inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

inline uint3 threadIdx, blockIdx;
inline dim3 blockDim, gridDim;
constexpr int warpSize = 32;

namespace emulated {

constexpr size_t kStack = 256 << 10;

struct Fiber {
  ucontext_t start;
  jmp_buf place;
  uint3 thread;
  bool waits = false, fresh = true;
  void* stack = nullptr;
};

// Threads of `size` wait until all of them have arrived.
struct Barrier {
  int arrived = 0;
  unsigned round = 0;
};

struct Block {
  std::vector<Fiber*> running, idle;
  std::vector<Barrier> barriers;  // 0: the block's; then 32 per warp, by the first lane of the mask
  std::vector<uint64_t> slots;    // two per thread: what shuffles exchange
  std::vector<unsigned> exchanges;  // per thread: so far
  unsigned next = 0, count = 0;
  bool moved = false, backwards = false;
  const char* fault = nullptr;
  void (*body)(void*) = nullptr;
  void* arguments = nullptr;
  Fiber* now = nullptr;
  jmp_buf scheduler;
  std::vector<unsigned char> shared;
};

inline Block g_block;

inline void* shared() {
  return reinterpret_cast<void*>((reinterpret_cast<uintptr_t>(g_block.shared.data()) + 127) & ~uintptr_t{127});
}

inline unsigned flat(const uint3& t) { return t.x + blockDim.x * (t.y + blockDim.y * t.z); }
inline unsigned lane() { return flat(threadIdx) % 32; }

inline uint3 unflat(unsigned n) { return {n % blockDim.x, n / blockDim.x % blockDim.y, n / (blockDim.x * blockDim.y)}; }

// A fiber works threads off as long as there are any; it only leaves in a barrier, and when nothing is left.
inline void work() {
  for (;;) {
    Block& b = g_block;
    while (b.next < b.count) {
      const unsigned turn = b.next++;
      threadIdx = unflat(b.backwards ? b.count - 1 - turn : turn);
      b.moved = true;
      b.body(b.arguments);
    }
    b.now->waits = false;
    b.now->thread = {~0u, 0, 0};
    if (!_setjmp(b.now->place)) _longjmp(b.scheduler, 1);
  }
}

inline __attribute__((noinline)) void resume(Fiber* fiber) {
  Block& b = g_block;
  b.now = fiber;
  if (_setjmp(b.scheduler)) return;
  if (!fiber->fresh) {
    threadIdx = fiber->thread;
    _longjmp(fiber->place, 1);
  }
  fiber->fresh = false;
  getcontext(&fiber->start);
  fiber->stack = std::malloc(kStack);
  fiber->start.uc_stack.ss_sp = fiber->stack;
  fiber->start.uc_stack.ss_size = kStack;
  fiber->start.uc_link = nullptr;
  makecontext(&fiber->start, work, 0);
  setcontext(&fiber->start);
}

inline __attribute__((noinline)) void leave() {
  Block& b = g_block;
  b.now->thread = threadIdx;
  b.now->waits = true;
  if (!_setjmp(b.now->place)) _longjmp(b.scheduler, 1);
  asm volatile("" ::: "memory");
}

inline __attribute__((noinline)) void wait(Barrier& barrier, int size) {
  const unsigned round = barrier.round;
  g_block.moved = true;
  if (++barrier.arrived == size) {
    barrier.arrived = 0;
    ++barrier.round;
    asm volatile("" ::: "memory");
    return;
  }
  do leave();
  while (barrier.round == round);
  g_block.moved = true;
}

inline void run_block() {
  Block& b = g_block;
  b.next = 0;
  b.running.clear();
  b.barriers.assign(1 + (b.count + 31) / 32 * 32, Barrier{});
  b.slots.assign(2 * b.count, 0);
  b.exchanges.assign(b.count, 0);
  while (b.next < b.count) {  // every thread as far as it gets
    if (b.idle.empty()) b.idle.push_back(new Fiber);
    Fiber* fiber = b.idle.back();
    b.idle.pop_back();
    resume(fiber);
    (fiber->waits ? b.running : b.idle).push_back(fiber);
  }
  while (!b.running.empty()) {
    b.moved = false;
    std::vector<Fiber*> still;
    for (Fiber* fiber : b.running) {
      resume(fiber);
      (fiber->waits ? still : b.idle).push_back(fiber);
      if (!fiber->waits) b.moved = true;
    }
    b.running.swap(still);
    if (!b.moved) {
      b.fault = "threads of a block wait for others that do not come";
      for (Fiber* fiber : b.running) {
        std::free(fiber->stack);
        delete fiber;
      }
      b.running.clear();
    }
  }
}

inline Barrier& warp_barrier(unsigned mask) {
  return g_block.barriers[1 + flat(threadIdx) / 32 * 32 + __builtin_ctz(mask)];
}

// Lanes of the warp that exist and take part.
inline unsigned present(unsigned mask) {
  const unsigned first = flat(threadIdx) / 32 * 32, have = g_block.count - first;
  return have >= 32 ? mask : mask & ((1u << have) - 1);
}

// All lanes of `mask` give `value` and then may read those of the others: pointer to lane 0's, 2 slots apart.
inline const uint64_t* exchange(unsigned mask, uint64_t value) {
  const unsigned me = flat(threadIdx), half = g_block.exchanges[me]++ & 1;
  if (!(mask >> (me % 32) & 1)) g_block.fault = "a lane calls a warp function with a mask that leaves it out";
  mask = present(mask);
  g_block.slots[2 * me + half] = value;
  wait(warp_barrier(mask), __builtin_popcount(mask));
  return &g_block.slots[2 * (me / 32 * 32) + half];
}

template <typename T>
uint64_t packed(T value) {
  static_assert(sizeof(T) <= 8, "shuffles move up to 8 bytes");
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof(T));
  return bits;
}

template <typename T>
T shuffle(unsigned mask, T value, int width, int from, bool valid) {
  const uint64_t* lanes = exchange(mask, packed(value));
  if (!valid) return value;
  const int source = static_cast<int>(lane()) / width * width + from;
  if (!(present(mask) >> source & 1)) return value;
  std::memcpy(&value, lanes + 2 * source, sizeof(T));
  return value;
}

template <typename P>
const char* type_of() {
  using T = std::remove_cv_t<std::remove_pointer_t<P>>;
  constexpr bool pointer = std::is_pointer_v<P>;
  const char* kind = std::is_floating_point_v<T> ? "f" : std::is_same_v<T, bool> ? "b"
                     : std::is_integral_v<T>     ? (std::is_signed_v<T> ? "i" : "u")
                                                 : "V";
  static char text[16];
  std::snprintf(text, sizeof text, "%s%s%zu ", pointer ? "*" : "", kind, sizeof(T));
  return text;
}

template <typename... P>
struct Kernel {
  void (*function)(P...);
  void** arguments;
  template <size_t... I>
  void call(std::index_sequence<I...>) const {
    function(*static_cast<std::remove_reference_t<P>*>(arguments[I])...);
  }
  static void body(void* self) { static_cast<Kernel*>(self)->call(std::index_sequence_for<P...>{}); }
};

template <typename... P>
const char* launch(void (*function)(P...), const unsigned* grid, const unsigned* block, unsigned shared_bytes,
                   int backwards, void** arguments) {
  Kernel<P...> kernel{function, arguments};
  Block& b = g_block;
  gridDim = {grid[0], grid[1], grid[2]};
  blockDim = {block[0], block[1], block[2]};
  b.count = block[0] * block[1] * block[2];
  b.body = Kernel<P...>::body;
  b.arguments = &kernel;
  b.backwards = backwards != 0;
  b.fault = nullptr;
  for (unsigned z = 0; z < grid[2] && !b.fault; ++z)
    for (unsigned y = 0; y < grid[1] && !b.fault; ++y)
      for (unsigned x = 0; x < grid[0] && !b.fault; ++x) {
        blockIdx = {x, y, z};
        b.shared.assign(shared_bytes + 128, 0xcd);
        run_block();
      }
  return b.fault;
}

template <typename... P>
const char* types(void (*)(P...)) {
  static char text[2048];
  text[0] = 0;
  (std::strcat(text, type_of<P>()), ...);
  return text;
}

}  // namespace emulated

// One per kernel, written by the tests' Python.
#define SEEPAST_EMULATED(name)                                                                              \
  extern "C" const char* seepast_launch_##name(const unsigned* grid, const unsigned* block, unsigned bytes, \
                                               int backwards, void** arguments) {                           \
    return emulated::launch(name, grid, block, bytes, backwards, arguments);                                \
  }                                                                                                         \
  extern "C" const char* seepast_types_##name() { return emulated::types(name); }

inline void __syncthreads() { emulated::wait(emulated::g_block.barriers[0], emulated::g_block.count); }
inline int __syncthreads_count(int predicate);
inline void __syncwarp(unsigned mask = 0xffffffffu) { emulated::exchange(mask, 0); }
inline void __threadfence() {}
inline void __threadfence_block() {}

template <typename T>
T __shfl_sync(unsigned mask, T value, int source, int width = 32) {
  return emulated::shuffle(mask, value, width, source & (width - 1), true);
}
template <typename T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta, int width = 32) {
  const int from = static_cast<int>(emulated::lane()) % width - static_cast<int>(delta);
  return emulated::shuffle(mask, value, width, from, from >= 0);
}
template <typename T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = 32) {
  const int from = static_cast<int>(emulated::lane()) % width + static_cast<int>(delta);
  return emulated::shuffle(mask, value, width, from, from < width);
}
template <typename T>
T __shfl_xor_sync(unsigned mask, T value, int lanes, int width = 32) {
  const int from = static_cast<int>(emulated::lane()) % width ^ lanes;
  return emulated::shuffle(mask, value, width, from, from < width);
}
inline unsigned __ballot_sync(unsigned mask, int predicate) {
  const uint64_t* lanes = emulated::exchange(mask, predicate != 0);
  unsigned found = 0;
  for (unsigned i = 0, in = emulated::present(mask); i < 32; ++i)
    if (in >> i & 1) found |= static_cast<unsigned>(lanes[2 * i]) << i;
  return found;
}
inline int __any_sync(unsigned mask, int predicate) { return __ballot_sync(mask, predicate) != 0; }
inline int __all_sync(unsigned mask, int predicate) {
  return __ballot_sync(mask, predicate) == emulated::present(mask);
}
inline unsigned __reduce_add_sync(unsigned mask, unsigned value) {
  const uint64_t* lanes = emulated::exchange(mask, value);
  unsigned sum = 0;
  for (unsigned i = 0, in = emulated::present(mask); i < 32; ++i)
    if (in >> i & 1) sum += static_cast<unsigned>(lanes[2 * i]);
  return sum;
}
inline unsigned __reduce_min_sync(unsigned mask, unsigned value) {
  const uint64_t* lanes = emulated::exchange(mask, value);
  for (unsigned i = 0, in = emulated::present(mask); i < 32; ++i)
    if (in >> i & 1 && lanes[2 * i] < value) value = static_cast<unsigned>(lanes[2 * i]);
  return value;
}
inline unsigned __activemask() { return emulated::present(0xffffffffu); }

inline int __syncthreads_count(int predicate) {
  static int count;
  if (predicate) count += 1;  // zero before and after: the last to leave clears it
  __syncthreads();
  const int found = count;
  __syncthreads();
  count = 0;
  return found;
}
inline int __syncthreads_or(int predicate) { return __syncthreads_count(predicate) > 0; }
inline int __syncthreads_and(int predicate) {
  return __syncthreads_count(predicate) == static_cast<int>(emulated::g_block.count);
}

inline int __popc(unsigned v) { return __builtin_popcount(v); }
inline int __popcll(unsigned long long v) { return __builtin_popcountll(v); }
inline int __ffs(int v) { return __builtin_ffs(v); }
inline int __ffsll(long long v) { return __builtin_ffsll(v); }
inline int __clz(int v) { return v ? __builtin_clz(static_cast<unsigned>(v)) : 32; }
inline int __clzll(long long v) { return v ? __builtin_clzll(static_cast<unsigned long long>(v)) : 64; }
inline unsigned __brev(unsigned v) {
  unsigned r = 0;
  for (int i = 0; i < 32; ++i) r |= (v >> i & 1u) << (31 - i);
  return r;
}
inline int __mul24(int a, int b) { return a * b; }
inline unsigned __umulhi(unsigned a, unsigned b) { return static_cast<uint64_t>(a) * b >> 32; }
template <typename T>
T __ldg(const T* p) {
  return *p;
}

// One rule for every old(*p), new(*p): threads run one after the other here, so plain memory is atomic.
#define SEEPAST_ATOMIC(name, expression)                                     \
  template <typename T, typename V>                                          \
  std::enable_if_t<!std::is_pointer_v<T>, T> name(T* p, V operand) {         \
    const T old = *p, v = static_cast<T>(operand);                           \
    *p = static_cast<T>(expression);                                         \
    return old;                                                              \
  }
SEEPAST_ATOMIC(atomicAdd, old + v)
SEEPAST_ATOMIC(atomicSub, old - v)
SEEPAST_ATOMIC(atomicMin, v < old ? v : old)
SEEPAST_ATOMIC(atomicMax, v > old ? v : old)
SEEPAST_ATOMIC(atomicOr, old | v)
SEEPAST_ATOMIC(atomicAnd, old & v)
SEEPAST_ATOMIC(atomicXor, old ^ v)
SEEPAST_ATOMIC(atomicExch, (old, v))
template <typename T>
T atomicCAS(T* p, T compare, T value) {
  const T old = *p;
  if (old == compare) *p = value;
  return old;
}

template <typename A, typename B>
constexpr std::common_type_t<A, B> min(A a, B b) {
  using T = std::common_type_t<A, B>;
  return static_cast<T>(b) < static_cast<T>(a) ? static_cast<T>(b) : static_cast<T>(a);
}
template <typename A, typename B>
constexpr std::common_type_t<A, B> max(A a, B b) {
  using T = std::common_type_t<A, B>;
  return static_cast<T>(a) < static_cast<T>(b) ? static_cast<T>(b) : static_cast<T>(a);
}
using std::abs;
inline float __int2float_rn(int v) { return static_cast<float>(v); }
inline int __float2int_rn(float v) { return static_cast<int>(std::nearbyintf(v)); }
inline int __float2int_rd(float v) { return static_cast<int>(std::floor(v)); }
inline int __float2int_rz(float v) { return static_cast<int>(v); }
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fsub_rn(float a, float b) { return a - b; }
inline float __fdiv_rn(float a, float b) { return a / b; }
inline float __fmaf_rn(float a, float b, float c) { return std::fma(a, b, c); }
inline float __fsqrt_rn(float a) { return std::sqrt(a); }
inline int __float_as_int(float v) {
  int i;
  std::memcpy(&i, &v, 4);
  return i;
}
inline float __int_as_float(int v) {
  float f;
  std::memcpy(&f, &v, 4);
  return f;
}
inline unsigned __float_as_uint(float v) { return static_cast<unsigned>(__float_as_int(v)); }

// Four bytes in one word, and the like.
#define SEEPAST_BYTES(name, expression)                    \
  inline unsigned name(unsigned a, unsigned b) {           \
    unsigned r = 0;                                        \
    for (int i = 0; i < 32; i += 8) {                      \
      const int x = a >> i & 255, y = b >> i & 255;        \
      r |= (static_cast<unsigned>(expression) & 255) << i; \
    }                                                      \
    return r;                                              \
  }
SEEPAST_BYTES(__vadd4, x + y)
SEEPAST_BYTES(__vsub4, x - y)
SEEPAST_BYTES(__vaddus4, x + y > 255 ? 255 : x + y)
SEEPAST_BYTES(__vsubus4, x < y ? 0 : x - y)
SEEPAST_BYTES(__vabsdiffu4, x < y ? y - x : x - y)
SEEPAST_BYTES(__vminu4, x < y ? x : y)
SEEPAST_BYTES(__vmaxu4, x < y ? y : x)
SEEPAST_BYTES(__vavgu4, (x + y + 1) >> 1)
SEEPAST_BYTES(__vcmpeq4, x == y ? 255 : 0)
SEEPAST_BYTES(__vcmpne4, x != y ? 255 : 0)
SEEPAST_BYTES(__vcmpltu4, x < y ? 255 : 0)
SEEPAST_BYTES(__vcmpgtu4, x > y ? 255 : 0)
SEEPAST_BYTES(__vcmpleu4, x <= y ? 255 : 0)
SEEPAST_BYTES(__vcmpgeu4, x >= y ? 255 : 0)
#undef SEEPAST_BYTES
#define SEEPAST_WORDS(name, expression)                       \
  inline unsigned name(unsigned a, unsigned b) {              \
    unsigned r = 0;                                           \
    for (int i = 0; i < 32; i += 16) {                        \
      const int x = a >> i & 65535, y = b >> i & 65535;       \
      r |= (static_cast<unsigned>(expression) & 65535u) << i; \
    }                                                         \
    return r;                                                 \
  }
SEEPAST_WORDS(__vadd2, x + y)
SEEPAST_WORDS(__vsub2, x - y)
SEEPAST_WORDS(__vaddus2, x + y > 65535 ? 65535 : x + y)
SEEPAST_WORDS(__vsubus2, x < y ? 0 : x - y)
SEEPAST_WORDS(__vabsdiffu2, x < y ? y - x : x - y)
SEEPAST_WORDS(__vminu2, x < y ? x : y)
SEEPAST_WORDS(__vmaxu2, x < y ? y : x)
SEEPAST_WORDS(__vavgu2, (x + y + 1) >> 1)
SEEPAST_WORDS(__vcmpeq2, x == y ? 65535 : 0)
SEEPAST_WORDS(__vcmpgtu2, x > y ? 65535 : 0)
SEEPAST_WORDS(__vcmpltu2, x < y ? 65535 : 0)
#undef SEEPAST_WORDS
inline unsigned __vsadu4(unsigned a, unsigned b) {
  unsigned sum = 0;
  for (int i = 0; i < 32; i += 8) sum += std::abs(static_cast<int>(a >> i & 255) - static_cast<int>(b >> i & 255));
  return sum;
}
inline unsigned __dp4a(unsigned a, unsigned b, unsigned c) {
  for (int i = 0; i < 32; i += 8) c += (a >> i & 255) * (b >> i & 255);
  return c;
}
inline int __dp4a(int a, int b, int c) {
  for (int i = 0; i < 32; i += 8) c += static_cast<int8_t>(a >> i) * static_cast<int8_t>(b >> i);
  return c;
}
inline unsigned __byte_perm(unsigned a, unsigned b, unsigned selector) {
  const uint64_t both = static_cast<uint64_t>(b) << 32 | a;
  unsigned r = 0;
  for (int i = 0; i < 4; ++i) {
    const unsigned pick = selector >> 4 * i & 15;
    unsigned byte = both >> 8 * (pick & 7) & 255;
    if (pick & 8) byte = byte & 128 ? 255 : 0;
    r |= byte << 8 * i;
  }
  return r;
}
inline unsigned __funnelshift_l(unsigned low, unsigned high, unsigned shift) {
  return static_cast<unsigned>(((static_cast<uint64_t>(high) << 32 | low) << (shift & 31)) >> 32);
}
inline unsigned __funnelshift_r(unsigned low, unsigned high, unsigned shift) {
  return static_cast<unsigned>((static_cast<uint64_t>(high) << 32 | low) >> (shift & 31));
}
