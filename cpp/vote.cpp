// Votes of the other cameras on a view's candidates: reference_multiview.votes.
//
// Blocks of 64 columns, chunk by chunk from the nearest on, over the chunks that any of their pixels asks
// for. At one candidate a block looks at every camera with one constant shift, so that the sums vectorise;
// the finished chunk is transposed, and every pixel that has it takes its 16 energies.
#include <algorithm>
#include <bit>
#include <climits>
#include <cstring>
#include <vector>

#include "multiview.h"

namespace seepast {
namespace {

constexpr uint16_t kBeyond = 3 * kUnits;  // who sees that much farther votes against with full weight
constexpr int kKept = 2 * kChunk;  // candidates whose margins are kept: what hides may be a chunk nearer

// What one camera sees on one candidate of a block.
struct Vote {
  const uint16_t* disparity;
  const uint8_t* confidence;
  uint16_t expected;
  bool through;  // every pixel sees kBeyond farther, or has no confidence
};

// Votes on a chunk, its last candidate first.
struct Votes {
  Vote all[kChunk * kMaxCameras];
  int count[kChunk];
};

// Of one block, from chunk to chunk. Margins and nearer: max(0, s - v) of a candidate, and the largest so
// far.
struct Hidden {
  int16_t margins[kKept][kBlock], nearer[kBlock];
  int16_t weight[kBlock];  // 0 where the view sees itself
};

inline __attribute__((always_inline)) void add_vote(const Vote& vote, uint16_t* __restrict support,
                                                    uint16_t* __restrict violation) {
  const uint16_t* __restrict disparity = vote.disparity;
  const uint8_t* __restrict confidence = vote.confidence;
  const uint16_t expected = vote.expected, unit = kUnits;
  if (vote.through) {
    for (int x = 0; x < kBlock; ++x)
      violation[x] = static_cast<uint16_t>(violation[x] + confidence[x] * 2 * kUnits);
    return;
  }
  for (int x = 0; x < kBlock; ++x) {
    const uint16_t seen = disparity[x], c = confidence[x];
    const uint16_t upper = seen > expected ? seen : expected, lower = seen < expected ? seen : expected;
    const uint16_t apart = static_cast<uint16_t>(upper - lower);
    const uint16_t near = static_cast<uint16_t>(unit - (apart < unit ? apart : unit));
    uint16_t below = static_cast<uint16_t>(expected - lower);
    below = below < kBeyond ? below : kBeyond;
    below = static_cast<uint16_t>((below > unit ? below : unit) - unit);
    support[x] = static_cast<uint16_t>(support[x] + static_cast<uint16_t>(c * near));
    violation[x] = static_cast<uint16_t>(violation[x] + static_cast<uint16_t>(c * below));
  }
}

inline __attribute__((always_inline)) void raise(int16_t* __restrict nearer,
                                                 const int16_t* __restrict margin) {
  for (int x = 0; x < kBlock; ++x) nearer[x] = nearer[x] > margin[x] ? nearer[x] : margin[x];
}

typedef uint8_t Bytes __attribute__((vector_size(16)));

// [16][64] -> [64][16].
inline __attribute__((always_inline)) void turn(const uint8_t* rows, uint8_t* out) {
  for (int x = 0; x < kBlock; x += 16) {
    Bytes a[16], b[16];
    for (int i = 0; i < 16; ++i) std::memcpy(&a[i], rows + i * kBlock + x, 16);
    for (int stage = 0; stage < 4; ++stage) {  // each interleaves row i with row i + 8
      for (int i = 0; i < 8; ++i) {
        b[2 * i] =
            __builtin_shufflevector(a[i], a[i + 8], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
        b[2 * i + 1] = __builtin_shufflevector(a[i], a[i + 8], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29,
                                               14, 30, 15, 31);
      }
      std::memcpy(a, b, sizeof a);
    }
    std::memcpy(out + 16 * x, a, sizeof a);
  }
}

// Energies of a chunk without the costs: out [kBlock][kChunk]. `asked` -1 where a pixel has the chunk, else
// 0; `first` its first candidate, `lag` candidates to the first that hides; `next`: the chunk before it was
// counted too. hidden null: the view sees the whole block itself.
SEEPAST_CLONES
void vote_chunk(const Votes& votes, const VoteWeights& weights, const int16_t* __restrict asked, int first,
                int lag, bool next, Hidden* hidden, uint8_t* __restrict out) {
  const int16_t base = static_cast<int16_t>(weights.base), gain = static_cast<int16_t>(weights.gain);
  constexpr int16_t kTwo = 2 * kFullVote, kOne = kFullVote;
  alignas(64) uint8_t tile[kChunk * kBlock];
  const Vote* vote = votes.all;
  for (int i = kChunk - 1; i >= 0; --i) {
    alignas(64) uint16_t support[kBlock], violation[kBlock];
    for (int x = 0; x < kBlock; ++x) support[x] = violation[x] = 0;
    for (int n = 0; n < votes.count[i]; ++n) add_vote(*vote++, support, violation);
    uint8_t* row = tile + i * kBlock;
    if (!hidden) {
      for (int x = 0; x < kBlock; ++x) {
        const int16_t s = static_cast<int16_t>(2 * support[x]), v = static_cast<int16_t>(violation[x]);
        const int16_t sum = static_cast<int16_t>((v < kTwo ? v : kTwo) - (s < kTwo ? s : kTwo));
        const int16_t energy = static_cast<int16_t>(base + static_cast<int16_t>(gain * sum));
        row[x] = static_cast<uint8_t>(((energy > 0 ? energy : 0) + 64) >> 7);
      }
      continue;
    }
    if (i + lag < kChunk || next) raise(hidden->nearer, hidden->margins[(first + i + lag) % kKept]);
    int16_t* __restrict margin = hidden->margins[(first + i) % kKept];
    const int16_t* __restrict nearer = hidden->nearer, * __restrict weight = hidden->weight;
    for (int x = 0; x < kBlock; ++x) {
      const int16_t s = static_cast<int16_t>(2 * support[x]), v = static_cast<int16_t>(violation[x]);
      const int16_t sum = static_cast<int16_t>((v < kTwo ? v : kTwo) - (s < kTwo ? s : kTwo));
      const int16_t behind = static_cast<int16_t>(weight[x] * (nearer[x] < kOne ? nearer[x] : kOne));
      const int16_t energy = static_cast<int16_t>(base + static_cast<int16_t>(gain * sum) + behind);
      const int16_t whole = static_cast<int16_t>(((energy > 0 ? energy : 0) + 64) >> 7);
      row[x] = static_cast<uint8_t>(whole < 255 ? whole : 255);
      margin[x] = static_cast<int16_t>((s > v ? s - v : 0) & asked[x]);
    }
  }
  turn(tile, out);
}

// The pixels of a block that have a chunk: asked -1, else 0; their rows of the volume move on to it.
SEEPAST_CLONES
void ask(const uint64_t* __restrict active, int count, int chunk, int16_t* __restrict asked,
         int32_t* __restrict row) {
  for (int x = 0; x < count; ++x) {
    const int has = static_cast<int>(active[x] >> chunk & 1);
    asked[x] = static_cast<int16_t>(-has);
    row[x] -= has;
  }
}

// out = energies + weight / 128 costs of the pixels that have the chunk; may be in place. Asks the memory for
// as many rows from `ahead` on, and returns where these end.
SEEPAST_CLONES
size_t add_costs(const int16_t* asked, const int32_t* row, int count, const uint8_t* energies,
                 const uint8_t* costs, uint16_t weight, size_t ahead, uint8_t* out) {
  for (int x = 0; x < count; ++x) {
    if (!asked[x]) continue;
    __builtin_prefetch(costs + ahead * kChunk);
    __builtin_prefetch(out + ahead * kChunk, 1);
    ++ahead;
    uint8_t cost[kChunk], sums[kChunk];
    const uint8_t* energy = energies + x * kChunk;
    const size_t at = static_cast<size_t>(row[x]) * kChunk;
    std::memcpy(cost, costs + at, kChunk);
    for (int i = 0; i < kChunk; ++i) {
      const uint16_t part = static_cast<uint16_t>(static_cast<uint16_t>(cost[i] * weight + 64) >> 7);
      const uint16_t sum = static_cast<uint16_t>(energy[i] + part);
      sums[i] = static_cast<uint8_t>(sum < 255 ? sum : 255);
    }
    std::memcpy(out + at, sums, kChunk);
  }
  return ahead;
}

// Least disparity that has confidence, and the greatest in the upper 16 bits.
SEEPAST_CLONES
uint32_t range_of(const uint16_t* disparity, const uint8_t* confidence, int count) {
  uint16_t low = 0xffff, high = 0;
  for (int x = 0; x < count; ++x) {
    const uint16_t known = static_cast<uint16_t>(-static_cast<uint16_t>(confidence[x] != 0));
    const uint16_t least = static_cast<uint16_t>(disparity[x] | static_cast<uint16_t>(~known));
    const uint16_t most = disparity[x] & known;
    low = least < low ? least : low;
    high = most > high ? most : high;
  }
  return static_cast<uint32_t>(high) << 16 | low;
}

// The range of every two blocks of every row of all cameras.
struct Ranges {
  Ranges(const Array& array, const uint16_t* disparities, const uint8_t* confidence)
      : blocks((array.width + kBlock - 1) / kBlock),
        all(static_cast<size_t>(array.cameras) * array.height * blocks) {
    const int rows = array.cameras * array.height;
#pragma omp parallel for schedule(static)
    for (int row = 0; row < rows; ++row)
      for (int b = 0; b < blocks; ++b) {
        const size_t at = static_cast<size_t>(row) * array.width + b * kBlock;
        all[static_cast<size_t>(row) * blocks + b] =
            range_of(disparities + at, confidence + at, std::min(2 * kBlock, array.width - b * kBlock));
      }
  }
  int blocks;
  std::vector<uint32_t> all;  // [K, H, blocks]: of a block and the next one
};

// Where all candidates look: the same for every row.
struct Aims {
  static constexpr int kMany = INT_MIN;
  Aims(const Array& array, const Grid& grid, int skip) : count(grid.count * array.cameras) {
    for (int i = 0; i < grid.count; ++i)
      for (int k = 0; k < array.cameras; ++k) {
        const RayShift shift = array.shift(k, grid.value(i));
        shifts.push_back(shift);
        zoom.push_back(shift.zoom);
        down.push_back(shift.y);
        view.push_back(shift.view_y);
        top.push_back(k == skip ? -1 : k * array.height);
        expected.push_back(
            floor_int(grid.value(i) * static_cast<float>(kUnits) * (shift.zoom + 1.0f) + 0.5f));
      }
    for (int from = 0; from < array.width; from += kBlock)
      for (const RayShift& shift : shifts) {
        const int first = whole_offset(ray_dx(shift, from, array.cx));
        const int last = whole_offset(ray_dx(shift, std::min(array.width, from + kBlock) - 1, array.cx));
        offsets.push_back(first == last ? first : kMany);
      }
  }
  int count;                            // of candidates and cameras
  std::vector<RayShift> shifts;         // [candidate][camera]
  std::vector<float> zoom, down, view;  // of the shifts, for rows
  std::vector<int32_t> top;             // k H, -1 for the camera left out
  std::vector<int> expected;            // likewise: what a view that agrees has there, 32nds of a pixel
  std::vector<int> offsets;             // [block][candidate][camera] in columns, kMany where it changes
};

// What becomes of a camera's vote on a candidate of a block.
enum Verdict : int32_t { kNothing, kCounted, kThrough, kCopied };

SEEPAST_CLONES
void judge(const int32_t* __restrict rows, const int32_t* __restrict expected,
           const int32_t* __restrict offsets, int count, int from, int width,
           const uint32_t* __restrict ranges, int blocks, int32_t* __restrict verdicts) {
  for (int n = 0; n < count; ++n) {
    const int32_t many = -static_cast<int32_t>(offsets[n] == Aims::kMany), seen = expected[n];
    const int32_t first = from + (offsets[n] & ~many), last = first + kBlock;
    const int32_t outside = (rows[n] < 0) | (first >= width) | (last <= 0) | (seen <= -kUnits);
    const uint32_t range = ranges[(rows[n] * blocks + (first > 0 ? first : 0) / kBlock) & (outside - 1)];
    const int32_t low = static_cast<int32_t>(range & 0xffff), high = static_cast<int32_t>(range >> 16);
    const int32_t empty = (low > high) | (low - seen >= kUnits);
    const int32_t inside = (first >= 0) & (last <= width), fits = (seen >= 0) & (seen <= 0xffff);
    const int32_t through = inside & (high - seen <= -kBeyond);
    int32_t verdict = inside & fits ? kCounted : kCopied;
    verdict = through ? static_cast<int32_t>(kThrough) : verdict;
    verdict = empty ? static_cast<int32_t>(kNothing) : verdict;
    verdict = many ? static_cast<int32_t>(kCopied) : verdict;
    verdicts[n] = outside ? static_cast<int32_t>(kNothing) : verdict;
  }
}

// Rows of the cameras' images one below the other, that all rays of row y end in; -1 outside, and of the
// camera left out.
SEEPAST_CLONES
void find_rows(const float* __restrict zoom, const float* __restrict down, const float* __restrict view,
               const int32_t* __restrict top, int count, int y, float cy, int height,
               int32_t* __restrict rows) {
  for (int n = 0; n < count; ++n) {
    const RayShift shift{zoom[n], 0.0f, down[n], 0.0f, view[n]};
    const int32_t row = y + whole_offset(ray_dy(shift, y, cy));
    const int32_t inside = -((row >= 0) & (row < height) & (top[n] >= 0));
    rows[n] = ((top[n] + row) & inside) | ~inside;
  }
}

// All that the votes on any block need.
struct Poll {
  const Array& array;
  const Grid& grid;
  const uint16_t* disparities;
  const uint8_t* confidence;
  const Aims& aims;
  const Ranges& ranges;
};

// The votes on the blocks of one row of pixels.
struct Ballot {
  explicit Ballot(const Poll& poll) : poll(poll), lag((16 + poll.grid.step - 1) / poll.grid.step) {
    seen.resize(static_cast<size_t>(kChunk) * poll.array.cameras * kBlock);
    sure.resize(seen.size());
    rows.resize(poll.aims.count);
  }

  void start(int y) {
    const Array& array = poll.array;
    const Aims& aims = poll.aims;
    find_rows(aims.zoom.data(), aims.down.data(), aims.view.data(), aims.top.data(), aims.count, y, array.cy,
              array.height, rows.data());
  }

  // Columns from .. to - 1 of row y.
  void block(int y, int from, int to, const uint8_t* costs, const uint8_t* is_static, const Chunks& chunks,
             const VoteWeights& weights, uint8_t* out) {
    const size_t at = static_cast<size_t>(y) * poll.array.width + from;
    const int width = to - from;
    uint64_t active[kBlock];  // chunks that there are votes on
    for (int x = 0; x < width; ++x)
      active[x] = weights.visible || !is_static[at + x] ? chunks.active[at + x] : uint64_t{0};
    alignas(64) int32_t row[kBlock];  // of the volume, the last that is done
    std::copy_n(chunks.start + at + 1, width, row);
    const bool blind = std::find(is_static + at, is_static + at + width, 0) != is_static + at + width;
    if (blind) {
      std::fill_n(hidden.nearer, kBlock, 0);
      std::fill_n(hidden.weight, kBlock, 0);
      for (int x = 0; x < width; ++x)
        hidden.weight[x] = is_static[at + x] ? static_cast<int16_t>(0) : static_cast<int16_t>(weights.hide);
    }
    size_t ahead = static_cast<size_t>(chunks.start[at + width]);  // the next block
    uint64_t wanted = 0;
    for (int x = 0; x < width; ++x) wanted |= active[x];
    for (int before = -1; wanted;) {
      const int chunk = 63 - std::countl_zero(wanted);
      wanted ^= uint64_t{1} << chunk;
      if (blind && before > chunk + 1)  // the rest of what hides from there on
        for (int i = 0; i < lag; ++i) raise(hidden.nearer, hidden.margins[(before * kChunk + i) % kKept]);
      alignas(64) int16_t asked[kBlock] = {};
      alignas(64) uint8_t energies[kBlock * kChunk];
      ask(active, width, chunk, asked, row);
      collect(chunk, from, to);
      vote_chunk(votes, weights, asked, chunk * kChunk, lag, before == chunk + 1, blind ? &hidden : nullptr,
                 energies);
      ahead =
          add_costs(asked, row, width, energies, costs, static_cast<uint16_t>(weights.volume), ahead, out);
      before = chunk;
    }
  }

  // Looks for votes on the candidates of a chunk.
  void collect(int chunk, int from, int to) {
    const int cameras = poll.array.cameras, width = poll.array.width, count = kChunk * cameras;
    const int *row = rows.data() + chunk * count, *expected = poll.aims.expected.data() + chunk * count;
    const int* offset = poll.aims.offsets.data() + from / kBlock * poll.aims.count + chunk * count;
    int32_t verdicts[kChunk * kMaxCameras];
    judge(row, expected, offset, count, from, width, poll.ranges.all.data(), poll.ranges.blocks, verdicts);
    Vote* vote = votes.all;
    for (int i = kChunk - 1, n = count - 1; i >= 0; --i) {
      const Vote* begin = vote;
      for (int k = 0; k < cameras; ++k, --n) {
        if (verdicts[n] == kNothing) continue;
        const size_t line = static_cast<size_t>(row[n]) * width;
        if (verdicts[n] == kCopied) {
          *vote++ = copy(chunk * count + n, line, from, to);
        } else {
          const size_t at = line + from + offset[n];
          *vote++ = {poll.disparities + at, poll.confidence + at, static_cast<uint16_t>(expected[n]),
                     verdicts[n] == kThrough};
        }
      }
      votes.count[i] = static_cast<int>(vote - begin);
    }
  }

  // A vote whose columns from .. to - 1 are made a block of their own, without confidence outside the image.
  // What is expected beyond the 16 bits of a disparity is moved, and all disparities with it.
  Vote copy(int n, size_t line, int from, int to) {
    const int expected = poll.aims.expected[n], width = poll.array.width;
    const int by = expected < 0 ? kUnits : expected > 0xffff ? -kBeyond : 0;
    const size_t place = static_cast<size_t>(n % (kChunk * poll.array.cameras)) * kBlock;
    uint16_t* disparity = seen.data() + place;
    uint8_t* confidence = sure.data() + place;
    std::fill_n(confidence, kBlock, 0);
    for_each_run(
        from, to, [&](int x) { return whole_offset(ray_dx(poll.aims.shifts[n], x, poll.array.cx)); },
        [&](int first, int last, int offset) {
          first = std::max(first, -offset);
          last = std::min(last, width - offset);
          if (first >= last) return;
          std::copy_n(poll.disparities + line + first + offset, last - first, disparity + first - from);
          std::copy_n(poll.confidence + line + first + offset, last - first, confidence + first - from);
        });
    if (by)
      for (int x = 0; x < kBlock; ++x)
        disparity[x] = static_cast<uint16_t>(clamp(disparity[x] + by, 0, 0xffff));
    return {disparity, confidence, static_cast<uint16_t>(expected + by), expected >= 0xffff + kBeyond};
  }

  const Poll& poll;
  int lag;                // candidates to the first that hides, 2 px nearer
  std::vector<int> rows;  // [candidate][camera]: k H + y where it looks, -1 for nowhere
  Votes votes;
  Hidden hidden;
  std::vector<uint16_t> seen;  // copies of what lies across an edge of the image or of a run
  std::vector<uint8_t> sure;
};

}  // namespace

void votes(const Array& array, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const Grid& grid, const Chunks& chunks, int skip,
           const VoteWeights& weights, uint8_t* out) {
  const Aims aims(array, grid, skip);
  const Ranges ranges(array, disparities, confidence);
  const Poll poll{array, grid, disparities, confidence, aims, ranges};
#pragma omp parallel
  {
    Ballot ballot(poll);
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < array.height; ++y) {
      ballot.start(y);
      for (int from = 0; from < array.width; from += kBlock)
        ballot.block(y, from, std::min(array.width, from + kBlock), costs, is_static, chunks, weights, out);
    }
  }
}

}  // namespace seepast
