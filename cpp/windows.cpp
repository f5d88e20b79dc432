// Stage "candidates" of the many-view method: where a coarser level says to look.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <numeric>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

// The number of the chunk that an offset from the first candidate lies in, in 32nds of a pixel. The quotient
// is rounded down right: a multiple of `length` is farther from the next float below than 1 / length.
inline int chunk_of(int offset, float length, int last) {
  return std::min(static_cast<int>(static_cast<float>(std::max(offset, 0)) / length), last);
}

// The chunks within reach of each pixel of a coarse row.
SEEPAST_CLONES
void row_bits(const uint16_t* __restrict d, int width, int ratio, const Grid& grid, int reach,
              uint64_t* __restrict bits) {
  const int origin = kUnits / 8 * grid.first, spacing = kUnits / 8 * grid.step,
            last = grid.count / kChunk - 1;
  const float length = static_cast<float>(kChunk * spacing);
  for (int x = 0; x < width; ++x) {
    const int centre = d[x] * ratio - origin;
    const int low = chunk_of(centre - reach, length, last),
              high = chunk_of(centre + reach + spacing - 1, length, last);
    bits[x] = (~uint64_t{0} >> (63 - (high - low))) << low;
  }
}

// Row j of a ring of `rows` rows.
struct Ring {
  Ring(int rows, int columns) : rows(rows), columns(columns), bits(static_cast<size_t>(rows) * columns) {}
  uint64_t* row(int j) { return bits.data() + static_cast<size_t>(j % rows) * columns; }
  int rows, columns;
  std::vector<uint64_t> bits;
};

SEEPAST_CLONES
void add_row(const uint64_t* __restrict row, int columns, uint64_t* __restrict sum) {
  for (int x = 0; x < columns; ++x) sum[x] |= row[x];
}

// The chunks of `column` as far as `spread` to the sides, where there are as many entries to spare; none
// where `where` does not hold.
SEEPAST_CLONES
void spread_out(const uint64_t* column, const uint8_t* __restrict where, int columns, int spread,
                uint64_t* __restrict around) {
  for (int x = 0; x < columns; ++x) around[x] = column[x];
  for (int i = 1; i <= spread; ++i)
    for (int x = 0; x < columns; ++x) around[x] |= column[x - i] | column[x + i];
  for (int x = 0; x < columns; ++x) around[x] = where[x] ? around[x] : 0;
}

// None where `within` does not hold. Returns how many there are.
SEEPAST_CLONES
int32_t keep_within(const uint8_t* __restrict within, int width, uint64_t* __restrict active) {
  int32_t sum = 0;
  for (int x = 0; x < width; ++x) {
    active[x] = within[x] ? active[x] : 0;
    sum += std::popcount(active[x]);
  }
  return sum;
}

SEEPAST_CLONES
int32_t chunks_of(const uint64_t* active, int width) {
  int32_t sum = 0;
  for (int x = 0; x < width; ++x) sum += std::popcount(active[x]);
  return sum;
}

template <int ratio>
inline void repeat(const uint64_t* __restrict coarse, int count, uint64_t* __restrict fine) {
  for (int x = 0; x < count; ++x)
    for (int i = 0; i < ratio; ++i) fine[ratio * x + i] = coarse[x];
}

// Every pixel `ratio` times, the last one to the end.
void widen(const uint64_t* coarse, int columns, int ratio, int width, uint64_t* fine) {
  const int whole = std::min(columns - 1, width / ratio);
  if (ratio == 2)
    repeat<2>(coarse, whole, fine);
  else
    for (int x = 0; x < whole; ++x) std::fill_n(fine + ratio * x, ratio, coarse[x]);
  std::fill(fine + ratio * whole, fine + width, coarse[whole]);
}

// How many chunks there are before each pixel, `before` before the first.
SEEPAST_CLONES
void count_row(const uint64_t* __restrict active, int width, int32_t before, int32_t* __restrict start) {
  for (int x = 0; x < width; ++x) {
    start[x] = before;
    before += std::popcount(active[x]);
  }
}

}  // namespace

void windows(int views, const uint16_t* disparity, const uint8_t* where, int rows, int columns, int ratio,
             const Grid& grid, int reach, int spread, const uint8_t* within, int whole, int height, int width,
             uint64_t* active, int32_t* start) {
  const size_t coarse = static_cast<size_t>(rows) * columns, fine = static_cast<size_t>(height) * width;
  std::vector<int32_t> before(views * static_cast<size_t>(height + 1));  // chunks of all rows before
  const auto top = [&](int y) { return y < rows ? std::min(height, y * ratio) : height; };
#pragma omp parallel
  {
    Ring ring(2 * spread + 1, columns);
    std::vector<uint64_t> column(columns + 2 * spread), around(columns);
    int view = -1, known = -1;  // the last row in the ring, and its view
#pragma omp for schedule(static)
    for (int line = 0; line < views * rows; ++line) {
      const int v = line / rows, y = line % rows;
      uint64_t* const of_view = active + v * fine;
      const uint16_t* const d = disparity + v * coarse;
      const uint8_t* const here = where + v * coarse + static_cast<size_t>(y) * columns;
      const uint8_t* const kept = within && v != whole ? within + v * fine : nullptr;
      int32_t* const chunks = before.data() + v * static_cast<size_t>(height + 1) + 1;
      const auto row = [&](int at) { return static_cast<size_t>(at) * width; };
      if (!std::memchr(here, 1, columns)) {
        std::fill_n(of_view + row(top(y)), row(top(y + 1) - top(y)), uint64_t{0});
        continue;
      }
      if (v != view) view = v, known = -1;
      const int first = std::max(0, y - spread), last = std::min(rows - 1, y + spread);
      for (known = std::max(known, first - 1); known < last; ++known)
        row_bits(d + static_cast<size_t>(known + 1) * columns, columns, ratio, grid, reach,
                 ring.row(known + 1));
      std::fill(column.begin(), column.end(), 0);
      for (int j = first; j <= last; ++j) add_row(ring.row(j), columns, column.data() + spread);
      spread_out(column.data() + spread, here, columns, spread, around.data());
      for (int at = top(y); at < top(y + 1); ++at) {
        uint64_t* const out = of_view + row(at);
        if (at == top(y) || kept)
          widen(around.data(), columns, ratio, width, out);
        else
          std::copy_n(of_view + row(top(y)), width, out);
        if (kept)
          chunks[at] = keep_within(kept + row(at), width, out);
        else
          chunks[at] = at == top(y) ? chunks_of(out, width) : chunks[at - 1];
      }
    }
#pragma omp for schedule(static)
    for (int v = 0; v < views; ++v) {
      int32_t* const chunks = before.data() + v * static_cast<size_t>(height + 1);
      for (int y = 0; y < height; ++y) chunks[y + 1] += chunks[y];
      start[v * (fine + 1) + fine] = chunks[height];
    }
#pragma omp for schedule(static)
    for (int line = 0; line < views * height; ++line) {
      const int v = line / height, y = line % height;
      const int32_t* const chunks = before.data() + v * static_cast<size_t>(height + 1) + y;
      int32_t* const to = start + v * (fine + 1) + static_cast<size_t>(y) * width;
      if (chunks[0] == chunks[1])
        std::fill_n(to, width, chunks[0]);
      else
        count_row(active + line * static_cast<size_t>(width), width, chunks[0], to);
    }
  }
}

void landings(const Array& array, const uint8_t* hidden, const float* low, const float* high, uint8_t* out) {
  const float cx = array.cx, cy = array.cy;
  const float last_column = static_cast<float>(array.width - 1),
              last_row = static_cast<float>(array.height - 1);
#pragma omp parallel for schedule(dynamic, 1)
  for (int k = 0; k < array.cameras; ++k) {
    const float* offset = array.offsets + kOffsets * k;
    uint8_t* const there = out + k * array.pixels();
    for (int y = 0; y < array.height; ++y)
      for (int x = 0; x < array.width; ++x) {
        const size_t at = static_cast<size_t>(y) * array.width + x;
        if (!hidden[at]) continue;
        float u[2], v[2];
        for (int i = 0; i < 2; ++i) {
          const float d = i ? high[at] : low[at], scale = 1.0f / (1.0f - d * offset[2]);
          u[i] = cx + (static_cast<float>(x) - cx - d * offset[0]) * scale + offset[3];
          v[i] = cy + (static_cast<float>(y) - cy - d * offset[1]) * scale + offset[4];
        }
        const int left = static_cast<int>(std::max(std::nearbyint(std::min(u[0], u[1])), 0.0f)),
                  right = static_cast<int>(std::min(std::nearbyint(std::max(u[0], u[1])), last_column)),
                  top = static_cast<int>(std::max(std::nearbyint(std::min(v[0], v[1])), 0.0f)),
                  bottom = static_cast<int>(std::min(std::nearbyint(std::max(v[0], v[1])), last_row));
        for (int row = top; left <= right && row <= bottom; ++row)
          std::memset(there + static_cast<size_t>(row) * array.width + left, 1,
                      static_cast<size_t>(right - left + 1));
      }
  }
}

void witnessed(const Array& array, const uint8_t* hidden, const uint16_t* disparities,
               const uint8_t* is_static, const int32_t* order, int most, int tolerance, uint8_t* out) {
  const float cx = array.cx, cy = array.cy;
  const size_t pixels = array.pixels();
  const auto within = [](float at, int count) { return at >= 0 && at < static_cast<float>(count); };
#pragma omp parallel for schedule(static)
  for (int y = 0; y < array.height; ++y)
    for (int x = 0; x < array.width; ++x) {
      const size_t at = static_cast<size_t>(y) * array.width + x;
      if (!hidden[at]) continue;
      const int units = disparities[order[0] * pixels + at];
      const float d = static_cast<float>(units) / static_cast<float>(kUnits);
      out[order[0] * pixels + at] = 1;
      for (int i = 1, seen = 0; i < array.cameras && seen < most; ++i) {
        const float* offset = array.offsets + kOffsets * order[i];
        const float scale = 1.0f / (1.0f - d * offset[2]);
        const float u = std::nearbyint(cx + (static_cast<float>(x) - cx - d * offset[0]) * scale + offset[3]),
                    v = std::nearbyint(cy + (static_cast<float>(y) - cy - d * offset[1]) * scale + offset[4]);
        if (!within(u, array.width) || !within(v, array.height)) continue;
        const size_t there =
            order[i] * pixels + static_cast<size_t>(v) * array.width + static_cast<size_t>(u);
#pragma omp atomic write
        out[there] = 1;
        seen += is_static[there] && std::abs(disparities[there] - units) <= tolerance;
      }
    }
}

}  // namespace seepast
