// Stage "rectify": images and masks of all cameras into the common orientation, and refined masks back. Both
// give what cv2.remap gives: positions in 32nds of a pixel, edges continued.
#include "device.h"

using namespace seepast;

constexpr int kFractions = 32;  // of a pixel
constexpr int kTaps = 4;        // of cubic interpolation, along each axis
constexpr int kMaxDynamic = 254;

// An image of a camera, [height, width, channels].
struct Image {
  const uint8_t* pixels;
  int width, height, channels;
  __device__ int at(int x, int y, int c) const {
    return pixels[(static_cast<size_t>(clamp(y, 0, height - 1)) * width + clamp(x, 0, width - 1)) * channels +
                  c];
  }
};

// Where a pixel comes from: whole pixels, and 32nds beyond them.
struct Source {
  int x, y, fraction;  // 32 fy + fx
};

static __device__ Source source_of(const short2* whole, const uint16_t* fraction, size_t at) {
  const short2 w = whole[at];
  return {w.x, w.y, fraction[at] & (kFractions * kFractions - 1)};
}

static __device__ int linear(const Image& image, const Source& s, int c) {
  const int fx = s.fraction % kFractions, fy = s.fraction / kFractions;
  const int upper = image.at(s.x, s.y, c) * (kFractions - fx) + image.at(s.x + 1, s.y, c) * fx;
  const int lower = image.at(s.x, s.y + 1, c) * (kFractions - fx) + image.at(s.x + 1, s.y + 1, c) * fx;
  return (upper * (kFractions - fy) + lower * fy + kFractions * kFractions / 2) / (kFractions * kFractions);
}

// weights float [32, 4] of the pixels from one before on, by 32nds. Row by row, multiplied and added in one
// rounding, as OpenCV 5 does it.
static __device__ int cubic(const Image& image, const Source& s, const float4* weights, int c) {
  const float4 across = weights[s.fraction % kFractions], down = weights[s.fraction / kFractions];
  float rows[kTaps];
#pragma unroll
  for (int j = 0; j < kTaps; ++j) {
    const int y = s.y + j - 1;
    rows[j] = static_cast<float>(image.at(s.x - 1, y, c)) * across.x;
    rows[j] = fmaf(static_cast<float>(image.at(s.x, y, c)), across.y, rows[j]);
    rows[j] = fmaf(static_cast<float>(image.at(s.x + 1, y, c)), across.z, rows[j]);
    rows[j] = fmaf(static_cast<float>(image.at(s.x + 2, y, c)), across.w, rows[j]);
  }
  const float sum = fmaf(rows[3], down.w, fmaf(rows[2], down.z, fmaf(rows[1], down.y, rows[0] * down.x)));
  return clamp(__float2int_rn(sum), 0, 255);
}

// cv2.cvtColor's weights of blue, green and red, in 2^15ths.
static __device__ uint8_t grey_of(const int* bgr) {
  return static_cast<uint8_t>((bgr[0] * 3735 + bgr[1] * 19235 + bgr[2] * 9798 + (1 << 14)) >> 15);
}

// Blocks of 32 x 8 pixels of camera blockIdx.z.
//   images, masks uint64 [K]: addresses of uint8 [h, w, channels] and [h, w]; 0 for a mask of nothing
//   sizes int32 [K, 2]: (w, h)
//   slots int32 [K]: which of the maps is the camera's, -1 if its image is the view already
//   whole int16 [M, H, W, 2], fraction uint16 [M, H, W]: the maps
//   no_ray uint8 [M, H, W]: NO_RAY or 0
//   weights float [32, 4]: of cubic interpolation, if use_cubic
// colour [K, H, W, channels], channels 1 or 3; grey (not written if not wanted, nor of 1) and dynamic
// [K, H, W].
extern "C" __global__ void __launch_bounds__(256)
    rectify(const uint64_t* __restrict__ images, const uint64_t* __restrict__ masks,
            const int32_t* __restrict__ sizes, const int32_t* __restrict__ slots,
            const short2* __restrict__ whole, const uint16_t* __restrict__ fraction,
            const uint8_t* __restrict__ no_ray, const float4* __restrict__ weights, int use_cubic,
            int wants_grey, int height, int width, int channels, uint8_t* __restrict__ colour,
            uint8_t* __restrict__ grey, uint8_t* __restrict__ dynamic) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, k = blockIdx.z;
  if (x >= width || y >= height) return;
  const size_t pixel = static_cast<size_t>(y) * width + x, pixels = static_cast<size_t>(height) * width;
  const Image image{reinterpret_cast<const uint8_t*>(images[k]), sizes[2 * k], sizes[2 * k + 1], channels};
  const Image mask{reinterpret_cast<const uint8_t*>(masks[k]), sizes[2 * k], sizes[2 * k + 1], 1};
  const bool bent = slots[k] >= 0;
  const size_t from = slots[k] * pixels + pixel, to = k * pixels + pixel;
  const Source source = bent ? source_of(whole, fraction, from) : Source{x, y, 0};
  int value[3] = {0, 0, 0};
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    if (c >= channels) break;
    value[c] = !bent       ? image.at(x, y, c)
               : use_cubic ? cubic(image, source, weights, c)
                           : linear(image, source, c);
    colour[to * channels + c] = static_cast<uint8_t>(value[c]);
  }
  if (wants_grey && channels == 3) grey[to] = grey_of(value);
  int moving = !mask.pixels ? 0 : bent ? linear(mask, source, 0) : mask.at(x, y, 0);
  moving = min(moving, kMaxDynamic);
  dynamic[to] = static_cast<uint8_t>(bent ? max(moving, static_cast<int>(no_ray[from])) : moving);
}

// 254ths of P(dynamic) as 255ths; 255, no ray, stays.
static __device__ int to_bytes(int dynamic) {
  return dynamic == kNoRay ? dynamic : dynamic + (dynamic >= 128);
}

// Refined masks in the cameras' own pixels. Blocks of 256 pixels of camera blockIdx.y.
//   dynamic [K, H, W] in 254ths; masks, sizes as above
//   starts int64 [K]: where the camera's pixels start in `out`
//   map_starts int64 [K]: the same in whole [.., 2], fraction and unreached; -1 if its image is the view
extern "C" __global__ void __launch_bounds__(256)
    to_input(const uint8_t* __restrict__ dynamic, const uint64_t* __restrict__ masks,
             const int32_t* __restrict__ sizes, const int64_t* __restrict__ starts,
             const int64_t* __restrict__ map_starts, const short2* __restrict__ whole,
             const uint16_t* __restrict__ fraction, const uint8_t* __restrict__ unreached, int height,
             int width, uint8_t* __restrict__ out) {
  const int i = blockIdx.x * 256 + threadIdx.x, k = blockIdx.y;
  if (i >= sizes[2 * k] * sizes[2 * k + 1]) return;
  const uint8_t* view = dynamic + static_cast<size_t>(k) * height * width;
  const uint8_t* mask = reinterpret_cast<const uint8_t*>(masks[k]);
  int value;
  if (map_starts[k] < 0) {
    value = to_bytes(view[i]);
  } else if (const size_t at = map_starts[k] + i; unreached[at]) {
    value = mask ? mask[i] : 0;
  } else {
    const Source s = source_of(whole, fraction, at);
    const int fx = s.fraction % kFractions, fy = s.fraction / kFractions;
    int sum = kFractions * kFractions / 2;
    for (int j = 0; j < 4; ++j) {
      const int x = clamp(s.x + j % 2, 0, width - 1), y = clamp(s.y + j / 2, 0, height - 1);
      const int weight = (j % 2 ? fx : kFractions - fx) * (j / 2 ? fy : kFractions - fy);
      sum += to_bytes(view[static_cast<size_t>(y) * width + x]) * weight;
    }
    value = sum / (kFractions * kFractions);
  }
  out[starts[k] + i] = static_cast<uint8_t>(value);
}
