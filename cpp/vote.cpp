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

// What a pixel of a block takes of a chunk: its column, and its row of the volume.
struct Taker {
  int column, row;
};

// out = energies + weight / 128 costs; may be in place.
SEEPAST_CLONES
void add_costs(const Taker* takers, int count, const uint8_t* energies, const uint8_t* costs, uint16_t weight,
               uint8_t* out) {
  for (int n = 0; n < count; ++n) {
    uint8_t cost[kChunk], sums[kChunk];
    const uint8_t* energy = energies + takers[n].column * kChunk;
    const size_t at = static_cast<size_t>(takers[n].row) * kChunk;
    std::memcpy(cost, costs + at, kChunk);
    for (int i = 0; i < kChunk; ++i) {
      const uint16_t part = static_cast<uint16_t>(static_cast<uint16_t>(cost[i] * weight + 64) >> 7);
      const uint16_t sum = static_cast<uint16_t>(energy[i] + part);
      sums[i] = static_cast<uint8_t>(sum < 255 ? sum : 255);
    }
    std::memcpy(out + at, sums, kChunk);
  }
}

struct Range {
  uint16_t low, high;
};

SEEPAST_CLONES
Range range_of(const uint16_t* disparity, const uint8_t* confidence, int count) {
  uint16_t low = 0xffff, high = 0;
  for (int x = 0; x < count; ++x) {
    const uint16_t least = confidence[x] ? disparity[x] : static_cast<uint16_t>(0xffff);
    const uint16_t most = confidence[x] ? disparity[x] : static_cast<uint16_t>(0);
    low = least < low ? least : low;
    high = most > high ? most : high;
  }
  return {low, high};
}

// Least and greatest disparity that has confidence, of every block of every row of all cameras.
struct Ranges {
  Ranges(const Array& array, const uint16_t* disparities, const uint8_t* confidence)
      : blocks((array.width + kBlock - 1) / kBlock),
        all(static_cast<size_t>(array.cameras) * array.height * blocks) {
    const int rows = array.cameras * array.height;
#pragma omp parallel for schedule(static)
    for (int row = 0; row < rows; ++row) {
      const size_t at = static_cast<size_t>(row) * array.width;
      for (int b = 0; b < blocks; ++b)
        all[static_cast<size_t>(row) * blocks + b] =
            range_of(disparities + at + b * kBlock, confidence + at + b * kBlock,
                     std::min(kBlock, array.width - b * kBlock));
    }
  }
  // Of columns first .. first + kBlock - 1, and more.
  Range around(int row, int first) const {
    const Range* of_row = all.data() + static_cast<size_t>(row) * blocks;
    const Range &a = of_row[first / kBlock], &b = of_row[std::min(first / kBlock + 1, blocks - 1)];
    return {std::min(a.low, b.low), std::max(a.high, b.high)};
  }
  int blocks;
  std::vector<Range> all;  // [K, H, blocks]
};

// Where all candidates look: the same for every row.
struct Aims {
  static constexpr int kMany = INT_MIN;
  Aims(const Array& array, const Grid& grid) : blocks((array.width + kBlock - 1) / kBlock) {
    for (int i = 0; i < grid.count; ++i)
      for (int k = 0; k < array.cameras; ++k) {
        const RayShift shift = array.shift(k, grid.value(i));
        shifts.push_back(shift);
        expected.push_back(
            floor_int(grid.value(i) * static_cast<float>(kUnits) * (shift.zoom + 1.0f) + 0.5f));
        for (int from = 0; from < array.width; from += kBlock) {
          const int first = whole_offset(ray_dx(shift, from, array.cx));
          const int last = whole_offset(ray_dx(shift, std::min(array.width, from + kBlock) - 1, array.cx));
          offsets.push_back(first == last ? first : kMany);
        }
      }
  }
  int blocks;
  std::vector<RayShift> shifts;  // [candidate][camera]
  std::vector<int> expected;     // likewise: what a view that agrees has there, 32nds of a pixel
  std::vector<int> offsets;      // [candidate][camera][block] in columns, kMany where it changes
};

// All that the votes on any block need.
struct Poll {
  const Array& array;
  const Grid& grid;
  const uint16_t* disparities;
  const uint8_t* confidence;
  const Aims& aims;
  const Ranges& ranges;
  int skip;
};

// The votes on one block of pixels.
struct Ballot {
  explicit Ballot(const Poll& poll) : poll(poll), lag((16 + poll.grid.step - 1) / poll.grid.step) {
    seen.resize(static_cast<size_t>(kChunk) * poll.array.cameras * kBlock);
    sure.resize(seen.size());
  }

  // Columns from .. to - 1 of row y.
  void block(int y, int from, int to, const uint8_t* costs, const uint8_t* is_static, const Chunks& chunks,
             const VoteWeights& weights, uint8_t* out) {
    const size_t at = static_cast<size_t>(y) * poll.array.width + from;
    const int width = to - from;
    int row[kBlock];  // of the volume: after the pixel's last one that is not done
    uint64_t wanted = 0;
    for (int x = 0; x < width; ++x) {
      wanted |= chunks.active[at + x];
      row[x] = chunks.start[at + x + 1];
    }
    const bool blind = std::any_of(is_static + at, is_static + at + width, [](uint8_t s) { return s == 0; });
    if (blind) {
      std::fill_n(hidden.nearer, kBlock, 0);
      std::fill_n(hidden.weight, kBlock, 0);
      for (int x = 0; x < width; ++x)
        hidden.weight[x] = is_static[at + x] ? static_cast<int16_t>(0) : static_cast<int16_t>(weights.hide);
    }
    for (int before = -1; wanted;) {
      const int chunk = 63 - std::countl_zero(wanted);
      wanted ^= uint64_t{1} << chunk;
      Taker takers[kBlock];
      int count = 0;
      alignas(64) int16_t asked[kBlock] = {};
      for (int x = 0; x < width; ++x) {
        const bool has = chunks.active[at + x] >> chunk & 1;
        row[x] -= has;
        asked[x] = static_cast<int16_t>(-has);
        takers[count] = {x, row[x]};
        count += has;
      }
      if (blind && before > chunk + 1)  // the rest of what hides from there on
        for (int i = 0; i < lag; ++i) raise(hidden.nearer, hidden.margins[(before * kChunk + i) % kKept]);
      collect(chunk, y, from, to);
      alignas(64) uint8_t energies[kBlock * kChunk];
      vote_chunk(votes, weights, asked, chunk * kChunk, lag, before == chunk + 1, blind ? &hidden : nullptr,
                 energies);
      add_costs(takers, count, energies, costs, static_cast<uint16_t>(weights.volume), out);
      before = chunk;
    }
  }

  // Looks for votes on the candidates of a chunk.
  void collect(int chunk, int y, int from, int to) {
    Vote* vote = votes.all;
    for (int i = kChunk - 1; i >= 0; --i) {
      const Vote* begin = vote;
      for (int k = 0; k < poll.array.cameras; ++k)
        if (k != poll.skip && look(chunk * kChunk + i, k, y, from, to, *vote)) ++vote;
      votes.count[i] = static_cast<int>(vote - begin);
    }
  }

  // What camera k sees on candidate i; false: nothing that counts.
  bool look(int i, int k, int y, int from, int to, Vote& vote) {
    const Array& array = poll.array;
    const size_t n = static_cast<size_t>(i) * array.cameras + k;
    const RayShift& shift = poll.aims.shifts[n];
    const int row = y + whole_offset(ray_dy(shift, y, array.cy));
    if (row < 0 || row >= array.height) return false;
    const int expected = poll.aims.expected[n],
              offset = poll.aims.offsets[n * poll.aims.blocks + from / kBlock];
    // what lies beyond the 16 bits of a disparity is compared with moved disparities
    const int moved = expected < 0 ? kUnits : expected > 0xffff ? -kBeyond : 0;
    if (expected <= -kUnits) return false;
    const size_t line = (static_cast<size_t>(k) * array.height + row) * array.width;
    vote = {poll.disparities + line, poll.confidence + line, static_cast<uint16_t>(expected + moved), false};
    if (offset != Aims::kMany) {
      const int first = std::max(0, from + offset);
      if (first >= array.width || from + offset + kBlock <= 0) return false;
      const Range range = poll.ranges.around(k * array.height + row, first);
      if (range.low > range.high || range.low - expected >= kUnits) return false;
      vote.through = range.high - expected <= -kBeyond;
      if (from + offset >= 0 && from + offset + kBlock <= array.width && (vote.through || !moved)) {
        vote.disparity += from + offset;
        vote.confidence += from + offset;
        return true;
      }
    } else {
      vote.through = expected >= 0xffff + kBeyond;
    }
    copy(shift, from, to, (static_cast<size_t>(i % kChunk) * array.cameras + k) * kBlock, moved, vote);
    return true;
  }

  // Makes the vote's columns from .. to - 1 a block of their own, without confidence outside the image, and
  // moves its disparities.
  void copy(const RayShift& shift, int from, int to, size_t place, int moved, Vote& vote) {
    const int width = poll.array.width;
    uint16_t* disparity = seen.data() + place;
    uint8_t* confidence = sure.data() + place;
    std::fill_n(confidence, kBlock, 0);
    for_each_run(
        from, to, [&](int x) { return whole_offset(ray_dx(shift, x, poll.array.cx)); },
        [&](int first, int last, int offset) {
          first = std::max(first, -offset);
          last = std::min(last, width - offset);
          if (first >= last) return;
          std::transform(vote.disparity + first + offset, vote.disparity + last + offset,
                         disparity + first - from,
                         [&](int d) { return static_cast<uint16_t>(clamp(d + moved, 0, 0xffff)); });
          std::copy_n(vote.confidence + first + offset, last - first, confidence + first - from);
        });
    vote.disparity = disparity;
    vote.confidence = confidence;
  }

  const Poll& poll;
  int lag;  // candidates to the first that hides, 2 px nearer
  Votes votes;
  Hidden hidden;
  std::vector<uint16_t> seen;  // copies of what lies across an edge of the image or of a run
  std::vector<uint8_t> sure;
};

}  // namespace

void votes(const Array& array, const uint8_t* costs, const uint16_t* disparities, const uint8_t* confidence,
           const uint8_t* is_static, const Grid& grid, const Chunks& chunks, int skip,
           const VoteWeights& weights, uint8_t* out) {
  const Aims aims(array, grid);
  const Ranges ranges(array, disparities, confidence);
  const Poll poll{array, grid, disparities, confidence, aims, ranges, skip};
#pragma omp parallel
  {
    Ballot ballot(poll);
#pragma omp for schedule(dynamic, 4)
    for (int y = 0; y < array.height; ++y)
      for (int from = 0; from < array.width; from += kBlock)
        ballot.block(y, from, std::min(array.width, from + kBlock), costs, is_static, chunks, weights, out);
  }
}

}  // namespace seepast
