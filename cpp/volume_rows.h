// What stage "volume" does to a row, for one level of instructions: volume.cpp includes this once per level.
// `Lanes` are as many columns as one instruction takes, one byte each.
//
// SEEPAST_BYTES_AVX512 or SEEPAST_BYTES_AVX2 say what there is beside the compiler's own vectors.

#if defined(SEEPAST_BYTES_AVX512)
constexpr int kLanes = 64;
#elif defined(SEEPAST_BYTES_AVX2)
constexpr int kLanes = 32;
#else
constexpr int kLanes = 16;
#endif
typedef uint8_t Lanes __attribute__((vector_size(kLanes)));
typedef uint16_t Wide __attribute__((vector_size(kLanes)));  // half as many columns, two bytes each

#define SEEPAST_INLINE inline __attribute__((always_inline))

SEEPAST_INLINE Lanes load(const uint8_t* at) {
  Lanes v;
  std::memcpy(&v, at, sizeof(v));
  return v;
}
SEEPAST_INLINE void store(uint8_t* at, Lanes v) { std::memcpy(at, &v, sizeof(v)); }
SEEPAST_INLINE Lanes all(uint8_t value) { return Lanes{} + value; }

// 255 where the byte is not 0.
SEEPAST_INLINE Lanes holds(Lanes flags) { return reinterpret_cast<Lanes>(flags != 0); }
SEEPAST_INLINE Lanes choose(Lanes where, Lanes a, Lanes b) { return (where & a) | (~where & b); }

#if defined(SEEPAST_BYTES_AVX512)
SEEPAST_INLINE Lanes lesser(Lanes a, Lanes b) { return (Lanes)_mm512_min_epu8((__m512i)a, (__m512i)b); }
SEEPAST_INLINE Lanes greater(Lanes a, Lanes b) { return (Lanes)_mm512_max_epu8((__m512i)a, (__m512i)b); }
SEEPAST_INLINE Lanes mean(Lanes a, Lanes b) { return (Lanes)_mm512_avg_epu8((__m512i)a, (__m512i)b); }
SEEPAST_INLINE Lanes plus(Lanes a, Lanes b) { return (Lanes)_mm512_adds_epu8((__m512i)a, (__m512i)b); }
SEEPAST_INLINE bool any_of(Lanes v, uint8_t value) {
  return _mm512_cmpeq_epi8_mask((__m512i)v, (__m512i)all(value)) != 0;
}
SEEPAST_INLINE Wide third(Wide sum) {
  return (Wide)_mm512_mulhi_epu16((__m512i)sum, _mm512_set1_epi16(21846));
}
SEEPAST_INLINE Lanes bits_of(Lanes a, Lanes b, Lanes c) {
  return (Lanes)_mm512_popcnt_epi8((__m512i)a) + (Lanes)_mm512_popcnt_epi8((__m512i)b) +
         (Lanes)_mm512_popcnt_epi8((__m512i)c);
}
// What stands at the number of valid neighbours in a table of 32.
SEEPAST_INLINE Lanes looked_up(const uint8_t* table, Lanes known) {
  const __m512i all = _mm512_castsi256_si512(_mm256_loadu_si256((const __m256i*)table));
  return (Lanes)_mm512_permutexvar_epi8((__m512i)known, all);
}
SEEPAST_INLINE Lanes enough(const uint8_t* scale, Lanes known) { return looked_up(scale, known); }
SEEPAST_INLINE Lanes too_few(const uint8_t* few, Lanes known) { return looked_up(few, known); }
#elif defined(SEEPAST_BYTES_AVX2)
SEEPAST_INLINE Lanes lesser(Lanes a, Lanes b) { return (Lanes)_mm256_min_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Lanes greater(Lanes a, Lanes b) { return (Lanes)_mm256_max_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Lanes mean(Lanes a, Lanes b) { return (Lanes)_mm256_avg_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Lanes plus(Lanes a, Lanes b) { return (Lanes)_mm256_adds_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE bool any_of(Lanes v, uint8_t value) {
  return _mm256_movemask_epi8((__m256i)(v == all(value))) != 0;
}
SEEPAST_INLINE Wide third(Wide sum) {
  return (Wide)_mm256_mulhi_epu16((__m256i)sum, _mm256_set1_epi16(21846));
}
SEEPAST_INLINE Lanes permuted(__m128i table, Lanes i) {
  return (Lanes)_mm256_shuffle_epi8(_mm256_broadcastsi128_si256(table), (__m256i)i);
}
SEEPAST_INLINE Lanes bits_of(Lanes a, Lanes b,
                             Lanes c) {  // of every three bits one counts once and one twice
  const __m128i once = _mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4),
                twice = _mm_setr_epi8(0, 2, 2, 4, 2, 4, 4, 6, 2, 4, 4, 6, 4, 6, 6, 8);
  const auto count = [](__m128i table, Lanes v) {
    return permuted(table, v & 15) + permuted(table, (Lanes)((Wide)v >> 4) & 15);
  };
  const Lanes either = a ^ b;
  return count(once, either ^ c) + count(twice, (a & b) | (either & c));
}
// What is 0 below kFew, and what is 0 from there on.
SEEPAST_INLINE Lanes enough(const uint8_t* scale, Lanes known) {
  return permuted(_mm_loadu_si128((const __m128i*)(scale + kFew + 1)),
                  known - (kFew + 1)) |  // 0 for what is negative
         ((Lanes)(known == kFew) & all(scale[kFew]));
}
SEEPAST_INLINE Lanes too_few(const uint8_t* few, Lanes known) {
  return permuted(_mm_loadu_si128((const __m128i*)few), lesser(known, all(15)));
}
#else
SEEPAST_INLINE Lanes lesser(Lanes a, Lanes b) { return choose(reinterpret_cast<Lanes>(a < b), a, b); }
SEEPAST_INLINE Lanes greater(Lanes a, Lanes b) { return choose(reinterpret_cast<Lanes>(a < b), b, a); }
SEEPAST_INLINE Lanes halved(Lanes v) {
  return reinterpret_cast<Lanes>(reinterpret_cast<Wide>(v) >> 1) & 0x7f;
}
SEEPAST_INLINE Lanes mean(Lanes a, Lanes b) { return (a | b) - halved(a ^ b); }
SEEPAST_INLINE Lanes plus(Lanes a, Lanes b) {
  return (a + b) | reinterpret_cast<Lanes>(a + b < a);
}  // 255 at most
SEEPAST_INLINE bool any_of(Lanes v, uint8_t value) { return std::memchr(&v, value, sizeof(v)) != nullptr; }
SEEPAST_INLINE Wide third(Wide sum) {
  Wide out;
  for (int x = 0; x < kLanes / 2; ++x)
    out[x] = static_cast<uint16_t>(static_cast<uint32_t>(sum[x]) * 21846 >> 16);
  return out;
}
SEEPAST_INLINE Lanes shifted(Lanes v, int by, uint8_t kept) {
  return reinterpret_cast<Lanes>(reinterpret_cast<Wide>(v) >> by) & kept;
}
SEEPAST_INLINE Lanes fours(Lanes v) {  // the bits of every four
  const Lanes pairs = v - shifted(v, 1, 0x55);
  return (pairs & 0x33) + shifted(pairs, 2, 0x33);
}
SEEPAST_INLINE Lanes bits_of(Lanes a, Lanes b, Lanes c) {
  const Lanes sum = fours(a) + fours(b) + fours(c);
  return (sum & 15) + shifted(sum, 4, 15);
}
SEEPAST_INLINE Lanes looked_up(const uint8_t* table, Lanes known) {
#if defined(__clang__)
  Lanes out;
  for (int x = 0; x < kLanes; ++x) out[x] = table[known[x]];
  return out;
#else
  return __builtin_shuffle(load(table), load(table + 16), known);
#endif
}
SEEPAST_INLINE Lanes enough(const uint8_t* scale, Lanes known) { return looked_up(scale, known); }
SEEPAST_INLINE Lanes too_few(const uint8_t* few, Lanes known) { return looked_up(few, known); }
#endif

#if defined(SEEPAST_BYTES_AVX512)
constexpr int kRowsAtOnce = 2;
static_assert(kLanes == 2 * kColumns);
#else
constexpr int kRowsAtOnce = 1;
static_assert(kColumns % kLanes == 0);
#endif

// Where as much of a tile of one camera is read as there are lanes: plane p of row j at [j] + p stride,
// planes as those of a phase.
struct Tile {
  SEEPAST_INLINE Lanes plane(int p) const {
#if defined(SEEPAST_BYTES_AVX512)
    const __m256i first = _mm256_loadu_si256((const __m256i*)(at[0] + p * stride)),
                  second = _mm256_loadu_si256((const __m256i*)(at[1] + p * stride));
    return (Lanes)_mm512_inserti64x4(_mm512_castsi256_si512(first), second, 1);
#else
    return load(at[0] + p * stride);
#endif
  }
  SEEPAST_INLINE Lanes census(int i) const { return plane(i); }
  SEEPAST_INLINE Lanes colour(int i) const { return plane(kBytes + i); }
  SEEPAST_INLINE Lanes known(int i) const { return plane(plane_valid(0) + i); }
  SEEPAST_INLINE Lanes is_static() const { return plane(plane_static(0)); }

  const uint8_t* at[kRowsAtOnce];
  ptrdiff_t stride;
};

// One whose planes were read before.
struct Copied {
  SEEPAST_INLINE explicit Copied(const Tile& tile) {
    for (int p = 0; p < 3 * kBytes; ++p) planes[p] = tile.plane(p);
  }
  SEEPAST_INLINE Lanes census(int i) const { return planes[i]; }
  SEEPAST_INLINE Lanes colour(int i) const { return planes[kBytes + i]; }
  SEEPAST_INLINE Lanes known(int i) const { return planes[2 * kBytes + i]; }
  Lanes planes[3 * kBytes];
};

SEEPAST_INLINE Lanes apart(Lanes a, Lanes b) { return greater(a, b) - lesser(a, b); }

// The same sum in both halves of every two bytes.
template <class Function>
SEEPAST_INLINE Lanes in_halves(Function of) {
  const Wide low = of([](Lanes v) { return reinterpret_cast<Wide>(v) & 255; });
  const Wide high = of([](Lanes v) { return reinterpret_cast<Wide>(v) >> 8; });
  return reinterpret_cast<Lanes>(low | (high << 8));
}

// (a b + 4) / 8 of bytes whose products have 15 bits, b below 128.
SEEPAST_INLINE Lanes eighths(Lanes a, Lanes b) {
#if defined(SEEPAST_BYTES_AVX512)
  const __m512i even = _mm512_set1_epi16(255);
  const Wide low = (Wide)_mm512_maddubs_epi16(_mm512_and_si512((__m512i)a, even), (__m512i)b);
  const Wide high = (Wide)_mm512_maddubs_epi16(_mm512_andnot_si512(even, (__m512i)a), (__m512i)b);
  return reinterpret_cast<Lanes>((low + 4) >> 3 | (((high + 4) << 5) & 0xff00));
#elif defined(SEEPAST_BYTES_AVX2)
  const __m256i even = _mm256_set1_epi16(255);
  const Wide low = (Wide)_mm256_maddubs_epi16(_mm256_and_si256((__m256i)a, even), (__m256i)b);
  const Wide high = (Wide)_mm256_maddubs_epi16(_mm256_andnot_si256(even, (__m256i)a), (__m256i)b);
  return reinterpret_cast<Lanes>((low + 4) >> 3 | (((high + 4) << 5) & 0xff00));
#else
  return in_halves([&](auto half) { return (half(a) * half(b) + 4) >> 3; });
#endif
}

// reference_multiview.pair_cost. A copy of what it takes: behind a pointer the compiler would read it again
// for every pair, since costs might be written over it.
struct PairCost {
  // Where every neighbour of both rays is static ...
  template <class A>
  SEEPAST_INLINE Lanes of_clear(const A& a, const Tile& b) const {
    const Lanes differing =
        bits_of(a.census(0) ^ b.census(0), a.census(1) ^ b.census(1), a.census(2) ^ b.census(2));
    const Lanes twice = differing + differing;
    return twice + twice + of_colour(a, b);
  }

  // ... and anywhere.
  template <class A>
  SEEPAST_INLINE Lanes of(const A& a, const Tile& b) const {
    const Lanes k0 = a.known(0) & b.known(0), k1 = a.known(1) & b.known(1), k2 = a.known(2) & b.known(2),
                known = bits_of(k0, k1, k2);
    const Lanes differing = bits_of((a.census(0) ^ b.census(0)) & k0, (a.census(1) ^ b.census(1)) & k1,
                                    (a.census(2) ^ b.census(2)) & k2);
    return plus(eighths(differing, enough(scale, known)) | too_few(few, known), of_colour(a, b));
  }

  template <class A>
  SEEPAST_INLINE Lanes of_colour(const A& a, const Tile& b) const {
    const Lanes blue = apart(a.colour(0), b.colour(0)), green = apart(a.colour(1), b.colour(1)),
                red = apart(a.colour(2), b.colour(2));
    return lesser(mean(mean(blue, red), green), cap);
  }

  const uint8_t *scale, *few;
  Lanes cap;
};

// Two rows of the volume.
struct RowMatcher {
  static constexpr int kRuns = 16;  // that are matched together
  struct Found {                    // of a pair
    alignas(64) uint8_t costs[kRuns][kBlock];
    uint8_t at[kRuns];   // where in `costs` those of a run are,
    uint32_t again = 0;  // if these runs were matched: a bit each
  };

  RowMatcher(const Volume& volume, const Rows& rows) : v(volume), rows(rows) {
    few[0] = kNoPair;
    for (int known = 1; known < kFew; ++known) few[known] = volume.params.few;
    for (auto& of_row : drops) of_row.resize(volume.columns.shifts());
    steady.resize(volume.columns.shifts() / kChunk);
  }

  // The rows [y, end) that `rows` and `drops` are about.
  __attribute__((noinline)) void match_rows(int y, int end) {
    if (end < y + kTileRows) drops[1] = drops[0];  // any: nothing is wanted there
    find_steady();
    for (int t = 0; t < v.columns.tiles; ++t) match_tile(y, end, t);
  }

  // The chunks of a camera of which all candidates land on the same rows.
  void find_steady() {
    for (size_t chunk = 0; chunk < steady.size(); ++chunk) {
      int32_t apart = 0;
      for (const auto& of_row : drops) {
        const int32_t* drop = of_row.data() + kChunk * chunk;
        for (int i = 0; i < kChunk; ++i) apart |= drop[i] ^ drop[0];
      }
      steady[chunk] = !apart;
    }
  }

  static SEEPAST_INLINE uint32_t bits_from(const uint8_t* at, int skip) {
    uint64_t bits;
    std::memcpy(&bits, at, sizeof(bits));
    return static_cast<uint32_t>(bits >> skip);
  }

  // The chunks that some pixel of a tile wants, from the farthest on.
  void match_tile(int y, int end, int t) {
    const int from = t * kColumns, width = least(kColumns, v.array().width - from);
    alignas(64) uint64_t active[kBlock] = {};
    int32_t next[kBlock];
    for (int j = 0; j < end - y; ++j) {
      const size_t first = static_cast<size_t>(y + j) * v.array().width + from;
      const Chunks chunks{v.view.chunks.active + first, v.view.chunks.start + first};
      if (chunks.start[0] == chunks.start[width]) continue;
      copy_columns(chunks.active, width, active + j * kColumns);
      copy_columns(chunks.start, width, next + j * kColumns);
    }
    uint64_t any = 0;
    for (int x = 0; x < kBlock; ++x) any |= active[x];
    if (!any) return;
    look_at_own(from);
    for (; any; any &= any - 1) {
      const int chunk = __builtin_ctzll(any);
      const uint64_t wanted = lanes_with(active, chunk);
      fetch(t, chunk);
      match_chunk(t, chunk, wanted);
      put_chunk(wanted, next);
    }
  }

  template <class T>
  static void copy_columns(const T* from, int width, T* to) {
    if (width == kColumns)  // a copy of known size is a few instructions
      std::memcpy(to, from, sizeof(T) * kColumns);
    else
      std::memcpy(to, from, sizeof(T) * static_cast<size_t>(width));
  }

  static uint64_t lanes_with(const uint64_t* active, int chunk) {
    uint64_t lanes = 0;
#if defined(SEEPAST_BYTES_AVX512)
    const __m512i bit = _mm512_set1_epi64(static_cast<int64_t>(uint64_t{1} << chunk));
    for (int x = 0; x < kBlock; x += 8)
      lanes |= static_cast<uint64_t>(_mm512_test_epi64_mask(_mm512_loadu_si512(active + x), bit)) << x;
#elif defined(SEEPAST_BYTES_AVX2)
    const __m128i up = _mm_cvtsi32_si128(63 - chunk);  // to where a mask is taken from
    for (int x = 0; x < kBlock; x += 4) {
      const __m256i four = _mm256_sll_epi64(_mm256_load_si256((const __m256i*)(active + x)), up);
      lanes |= static_cast<uint64_t>(_mm256_movemask_pd(_mm256_castsi256_pd(four))) << x;
    }
#else
    for (int x = 0; x < kBlock; ++x) lanes |= (active[x] >> chunk & 1) << x;
#endif
    return lanes;
  }

  // Copies the view's own tile, which all candidates share.
  void look_at_own(int from) {
    const int stride = v.columns.stride, column = from + kBlock;
    uint32_t unclear = 0;
    seen = 0;
    for (int j = 0; j < kTileRows; ++j) {
      const uint8_t* row = rows.of(v.view.number)[j];
      for (int p = 0; p < kPlanesOfPhase; ++p)
        std::memcpy(own_planes[p] + j * kColumns, row + p * stride + column, kColumns);
      row += column / 8;
      unclear |= bits_from(row + bits_unclear(stride), column % 8);
      seen |= static_cast<uint64_t>(bits_from(row + bits_seen(stride), column % 8)) << j * kColumns;
    }
    for (int j = 0; j < kTileRows; ++j)
      std::fill_n(tiles[v.view.number][j], kRuns, own_planes[0] + j * kColumns);
    moved[v.view.number] = 1;
    clear[v.view.number] = unclear ? 0 : ~0u;
    blind[v.view.number] = seen ? 0 : ~0u;
  }

  // Asks for what a chunk will look at, all at once.
  void fetch(int t, int chunk) const {
    const Columns& columns = v.columns;
    const Columns::OfTile& tile = columns.of_tiles[t];
    const size_t candidate = static_cast<size_t>(kChunk) * chunk;
    for (int k = 0; k < v.array().cameras; ++k) {
      const Place place = tile.places[k * tile.runs.size() + tile.starts[candidate]];
      if (k == v.view.number || place.outside) continue;
      for (int j = 0; j < kTileRows; ++j) {
        const uint8_t* at =
            rows.of(k)[drops[j][k * columns.count + candidate] + j] + place.at % columns.stride;
        for (int plane = 0; plane < kPlanes; ++plane, at += columns.stride) __builtin_prefetch(at);
      }
    }
  }

  // The candidates of a chunk for the pixels `wanted` of a tile into `costs`.
  void match_chunk(int t, int chunk, uint64_t wanted) {
    const Columns::OfTile& tile = v.columns.of_tiles[t];
    const int32_t* starts = tile.starts.data() + kChunk * chunk;
    const Run* runs = tile.runs.data();
    whole = starts[kChunk] - starts[0] == kChunk;  // one run per candidate
    int count = 0;
    for (int r = starts[0]; r < starts[kChunk]; ++r) {
      if (!(wanted & runs[r].lanes())) continue;
      chosen[count++] = r;
      if (count == kRuns) match_runs(t, chunk, count, wanted), count = 0;
    }
    if (count) match_runs(t, chunk, count, wanted);
  }

  // The first `count` of the `chosen` runs.
  void match_runs(int t, int chunk, int count, uint64_t wanted) {
    for (int k = 0; k < v.array().cameras; ++k) {
      if (k == v.view.number) continue;
      const size_t at = static_cast<size_t>(k) * (v.columns.count / kChunk) + chunk;
      const uint32_t steps = count == kChunk && steady[at] ? v.columns.of_tiles[t].steps[at] : 0;
      if (steps)
        place_chunk(k, t, chunk, steps);
      else
        place_runs(k, t, count);
    }
    for (int x = 0; x < kBlock; x += kLanes) {
      const uint64_t here = wanted >> x << (64 - kLanes) >> (64 - kLanes), mine = seen >> x & here;
      if (!here) continue;
      const uint32_t sure_of_mine = mine ? match_pairs(v.view.with_own, with_own, count, x) : ~0u,
                     sure_of_theirs = mine != here ? match_pairs(v.view.others, others, count, x) : ~0u;
      for (int i = 0; i < count; ++i) {
        const Run& run = v.columns.of_tiles[t].runs[chosen[i]];
        const bool sure = (sure_of_mine & sure_of_theirs) >> i & 1;
        const Lanes cost = cost_of(x, i, mine, mine != here, sure);
        uint8_t* const to = costs[run.candidate % kChunk] + x;
        if (whole)
          store(to, cost);
        else
          store_run(to, cost, run.lanes() >> x);
      }
    }
  }

  // Where camera k is read for all runs of a chunk, which are on the same rows, and from which on elsewhere.
  void place_chunk(int k, int t, int chunk, uint32_t steps) {
    const Columns& columns = v.columns;
    const Columns::OfTile& tile = columns.of_tiles[t];
    const size_t first = k * tile.runs.size() + tile.starts[kChunk * chunk],
                 candidate = static_cast<size_t>(k) * columns.count + kChunk * chunk;
    const Place* const places = tile.places.data() + first;
    const int32_t* const at = tile.at.data() + first;
    const uint8_t *const row = rows.of(k)[drops[0][candidate]], *const below =
                                                                    rows.of(k)[drops[1][candidate] + 1];
    for (int i = 0; i < kChunk; ++i) tiles[k][0][i] = row + at[i];
    for (int i = 0; i < kChunk; ++i) tiles[k][1][i] = below + at[i];
    uint32_t is_clear = 0, is_blind = 0;
    for (uint32_t left = steps; left; left &= left - 1) {
      const int i = __builtin_ctz(left);
      const uint32_t on = ~0u << i, all = all_of(row, below, places[i]);
      is_clear = (is_clear & ~on) | (all == kClear ? on : 0);
      is_blind = (is_blind & ~on) | (all == kBlind ? on : 0);
    }
    moved[k] = steps, clear[k] = is_clear, blind[k] = is_blind;
  }

  // The same for the chosen runs.
  void place_runs(int k, int t, int count) {
    const Columns& columns = v.columns;
    const Columns::OfTile& tile = columns.of_tiles[t];
    const Place* const places = tile.places.data() + k * tile.runs.size();
    const size_t candidates = static_cast<size_t>(k) * columns.count;
    const uint8_t **const first = tiles[k][0], **const second = tiles[k][1];
    uint32_t elsewhere = 0, is_clear = 0, is_blind = 0;
    for (int i = 0; i < count; ++i) {
      const Place place = places[chosen[i]];
      const size_t candidate = candidates + tile.runs[chosen[i]].candidate;
      const uint8_t* const row = place.outside ? rows.outside : rows.of(k)[drops[0][candidate]];
      const uint8_t* const below = place.outside ? rows.outside : rows.of(k)[drops[1][candidate] + 1];
      first[i] = row + place.at, second[i] = below + place.at;
      if (!i || first[i] != first[i - 1] || second[i] != second[i - 1]) elsewhere |= 1u << i;
      const uint32_t all = all_of(row, below, place);
      is_clear |= static_cast<uint32_t>(all == kClear) << i, is_blind |= static_cast<uint32_t>(all == kBlind)
                                                                         << i;
    }
    moved[k] = elsewhere, clear[k] = is_clear, blind[k] = is_blind;
  }

  // What holds of all pixels of a tile that is read at `place` of two rows.
  static constexpr uint32_t kClear = 1;  // every neighbour of every sample is static
  static constexpr uint32_t kBlind = 2;  // no sample is
  SEEPAST_INLINE uint32_t all_of(const uint8_t* row, const uint8_t* below, const Place& place) const {
    const auto any = [&](int bits) {
      return bits_from(row + bits + place.bits, place.skip) |
             bits_from(below + bits + place.bits, place.skip);
    };
    if (!any(bits_unclear(v.columns.stride))) return kClear;
    return any(bits_seen(v.columns.stride)) ? 0 : kBlind;
  }

  // Where a camera is read at every run, from a pixel of the tile on.
  struct Places {
    SEEPAST_INLINE Tile at(int i) const {
      Tile tile{{}, stride};
      for (int j = 0; j < kRowsAtOnce; ++j) tile.at[j] = rows[j][i] + column;
      return tile;
    }
    const uint8_t* const* rows[kRowsAtOnce];
    ptrdiff_t column, stride;
  };
  SEEPAST_INLINE Places places(int k, int x) const {
    Places found{{}, x % kColumns, k == v.view.number ? kBlock : v.columns.stride};
    for (int j = 0; j < kRowsAtOnce; ++j) found.rows[j] = tiles[k][x / kColumns + j];
    return found;
  }

  static void store_run(uint8_t* to, Lanes cost, uint64_t lanes) {
    uint8_t found[kLanes];
    store(found, cost);
    for (int x = 0; x < kLanes; ++x)
      if (lanes >> x & 1) to[x] = found[x];
  }

  // Costs of pairs at the first `count` runs. Near cameras move by less than half a pixel from candidate to
  // candidate: what was found of such pairs stays. Returns a bit per run: some pair has a cost in every
  // pixel.
  SEEPAST_INLINE uint32_t match_pairs(const Pairs& pairs, Found* found, int count, int x) {
    uint32_t sure = 0;
    const int32_t* pair = pairs.cameras;
    for (int p = 0; p < pairs.count; ++p, pair += 2) {
      const int a = pair[1] == v.view.number ? pair[1] : pair[0], b = pair[0] + pair[1] - a;
      sure |= clear[a] & clear[b];
      if (a == v.view.number)
        match_pair<true>(a, b, found[p], count, x);
      else
        match_pair<false>(a, b, found[p], count, x);
    }
    return sure;
  }

  static void find_again(uint32_t again, Found& found) {
    for (int i = 0, last = 0; i < kRuns; ++i) {
      last = again >> i & 1 ? i : last;
      found.at[i] = static_cast<uint8_t>(last);
    }
    found.again = again;
  }

  // Of cameras a, which is the view's own or not, and b.
  template <bool kOwn>
  SEEPAST_INLINE void match_pair(int a, int b, Found& found, int count, int x) {
    const uint32_t again = (moved[a] | moved[b]) & ((uint32_t{1} << count) - 1), none = blind[a] | blind[b],
                   is_clear = clear[a] & clear[b] & ~none;
    if (again != found.again) find_again(again, found);
    for (uint32_t left = again & none; left; left &= left - 1)
      store(found.costs[__builtin_ctz(left)] + x, all(kNoPair));
    const PairCost cost{v.params.census_scale, few, all(v.params.colour_cap)};
    const Places of_a = places(a, x), of_b = places(b, x);
    const Copied own(of_a.at(0));  // of use if it is the view's own
    const uint32_t unclear = again & ~none & ~is_clear;
    uint8_t* const to = found.costs[0] + x;
    for (uint32_t left = again & is_clear; left; left &= left - 1) {
      const int i = __builtin_ctz(left);
      const Tile other = of_b.at(i);
      store(to + i * kBlock, kOwn ? cost.of_clear(own, other) : cost.of_clear(of_a.at(i), other));
    }
    for (uint32_t left = unclear; left; left &= left - 1) {
      const int i = __builtin_ctz(left);
      const Tile other = of_b.at(i);
      store(to + i * kBlock, kOwn ? cost.of(own, other) : cost.of(of_a.at(i), other));
    }
  }

  // The costs of run i: of pixels that the view sees itself (`mine`), that it does not (`theirs`), or of
  // both.
  SEEPAST_INLINE Lanes cost_of(int x, int i, bool mine, bool theirs, bool sure) {
    Lanes cost = all(kNoPair);
    if (mine) cost = smaller_half(with_own, x, i, v.view.with_own.count);
    if (theirs) {
      const Lanes without = smaller_half(others, x, i, v.view.others.count);
      cost = mine ? choose(holds(load(own_planes[plane_static(0)] + x)), cost, without) : without;
    }
    if (sure || !any_of(cost, kNoPair)) return cost;
    Lanes any{};
    for (int k = 0; k < v.array().cameras; ++k) any |= places(k, x).at(i).is_static();
    const Lanes without = choose(holds(any), all(v.params.lone), all(v.params.unseen));
    return choose(reinterpret_cast<Lanes>(cost == kNoPair), without, cost);
  }

  // Mean of the smaller half of the costs `found` of run i, kNoPair where none exists.
  SEEPAST_INLINE Lanes smaller_half(const Found* found, int x, int i, int count) {
    const auto of = [&](int p) { return load(found[p].costs[found[p].at[i]] + x); };
    if (count <= 1) return count ? of(0) : all(kNoPair);
    const auto at = [&](int p) { return p < count ? of(p) : all(kNoPair); };
    if (count <= 4) return smaller_half_of_4(at);
    if (count <= 6) return smaller_half_of_6(at);
    for (int p = 0; p < count; ++p) store(sorted[p], of(p));
    return smaller_half_of_many(count);
  }

  static SEEPAST_INLINE void order(Lanes& a, Lanes& b) {
    const Lanes low = lesser(a, b), high = greater(a, b);
    a = low, b = high;
  }

  // Two costs or one.
  template <class At>
  SEEPAST_INLINE Lanes smaller_half_of_4(At at) const {
    Lanes a = at(0), b = at(1), c = at(2), d = at(3);
    order(a, b), order(c, d), order(a, c), order(b, d), order(b, c);
    return choose(reinterpret_cast<Lanes>(c == kNoPair), a, mean(a, b));
  }

  // Three costs, two or one.
  template <class At>
  SEEPAST_INLINE Lanes smaller_half_of_6(At at) const {
    Lanes a = at(0), b = at(1), c = at(2), d = at(3), e = at(4), f = at(5);
    order(a, f), order(b, d), order(c, e);  // the shortest network that sorts six
    order(b, c), order(d, e);
    order(a, d), order(c, f);
    order(a, b), order(c, d), order(e, f);
    order(b, c), order(d, e);
    const Lanes three = in_halves([&](auto half) { return third(half(a) + half(b) + half(c) + 1); });
    const Lanes two = choose(reinterpret_cast<Lanes>(c == kNoPair), a, mean(a, b));
    return choose(reinterpret_cast<Lanes>(e == kNoPair), two, three);
  }

  // Any number of them, `sorted`, which they are afterwards.
  Lanes smaller_half_of_many(int count) {
    Lanes exist{};
    for (int p = 0; p < count; ++p) exist -= reinterpret_cast<Lanes>(load(sorted[p]) != kNoPair);
    uint8_t half[kLanes], out[kLanes];
    uint16_t sum[kLanes], reciprocal[kLanes];
    store(half, exist);
    for (int i = 0; i < kLanes; ++i) half[i] = static_cast<uint8_t>((half[i] + 1) >> 1);
    for (int i = 0; i < kLanes; ++i) sum[i] = half[i] >> 1, reciprocal[i] = 0;
    for (int q = 0; q < (count + 1) / 2; ++q) {
      Lanes least = load(sorted[count - 1]);
      for (int p = count - 1; p > q; --p) {  // the smallest of the rest rises to q
        Lanes next = load(sorted[p - 1]);
        order(least, next);
        store(sorted[p], next);
      }
      store(sorted[q], least);
      const uint16_t share =
          static_cast<uint16_t>(65535 / (q + 1) + 1);  // ceil(65536 / half); 0 stands for 1
      for (int i = 0; i < kLanes; ++i) {
        const bool counts = half[i] > q;
        sum[i] = static_cast<uint16_t>(sum[i] + (counts ? sorted[q][i] : 0));
        reciprocal[i] = counts ? share : reciprocal[i];
      }
    }
    for (int i = 0; i < kLanes; ++i) {
      const uint16_t mean = static_cast<uint16_t>(static_cast<uint32_t>(sum[i]) * reciprocal[i] >> 16);
      const uint16_t cost = half[i] == 1 ? sum[i] : mean;
      out[i] = half[i] ? static_cast<uint8_t>(cost) : kNoPair;
    }
    return load(out);
  }

  // Writes the pixels `wanted` where their rows of the volume are.
  void put_chunk(uint64_t wanted, int32_t* next) {
    for (int group = 0; group < kBlock; group += kChunk) {
      uint32_t left = static_cast<uint16_t>(wanted >> group);
      if (!left) continue;
      Sixteen turned[kChunk];
      transpose_16x16(costs[0] + group, kBlock, turned);
      for (; left; left &= left - 1) {
        const int x = __builtin_ctz(left);
        std::memcpy(v.view.out + kChunk * static_cast<size_t>(next[group + x]++), turned + x, kChunk);
      }
    }
  }

  const Volume& v;
  const Rows& rows;
  alignas(32) uint8_t few[32] = {};  // cost of the census by the number of valid neighbours, if they are few
  std::vector<int32_t> drops[kTileRows];  // [camera, candidate]: how far below the row its rays land
  std::vector<uint8_t> steady;            // [camera, chunk]: find_steady
  uint64_t seen;                          // bit per pixel that is static there
  alignas(64) uint8_t own_planes[kPlanesOfPhase][kBlock];  // of the view
  bool whole;
  int chosen[kRuns];
  const uint8_t* tiles[kMaxCameras][kTileRows][kRuns];                  // of the chosen runs
  uint32_t moved[kMaxCameras], clear[kMaxCameras], blind[kMaxCameras];  // bit per run
  Found with_own[kMaxPairs], others[kMaxPairs];
  alignas(64) uint8_t sorted[kMaxPairs][kLanes];
  alignas(64) uint8_t costs[kChunk][kBlock];
};

#undef SEEPAST_INLINE
