// Stage "rectify": images and masks through fixed-point maps, bilinear, edges continued. The same as
// cv2.remap, bit for bit, in half the time, since image and mask are sampled together and edges cost no
// branches.
#include <algorithm>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "core.h"

namespace seepast {
namespace {

constexpr int kBlock = 128;        // pixels: what one step leaves to the next stays in the first-level cache
constexpr int kSteps = 32;         // of a fraction
constexpr size_t kPart = 1 << 13;  // pixels that a thread takes at once
constexpr size_t kMostLookedAt = 32 * kBlock;  // bytes
constexpr int kAlone = 8;  // parts: so few are left to the calling thread, which is one of several

// Where the pixels of a block are sampled: `at` is the upper left of four source pixels that all exist, in
// columns left .. and rows top .. of the source; `right` and `lower` say by how many 32nds the place is
// nearer to the others, times a factor.
struct Places {
  int32_t at[kBlock];
  uint32_t right[kBlock], lower[kBlock];
  int left, last_left, top, last_top;
};
// The four source pixels of each, upper ones first: three colours, and a byte of the mask.
struct Corners {
  uint32_t pixel[4][kBlock];
};

constexpr uint32_t kInEachByte = 0x01010101;

// Beyond an edge both of two neighbours are the pixel on the edge, which gets all of the weight.
template <uint32_t kFactor>
[[gnu::always_inline]] inline void find_places(const int16_t* __restrict whole,
                                               const uint16_t* __restrict fraction, int count, int height,
                                               int width, Places& places) {
  int32_t* __restrict at = places.at;
  uint32_t* __restrict rights = places.right, * __restrict lowers = places.lower;
  int least_x = width, most_x = 0, least_y = height, most_y = 0;
  for (int i = 0; i < count; ++i) {
    int32_t both;  // read as one, since pairs of words make slow loops
    std::memcpy(&both, whole + 2 * i, sizeof both);
    const int x = static_cast<int32_t>(static_cast<uint32_t>(both) << 16) >> 16, y = both >> 16;
    const int left = std::clamp(x, 0, width - 2), top = std::clamp(y, 0, height - 2);
    int right = fraction[i] % kSteps, lower = fraction[i] / kSteps;
    right = x < left ? 0 : right;
    right = x > left ? kSteps : right;
    lower = y < top ? 0 : lower;
    lower = y > top ? kSteps : lower;
    at[i] = top * width + left;
    least_x = std::min(least_x, left), most_x = std::max(most_x, left);
    least_y = std::min(least_y, top), most_y = std::max(most_y, top);
    rights[i] = static_cast<uint32_t>(right) * kFactor;
    lowers[i] = static_cast<uint32_t>(lower) * kFactor;
  }
  places.left = least_x, places.last_left = most_x, places.top = least_y, places.last_top = most_y;
}

// Whether all that a block is sampled from is known to be 0: not looked for where that is far apart, as where
// a block begins in the image and ends beyond its edge.
inline bool is_empty(const uint8_t* plane, int width, const Places& places) {
  const int columns = places.last_left + 2 - places.left, rows = places.last_top + 2 - places.top;
  if (static_cast<size_t>(columns) * rows > kMostLookedAt) return false;
  for (int y = 0; y < rows; ++y) {
    const uint8_t* row = plane + static_cast<size_t>(places.top + y) * width + places.left;
    uint8_t any = 0;
    for (int x = 0; x < columns; ++x) any |= row[x];
    if (any) return false;
  }
  return true;
}

// Bytes from p on as one number; compilers that take the loop around it for a gather make it slower.
template <class Number>
[[gnu::always_inline]] inline Number read(const uint8_t* p) {
  asm("" : "+r"(p));
  Number number;
  std::memcpy(&number, p, sizeof number);
  return number;
}

// `careful`: nothing can be read behind the last pixel of the image [H, W, 3].
[[gnu::always_inline]] inline void fetch(const uint8_t* image, const Places& places, int count, int width,
                                         int last, bool careful, Corners& corners) {
  uint64_t upper[kBlock], lower[kBlock];  // two pixels each
  for (int i = 0; i < count; ++i) {
    const uint8_t* first = image + 3 * static_cast<ptrdiff_t>(places.at[i]);
    upper[i] = read<uint64_t>(first);
    if (!careful)
      lower[i] = read<uint64_t>(first + 3 * width);
    else if (places.at[i] == last)
      lower[i] = read<uint64_t>(first + 3 * width - 2) >> 16;
    else
      lower[i] = read<uint64_t>(first + 3 * width);
  }
  for (int i = 0; i < count; ++i) {
    corners.pixel[0][i] = static_cast<uint32_t>(upper[i]);
    corners.pixel[1][i] = static_cast<uint32_t>(upper[i] >> 24);
    corners.pixel[2][i] = static_cast<uint32_t>(lower[i]);
    corners.pixel[3][i] = static_cast<uint32_t>(lower[i] >> 24);
  }
}

// The four source pixels of each in a plane, upper ones lowest.
[[gnu::always_inline]] inline void fetch_plane(const uint8_t* plane, const Places& places, int count,
                                               int width, uint32_t* fours) {
  for (int i = 0; i < count; ++i) {
    const uint8_t* first = plane + places.at[i];
    fours[i] = read<uint16_t>(first) | static_cast<uint32_t>(read<uint16_t>(first + width)) << 16;
  }
}

[[gnu::always_inline]] inline void add_plane(const uint32_t* fours, int count, Corners& corners) {
  for (int j = 0; j < 4; ++j)
    for (int i = 0; i < count; ++i)
      corners.pixel[j][i] = (corners.pixel[j][i] & 0xffffff) | fours[i] >> 8 * j << 24;
}

// Bilinear in words: with rows u, l of sums of 32nds, and t 32nds between them, the rounded mean is
// floor((32 u + t (l - u) + 512) / 1024) = floor((u + floor(t (l - u) / 32) + 16) / 32).
[[gnu::always_inline]] inline uint8_t mixed(int a, int b, int c, int d, int right, int lower) {
  const int16_t u = static_cast<int16_t>(a * kSteps + static_cast<int16_t>(right * (b - a)));
  const int16_t l = static_cast<int16_t>(c * kSteps + static_cast<int16_t>(right * (d - c)));
  const int16_t difference = static_cast<int16_t>((l - u) * 4), weight = static_cast<int16_t>(lower * 512);
  const int16_t moved = static_cast<int16_t>((difference * weight) >> 16);  // the upper half of a product
  return static_cast<uint8_t>(static_cast<uint16_t>(u + moved + kSteps / 2) / kSteps);
}

[[gnu::always_inline]] inline void mix(const Corners& corners, const Places& places, int count,
                                       uint8_t* __restrict out) {
  const auto bytes = [](const uint32_t* words) { return reinterpret_cast<const uint8_t*>(words); };
  const uint8_t *a = bytes(corners.pixel[0]), *b = bytes(corners.pixel[1]), *c = bytes(corners.pixel[2]),
                *d = bytes(corners.pixel[3]), *right = bytes(places.right), *lower = bytes(places.lower);
  for (int i = 0; i < 4 * count; ++i) out[i] = mixed(a[i], b[i], c[i], d[i], right[i], lower[i]);
}

// The first three of every four bytes.
[[gnu::always_inline]] inline void pack(const uint8_t* __restrict pixels, int count,
                                        uint8_t* __restrict out) {
  for (int i = 0; i + 1 < count; ++i) std::memcpy(out + 3 * i, pixels + 4 * i, 4);  // the next overwrites one
  std::memcpy(out + 3 * (count - 1), pixels + 4 * (count - 1), 3);
}

// What a mask sampled to 0..255 becomes as P(dynamic): 254 at most, and no_ray, 255 or 0, where that is more.
[[gnu::always_inline]] inline void mark(const uint8_t* __restrict no_ray, int count, uint8_t* __restrict p) {
  for (int i = 0; i < count; ++i) {
    const uint8_t most = std::min<uint8_t>(p[i], kNoRay - 1);
    p[i] = std::max(most, no_ray[i]);
  }
}

// A part of an image [H, W, 3] and its mask [H, W], or null, that one thread samples.
struct Part {
  const uint8_t *image, *mask;
  int height, width;
  const int16_t* whole;
  const uint16_t* fraction;
  const uint8_t* no_ray;
  size_t count;
  uint8_t *out, *mask_out;
};

SEEPAST_CLONES
void sample_colours(const Part& part) {
  alignas(64) Places places;
  alignas(64) Corners corners;
  alignas(64) uint8_t pixels[4 * kBlock];
  uint32_t fours[kBlock];
  const auto [image, mask, height, width, whole, fraction, no_ray, count, out, mask_out] = part;
  const int last = (height - 2) * width + width - 2;
  for (size_t from = 0; from < count; from += kBlock) {
    const int n = static_cast<int>(std::min<size_t>(kBlock, count - from));
    find_places<kInEachByte>(whole + 2 * from, fraction + from, n, height, width, places);
    fetch(image, places, n, width, last, places.last_top == height - 2, corners);
    const bool masked = mask && !is_empty(mask, width, places);
    if (masked) fetch_plane(mask, places, n, width, fours), add_plane(fours, n, corners);
    mix(corners, places, n, pixels);
    pack(pixels, n, out + 3 * from);
    if (masked)
      for (int i = 0; i < n; ++i) mask_out[from + i] = pixels[4 * i + 3];
    else if (mask)
      std::memset(mask_out + from, 0, static_cast<size_t>(n));
    if (no_ray) mark(no_ray + from, n, mask_out + from);
  }
}

#if defined(SEEPAST_V3) || defined(SEEPAST_V4)
#pragma GCC push_options
#if !defined(SEEPAST_LEVEL)  // else it is that already, or more
#pragma GCC target("arch=x86-64-v3")
#endif
// Weights of two neighbours, for every number of 32nds: of bytes, one above the other; and of the 16 bits
// that become of them, times 64, so that the sum's upper half is the sample.
struct Weights {
  constexpr Weights() {
    for (int i = 0; i <= kSteps; ++i)
      for (int j = 0; j < 8; ++j) {
        lower[i][2 * j] = static_cast<int8_t>(kSteps - i), lower[i][2 * j + 1] = static_cast<int8_t>(i);
        right[i][j] = static_cast<int16_t>(64 * (j % 2 ? i : kSteps - i));
      }
  }
  alignas(16) int8_t lower[kSteps + 1][16]{};
  alignas(16) int16_t right[kSteps + 1][8]{};
};
constexpr Weights kWeights;
constexpr int kEntry = 16;      // bytes of a table for one weight
constexpr int kReadBehind = 6;  // more pixels than it needs are read of the lower row: so many

// BGR and the mask of a pixel: each in the upper half of 32 bits.
template <bool kMasked>
[[gnu::always_inline]] inline __m128i sample_of(const uint8_t* image, const uint8_t* mask, int width,
                                                const Places& places, int i) {
  const ptrdiff_t at = places.at[i];
  const uint8_t* const first = image + 3 * at;
  __m128i upper = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(first));
  __m128i lower = _mm_loadu_si128(reinterpret_cast<const __m128i*>(first + 3 * width));
  if (kMasked) {  // behind the two pixels
    upper = _mm_insert_epi16(upper, read<uint16_t>(mask + at), 3);
    lower = _mm_insert_epi16(lower, read<uint16_t>(mask + at + width), 3);
  }
  const auto entry = [](const void* table, uint32_t weight) {
    return _mm_load_si128(reinterpret_cast<const __m128i*>(static_cast<const char*>(table) + weight));
  };
  const __m128i down =
      _mm_maddubs_epi16(_mm_unpacklo_epi8(upper, lower), entry(kWeights.lower, places.lower[i]));
  const __m128i pairs = _mm_setr_epi8(0, 1, 6, 7, 2, 3, 8, 9, 4, 5, 10, 11, 12, 13, 14, 15);
  const __m128i rounded = _mm_add_epi16(down, _mm_set1_epi16(kSteps / 2));
  return _mm_madd_epi16(_mm_shuffle_epi8(rounded, pairs), entry(kWeights.right, places.right[i]));
}

// Four pixels from i on, at `pixels`, and their mask at `fours`.
template <bool kMasked>
[[gnu::always_inline]] inline void sample_four(const uint8_t* image, const uint8_t* mask, int width,
                                               const Places& places, int i, uint8_t* pixels, uint8_t* fours) {
  const auto two = [&](int j) {
    const __m128i first = sample_of<kMasked>(image, mask, width, places, j),
                  second = sample_of<kMasked>(image, mask, width, places, j + 1);
    return _mm_blend_epi16(_mm_srli_epi32(first, 16), second, 0xaa);
  };
  __builtin_prefetch(image +
                     3 * static_cast<ptrdiff_t>(places.at[i] + 2 * width));  // what the next row needs
  const __m128i four = _mm_packus_epi16(two(i), two(i + 2));
  const __m128i colours = _mm_setr_epi8(0, 2, 4, 1, 3, 5, 8, 10, 12, 9, 11, 13, -1, -1, -1, -1),
                masks = _mm_setr_epi8(6, 7, 14, 15, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1);
  _mm_storeu_si128(reinterpret_cast<__m128i*>(pixels), _mm_shuffle_epi8(four, colours));
  if (kMasked) _mm_storeu_si32(fours, _mm_shuffle_epi8(four, masks));
}

// The same as sample_colours.
void sample_colours_by_four(const Part& part) {
  alignas(64) Places places;
  alignas(64) uint8_t pixels[3 * kBlock + 16], fours[kBlock];
  const auto [image, mask, height, width, whole, fraction, no_ray, count, out, mask_out] = part;
  for (size_t from = 0; from < count; from += kBlock) {
    const int n = static_cast<int>(std::min<size_t>(kBlock, count - from));
    find_places<kEntry>(whole + 2 * from, fraction + from, n, height, width, places);
    if (places.last_top == height - 2 && places.last_left + kReadBehind >= width) {
      sample_colours({image, mask, height, width, whole + 2 * from, fraction + from,
                      no_ray ? no_ray + from : nullptr, static_cast<size_t>(n), out + 3 * from,
                      mask ? mask_out + from : nullptr});
      continue;
    }
    for (int i = n; i % 4; ++i) places.at[i] = places.at[0], places.right[i] = places.lower[i] = 0;
    const bool masked = mask && !is_empty(mask, width, places);
    if (masked)
      for (int i = 0; i < n; i += 4)
        sample_four<true>(image, mask, width, places, i, pixels + 3 * i, fours + i);
    else
      for (int i = 0; i < n; i += 4)
        sample_four<false>(image, mask, width, places, i, pixels + 3 * i, nullptr);
    std::memcpy(out + 3 * from, pixels, 3 * static_cast<size_t>(n));
    if (masked)
      std::memcpy(mask_out + from, fours, static_cast<size_t>(n));
    else if (mask)
      std::memset(mask_out + from, 0, static_cast<size_t>(n));
    if (no_ray) mark(no_ray + from, n, mask_out + from);
  }
}
#pragma GCC pop_options
#endif

}  // namespace

void sample_colour(const uint8_t* image, const uint8_t* mask, int height, int width, const int16_t* whole,
                   const uint16_t* fraction, const uint8_t* no_ray, size_t count, uint8_t* out,
                   uint8_t* mask_out) {
  const int parts = static_cast<int>((count + kPart - 1) / kPart);
#pragma omp parallel for schedule(dynamic, 1) if (parts > kAlone)
  for (int i = 0; i < parts; ++i) {
    const size_t from = i * kPart;
    const Part part{image,
                    mask,
                    height,
                    width,
                    whole + 2 * from,
                    fraction + from,
                    no_ray ? no_ray + from : nullptr,
                    std::min(kPart, count - from),
                    out + 3 * from,
                    mask ? mask_out + from : nullptr};
#if defined(SEEPAST_V3) || defined(SEEPAST_V4)
    if (simd() >= Simd::avx2) {
      sample_colours_by_four(part);
      continue;
    }
#endif
    sample_colours(part);
  }
}

SEEPAST_CLONES
void sample_plane(const uint8_t* plane, int height, int width, const int16_t* whole, const uint16_t* fraction,
                  size_t count, uint8_t* out) {
  alignas(64) Places places;
  uint32_t fours[kBlock];
  for (size_t from = 0; from < count; from += kBlock) {
    const int n = static_cast<int>(std::min<size_t>(kBlock, count - from));
    find_places<kInEachByte>(whole + 2 * from, fraction + from, n, height, width, places);
    if (is_empty(plane, width, places)) {
      std::memset(out + from, 0, static_cast<size_t>(n));
      continue;
    }
    fetch_plane(plane, places, n, width, fours);
    for (int i = 0; i < n; ++i)
      out[from + i] = mixed(fours[i] & 255, fours[i] >> 8 & 255, fours[i] >> 16 & 255, fours[i] >> 24,
                            places.right[i] & 255, places.lower[i] & 255);
  }
}

}  // namespace seepast
