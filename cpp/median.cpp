// The median of 5 x 5 pixels, for 16-bit images, whose edges continue outside.
#include <algorithm>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

// Networks of comparisons, which the compiler does for many columns at once.
inline __attribute__((always_inline)) void order(uint16_t& a, uint16_t& b) {
  const uint16_t low = a < b ? a : b, high = a < b ? b : a;
  a = low, b = high;
}

inline __attribute__((always_inline)) void sort_five(uint16_t* v) {
  order(v[0], v[1]), order(v[3], v[4]), order(v[2], v[4]), order(v[2], v[3]), order(v[0], v[3]);
  order(v[0], v[2]), order(v[1], v[4]), order(v[1], v[3]), order(v[1], v[2]);
}

// Moves the least and the greatest of v[0 .. n) to its ends.
template <int n>
inline __attribute__((always_inline)) void move_ends(uint16_t* v) {
  for (int i = 0; i < n / 2; ++i) order(v[i], v[n - 1 - i]);
  for (int i = 1; i < (n + 1) / 2; ++i) order(v[0], v[i]);
  for (int i = n / 2; i < n - 1; ++i) order(v[i], v[n - 1]);
}

// The middle one of v[0 .. 13): of any eight, neither the least nor the greatest; and so on, with one more of
// the others each time.
inline __attribute__((always_inline)) uint16_t middle_of_13(uint16_t* v) {
  move_ends<8>(v);
  v[0] = v[8], move_ends<7>(v);
  v[0] = v[9], move_ends<6>(v);
  v[0] = v[10], move_ends<5>(v);
  v[0] = v[11], move_ends<4>(v);
  v[0] = v[12], move_ends<3>(v);
  return v[1];
}

// sorted[i] [width + 4]: the i-th of the five rows' values, from column -2 on.
SEEPAST_CLONES void sort_columns(const uint16_t* const* rows, int width, uint16_t* const* sorted) {
  const uint16_t *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4];
  uint16_t *p = sorted[0] + 2, *q = sorted[1] + 2, *r = sorted[2] + 2, *s = sorted[3] + 2, *t = sorted[4] + 2;
#pragma GCC ivdep
  for (int x = 0; x < width; ++x) {
    uint16_t v[5] = {a[x], b[x], c[x], d[x], e[x]};
    sort_five(v);
    p[x] = v[0], q[x] = v[1], r[x] = v[2], s[x] = v[3], t[x] = v[4];
  }
}

// Of five columns in order, the i-th values of all are put in order, too: then there are at least (i + 1) (j
// + 1) values up to the j-th of them, and (5 - i) (5 - j) from it on. Twelve cannot be in the middle of 25.
SEEPAST_CLONES void median_row(const uint16_t* const* sorted, int width, uint16_t* out) {
  const uint16_t *p = sorted[0], *q = sorted[1], *r = sorted[2], *s = sorted[3], *t = sorted[4];
#pragma GCC ivdep
  for (int x = 0; x < width; ++x) {
    uint16_t a[5] = {p[x], p[x + 1], p[x + 2], p[x + 3], p[x + 4]},
             b[5] = {q[x], q[x + 1], q[x + 2], q[x + 3], q[x + 4]},
             c[5] = {r[x], r[x + 1], r[x + 2], r[x + 3], r[x + 4]},
             d[5] = {s[x], s[x + 1], s[x + 2], s[x + 3], s[x + 4]},
             e[5] = {t[x], t[x + 1], t[x + 2], t[x + 3], t[x + 4]};
    sort_five(a), sort_five(b), sort_five(c), sort_five(d), sort_five(e);
    uint16_t v[13] = {a[3], a[4], b[2], b[3], b[4], c[1], c[2], c[3], d[0], d[1], d[2], e[0], e[1]};
    out[x] = middle_of_13(v);
  }
}

}  // namespace

MedianOfRows::MedianOfRows(int height, int width)
    : height(height), width(width), memory(5 * static_cast<size_t>(width + 4)), medians(width) {
  for (int i = 0; i < 5; ++i) sorted[i] = memory.data() + i * static_cast<size_t>(width + 4);
}

const uint16_t* MedianOfRows::of(const uint16_t* image, int y, int from, int to) {
  const int first = std::max(0, from - 2), count = std::min(width, to + 2) - first;
  const uint16_t* rows[5];
  for (int i = 0; i < 5; ++i)
    rows[i] = image + static_cast<size_t>(std::clamp(y + i - 2, 0, height - 1)) * width + first;
  sort_columns(rows, count, sorted);
  for (uint16_t* s : sorted) s[0] = s[1] = s[2], s[count + 2] = s[count + 3] = s[count + 1];
  median_row(sorted, count, medians.data());
  return medians.data() + (from - first);
}

}  // namespace seepast
