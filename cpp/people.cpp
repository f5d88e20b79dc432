// Masks from all views: what the cameras say about each surface, objects, and the log-odds of every pixel.
#include "people.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace seepast {
namespace {

// Where the pixels of a row lie in another camera, and their surface's disparity there.
SEEPAST_CLONES
void land_row(const float* __restrict offset, float cx, float cy, int y, int width, const float* __restrict d,
              int32_t* __restrict px, int32_t* __restrict py, float* __restrict there) {
  for (int x = 0; x < width; ++x) {
    const RayShift shift = ray_shift(offset, d[x]);
    px[x] = x + whole_offset(ray_dx(shift, x, cx));
    py[x] = y + whole_offset(ray_dy(shift, y, cy));
    there[x] = seen_disparity(offset, d[x]);
  }
}

// What camera j says about the surfaces of a row of camera k; out has a stride of `cameras`.
void says_row(const int32_t* px, const int32_t* py, const float* there, int width, int height,
              const uint8_t* known, const uint8_t* dynamic, const float* surface, float tolerance,
              int cameras, uint8_t* out) {
  for (int x = 0; x < width; ++x) {
    uint8_t say = kNoSay;
    if (static_cast<unsigned>(px[x]) < static_cast<unsigned>(width) &&
        static_cast<unsigned>(py[x]) < static_cast<unsigned>(height)) {
      const size_t at = static_cast<size_t>(py[x]) * width + px[x];
      if (known[x] != kNoRay && std::fabs(surface[at] - there[x]) <= tolerance) say = dynamic[at];
    }
    out[static_cast<size_t>(x) * cameras] = say;
  }
}

GridPosition grid_position(const Array& view, int reference, const Cells& cells, int x, int y, float d) {
  return grid_position(view.offsets + kOffsets * reference, view.cx, view.cy, cells, x, y, d);
}

// The terms of a row of potentials, before they are added.
struct PotentialRow {
  explicit PotentialRow(size_t width) : sure(width), local(width), colour(width), unlike(width) {}
  std::vector<float> sure, local, colour, unlike;
};

SEEPAST_CLONES
void potential_row(const float* __restrict sure, const float* __restrict said, const float* __restrict local,
                   const float* __restrict colour, const float* __restrict unlike, float said_weight,
                   float local_weight, int width, int16_t* __restrict u) {
  for (int i = 0; i < width; ++i)
    u[i] = potential_of(sure[i], said[i], local[i], colour[i], unlike[i], said_weight, local_weight);
}

}  // namespace

void witnesses(const Array* views, const uint8_t* dynamic, const float* surfaces, float tolerance,
               uint8_t* saw) {
  const int K = views->cameras, height = views->height, width = views->width;
  const size_t pixels = views->pixels();
#pragma omp parallel
  {
    std::vector<int32_t> px(width), py(width);
    std::vector<float> there(width);
#pragma omp for schedule(static)
    for (int line = 0; line < K * height; ++line) {
      const int k = line / height, y = line % height;
      const size_t row = static_cast<size_t>(line) * width;
      for (int j = 0; j < K; ++j) {
        uint8_t* out = saw + row * K + j;
        if (j == k) {
          for (int x = 0; x < width; ++x) out[static_cast<size_t>(x) * K] = dynamic[row + x];
          continue;
        }
        const Array& view = views[k];
        land_row(view.offsets + kOffsets * j, view.cx, view.cy, y, width, surfaces + row, px.data(),
                 py.data(), there.data());
        says_row(px.data(), py.data(), there.data(), width, height, dynamic + row, dynamic + j * pixels,
                 surfaces + j * pixels, tolerance, K, out);
      }
    }
  }
}

void disagreement(const uint8_t* saw, int cameras, int height, int width, int step, int64_t* sums) {
  const int rows = (height + step - 1) / step;
  int64_t low = 0, high = 0;
#pragma omp parallel for schedule(static) reduction(+ : low, high)
  for (int line = 0; line < cameras * rows; ++line) {
    const int k = line / rows, y = line % rows * step;
    const uint8_t* says = saw + (static_cast<size_t>(k) * height + y) * width * cameras;
    int less = 0, more = 0;
    for (int x = 0; x < width; x += step, says += step * cameras) {
      const int own = says[k];
      if (own == kNoSay) continue;
      for (int j = 0; j < cameras; ++j) {
        const int other = says[j] == kNoSay || j == k ? -1 : says[j];
        less += other < 0 ? 0 : std::min(own, other);
        more += other < 0 ? 0 : std::max(own, other);
      }
    }
    low += less, high += more;
  }
  sums[0] = low, sums[1] = high;
}

void sloping(int cameras, int height, int width, const float* surfaces, float least, int rows, int stride,
             uint16_t* out) {
  const Lattice grid(height, width, stride);
  const size_t away = static_cast<size_t>(rows) * width;
#pragma omp parallel for schedule(static)
  for (int line = 0; line < cameras * grid.height; ++line) {
    const int k = line / grid.height, y = grid.image(line % grid.height);
    uint16_t* row = out + static_cast<size_t>(line) * grid.width;
    if (y < rows || y + rows >= height) {
      std::fill_n(row, grid.width, uint16_t{0});
      continue;
    }
    const float* d = surfaces + (static_cast<size_t>(k) * height + y) * width;
    for (int i = 0; i < grid.width; ++i) {
      const float* here = d + grid.image(i);
      row[i] = slopes(*(here - away), *here, here[away], least) ? kUnknown : uint16_t{0};
    }
  }
}

void object_grid(const Array* views, int reference, const uint8_t* saw, const float* surfaces,
                 const Cells& cells, int stride, const uint16_t* floor, uint16_t* mean, int64_t* sums) {
  const int K = views->cameras;
  const Lattice grid(views->height, views->width, stride);
  const size_t size = cells.index(cells.count[0], 0, 0);
  std::fill_n(sums, 2 * size, 0);
#pragma omp parallel
  {
    std::vector<int64_t> own(2 * size, 0);
#pragma omp for schedule(static)
    for (int line = 0; line < K * grid.height; ++line) {
      const int k = line / grid.height, y = grid.image(line % grid.height);
      for (int i = 0; i < grid.width; ++i) {
        const int x = grid.image(i);
        const size_t at = (static_cast<size_t>(k) * views->height + y) * views->width + x;
        int n = 0, total = 0;
        for (int j = 0; j < K; ++j) {
          const int say = saw[at * K + j];
          n += say != kNoSay;
          total += say != kNoSay ? say : 0;
        }
        uint16_t& pooled = mean[static_cast<size_t>(line) * grid.width + i];
        pooled = n ? static_cast<uint16_t>((kPooled * total + n / 2) / n) : kUnknown;
        if (!n || floor[static_cast<size_t>(line) * grid.width + i]) continue;
        const GridPosition g = grid_position(views[k], reference, cells, x, y, surfaces[at]);
        const size_t cell =
            cells.index(floor_int(g.at[0] + 0.5f), floor_int(g.at[1] + 0.5f), floor_int(g.at[2] + 0.5f));
        own[cell] += pooled;
        own[size + cell] += 1;
      }
    }
#pragma omp critical
    for (size_t i = 0; i < 2 * size; ++i) sums[i] += own[i];
  }
}

void object_slice(const Array* views, int reference, const float* values, const uint16_t* mean,
                  const float* surfaces, const Cells& cells, int stride, uint16_t* share) {
  const Lattice grid(views->height, views->width, stride);
  const size_t size = cells.index(cells.count[0], 0, 0);
#pragma omp parallel for schedule(static)
  for (int line = 0; line < views->cameras * grid.height; ++line) {
    const int k = line / grid.height, y = grid.image(line % grid.height);
    for (int i = 0; i < grid.width; ++i) {
      const size_t out = static_cast<size_t>(line) * grid.width + i;
      share[out] = kUnknown;
      if (mean[out] == kUnknown) continue;
      const int x = grid.image(i);
      const float d = surfaces[(static_cast<size_t>(k) * views->height + y) * views->width + x];
      const GridPosition g = grid_position(views[k], reference, cells, x, y, d);
      share[out] = object_share(values, values + size, cells, g);
    }
  }
}

void border_counts(int cameras, int height, int width, const uint16_t* share, const uint16_t* mean,
                   const float* surfaces, const int32_t* thresholds, int count, float step, int stride,
                   int64_t* counts) {
  const Lattice grid(height, width, stride);
  std::vector<uint8_t> rank(kShare + 1);  // how many thresholds lie below a share
  for (int s = 0; s <= kShare; ++s)
    rank[s] =
        static_cast<uint8_t>(std::count_if(thresholds, thresholds + count, [&](int t) { return t < s; }));
  // a pixel of rank r is inside for the first r thresholds; a pair is a border for those from the lower rank
  // to the higher: as differences, summed up at the end
  const size_t row = count + 1;
  std::vector<int64_t> total(4 * row, 0);
#pragma omp parallel
  {
    std::vector<int64_t> own(4 * row, 0);
    const auto pair = [&](size_t p, size_t q, float dp, float dq) {
      if (share[p] == kUnknown || share[q] == kUnknown) return;
      int low = rank[share[q]], high = rank[share[p]];
      if (low == high) return;
      if (low > high) std::swap(low, high), std::swap(dp, dq);
      own[row + low] += 1, own[row + high] -= 1;
      if (dp - dq > step) own[low] += 1, own[high] -= 1;
    };
#pragma omp for schedule(static)
    for (int line = 0; line < cameras * grid.height; ++line) {
      const int k = line / grid.height, j = line % grid.height;
      const float* d = surfaces + (static_cast<size_t>(k) * height + grid.image(j)) * width;
      const float* below = j + 1 < grid.height ? d + static_cast<size_t>(stride) * width : nullptr;
      for (int i = 0; i < grid.width; ++i) {
        const size_t p = static_cast<size_t>(line) * grid.width + i;
        const int x = grid.image(i);
        if (share[p] != kUnknown) {
          own[2 * row] += mean[p], own[2 * row + rank[share[p]]] -= mean[p];
          own[3 * row] += 1, own[3 * row + rank[share[p]]] -= 1;
        }
        if (i + 1 < grid.width) pair(p, p + 1, d[x], d[x + stride]);
        if (below) pair(p, p + grid.width, d[x], below[x]);
      }
    }
#pragma omp critical
    for (size_t i = 0; i < total.size(); ++i) total[i] += own[i];
  }
  for (int c = 0; c < 4; ++c)
    for (int64_t i = 0, sum = 0; i < count; ++i) {
      sum += total[c * row + i];
      counts[c * count + i] = sum;
    }
}

void surprise(size_t pixels, const uint8_t* colour, const uint8_t* behind, const uint16_t* rays,
              const uint8_t* wanted, const uint8_t* levels, uint8_t* out) {
  constexpr size_t kSome = 1 << 12;
  const int parts = static_cast<int>((pixels + kSome - 1) / kSome);
#pragma omp parallel for schedule(static)
  for (int part = 0; part < parts; ++part)
    for (size_t i = part * kSome; i < std::min(pixels, (part + 1) * kSome); ++i)
      out[i] = wanted[i] && rays[i] ? levels[colour_step(colour + 3 * i, behind + 3 * i)] : kNoSay;
}

void surprise_counts(int cameras, int height, int width, const uint8_t* surprise, const int8_t* sure,
                     int stride, int64_t* counts) {
  const Lattice grid(height, width, stride);
  std::fill_n(counts, static_cast<size_t>(cameras) * 2 * kLevels, 0);
#pragma omp parallel for schedule(static)
  for (int k = 0; k < cameras; ++k)
    for (int j = 0; j < grid.height; ++j)
      for (int i = 0; i < grid.width; ++i) {
        const int label = sure[k * grid.pixels() + static_cast<size_t>(j) * grid.width + i];
        const uint8_t level =
            surprise[(static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i)];
        if (label && level != kNoSay) ++counts[(2 * k + (label > 0)) * kLevels + level];
      }
}

void people_histograms(int cameras, int height, int width, int channels, const uint8_t* dynamic,
                       const uint8_t* colour, const uint8_t* person, int stride, int64_t* levels,
                       int64_t* colours) {
  const Lattice grid(height, width, stride);
  std::fill_n(levels, static_cast<size_t>(cameras) * 2 * kLevels, 0);
  std::fill_n(colours, 2 * kColours, 0);
#pragma omp parallel
  {
    std::vector<int64_t> own(2 * kColours, 0);
#pragma omp for schedule(static)
    for (int k = 0; k < cameras; ++k)
      for (int j = 0; j < grid.height; ++j)
        for (int i = 0; i < grid.width; ++i) {
          const size_t at = (static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i);
          if (dynamic[at] == kNoRay) continue;
          const int label = person[k * grid.pixels() + static_cast<size_t>(j) * grid.width + i];
          int c[3];
          bgr(colour + at * channels, channels, c);
          ++levels[(2 * k + label) * kLevels + (dynamic[at] >> 4)];
          ++own[label * kColours + colour_bin(c)];
        }
#pragma omp critical
    for (int i = 0; i < 2 * kColours; ++i) colours[i] += own[i];
  }
}

void colour_moments(int cameras, int height, int width, int channels, const uint8_t* colour,
                    const int8_t* sure, int stride, int block, int32_t* moments) {
  const Lattice grid(height, width, stride);
  const int rows = (grid.height + block - 1) / block, columns = (grid.width + block - 1) / block;
#pragma omp parallel for schedule(static)
  for (int line = 0; line < cameras * rows; ++line) {
    const int k = line / rows, r = line % rows;
    int32_t* out = moments + static_cast<size_t>(line) * columns * kMoments;
    std::fill_n(out, static_cast<size_t>(columns) * kMoments, 0);
    for (int j = r * block; j < std::min(grid.height, (r + 1) * block); ++j)
      for (int i = 0; i < grid.width; ++i) {
        const int label = sure[k * grid.pixels() + static_cast<size_t>(j) * grid.width + i];
        if (!label) continue;
        int c[3];
        const size_t at = (static_cast<size_t>(k) * height + grid.image(j)) * width + grid.image(i);
        bgr(colour + at * channels, channels, c);
        int32_t* m = out + static_cast<size_t>(i / block) * kMoments;
        const int terms[10] = {1,           c[0],        c[1],        c[2],        c[0] * c[0],
                               c[0] * c[1], c[0] * c[2], c[1] * c[1], c[1] * c[2], c[2] * c[2]};
        for (int t = 0; t < 10; ++t) m[t] += terms[t];
        if (label > 0)
          for (int t = 0; t < 4; ++t) m[10 + t] += terms[t];
      }
  }
}

void log_odds(int cameras, int height, int width, const uint8_t* saw, const float* levels, int stride,
              float* out) {
  const Lattice grid(height, width, stride);
  std::vector<float> table(256 * static_cast<size_t>(cameras));  // by camera and what it says; 0 for nothing
  for (int j = 0; j < cameras; ++j)
    for (int say = 0; say < kNoSay; ++say) table[256 * j + say] = levels[j * kLevels + (say >> 4)];
  float inverse[kMaxCameras + 1] = {1.0f};
  for (int n = 1; n <= kMaxCameras; ++n) inverse[n] = 1.0f / static_cast<float>(n);
#pragma omp parallel for schedule(static)
  for (int line = 0; line < cameras * grid.height; ++line) {
    const int k = line / grid.height, y = grid.image(line % grid.height);
    const uint8_t* says = saw + (static_cast<size_t>(k) * height + y) * width * cameras;
    for (int i = 0; i < grid.width; ++i) {
      const uint8_t* of = says + static_cast<size_t>(grid.image(i)) * cameras;
      int n = 0;
      float total = 0;
      for (int j = 0; j < cameras; ++j) {
        total += table[256 * j + of[j]];
        n += of[j] != kNoSay;
      }
      out[static_cast<size_t>(line) * grid.width + i] = total * inverse[n];
    }
  }
}

void potential(int height, int width, int channels, const float* said, const uint8_t* dynamic,
               const uint8_t* colour, const float* linear, const int8_t* sure, int sure_height,
               int sure_width, const uint8_t* surprise, const Terms& terms, int stride, int cell,
               int16_t* u) {
  const Lattice grid(height, width, stride);
#pragma omp parallel
  {
    PotentialRow row(grid.width);
#pragma omp for schedule(static)
    for (int j = 0; j < grid.height; ++j) {
      const size_t at = static_cast<size_t>(grid.image(j)) * width, out = static_cast<size_t>(j) * grid.width;
      const int8_t* labels = sure + static_cast<size_t>(std::min(j / cell, sure_height - 1)) * sure_width;
      for (int i = 0; i < grid.width; ++i) {
        const size_t x = at + grid.image(i);
        int c[3];
        bgr(colour + x * channels, channels, c);
        row.local[i] = local_of(linear + 4 * x, c);
        row.colour[i] = terms.colours[colour_bin(c)];
      }
      for (int i = 0; i < grid.width;) {
        const int here = i / cell,
                  end = here + 1 < sure_width ? std::min((here + 1) * cell, grid.width) : grid.width;
        const int label = labels[std::min(here, sure_width - 1)];
        for (; i < end; ++i) {
          const uint8_t level = surprise[at + grid.image(i)];
          row.sure[i] = terms.sure[label + 1];
          row.unlike[i] = level == kNoSay || label < 0 ? 0.0f : terms.behind[level];
        }
      }
      potential_row(row.sure.data(), said + out, row.local.data(), row.colour.data(), row.unlike.data(),
                    terms.said, terms.local, grid.width, u + out);
      for (int i = 0; i < grid.width; ++i)
        if (dynamic[at + grid.image(i)] == kNoRay) u[out + i] = 0;
    }
  }
}

}  // namespace seepast
