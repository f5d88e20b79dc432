// The inner loops of aggregate.cpp, which includes this once for every instruction set.
//
// Lanes: sixteen signed 16-bit numbers, as many as a chunk has candidates. Wide: two chunks'.
typedef int16_t Half __attribute__((vector_size(16), may_alias));
typedef uint8_t Bytes __attribute__((vector_size(16), may_alias));

inline Half least(Half a, Half b) { return a < b ? a : b; }

template <class V>
inline V load(const int16_t* from) {
  V v;
  __builtin_memcpy(&v, from, sizeof v);
  return v;
}
template <class V>
inline void store(int16_t* to, V v) {
  __builtin_memcpy(to, &v, sizeof v);
}
template <class V>
V splat(int16_t value);
template <class V>
V widened(const uint8_t* from);

// Of every kind of vector: `after` and `before` move the lanes by one, with the last of the vector before, or
// the first of the one after, in the free place; `lowest` has the lowest lane in all, which must be 0 or
// more; `equal` has a bit per lane; the lanes that `store_bytes` takes are below 256.
#ifdef SEEPAST_AVX2
typedef int16_t Lanes __attribute__((vector_size(32), may_alias));

template <>
inline Lanes splat<Lanes>(int16_t value) {
  return reinterpret_cast<Lanes>(_mm256_set1_epi16(value));
}
template <>
inline Lanes widened<Lanes>(const uint8_t* from) {
  return reinterpret_cast<Lanes>(
      _mm256_cvtepu8_epi16(_mm_loadu_si128(reinterpret_cast<const __m128i*>(from))));
}
inline Lanes least(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes after(Lanes before, Lanes here) {
  return __builtin_shufflevector(before, here, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29,
                                 30);
}
inline Lanes before(Lanes here, Lanes after) {
  return __builtin_shufflevector(here, after, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16);
}
inline __m128i folded(Lanes a) {
  const __m256i all = reinterpret_cast<__m256i>(a);
  return _mm_minpos_epu16(_mm_min_epi16(_mm256_castsi256_si128(all), _mm256_extracti128_si256(all, 1)));
}
inline Lanes lowest(Lanes a) { return reinterpret_cast<Lanes>(_mm256_broadcastw_epi16(folded(a))); }
inline uint32_t equal(Lanes a, Lanes b) {
#ifdef SEEPAST_AVX512
  return _mm256_cmpeq_epi16_mask(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b));
#else
  const __m256i same = reinterpret_cast<__m256i>(a == b);
  return static_cast<uint32_t>(
      _mm_movemask_epi8(_mm_packs_epi16(_mm256_castsi256_si128(same), _mm256_extracti128_si256(same, 1))));
#endif
}
inline void store_bytes(uint8_t* to, Lanes v) {
  const __m256i all = reinterpret_cast<__m256i>(v);
  _mm_storeu_si128(reinterpret_cast<__m128i*>(to),
                   _mm_packus_epi16(_mm256_castsi256_si128(all), _mm256_extracti128_si256(all, 1)));
}
inline int16_t first_lane(Lanes v) { return v[0]; }
#else
// Where nothing is as wide, two halves: the compiler would take them to pieces.
struct Lanes {
  Half a, b;
};
inline Lanes operator+(Lanes a, Lanes b) { return {a.a + b.a, a.b + b.b}; }
inline Lanes operator-(Lanes a, Lanes b) { return {a.a - b.a, a.b - b.b}; }

template <>
inline Lanes splat<Lanes>(int16_t value) {
  const Half h = {value, value, value, value, value, value, value, value};
  return {h, h};
}
template <>
inline Lanes widened<Lanes>(const uint8_t* from) {
  const Bytes zero = {};
  Bytes b;
  __builtin_memcpy(&b, from, sizeof b);
  return {reinterpret_cast<Half>(static_cast<Bytes>(
              __builtin_shufflevector(b, zero, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23))),
          reinterpret_cast<Half>(static_cast<Bytes>(__builtin_shufflevector(
              b, zero, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)))};
}
inline Lanes least(Lanes a, Lanes b) { return {least(a.a, b.a), least(a.b, b.b)}; }
inline Half shifted(Half low, Half high) {  // the last lane of low and all but the last of high
  return __builtin_shufflevector(low, high, 7, 8, 9, 10, 11, 12, 13, 14);
}
inline Half shifted_down(Half low, Half high) {
  return __builtin_shufflevector(low, high, 1, 2, 3, 4, 5, 6, 7, 8);
}
inline Lanes after(Lanes before, Lanes here) { return {shifted(before.b, here.a), shifted(here.a, here.b)}; }
inline Lanes before(Lanes here, Lanes after) {
  return {shifted_down(here.a, here.b), shifted_down(here.b, after.a)};
}
inline Lanes lowest(Lanes a) {
  Half h = least(a.a, a.b);
  h = least(h, __builtin_shufflevector(h, h, 4, 5, 6, 7, 0, 1, 2, 3));
  h = least(h, __builtin_shufflevector(h, h, 2, 3, 0, 1, 6, 7, 4, 5));
  h = least(h, __builtin_shufflevector(h, h, 1, 0, 3, 2, 5, 4, 7, 6));
  return {h, h};
}
inline Bytes packed(Lanes a) {
#if defined(__SSE2__)
  return reinterpret_cast<Bytes>(
      _mm_packus_epi16(reinterpret_cast<__m128i>(a.a), reinterpret_cast<__m128i>(a.b)));
#else
  return __builtin_shufflevector(reinterpret_cast<Bytes>(a.a), reinterpret_cast<Bytes>(a.b), 0, 2, 4, 6, 8,
                                 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
#endif
}
inline uint32_t equal(Lanes a, Lanes b) {
  const Half one = {1, 1, 1, 1, 1, 1, 1, 1};
  const Bytes same = packed({(a.a == b.a) & one, (a.b == b.b) & one});
  uint64_t halves[2];
  __builtin_memcpy(halves, &same, sizeof halves);
  constexpr uint64_t gather = 0x0102040810204080;  // bit 8 i goes to bit 56 + i
  return static_cast<uint32_t>(halves[0] * gather >> 56 | halves[1] * gather >> 56 << 8);
}
inline void store_bytes(uint8_t* to, Lanes v) {
  const Bytes b = packed(v);
  __builtin_memcpy(to, &b, sizeof b);
}
inline int16_t first_lane(Lanes v) { return v.a[0]; }
#endif

#ifdef SEEPAST_AVX512
typedef int16_t Wide __attribute__((vector_size(64), may_alias));

template <>
inline Wide splat<Wide>(int16_t value) {
  return reinterpret_cast<Wide>(_mm512_set1_epi16(value));
}
template <>
inline Wide widened<Wide>(const uint8_t* from) {
  return reinterpret_cast<Wide>(
      _mm512_cvtepu8_epi16(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(from))));
}
inline Wide least(Wide a, Wide b) { return a < b ? a : b; }
inline Wide after(Wide before, Wide here) {
  const Wide place = {31, 32, 33, 34, 35, 36, 37, 38, 39, 40, 41, 42, 43, 44, 45, 46,
                      47, 48, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 59, 60, 61, 62};
  return reinterpret_cast<Wide>(_mm512_permutex2var_epi16(
      reinterpret_cast<__m512i>(before), reinterpret_cast<__m512i>(place), reinterpret_cast<__m512i>(here)));
}
inline Wide before(Wide here, Wide after) {
  const Wide place = {1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15, 16,
                      17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32};
  return reinterpret_cast<Wide>(_mm512_permutex2var_epi16(
      reinterpret_cast<__m512i>(here), reinterpret_cast<__m512i>(place), reinterpret_cast<__m512i>(after)));
}
inline Wide lowest(Wide a) {
  const __m512i all = reinterpret_cast<__m512i>(a);
  const Lanes half = least(reinterpret_cast<Lanes>(_mm512_castsi512_si256(all)),
                           reinterpret_cast<Lanes>(_mm512_extracti64x4_epi64(all, 1)));
  return reinterpret_cast<Wide>(_mm512_broadcastw_epi16(folded(half)));
}
inline uint32_t equal(Wide a, Wide b) {
  return _mm512_cmpeq_epi16_mask(reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(b));
}
inline void store_bytes(uint8_t* to, Wide v) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), _mm512_cvtepi16_epi8(reinterpret_cast<__m512i>(v)));
}
inline int16_t first_lane(Wide v) { return v[0]; }
#endif

template <class V>
constexpr int kLanes = sizeof(V) / sizeof(int16_t);

// The lower of the entries one before and one after each.
template <class V>
inline V least_beside(const int16_t* b) {
  return least(load<V>(b - 1), load<V>(b + 1));
}

inline void clear(int16_t* entries, uint64_t chunks) {
  for (; chunks; chunks &= chunks - 1)
    store(entries + __builtin_ctzll(chunks) * kChunk, splat<Lanes>(kBeyond));
}

// From x on, to before `end`: the first column that is not active at these chunks.
inline int same_until(const uint64_t* active, int x, int end, uint64_t chunks) {
#if defined(SEEPAST_AVX512)
  const __m512i all = _mm512_set1_epi64(static_cast<int64_t>(chunks));
  for (; x + 8 <= end; x += 8)
    if (const unsigned other = _mm512_cmpneq_epi64_mask(all, _mm512_loadu_si512(active + x)))
      return x + __builtin_ctz(other);
#elif defined(SEEPAST_AVX2)
  const __m256i all = _mm256_set1_epi64x(static_cast<int64_t>(chunks));
  for (; x + 4 <= end; x += 4) {
    const __m256i same =
        _mm256_cmpeq_epi64(all, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(active + x)));
    if (const int bits = _mm256_movemask_pd(_mm256_castsi256_pd(same)); bits != 15)
      return x + __builtin_ctz(~bits);
  }
#endif
  while (x < end && active[x] == chunks) ++x;
  return x;
}

// Calls use.template operator()<V, N>(first) for the chunks of a pixel that are N times those of a V, one
// after another, or any() where they are not.
template <class Use, class Any>
inline void by_chunks(uint64_t active, Use use, Any any) {
  const int first = __builtin_ctzll(active) * kChunk;
  switch (active >> __builtin_ctzll(active)) {
    case 1:
      return use.template operator()<Lanes, 1>(first);
    case 7:
      return use.template operator()<Lanes, 3>(first);
    case 31:
      return use.template operator()<Lanes, 5>(first);
#ifdef SEEPAST_AVX512
    case 3:
      return use.template operator()<Wide, 1>(first);
    case 15:
      return use.template operator()<Wide, 2>(first);
#else
    case 3:
      return use.template operator()<Lanes, 2>(first);
    case 15:
      return use.template operator()<Lanes, 4>(first);
#endif
    default:
      return any();
  }
}

// ------------------------------------------------------------------------------------------ along the rows

// The path along R rows at once from x on, `count` pixels that all are active at the N kLanes<V> candidates
// from `first` on. One row alone would wait for itself.
template <class V, int N, int R, bool kAdd>
inline void along_run(Line* rows, int x, int count, int direction, uint64_t active, int first,
                      int16_t small) {
  const V step = splat<V>(small), beyond = splat<V>(kBeyond);
  constexpr int L = kLanes<V>;
  const uint8_t* const costs = rows[0].costs;
  int16_t* const sums = rows[0].sums;
  const int32_t* start[R];
  const int16_t* large[R];
  V here[R][N], beside[R][N];
  for (int r = 0; r < R; ++r) {
    start[r] = rows[r].start, large[r] = rows[r].large;
    const int16_t* from = rows[r].entries + first;
    for (int i = 0; i < N; ++i)
      here[r][i] = load<V>(from + i * L), beside[r][i] = least_beside<V>(from + i * L);
    clear(rows[r].entries, rows[r].held);
  }
  for (;; x += direction) {
    for (int r = 0; r < R; ++r) {
      const ptrdiff_t at = static_cast<ptrdiff_t>(start[r][x]) * kChunk;
      const V far = splat<V>(large[r][x]);
      V minimum;
      for (int i = 0; i < N; ++i) {
        here[r][i] = least(least(here[r][i], far), beside[r][i] + step) + widened<V>(costs + at + i * L);
        int16_t* sum = sums + at + i * L;
        store(sum, kAdd ? load<V>(sum) + here[r][i] : here[r][i]);
        minimum = i ? least(minimum, here[r][i]) : here[r][i];
      }
      minimum = lowest(minimum);
      for (int i = 0; i < N; ++i) here[r][i] = here[r][i] - minimum;
    }
    if (!--count) break;
    for (int r = 0; r < R; ++r)
      for (int i = 0; i < N; ++i)
        beside[r][i] = least(after(i ? here[r][i - 1] : beyond, here[r][i]),
                             before(here[r][i], i + 1 < N ? here[r][i + 1] : beyond));
  }
  for (int r = 0; r < R; ++r) {
    for (int i = 0; i < N; ++i) store(rows[r].entries + first + i * L, here[r][i]);
    rows[r].held = active;
  }
}

// Path costs of the chunks `active` from those before, over them, above their lowest: sums are set or added
// to.
template <bool kAdd>
inline void step_any(int16_t* entries, uint64_t held, uint64_t active, int16_t large, int16_t small,
                     const uint8_t* cost, int16_t* sum) {
  alignas(64) int16_t ways[kMostChunks * kChunk];
  const Lanes far = splat<Lanes>(large), step = splat<Lanes>(small);
  int16_t* way = ways;
  for (uint64_t rest = active; rest; rest &= rest - 1, way += kChunk) {
    const int16_t* from = entries + __builtin_ctzll(rest) * kChunk;
    store(way, least(least(load<Lanes>(from), far), least_beside<Lanes>(from) + step));
  }
  clear(entries, held & ~active);
  Lanes minimum = splat<Lanes>(kBeyond);
  way = ways;
  for (uint64_t rest = active; rest; rest &= rest - 1, way += kChunk, cost += kChunk, sum += kChunk) {
    const Lanes here = load<Lanes>(way) + widened<Lanes>(cost);
    store(sum, kAdd ? load<Lanes>(sum) + here : here);
    store(way, here);
    minimum = least(minimum, here);
  }
  minimum = lowest(minimum);
  way = ways;
  for (uint64_t rest = active; rest; rest &= rest - 1, way += kChunk)
    store(entries + __builtin_ctzll(rest) * kChunk, load<Lanes>(way) - minimum);
}

template <bool kAdd>
void along_any(Line& row, int x, int count, int direction, uint64_t active, int16_t small) {
  for (; count; --count, x += direction) {
    const ptrdiff_t at = static_cast<ptrdiff_t>(row.start[x]) * kChunk;
    step_any<kAdd>(row.entries, row.held, active, row.large[x], small, row.costs + at, row.sums + at);
    row.held = active;
  }
}

// The path ends here.
inline void leave(Line& row) {
  clear(row.entries, row.held);
  row.held = 0;
}

// The path along R rows in columns whose chunks are the same in all.
template <int R, bool kAdd>
inline void along_same(Line* rows, const Run& run, int16_t small) {
  const int count = run.end - run.from, direction = kAdd ? -1 : 1, x = kAdd ? run.end - 1 : run.from;
  if (!run.active) {
    for (int r = 0; r < R; ++r) leave(rows[r]);
    return;
  }
  by_chunks(
      run.active,
      [&]<class V, int N>(int first) {
        along_run<V, N, R, kAdd>(rows, x, count, direction, run.active, first, small);
      },
      [&] {
        for (int r = 0; r < R; ++r) along_any<kAdd>(rows[r], x, count, direction, run.active, small);
      });
}

// Walks along a row by the columns that have the same chunks, or none.
struct Walk {
  Walk(const Runs& runs, int x, int width)
      : run(std::partition_point(runs.begin(), runs.end(), [x](const Run& r) { return r.end <= x; })),
        last(runs.end()),
        width(width) {
    arrive(x);
  }
  void to(int x) {
    if (x < end) return;
    run += active != 0;
    arrive(x);
  }
  void arrive(int x) {
    const bool inside = run != last && run->from <= x;
    active = inside ? run->active : 0;
    end = inside ? run->end : run != last ? run->from : width;
  }
  const Run *run, *last;
  int width, end;
  uint64_t active;
};

// Divides the columns [from, end) into those where all R rows have the same chunks, and others. Returns how
// many.
template <int R, size_t... r>
int split(const Line* rows, int from, int end, Part* parts, std::index_sequence<r...>) {
  Walk walks[R] = {Walk(rows[r].runs, from, end)...};
  int n = 0;
  while (from < end) {
    int until = std::min({end, walks[r].end...});
    const uint64_t active = walks[0].active;
    const bool same = ((walks[r].active == active) && ...);
    if (!same && n && !parts[n - 1].same)
      parts[n - 1].run.end = until;
    else
      parts[n++] = {{from, until, active}, same};
    from = until;
    (walks[r].to(from), ...);
  }
  return n;
}
template <int R>
int split(const Line* rows, int from, int end, Part* parts) {
  return split<R>(rows, from, end, parts, std::make_index_sequence<R>());
}

// The path along R rows in the n parts of their columns, from the left or, kAdd, from the right: where the
// rows are not alike, in twos or one by one. There is room for more parts behind these.
template <int R, bool kAdd>
void along(Line* rows, Part* parts, int n, int16_t small) {
  for (int i = 0; i < n; ++i) {
    const Part& part = parts[kAdd ? n - 1 - i : i];
    if (part.same) {
      along_same<R, kAdd>(rows, part.run, small);
    } else if constexpr (R > 1) {
      for (int r = 0; r < R; r += R / 2) {
        const int some = split<R / 2>(rows + r, part.run.from, part.run.end, parts + n);
        along<R / 2, kAdd>(rows + r, parts + n, some, small);
      }
    }
  }
}

template <int R>
void along_both_ways(Line* rows, int width, Part* parts, int16_t small) {
  const int n = split<R>(rows, 0, width, parts);
  along<R, false>(rows, parts, n, small);
  for (int r = 0; r < R; ++r) {
    leave(rows[r]);
    ++rows[r].large;
  }
  along<R, true>(rows, parts, n, small);
  for (int r = 0; r < R; ++r) leave(rows[r]);
}

void along_rows(Line* rows, int count, int width, Part* parts, int16_t small) {
  if (count == kRows) return along_both_ways<kRows>(rows, width, parts, small);
  for (int r = 0; r < count; ++r) along_both_ways<1>(rows + r, width, parts, small);
}

// ---------------------------------------------------------------------------------------- from row to row

// The sum of `costs` of a pixel's path, or paths, is saved; in bytes without the matching cost, which may not
// fit.
template <class V>
inline void save(uint8_t* to, V costs, V cost) {
  store_bytes(to, costs - cost);
}
template <class V>
inline void save(int16_t* to, V costs, V) {
  store(to, costs);
}
template <class V>
inline V saved(const uint8_t* from, V cost) {
  return widened<V>(from) + cost;
}
template <class V>
inline V saved(const int16_t* from, V) {
  return load<V>(from);
}

// The paths from row to row into the columns from x to before `end`, all active at the N kLanes<V> candidates
// from `first` on.
template <class V, int N, int P, class Saved, bool kLast>
inline void down_run(const Row& r, Saved* to, int x, int end, int first) {
  constexpr int L = kLanes<V>;
  const V step = splat<V>(r.small);
  const uint8_t* const costs = r.costs;
  const int32_t* const start = r.start;
  const int16_t* const along = r.along;
  int16_t* const totals = r.totals;
  const ptrdiff_t pitch = r.pitch;
  const int16_t* large[P];
  int16_t* entries[P];
  for (int p = 0; p < P; ++p) entries[p] = r.entries[p] + x * pitch + first, large[p] = r.large[p];
  for (; x < end; ++x) {
    const ptrdiff_t at = static_cast<ptrdiff_t>(start[x]) * kChunk;
    V total[N], cost[N];
    for (int i = 0; i < N; ++i) cost[i] = widened<V>(costs + at + i * L);
    for (int p = 0; p < P; ++p) {
      int16_t* e = entries[p];
      const V far = splat<V>(large[p][x]);
      V here[N], minimum;
      for (int i = 0; i < N; ++i) {
        here[i] = least(least(load<V>(e + i * L), far), least_beside<V>(e + i * L) + step) + cost[i];
        total[i] = p ? total[i] + here[i] : here[i];
        minimum = i ? least(minimum, here[i]) : here[i];
      }
      minimum = lowest(minimum);
      for (int i = 0; i < N; ++i) store(e + i * L, here[i] - minimum);
      entries[p] += pitch;
    }
    for (int i = 0; i < N; ++i) {
      if constexpr (kLast)
        store(totals + at + i * L,
              total[i] + load<V>(along + at + i * L) + saved<V>(to + at + i * L, cost[i]));
      else
        save(to + at + i * L, total[i], cost[i]);
    }
  }
}

// The same for any chunks.
template <int P, class Saved, bool kLast>
void down_any(const Row& r, Saved* to, const Run& run) {
  alignas(64) int16_t total[kMostChunks * kChunk];
  for (int x = run.from; x < run.end; ++x) {
    ptrdiff_t at = static_cast<ptrdiff_t>(r.start[x]) * kChunk;
    for (int p = 0; p < P; ++p) {
      const auto step = p ? step_any<true> : step_any<false>;
      step(r.entries[p] + x * r.pitch, 0, run.active, r.large[p][x], r.small, r.costs + at, total);
    }
    const int16_t* sum = total;
    for (uint64_t rest = run.active; rest; rest &= rest - 1, sum += kChunk, at += kChunk) {
      const Lanes t = load<Lanes>(sum), cost = widened<Lanes>(r.costs + at);
      if constexpr (kLast)
        store(r.totals + at, t + load<Lanes>(r.along + at) + saved<Lanes>(to + at, cost));
      else
        save(to + at, t, cost);
    }
  }
}

// First lowest sum of every pixel and those beside it.
template <class V, int N>
inline void pick_run(const Row& r, int x, int end, int first) {
  constexpr int L = kLanes<V>;
  const int16_t* const totals = r.totals;
  const int32_t* const start = r.start;
  Pick* const picks = r.picks;
  for (; x < end; ++x) {
    const int16_t* sums = totals + static_cast<ptrdiff_t>(start[x]) * kChunk;
    V sum[N], minimum;
    for (int i = 0; i < N; ++i) {
      sum[i] = load<V>(sums + i * L);
      minimum = i ? least(minimum, sum[i]) : sum[i];
    }
    minimum = lowest(minimum);
    int best = (N - 1) * L + __builtin_ctz(equal(sum[N - 1], minimum) | 1u << 31);
    for (int i = N - 1; i--;)
      if (const uint32_t same = equal(sum[i], minimum)) best = i * L + __builtin_ctz(same);
    Pick* const to = picks + x;
    __builtin_memcpy(to, sums + best - 1, sizeof *to);
    to->best = static_cast<int16_t>(first + best);
    if (best == 0 || best == N * L - 1) to->left = to->right = kNone;
  }
}

inline void pick_any(const Row& r, const Run& run) {
  const uint64_t active = run.active;
  for (int x = run.from; x < run.end; ++x) {
    const int16_t* sums = r.totals + static_cast<ptrdiff_t>(r.start[x]) * kChunk;
    int best = 0, at = 0, place = 0;
    for (uint64_t rest = active; rest; rest &= rest - 1, at += kChunk) {
      const Lanes sum = load<Lanes>(sums + at), low = lowest(sum);
      if (at && first_lane(low) >= sums[best]) continue;
      best = at + __builtin_ctz(equal(sum, low));
      place = best - at + __builtin_ctzll(rest) * kChunk;
    }
    const bool inner = place > 0 && place + 1 < kMostChunks * kChunk &&
                       (active >> (place - 1) / kChunk & 1) && (active >> (place + 1) / kChunk & 1);
    r.picks[x] = {inner ? sums[best - 1] : kNone, sums[best], inner ? sums[best + 1] : kNone,
                  static_cast<int16_t>(place)};
  }
}

// What the paths held at chunks where this row is not active, so that it does not reach beyond it.
template <int P>
void forget(const Row& r) {
  for (int p = 0; p < P; ++p) {
    const int dx = P == 1 ? 0 : r.dx[p];
    const Run* is = r.runs.begin();
    for (const Run& was : r.before) {
      int x = std::max(0, was.from + dx);
      for (const int end = std::min(r.width, was.end + dx); x < end;) {
        while (is != r.runs.end() && is->end <= x) ++is;
        const bool beyond = is == r.runs.end(), inside = !beyond && is->from <= x;
        const int until = beyond ? end : std::min(end, inside ? is->end : is->from);
        const uint64_t gone = inside ? was.active & ~is->active : was.active;
        if (gone)
          for (int i = x; i < until; ++i) clear(r.entries[p] + i * r.pitch, gone);
        x = until;
      }
    }
  }
}

// Candidates of a row, moved to the vertex of the parabola through three sums where all are active: 32nds of
// a pixel.
inline void places(const Row& r, int from, int to) {
  const Pick* const picks = r.picks;
  uint16_t* const out = r.out;
  const int half = kUnits / 16 * r.grid.step, step = kUnits / 8 * r.grid.step,
            start = kUnits / 8 * r.grid.first - half;
#pragma GCC ivdep
  for (int x = from; x < to; ++x) {
    const int left = picks[x].left, right = picks[x].right, lowest = picks[x].lowest;
    const int bend = left + right - 2 * lowest;
    // floor(half (left - right) / bend + 1/2) + half; a quotient of such numbers is never rounded up to a
    // whole
    const double whole = bend > 0 ? 4 * half * (left - lowest) + bend : 2 * half + 1;
    const double by = bend > 0 ? 2 * bend : 2;
    out[x] = static_cast<uint16_t>(start + step * picks[x].best + static_cast<int>(whole / by));
  }
}

void add_runs(const uint64_t* active, int width, std::vector<Run>& runs) {
  for (int x = 0; x < width;) {
    const int from = x;
    x = same_until(active, from, width, active[from]);
    if (active[from]) runs.push_back({from, x, active[from]});
  }
}

// Calls use(from, end) for the columns of runs that follow one another.
template <class Use>
inline void for_each_stretch(const Runs& runs, Use use) {
  for (const Run* run = runs.begin(); run != runs.end();) {
    const int from = run->from;
    int end = run->end;
    while (++run != runs.end() && run->from == end) end = run->end;
    use(from, end);
  }
}

template <int P, class Saved, bool kLast>
void down(const Row& r, Saved* to) {
  for (const Run& run : r.runs)
    by_chunks(
        run.active,
        [&]<class V, int N>(int first) { down_run<V, N, P, Saved, kLast>(r, to, run.from, run.end, first); },
        [&] { down_any<P, Saved, kLast>(r, to, run); });
  forget<P>(r);
  if (!kLast) return;
  for (const Run& run : r.runs)
    by_chunks(
        run.active, [&]<class V, int N>(int first) { pick_run<V, N>(r, run.from, run.end, first); },
        [&] { pick_any(r, run); });
  for_each_stretch(r.runs, [&](int from, int end) { places(r, from, end); });
}

template <int P, class Saved>
void down(const Row& r, Saved* to) {
  r.out ? down<P, Saved, true>(r, to) : down<P, Saved, false>(r, to);
}

void down_row(const Row& r, bool eight) {
  if (eight)
    down<3>(r, r.saved);
  else if (r.saved_bytes)
    down<1>(r, r.saved_bytes);
  else
    down<1>(r, r.saved);
}

// ----------------------------------------------------------------------------------------------- penalties

#ifdef SEEPAST_AVX2
// Colour steps sum |a - b| of eight pixels; no byte behind them is read.
inline __m256i colour_steps(const uint8_t* a, const uint8_t* b) {
  const auto load = [&](const uint8_t* from) {
    return _mm256_inserti128_si256(
        _mm256_castsi128_si256(_mm_loadu_si128(reinterpret_cast<const __m128i*>(from))),
        _mm_loadu_si128(reinterpret_cast<const __m128i*>(from + 8)), 1);
  };
  const __m256i m = load(a), n = load(b),
                step = _mm256_or_si256(_mm256_subs_epu8(m, n), _mm256_subs_epu8(n, m));
  const __m256i place = _mm256_setr_epi8(0, 1, 2, -1, 3, 4, 5, -1, 6, 7, 8, -1, 9, 10, 11, -1,  //
                                         4, 5, 6, -1, 7, 8, 9, -1, 10, 11, 12, -1, 13, 14, 15, -1);
  const __m256i parts = _mm256_shuffle_epi8(step, place);
  return _mm256_madd_epi16(_mm256_maddubs_epi16(parts, _mm256_set1_epi8(1)), _mm256_set1_epi16(1));
}
#endif

// P2 between kBlockOfSteps pixels and the others, which are `other` from them.
inline void step_block(const uint8_t* image, const uint8_t* is_static, ptrdiff_t other, const Large& large,
                       int16_t* out) {
#ifdef SEEPAST_AVX2
  static_assert(kBlockOfSteps == 8);
  const auto flags = [&](ptrdiff_t at) {
    return _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(is_static + at)));
  };
  const __m256i both = _mm256_and_si256(flags(0), flags(other));
  const __m256i none = _mm256_cmpeq_epi32(both, _mm256_setzero_si256());
  alignas(32) int32_t step[kBlockOfSteps];
  _mm256_store_si256(
      reinterpret_cast<__m256i*>(step),
      _mm256_blendv_epi8(colour_steps(image, image + 3 * other), _mm256_set1_epi32(kColourSteps), none));
#pragma GCC unroll 8
  for (int i = 0; i < kBlockOfSteps; ++i) out[i] = large[step[i]];
#else
  steps_of(image, is_static, kBlockOfSteps, other, large, out);
#endif
}

// The same in the columns [from, to) of a row, where they are matched; what is elsewhere does not
// matter, if it is a penalty.
void step_row(const uint8_t* image, const uint8_t* is_static, Runs runs, int from, int to, ptrdiff_t other,
              const Large& large, int16_t* out) {
  constexpr int n = kBlockOfSteps;
  std::fill(out + from, out + std::max(from, to), int16_t{0});
  for_each_stretch(runs, [&](int first, int last) {
    const int end = std::min(last, to);
    for (int x = std::max(first, from); x < end; x += n) {
      const int whole = std::min(x, to - n);  // a few twice, since whole blocks are faster
      if (whole >= from)
        step_block(image + 3 * whole, is_static + whole, other, large, out + whole);
      else
        steps_of(image + 3 * x, is_static + x, end - x, other, large, out + x);
    }
  });
}
