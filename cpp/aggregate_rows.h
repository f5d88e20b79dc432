// The inner loops of aggregate.cpp, which includes this once for every instruction set.
//
// Lanes: sixteen signed 16-bit numbers, as many as a chunk has candidates.
typedef int16_t Lanes __attribute__((vector_size(32), may_alias));
typedef uint8_t Bytes __attribute__((vector_size(16), aligned(1), may_alias));
typedef uint8_t BytesTwice __attribute__((vector_size(32), may_alias));
typedef int16_t LanesAnywhere __attribute__((vector_size(32), aligned(2), may_alias));

inline Lanes splat(int16_t value) {
  const Lanes first = {value};
  return __builtin_shufflevector(first, first, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
}
inline Lanes load(const int16_t* from) {
  return *reinterpret_cast<const LanesAnywhere*>(from);
}
inline void store(int16_t* to, Lanes v) { *reinterpret_cast<LanesAnywhere*>(to) = v; }
inline Lanes widened(const uint8_t* from) {
  const Bytes b = *reinterpret_cast<const Bytes*>(from), zero = {};
  return reinterpret_cast<Lanes>(static_cast<BytesTwice>(
      __builtin_shufflevector(b, zero, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23, 8, 24, 9, 25, 10,
                              26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)));
}
inline Lanes lane_numbers() {
  return Lanes{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
}
inline Lanes least(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes select_less(Lanes a, Lanes b, Lanes yes, Lanes no) { return a < b ? yes : no; }
inline Lanes select_equal(Lanes a, Lanes b, Lanes yes, Lanes no) { return a == b ? yes : no; }

// The lower of the entries one before and one after each.
inline Lanes least_beside(const int16_t* b) { return least(load(b - 1), load(b + 1)); }

#ifdef __AVX2__
// The same of entries that have just been written: a load that spans two stores would wait for both.
inline Lanes least_beside_fresh(const int16_t* b) {
  const __m256i before = reinterpret_cast<__m256i>(load(b - kChunk)), here = reinterpret_cast<__m256i>(load(b)),
                after = reinterpret_cast<__m256i>(load(b + kChunk));
  const __m256i up = _mm256_alignr_epi8(here, _mm256_permute2x128_si256(before, here, 0x21), 14);
  const __m256i down = _mm256_alignr_epi8(_mm256_permute2x128_si256(here, after, 0x21), here, 2);
  return least(reinterpret_cast<Lanes>(up), reinterpret_cast<Lanes>(down));
}
#else
inline Lanes least_beside_fresh(const int16_t* b) { return least_beside(b); }
#endif

typedef int16_t Half __attribute__((vector_size(16), may_alias));
inline Half lower_half(Half a, Half b) { return a < b ? a : b; }
inline Half folded(Lanes a) {
  return lower_half(__builtin_shufflevector(a, a, 0, 1, 2, 3, 4, 5, 6, 7),
                    __builtin_shufflevector(a, a, 8, 9, 10, 11, 12, 13, 14, 15));
}
inline Half interleaved(Half a, Half b) {
  return lower_half(__builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11),
                    __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15));
}
// Lowest lane of each: `lowest` [4], and that of a in all lanes.
inline Lanes lowest_of_four(Lanes a, Lanes b, Lanes c, Lanes d, int16_t* lowest) {
  Half t = interleaved(interleaved(folded(a), folded(c)), interleaved(folded(b), folded(d)));  // a b c d a b c d
  t = lower_half(t, __builtin_shufflevector(t, t, 4, 5, 6, 7, 0, 1, 2, 3));
  for (int i = 0; i < 4; ++i) lowest[i] = t[i];
  return splat(t[0]);
}
inline int16_t lowest_of(Lanes a) {
  int16_t lowest[4];
  lowest_of_four(a, a, a, a, lowest);
  return lowest[0];
}

inline void clear(int16_t* entries, uint64_t chunks) {
  for (; chunks; chunks &= chunks - 1)
    std::fill_n(entries + __builtin_ctzll(chunks) * kChunk, kChunk, kBeyond);
}

// First lowest sum, moved to the vertex of the parabola through it and its neighbours: 32nds of a pixel.
inline uint16_t place_of(const int16_t* total, int best, bool inner, const Grid& grid) {
  int place = kUnits / 8 * (grid.first + grid.step * best);
  if (inner) {
    const int left = total[best - 1], right = total[best + 1], bend = left + right - 2 * total[best];
    const int half = kUnits / 16 * grid.step;
    if (bend > 0) place += (2 * half * (left - right + bend) + bend) / (2 * bend) - half;
  }
  return static_cast<uint16_t>(place);
}

// `first` numbers the first lane of the chunk that `lowest` comes from.
inline uint16_t winner(const int16_t* total, Lanes lowest, Lanes first, uint64_t active, const Grid& grid) {
  const Lanes place = first + lane_numbers();
  const int best = lowest_of(select_equal(lowest, splat(lowest_of(lowest)), place, splat(32767)));
  const int before = best - 1, after = best + 1;
  const bool inner = best > 0 && after < grid.count && (active >> (before / kChunk) & active >> (after / kChunk) & 1);
  return place_of(total, best, inner, grid);
}

// Path costs are kept above their lowest by what has gathered on the path; rarely that is taken away, so that
// they stay far below kBeyond.
__attribute__((noinline)) void settle(int16_t* entries, uint64_t active, int16_t* lowest) {
  for (; active; active &= active - 1) {
    int16_t* e = entries + __builtin_ctzll(active) * kChunk;
    store(e, load(e) - splat(*lowest));
  }
  *lowest = 0;
}

template <int kVertical, bool kLast>
void steps_of_row(const Row& r) {
  const Lanes small = splat(static_cast<int16_t>(r.small));
  const int direction = r.direction, width = r.width;
  const ptrdiff_t before_path = r.before_path, before_pitch = r.before_pitch, path = r.path, pitch = r.pitch;
  alignas(64) int16_t last[64 * kChunk];
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
    do {
      const size_t at = static_cast<size_t>(__builtin_ctzll(active)) * kChunk;
      active &= active - 1;
      const Lanes c = widened(cost);
      Lanes total = (kLast ? load(sum) : splat(0)) - total_low;
      for (int p = 0; p < kVertical; ++p) {
        const int16_t* b = from + at + p * before_path;
        const Lanes beside = least_beside(b) + small;
        const Lanes v = least(least(load(b), far[p]), beside) + c;
        store(to + at + p * path, v);
        minimum[p] = least(minimum[p], v);
        total += v;
      }
      {
        const int16_t* b = along + at;
        const Lanes beside = least_beside_fresh(b) + small;
        const Lanes v = least(least(load(b), far[kVertical]), beside) + c;
        store(along_to + at, v);
        minimum[kVertical] = least(minimum[kVertical], v);
        total += v;
      }
      if (kLast) {
        store(last + at, total);
        lowest_first = select_less(total, lowest_total, splat(static_cast<int16_t>(at)), lowest_first);
        lowest_total = least(lowest_total, total);
      } else {
        store(sum, total);
      }
      cost += kChunk;
      sum += kChunk;
    } while (active);

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
    if (kLast) r.out[x] = winner(last, lowest_total, lowest_first, all, r.grid);
  }
}

template <int kVertical>
void steps_of(const Row& r) {
  r.out ? steps_of_row<kVertical, true>(r) : steps_of_row<kVertical, false>(r);
}

void run(const Row& r, bool eight) { eight ? steps_of<3>(r) : steps_of<1>(r); }
