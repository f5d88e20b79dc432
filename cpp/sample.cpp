// Stage "rectify": images and masks through fixed-point maps, bilinear, edges continued. The same as
// cv2.remap, bit for bit, in half the time, since image and mask are sampled together and edges cost no
// branches.
#include <algorithm>
#include <cstring>

#include "core.h"

namespace seepast {
namespace {

constexpr int kBlock = 128;        // pixels: what one step leaves to the next stays in the first-level cache
constexpr int kSteps = 32;         // of a fraction
constexpr size_t kPart = 1 << 13;  // pixels that a thread takes at once
constexpr int kAlone = 8;          // parts: so few are left to the calling thread, which is one of several

// Where the pixels of a block are sampled: `at` is the upper left of four source pixels that all exist,
// `right` and `lower` say by how many 32nds the place is nearer to the others, the same in each of four
// bytes.
struct Places {
  int32_t at[kBlock];
  uint32_t right[kBlock], lower[kBlock];
};
// The four source pixels of each, upper ones first: three colours, and a byte of the mask.
struct Corners {
  uint32_t pixel[4][kBlock];
};

[[gnu::always_inline]] inline uint32_t four_times(int weight) {
  return static_cast<uint32_t>(weight) * 0x01010101u;
}

// Beyond an edge both of two neighbours are the pixel on the edge, which gets all of the weight.
// Returns the largest `at`.
[[gnu::always_inline]] inline int find_places(const int16_t* __restrict whole,
                                              const uint16_t* __restrict fraction, int count, int height,
                                              int width, Places& places) {
  int32_t* __restrict at = places.at;
  uint32_t* __restrict rights = places.right, * __restrict lowers = places.lower;
  int largest = 0;
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
    largest = std::max(largest, at[i]);
    rights[i] = four_times(right);
    lowers[i] = four_times(lower);
  }
  return largest;
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

// The four source pixels of each in a plane, upper ones lowest. Returns whether any is not 0.
[[gnu::always_inline]] inline bool fetch_plane(const uint8_t* plane, const Places& places, int count,
                                               int width, uint32_t* fours) {
  uint32_t any = 0;
  for (int i = 0; i < count; ++i) {
    const uint8_t* first = plane + places.at[i];
    fours[i] = read<uint16_t>(first) | static_cast<uint32_t>(read<uint16_t>(first + width)) << 16;
    any |= fours[i];
  }
  return any != 0;
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

SEEPAST_CLONES
void sample_colours(const uint8_t* image, const uint8_t* mask, int height, int width, const int16_t* whole,
                    const uint16_t* fraction, const uint8_t* no_ray, size_t count, uint8_t* out,
                    uint8_t* mask_out) {
  alignas(64) Places places;
  alignas(64) Corners corners;
  alignas(64) uint8_t pixels[4 * kBlock];
  uint32_t fours[kBlock];
  const int last = (height - 2) * width + width - 2;
  for (size_t from = 0; from < count; from += kBlock) {
    const int n = static_cast<int>(std::min<size_t>(kBlock, count - from));
    const int largest = find_places(whole + 2 * from, fraction + from, n, height, width, places);
    fetch(image, places, n, width, last, largest == last, corners);
    const bool masked = mask && fetch_plane(mask, places, n, width, fours);
    if (masked) add_plane(fours, n, corners);
    mix(corners, places, n, pixels);
    pack(pixels, n, out + 3 * from);
    if (masked)
      for (int i = 0; i < n; ++i) mask_out[from + i] = pixels[4 * i + 3];
    else if (mask)
      std::memset(mask_out + from, 0, static_cast<size_t>(n));
    if (no_ray) mark(no_ray + from, n, mask_out + from);
  }
}

}  // namespace

void sample_colour(const uint8_t* image, const uint8_t* mask, int height, int width, const int16_t* whole,
                   const uint16_t* fraction, const uint8_t* no_ray, size_t count, uint8_t* out,
                   uint8_t* mask_out) {
  const int parts = static_cast<int>((count + kPart - 1) / kPart);
#pragma omp parallel for schedule(dynamic, 1) if (parts > kAlone)
  for (int i = 0; i < parts; ++i) {
    const size_t from = i * kPart;
    sample_colours(image, mask, height, width, whole + 2 * from, fraction + from,
                   no_ray ? no_ray + from : nullptr, std::min(kPart, count - from), out + 3 * from,
                   mask ? mask_out + from : nullptr);
  }
}

SEEPAST_CLONES
void sample_plane(const uint8_t* plane, int height, int width, const int16_t* whole, const uint16_t* fraction,
                  size_t count, uint8_t* out) {
  alignas(64) Places places;
  uint32_t fours[kBlock];
  for (size_t from = 0; from < count; from += kBlock) {
    const int n = static_cast<int>(std::min<size_t>(kBlock, count - from));
    find_places(whole + 2 * from, fraction + from, n, height, width, places);
    if (!fetch_plane(plane, places, n, width, fours)) {
      std::memset(out + from, 0, static_cast<size_t>(n));
      continue;
    }
    for (int i = 0; i < n; ++i)
      out[from + i] = mixed(fours[i] & 255, fours[i] >> 8 & 255, fours[i] >> 16 & 255, fours[i] >> 24,
                            places.right[i] & 255, places.lower[i] & 255);
  }
}

}  // namespace seepast
