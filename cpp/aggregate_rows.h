// The inner loops of aggregate.cpp, which includes this once for every instruction set.
//
// Lanes: sixteen signed 16-bit numbers, as many as a chunk has candidates.
typedef int16_t Half __attribute__((vector_size(16), may_alias));
typedef uint8_t Bytes __attribute__((vector_size(16), may_alias));

#ifdef SEEPAST_AVX2
typedef int16_t Lanes __attribute__((vector_size(32), may_alias));
typedef uint8_t BytesTwice __attribute__((vector_size(32), may_alias));

inline Lanes splat(int16_t value) {
  const Lanes first = {value};
  return __builtin_shufflevector(first, first, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
}
inline Lanes widened(const uint8_t* from) {
  const Bytes zero = {};
  Bytes b;
  __builtin_memcpy(&b, from, sizeof b);
  return reinterpret_cast<Lanes>(static_cast<BytesTwice>(
      __builtin_shufflevector(b, zero, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23, 8, 24, 9, 25,
                              10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)));
}
inline Lanes lane_numbers() { return Lanes{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }
template <class V>
inline V least(V a, V b) {
  return a < b ? a : b;
}
inline Lanes select_less(Lanes a, Lanes b, Lanes yes, Lanes no) { return a < b ? yes : no; }
inline Lanes select_equal(Lanes a, Lanes b, Lanes yes, Lanes no) { return a == b ? yes : no; }
inline Half lower_half(Half a, Half b) { return a < b ? a : b; }
inline Half folded(Lanes a) {
  return lower_half(__builtin_shufflevector(a, a, 0, 1, 2, 3, 4, 5, 6, 7),
                    __builtin_shufflevector(a, a, 8, 9, 10, 11, 12, 13, 14, 15));
}
#else
// Where nothing is as wide, two halves: the compiler would take them to pieces.
struct Lanes {
  Half a, b;
  Lanes& operator+=(Lanes o) { return *this = {a + o.a, b + o.b}; }
  Lanes& operator-=(Lanes o) { return *this = {a - o.a, b - o.b}; }
  int16_t operator[](int i) const { return i < 8 ? a[i] : b[i - 8]; }
};
inline Lanes operator+(Lanes a, Lanes b) { return a += b; }
inline Lanes operator-(Lanes a, Lanes b) { return a -= b; }
inline Lanes splat(int16_t value) {
  const Half h = {value, value, value, value, value, value, value, value};
  return {h, h};
}
inline Lanes widened(const uint8_t* from) {
  const Bytes zero = {};
  Bytes b;
  __builtin_memcpy(&b, from, sizeof b);
  return {reinterpret_cast<Half>(static_cast<Bytes>(
              __builtin_shufflevector(b, zero, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23))),
          reinterpret_cast<Half>(static_cast<Bytes>(__builtin_shufflevector(
              b, zero, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)))};
}
inline Lanes lane_numbers() { return {Half{0, 1, 2, 3, 4, 5, 6, 7}, Half{8, 9, 10, 11, 12, 13, 14, 15}}; }
inline Half lower_half(Half a, Half b) { return a < b ? a : b; }
inline Lanes least(Lanes a, Lanes b) { return {lower_half(a.a, b.a), lower_half(a.b, b.b)}; }
inline Lanes select_less(Lanes a, Lanes b, Lanes yes, Lanes no) {
  return {a.a < b.a ? yes.a : no.a, a.b < b.b ? yes.b : no.b};
}
inline Lanes select_equal(Lanes a, Lanes b, Lanes yes, Lanes no) {
  return {a.a == b.a ? yes.a : no.a, a.b == b.b ? yes.b : no.b};
}
inline Half folded(Lanes a) { return lower_half(a.a, a.b); }
#endif

template <class V>
inline V load_as(const int16_t* from) {
  V v;
  __builtin_memcpy(&v, from, sizeof v);
  return v;
}
template <class V>
inline void store_as(int16_t* to, V v) {
  __builtin_memcpy(to, &v, sizeof v);
}
inline Lanes load(const int16_t* from) { return load_as<Lanes>(from); }
inline void store(int16_t* to, Lanes v) { store_as(to, v); }

// The lower of the entries one before and one after each.
template <class V>
inline V least_beside(const int16_t* b) {
  return least(load_as<V>(b - 1), load_as<V>(b + 1));
}

#ifdef SEEPAST_AVX2
// The same of entries that have just been written: a load that spans two stores would wait for both.
inline Lanes least_beside_fresh(const int16_t* b) {
  const __m256i before = reinterpret_cast<__m256i>(load(b - kChunk)),
                here = reinterpret_cast<__m256i>(load(b)),
                after = reinterpret_cast<__m256i>(load(b + kChunk));
  const __m256i up = _mm256_alignr_epi8(here, _mm256_permute2x128_si256(before, here, 0x21), 14);
  const __m256i down = _mm256_alignr_epi8(_mm256_permute2x128_si256(here, after, 0x21), here, 2);
  return least(reinterpret_cast<Lanes>(up), reinterpret_cast<Lanes>(down));
}
#else
inline Lanes least_beside_fresh(const int16_t* b) { return least_beside<Lanes>(b); }
#endif

#ifdef SEEPAST_AVX512
// Two chunks that follow each other are one step of twice the width.
typedef int16_t Wide __attribute__((vector_size(64), may_alias));

inline Wide doubled(Lanes low, Lanes high) {
  return reinterpret_cast<Wide>(_mm512_inserti64x4(_mm512_castsi256_si512(reinterpret_cast<__m256i>(low)),
                                                   reinterpret_cast<__m256i>(high), 1));
}
inline Lanes lower(Wide a) {
  return reinterpret_cast<Lanes>(_mm512_castsi512_si256(reinterpret_cast<__m512i>(a)));
}
inline Lanes upper(Wide a) {
  return reinterpret_cast<Lanes>(_mm512_extracti64x4_epi64(reinterpret_cast<__m512i>(a), 1));
}
inline Wide widened_twice(const uint8_t* from) {
  return reinterpret_cast<Wide>(
      _mm512_cvtepu8_epi16(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(from))));
}
inline Wide least_beside_fresh_twice(const int16_t* b) {
  const __m512i here = reinterpret_cast<__m512i>(doubled(load(b), load(b + kChunk)));
  const Wide n = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                  16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
  const __m512i up = _mm512_mask_permutexvar_epi16(_mm512_set1_epi16(b[-1]), 0xfffffffe,
                                                   reinterpret_cast<__m512i>(n - 1), here);
  const __m512i down = _mm512_mask_permutexvar_epi16(_mm512_set1_epi16(b[2 * kChunk]), 0x7fffffff,
                                                     reinterpret_cast<__m512i>(n + 1), here);
  return least(reinterpret_cast<Wide>(up), reinterpret_cast<Wide>(down));
}
#endif

inline Half interleaved(Half a, Half b) {
  return lower_half(__builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11),
                    __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15));
}
// Lowest lane of each: `lowest` [4], and that of a in all lanes. All are 0 or more.
inline Lanes lowest_of_four(Lanes a, Lanes b, Lanes c, Lanes d, int16_t* lowest) {
#ifdef SEEPAST_AVX2
  const Half all[4] = {folded(a), folded(b), folded(c), folded(d)};
  for (int i = 0; i < 4; ++i)
    lowest[i] = static_cast<int16_t>(_mm_cvtsi128_si32(_mm_minpos_epu16(reinterpret_cast<__m128i>(all[i]))));
  return reinterpret_cast<Lanes>(
      _mm256_broadcastw_epi16(_mm_minpos_epu16(reinterpret_cast<__m128i>(all[0]))));
#else
  Half t =
      interleaved(interleaved(folded(a), folded(c)), interleaved(folded(b), folded(d)));  // a b c d a b c d
  t = lower_half(t, __builtin_shufflevector(t, t, 4, 5, 6, 7, 0, 1, 2, 3));
  for (int i = 0; i < 4; ++i) lowest[i] = t[i];
  return splat(t[0]);
#endif
}
inline Lanes lowest_of(Lanes a) {
  int16_t lowest[4];
  return lowest_of_four(a, a, a, a, lowest);
}

inline void clear(int16_t* entries, uint64_t chunks) {
  for (; chunks; chunks &= chunks - 1)
    std::fill_n(entries + __builtin_ctzll(chunks) * kChunk, kChunk, kBeyond);
}

// First lowest sum of a pixel, and those beside it; `first` numbers the first lane of the chunk that each
// lane of `lowest` comes from.
inline void pick(const int16_t* total, Lanes lowest, Lanes first, Pick* to) {
  const Lanes place = first + lane_numbers();
  const int best = lowest_of(select_equal(lowest, lowest_of(lowest), place, splat(32767)))[0];
  *to = {static_cast<int16_t>(best), total[best - 1], total[best], total[best + 1]};
}

// Candidates of a row, moved to the vertex of the parabola through three sums where all are active: 32nds of
// a pixel.
void places(const Row& r) {
  const int half = kUnits / 16 * r.grid.step;
  for (int x = 0; x < r.width; ++x) {
    const Pick p = r.picks[x];
    const int before = p.best - 1, after = p.best + 1, bend = p.left + p.right - 2 * p.lowest;
    const bool inner = p.best > 0 && after < r.grid.count &&
                       (r.active[x] >> before / kChunk & r.active[x] >> after / kChunk & 1);
    int place = kUnits / 8 * (r.grid.first + r.grid.step * p.best);
    if (inner && bend > 0) place += (2 * half * (p.left - p.right + bend) + bend) / (2 * bend) - half;
    r.out[x] = static_cast<uint16_t>(place);
  }
}

// Path costs are kept above their lowest by what has gathered on the path; rarely that is taken away, so that
// they stay far below kBeyond. Also what makes paths begin anew behind a pixel that is not matched.
__attribute__((noinline)) void settle(int16_t* entries, uint64_t active, int16_t* lowest) {
  for (; active; active &= active - 1) {
    int16_t* e = entries + __builtin_ctzll(active) * kChunk;
    store(e, load(e) - splat(*lowest));
  }
  *lowest = 0;
}

// All paths into one pixel, of one chunk, or two: what they cost together. Lowers `minimum`.
template <int kVertical, class V>
inline __attribute__((always_inline)) V step_into(ptrdiff_t before_path, ptrdiff_t path, V c, V small,
                                                  const V* far, V* minimum, const int16_t* from, int16_t* to,
                                                  V along, V beside_along, int16_t* along_to) {
  V total = {};
  for (int p = 0; p < kVertical; ++p) {
    const int16_t* b = from + p * before_path;
    const V v = least(least(load_as<V>(b), far[p]), least_beside<V>(b) + small) + c;
    store_as(to + p * path, v);
    minimum[p] = least(minimum[p], v);
    total += v;
  }
  const V v = least(least(along, far[kVertical]), beside_along + small) + c;
  store_as(along_to, v);
  minimum[kVertical] = least(minimum[kVertical], v);
  return total + v;
}

template <int kVertical, bool kLast>
void steps_of_row(const Row& r) {
  const Lanes small = splat(static_cast<int16_t>(r.small));
  const int direction = r.direction, width = r.width;
  const ptrdiff_t before_path = r.before_path, before_pitch = r.before_pitch, path = r.path, pitch = r.pitch;
  alignas(64) int16_t last[64 * kChunk + 2 * kGuard] = {};
  const int16_t* along = r.outside;
  int16_t *along_to = r.beside, *along_next = r.beside + pitch;
  uint64_t held = 0, held_next = 0;  // chunks written there
  std::fill_n(r.beside, 2 * pitch, kBeyond);
  Lanes along_low = splat(0);
  int x = direction > 0 ? 0 : width - 1;
  for (int i = 0; i < width; ++i, x += direction) {
    uint64_t active = r.active[x];
    const uint64_t all = active;
    const int16_t* from = r.before + x * before_pitch;
    int16_t* to = r.to + x * pitch;
    if (const uint64_t stale = held & ~all) clear(along_to, stale);
    if (r.active_stale)
      if (const uint64_t stale = r.active_stale[x] & ~all)
        for (int p = 0; p < kVertical; ++p) clear(to + p * path, stale);
    Lanes far[kVertical + 1], minimum[kVertical + 1];
    Lanes total_low = along_low;
    for (int p = 0; p < kVertical; ++p) {
      const Lanes low = splat(r.before_low[p][x]);
      total_low += low;
      far[p] = low + splat(r.large[p][x]);
      minimum[p] = splat(kBeyond);
    }
    far[kVertical] = along_low + splat(r.large[kVertical][x]);
    minimum[kVertical] = splat(kBeyond);

    const size_t first = static_cast<size_t>(r.start[x]) * kChunk;
    const uint8_t* cost = r.costs + first;
    int16_t* sum = r.sums + first;
    Lanes lowest_total = splat(32767), lowest_first = splat(0);
    const auto keep = [&](Lanes total, size_t at) __attribute__((always_inline)) {
      total -= total_low;
      if (kLast) {
        total += load(sum);
        store(last + kGuard + at, total);
        lowest_first = select_less(total, lowest_total, splat(static_cast<int16_t>(at)), lowest_first);
        lowest_total = least(lowest_total, total);
      } else {
        store(sum, total);
      }
      cost += kChunk;
      sum += kChunk;
    };
#ifdef SEEPAST_AVX512
    const Wide wide_small = doubled(small, small);
    Wide wide_far[kVertical + 1], wide_minimum[kVertical + 1];
    for (int p = 0; p <= kVertical; ++p)
      wide_far[p] = doubled(far[p], far[p]), wide_minimum[p] = doubled(minimum[p], minimum[p]);
#endif
    while (active) {
      const size_t at = static_cast<size_t>(__builtin_ctzll(active)) * kChunk;
      const uint64_t rest = active & (active - 1);
#ifdef SEEPAST_AVX512
      if (active & (active ^ rest) << 1) {
        const Wide here = doubled(load(along + at), load(along + at + kChunk));
        const Wide total = step_into<kVertical>(before_path, path, widened_twice(cost), wide_small, wide_far,
                                                wide_minimum, from + at, to + at, here,
                                                least_beside_fresh_twice(along + at), along_to + at);
        keep(lower(total), at);
        keep(upper(total), at + kChunk);
        active = rest & (rest - 1);
        continue;
      }
#endif
      keep(step_into<kVertical>(before_path, path, widened(cost), small, far, minimum, from + at, to + at,
                                load(along + at), least_beside_fresh(along + at), along_to + at),
           at);
      active = rest;
    }
#ifdef SEEPAST_AVX512
    for (int p = 0; p <= kVertical; ++p)
      minimum[p] = least(minimum[p], least(lower(wide_minimum[p]), upper(wide_minimum[p])));
#endif

    int16_t lowest[4];
    along_low = lowest_of_four(minimum[kVertical], minimum[0], minimum[kVertical > 1 ? 1 : 0],
                               minimum[kVertical > 1 ? 2 : 0], lowest);
    if (lowest[0] > kUnsettled) {
      settle(along_to, all, &lowest[0]);
      along_low = splat(0);
    }
    for (int p = 0; p < kVertical; ++p) {
      if (lowest[p + 1] > kUnsettled) settle(to + p * path, all, &lowest[p + 1]);
      r.to_low[p][x] = lowest[p + 1];
    }
    along = along_to;
    std::swap(along_to, along_next);
    held = held_next;
    held_next = all;
    if (kLast) pick(last + kGuard, lowest_total, lowest_first, r.picks + x);
  }
  if (kLast) places(r);
}

template <int kVertical>
void steps_of(const Row& r) {
  r.out ? steps_of_row<kVertical, true>(r) : steps_of_row<kVertical, false>(r);
}

void run(const Row& r, bool eight) { eight ? steps_of<3>(r) : steps_of<1>(r); }
