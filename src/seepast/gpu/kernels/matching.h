// What the kernels of matching hand each other.
#pragma once

#include <cstdint>

namespace seepast {

constexpr int kReach = 3;  // of the census
constexpr int kNeighbours = 24;
constexpr unsigned kAllNeighbours = (1u << kNeighbours) - 1;

// A sample of a camera is two words: the census; and B, G, R, and these. `valid` has the bits of neighbours
// that are static, none where the sample itself is not.
constexpr unsigned kStatic = 1u << 24;  // every pixel that the sample lies between is static
constexpr unsigned kClear = 2u << 24;   // and so is every neighbour

constexpr int kChunk = 16;  // candidates that are matched together (candidates.py)
constexpr int kUnits = 32;  // disparities of views: uint16 in 32nds of a pixel over the array
constexpr unsigned kNoPair = 255;

}  // namespace seepast
