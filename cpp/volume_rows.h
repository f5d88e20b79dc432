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
SEEPAST_INLINE Wide third(Wide sum) {
  return (Wide)_mm512_mulhi_epu16((__m512i)sum, _mm512_set1_epi16(21846));
}
SEEPAST_INLINE Lanes bits_of(Lanes a, Lanes b, Lanes c) {
  return (Lanes)_mm512_popcnt_epi8((__m512i)a) + (Lanes)_mm512_popcnt_epi8((__m512i)b) +
         (Lanes)_mm512_popcnt_epi8((__m512i)c);
}
struct Scales {
  explicit Scales(const uint8_t* table)
      : all(_mm512_castsi256_si512(_mm256_loadu_si256((const __m256i*)table))) {}
  SEEPAST_INLINE Lanes of(Lanes known) const { return (Lanes)_mm512_permutexvar_epi8((__m512i)known, all); }
  __m512i all;
};
#elif defined(SEEPAST_BYTES_AVX2)
SEEPAST_INLINE Lanes lesser(Lanes a, Lanes b) { return (Lanes)_mm256_min_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Lanes greater(Lanes a, Lanes b) { return (Lanes)_mm256_max_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Lanes mean(Lanes a, Lanes b) { return (Lanes)_mm256_avg_epu8((__m256i)a, (__m256i)b); }
SEEPAST_INLINE Wide third(Wide sum) {
  return (Wide)_mm256_mulhi_epu16((__m256i)sum, _mm256_set1_epi16(21846));
}
SEEPAST_INLINE Lanes permuted(__m128i table, Lanes i) {
  return (Lanes)_mm256_shuffle_epi8(_mm256_broadcastsi128_si256(table), (__m256i)i);
}
SEEPAST_INLINE Lanes bits_of(Lanes a, Lanes b, Lanes c) {
  const __m128i bits = _mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4);
  Lanes sum{};
  for (const Lanes v : {a, b, c}) sum += permuted(bits, v & 15) + permuted(bits, (Lanes)((Wide)v >> 4) & 15);
  return sum;
}
struct Scales {
  explicit Scales(const uint8_t* table)
      : low(_mm_loadu_si128((const __m128i*)table)), high(_mm_loadu_si128((const __m128i*)(table + 16))) {}
  SEEPAST_INLINE Lanes of(Lanes known) const {
    return choose((Lanes)(known > 15), permuted(high, known & 15), permuted(low, known & 15));
  }
  __m128i low, high;
};
#else
SEEPAST_INLINE Lanes lesser(Lanes a, Lanes b) { return choose(reinterpret_cast<Lanes>(a < b), a, b); }
SEEPAST_INLINE Lanes greater(Lanes a, Lanes b) { return choose(reinterpret_cast<Lanes>(a < b), b, a); }
SEEPAST_INLINE Lanes halved(Lanes v) {
  return reinterpret_cast<Lanes>(reinterpret_cast<Wide>(v) >> 1) & 0x7f;
}
SEEPAST_INLINE Lanes mean(Lanes a, Lanes b) { return (a | b) - halved(a ^ b); }
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
struct Scales {
  explicit Scales(const uint8_t* table) : low(load(table)), high(load(table + 16)) {}
  SEEPAST_INLINE Lanes of(Lanes known) const {
#if defined(__clang__)
    Lanes out;
    for (int x = 0; x < kLanes; ++x) out[x] = known[x] < 16 ? low[known[x]] : high[known[x] & 15];
    return out;
#else
    return __builtin_shuffle(low, high, known);
#endif
  }
  Lanes low, high;
};
#endif

SEEPAST_INLINE Lanes census_of(const Block& b, int i, int x) { return load(b.at + i * b.stride + x); }
SEEPAST_INLINE Lanes colour_of(const Block& b, int i, int x) {
  return load(b.at + (kBytes + i) * b.stride + x);
}
SEEPAST_INLINE Lanes known_of(const Block& b, int i, int x) { return load(b.valid + i * b.stride + x); }
SEEPAST_INLINE Lanes static_of(const Block& b, int x) { return load(b.valid + kBytes * b.stride + x); }

// Whether any byte of a block is not 0.
SEEPAST_INLINE bool any_of(const uint8_t* block) {
  Lanes sum = load(block);
  for (int x = kLanes; x < kBlock; x += kLanes) sum |= load(block + x);
#if defined(SEEPAST_BYTES_AVX512)
  return _mm512_test_epi8_mask((__m512i)sum, (__m512i)sum);
#else
  uint64_t words[kLanes / 8], all = 0;
  std::memcpy(words, &sum, sizeof(sum));
  for (const uint64_t word : words) all |= word;
  return all;
#endif
}

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

// One row of the volume.
struct RowMatcher {
  RowMatcher(const Volume& volume, const Rows& rows)
      : v(volume), rows(rows), scales(volume.params.census_scale), drops(volume.columns.shifts.size()) {}

  // The row that `rows` and `drops` are about.
  __attribute__((noinline)) void match_row(int y) {
    for (int b = 0; b < v.columns.blocks; ++b) match_block(y, b);
  }

  Block block_of(const FeatureRow& row, const Place& place) const {
    const size_t stride = v.columns.stride;
    if (!row.planes || place.at < 0) return {nullptr, nullptr, stride, false, true};
    const uint64_t* unclear = row.unclear + place.word;
    const bool clear = !(unclear[0] >> place.skip | unclear[1] << 1 << (63 - place.skip));
    const uint8_t* valid = row.planes + place.valid;
    return {row.planes + place.at, valid, stride, clear, !clear && !any_of(valid + kBytes * stride)};
  }

  // The chunks that some pixel of a block wants, from the farthest on.
  void match_block(int y, int b) {
    const int from = b * kBlock, width = least(kBlock, v.array().width - from);
    const size_t first = static_cast<size_t>(y) * v.array().width + from;
    const uint64_t* active = v.view.chunks.active + first;
    uint64_t any = 0;
    for (int x = 0; x < width; ++x) any |= active[x];
    if (!any) return;
    look_at_own(y, from);
    uint64_t wants[kMostChunks];  // bit per column
    for (uint64_t left = any; left; left &= left - 1) wants[__builtin_ctzll(left)] = 0;
    for (int x = 0; x < width; ++x)
      for (uint64_t left = active[x]; left; left &= left - 1)
        wants[__builtin_ctzll(left)] |= uint64_t{1} << x;
    int32_t next[kBlock];
    if (width == kBlock)  // a copy of known size is a few instructions
      std::memcpy(next, v.view.chunks.start + first, sizeof(next));
    else
      std::memcpy(next, v.view.chunks.start + first, sizeof(int32_t) * static_cast<size_t>(width));
    for (; any; any &= any - 1) {
      const int chunk = __builtin_ctzll(any);
      fetch(b, chunk);
      match_chunk(b, chunk, wants[chunk]);
      put_chunk(wants[chunk], next);
    }
  }

  // Copies the view's own block, which all candidates share.
  void look_at_own(int y, int from) {
    const size_t column = static_cast<size_t>(from) + kBlock, stride = v.columns.stride;
    const Block block =
        block_of(rows.at(v.view.number, 0),
                 {static_cast<int32_t>(column), static_cast<int32_t>(plane_valid(0) * stride + column),
                  static_cast<int16_t>(column / 64), 0});
    for (int i = 0; i < 2 * kBytes; ++i) std::memcpy(own_planes[i], block.at + i * block.stride, kBlock);
    for (int i = 0; i <= kBytes; ++i)
      std::memcpy(own_planes[2 * kBytes + i], block.valid + i * block.stride, kBlock);
    own = {own_planes[0], own_planes[2 * kBytes], kBlock, block.clear, block.blind};
    seen = 0;
    for (int x = 0; x < kBlock; ++x) seen |= static_cast<uint64_t>(own_planes[3 * kBytes][x] & 1) << x;
  }

  // Asks for what a chunk will look at, all at once.
  void fetch(int b, int chunk) const {
    const Columns& columns = v.columns;
    const int cameras = v.array().cameras;
    const int first = columns.starts[b][kChunk * chunk];
    const Place* place = columns.places[b].data() + static_cast<size_t>(first) * cameras;
    for (int k = 0; k < cameras; ++k) {
      const FeatureRow& row = rows.at(k, drops[static_cast<size_t>(kChunk * chunk) * cameras + k]);
      if (k == v.view.number || !row.planes || place[k].at < 0) continue;
      const uint8_t* at = row.planes + place[k].at % columns.stride;
      for (int plane = 0; plane < kPlanes; ++plane, at += columns.stride) {
        __builtin_prefetch(at);
        __builtin_prefetch(at + 64);
      }
    }
  }

  // The candidates of a chunk for the columns `wanted` of one block into `tile`.
  void match_chunk(int b, int chunk, uint64_t wanted) {
    const Columns& columns = v.columns;
    const int cameras = v.array().cameras;
    const int32_t* starts = columns.starts[b].data() + kChunk * chunk;
    const bool one_run = starts[kChunk] - starts[0] == kChunk;  // per candidate
    const Run* run = columns.runs[b].data() + starts[0];
    const Place* place = columns.places[b].data() + static_cast<size_t>(starts[0]) * cameras;
    for (int r = starts[0]; r < starts[kChunk]; ++r, ++run, place += cameras) {
      const uint64_t theirs = wanted & run->columns();
      if (!theirs) continue;
      const size_t first = static_cast<size_t>(run->candidate) * cameras;
      for (int k = 0; k < cameras; ++k) {
        const Block block = k == v.view.number ? own : block_of(rows.at(k, drops[first + k]), place[k]);
        moved[k] = r == starts[0] || !one_run || block.at != blocks[k].at;
        blocks[k] = block;
      }
      uint8_t* to = tile[run->candidate % kChunk];
      for (int x = 0; x < kBlock; x += kLanes) {
        const uint64_t here = theirs >> x << (64 - kLanes) >> (64 - kLanes);
        if (!here) continue;
        const Lanes cost = cost_of(x, here);
        if (one_run)
          store(to + x, cost);
        else
          store_run(to, x, cost, *run);
      }
    }
  }

  static void store_run(uint8_t* to, int x, Lanes cost, const Run& run) {
    const int from = run.from > x ? run.from : x, end = least(run.to, x + kLanes);
    uint8_t costs[kLanes];
    store(costs, cost);
    if (from < end) std::memcpy(to + from, costs + from - x, static_cast<size_t>(end - from));
  }

  // Costs of the columns from x on, of which those of `wanted` (bit 0 = column x) are asked for: `blocks` are
  // where.
  SEEPAST_INLINE Lanes cost_of(int x, uint64_t wanted) {
    const uint64_t mine = seen >> x & wanted;
    bool sure = true;  // some pair has a cost in every column
    Lanes cost = all(kNoPair);
    if (mine) cost = mean_of_pairs(v.view.with_own, with_own, x, sure);
    if (mine != wanted) {
      bool sure_of_theirs = true;
      const Lanes without = mean_of_pairs(v.view.others, others, x, sure_of_theirs);
      cost = choose(holds(static_of(own, x)), cost, without);
      sure = sure && sure_of_theirs;
    }
    if (sure) return cost;
    Lanes any{};
    for (int k = 0; k < v.array().cameras; ++k)
      if (blocks[k].at) any |= static_of(blocks[k], x);
    const Lanes without = choose(holds(any), all(v.params.lone), all(v.params.unseen));
    return choose(reinterpret_cast<Lanes>(cost == kNoPair), without, cost);
  }

  // Near cameras move by less than a quarter pixel from candidate to candidate: what was found of such pairs
  // stays.
  SEEPAST_INLINE Lanes mean_of_pairs(const Pairs& pairs, uint8_t (*found)[kBlock], int x, bool& sure) {
    sure = false;
    const bool stays = pairs.count <= kSorted;
    const int32_t* pair = pairs.cameras;
    for (int p = 0; p < pairs.count; ++p, pair += 2) {
      const Block &a = blocks[pair[0]], &b = blocks[pair[1]];
      const bool clear = a.clear && b.clear;
      sure = sure || clear;
      if (stays && !moved[pair[0]] && !moved[pair[1]]) continue;
      if (clear)
        store(found[p] + x, pair_of_clear(a, b, x));
      else if (a.blind || b.blind)
        store(found[p] + x, all(kNoPair));
      else
        store(found[p] + x, pair_cost(a, b, x));
    }
    return smaller_half(found, x, pairs.count);
  }

  // reference_multiview.pair_cost where every neighbour of both rays is static ...
  SEEPAST_INLINE Lanes pair_of_clear(const Block& a, const Block& b, int x) const {
    const Lanes differing =
        bits_of(census_of(a, 0, x) ^ census_of(b, 0, x), census_of(a, 1, x) ^ census_of(b, 1, x),
                census_of(a, 2, x) ^ census_of(b, 2, x));
    const Lanes twice = differing + differing;
    return twice + twice + colour_cost(a, b, x);
  }

  // ... and anywhere.
  SEEPAST_INLINE Lanes pair_cost(const Block& a, const Block& b, int x) const {
    const Lanes k0 = known_of(a, 0, x) & known_of(b, 0, x), k1 = known_of(a, 1, x) & known_of(b, 1, x),
                k2 = known_of(a, 2, x) & known_of(b, 2, x);
    const Lanes scale = scales.of(bits_of(k0, k1, k2));
    const Lanes differing = bits_of((census_of(a, 0, x) ^ census_of(b, 0, x)) & k0,
                                    (census_of(a, 1, x) ^ census_of(b, 1, x)) & k1,
                                    (census_of(a, 2, x) ^ census_of(b, 2, x)) & k2);
    const Lanes scaled = eighths(differing, scale);
    const Lanes census = choose(holds(scale), scaled, all(v.params.few));
    const Lanes both = holds(static_of(a, x) & static_of(b, x));
    return (census + colour_cost(a, b, x)) | ~both;
  }

  SEEPAST_INLINE Lanes colour_cost(const Block& a, const Block& b, int x) const {
    const Lanes blue = apart(colour_of(a, 0, x), colour_of(b, 0, x)),
                green = apart(colour_of(a, 1, x), colour_of(b, 1, x)),
                red = apart(colour_of(a, 2, x), colour_of(b, 2, x));
    return lesser(mean(mean(blue, red), green), all(v.params.colour_cap));
  }

  // Mean of the smaller half of the costs `found`, kNoPair where none exists.
  SEEPAST_INLINE Lanes smaller_half(uint8_t (*found)[kBlock], int x, int count) {
    if (count <= 1) return count ? load(found[0] + x) : all(kNoPair);
    const auto at = [&](int p) { return p < count ? load(found[p] + x) : all(kNoPair); };
    if (count <= 4) return smaller_half_of_4(at);
    if (count <= kSorted) return smaller_half_of_6(at);
    return smaller_half_of_many(found, x, count);
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

  // Any number. Reorders what was found.
  Lanes smaller_half_of_many(uint8_t (*found)[kBlock], int x, int count) {
    Lanes exist{};
    for (int p = 0; p < count; ++p) exist -= reinterpret_cast<Lanes>(load(found[p] + x) != kNoPair);
    uint8_t half[kLanes], out[kLanes];
    uint16_t sum[kLanes], reciprocal[kLanes];
    store(half, exist);
    for (int i = 0; i < kLanes; ++i) half[i] = static_cast<uint8_t>((half[i] + 1) >> 1);
    for (int i = 0; i < kLanes; ++i) sum[i] = half[i] >> 1, reciprocal[i] = 0;
    for (int q = 0; q < (count + 1) / 2; ++q) {
      Lanes least = load(found[count - 1] + x);
      for (int p = count - 1; p > q; --p) {  // the smallest of the rest rises to q
        Lanes next = load(found[p - 1] + x);
        order(least, next);
        store(found[p] + x, next);
      }
      store(found[q] + x, least);
      const uint16_t share =
          static_cast<uint16_t>(65535 / (q + 1) + 1);  // ceil(65536 / half); 0 stands for 1
      for (int i = 0; i < kLanes; ++i) {
        const bool counts = half[i] > q;
        sum[i] = static_cast<uint16_t>(sum[i] + (counts ? found[q][x + i] : 0));
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

  // Writes the tile's columns `wanted` where their rows of the volume are.
  void put_chunk(uint64_t wanted, int32_t* next) {
    for (int group = 0; group < kBlock; group += kChunk) {
      uint32_t left = static_cast<uint16_t>(wanted >> group);
      if (!left) continue;
      Sixteen turned[kChunk];
      transpose_16x16(tile[0] + group, kBlock, turned);
      for (; left; left &= left - 1) {
        const int x = __builtin_ctz(left);
        std::memcpy(v.view.out + kChunk * static_cast<size_t>(next[group + x]++), turned + x, kChunk);
      }
    }
  }

  const Volume& v;
  const Rows& rows;
  const Scales scales;
  std::vector<int32_t> drops;  // [candidate][camera]: how far below this row its rays land
  Block own;                   // of the view: its planes, which are copied
  uint64_t seen;               // bit per column that is static there
  Block blocks[kMaxCameras];
  alignas(64) uint8_t own_planes[3 * kBytes + 1][kBlock];
  static constexpr int kSorted = 6;  // as many pairs are sorted in registers
  bool moved[kMaxCameras];           // since the candidate before
  alignas(64) uint8_t with_own[kMaxPairs][kBlock], others[kMaxPairs][kBlock];  // costs of every pair
  alignas(64) uint8_t tile[kChunk][kBlock];
};

#undef SEEPAST_INLINE
