// Python's view of the many-view stages; see bindings.cpp.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <stdexcept>

#include "multiview.h"

namespace nb = nanobind;
using namespace seepast;

namespace {

template <class T, int Dimensions>
using In = nb::ndarray<const T, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
template <class T, int Dimensions>
using Out = nb::ndarray<T, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

Array array_of(const In<float, 2>& offsets, float cx, float cy, size_t height, size_t width) {
  if (offsets.shape(1) != kOffsets || offsets.shape(0) > kMaxCameras)
    throw std::invalid_argument("offsets must be [K <= 16, 5]");
  return {static_cast<int>(offsets.shape(0)),
          static_cast<int>(height),
          static_cast<int>(width),
          cx,
          cy,
          offsets.data()};
}

}  // namespace

void bind_multiview(nb::module_& m) {
  const auto free_lock = nb::call_guard<nb::gil_scoped_release>();
  m.attr("BLOCK") = kBlock;
  m.attr("PLANES") = kPlanes;

  m.def(
      "census",
      [](In<float, 2> offsets, In<uint8_t, 4> colour, In<uint8_t, 3> is_static, In<int32_t, 2> cubic,
         In<int32_t, 1> luma, Out<uint8_t, 4> planes, Out<int32_t, 4> unclear) {
        const Array array = array_of(offsets, 0, 0, is_static.shape(1), is_static.shape(2));
        census(array, colour.data(), is_static.data(), cubic.data(), luma.data(),
               static_cast<int>(planes.shape(3)), planes.data(), unclear.data());
      },
      free_lock);

  m.def(
      "volume",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 4> planes, In<int32_t, 4> unclear, int view,
         const Grid& grid, In<int32_t, 2> with_own, In<int32_t, 2> others, In<uint16_t, 1> census_scale,
         int few, int colour_weight, int colour_cap, int colour_limit, int lone, int unseen,
         Out<uint8_t, 3> out) {
        const Array array = array_of(offsets, cx, cy, out.shape(0), out.shape(1));
        const FeatureRows rows{planes.data(), unclear.data(), static_cast<int>(planes.shape(3))};
        const PairCostParams params{census_scale.data(), few,  colour_weight, colour_cap,
                                    colour_limit,        lone, unseen};
        volume(array, rows, view, grid, with_own.data(), static_cast<int>(with_own.shape(0)), others.data(),
               static_cast<int>(others.shape(0)), params, out.data());
      },
      free_lock);

  m.def("aggregate_scratch", &aggregate_scratch);
  m.def(
      "aggregate",
      [](In<uint8_t, 2> costs, In<uint8_t, 3> image, In<uint8_t, 2> is_static, const Grid& grid,
         In<uint64_t, 2> active, In<int32_t, 1> start, int small, In<uint16_t, 1> large, int dynamic,
         int paths, Out<uint16_t, 1> scratch, Out<uint16_t, 2> out) {
        aggregate(costs.data(), image.data(), is_static.data(), static_cast<int>(out.shape(0)),
                  static_cast<int>(out.shape(1)), grid, active.data(), start.data(),
                  Penalties{small, large.data(), dynamic}, paths, scratch.data(), out.data());
      },
      free_lock);

  m.def(
      "witnesses",
      [](In<float, 2> offsets, float cx, float cy, In<uint16_t, 2> d, In<uint16_t, 3> disparities,
         In<uint8_t, 3> is_static, int skip, int tolerance, Out<uint8_t, 2> agree, Out<uint8_t, 2> farther) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        witnesses(array, d.data(), disparities.data(), is_static.data(), skip, tolerance, agree.data(),
                  farther.data());
      },
      free_lock);

  m.def(
      "labels",
      [](In<float, 2> offsets, float cx, float cy, int reference, In<uint16_t, 2> d,
         In<uint16_t, 3> disparities, In<uint8_t, 3> is_static, int tolerance, Out<uint16_t, 2> shown,
         Out<uint16_t, 2> passing) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        labels(array, reference, d.data(), disparities.data(), is_static.data(), tolerance, shown.data(),
               passing.data());
      },
      free_lock);

  m.def(
      "votes",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 3> costs, In<uint16_t, 3> disparities,
         In<uint8_t, 3> confidence, In<uint8_t, 2> is_static, const Grid& grid, int skip, int base, int gain,
         int hide, int volume, Out<uint8_t, 3> out) {
        const Array array = array_of(offsets, cx, cy, out.shape(0), out.shape(1));
        votes(array, costs.data(), disparities.data(), confidence.data(), is_static.data(), grid, skip,
              VoteWeights{base, gain, hide, volume}, out.data());
      },
      free_lock);

  m.def(
      "planes",
      [](In<uint16_t, 2> d, In<uint8_t, 2> trusted, In<uint8_t, 2> wanted, In<uint8_t, 3> image,
         In<uint8_t, 2> is_static, int radius, int stride, int gate, float need, double ridge,
         In<float, 2> nearness, Out<uint16_t, 2> out) {
        const PlaneParams params{radius, stride, gate, need, ridge, nearness.data()};
        planes(static_cast<int>(d.shape(0)), static_cast<int>(d.shape(1)), d.data(), trusted.data(),
               wanted.data(), image.data(), is_static.data(), params, out.data());
      },
      free_lock);

  m.def(
      "blend",
      [](In<float, 2> offsets, float cx, float cy, int reference, In<uint8_t, 4> colour, In<uint16_t, 2> rays,
         In<float, 3> clear, In<float, 1> near, In<uint16_t, 2> d, In<uint8_t, 2> wanted,
         Out<uint8_t, 3> background) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        blend(array, reference, colour.data(), rays.data(), clear.data(), near.data(), d.data(),
              wanted.data(), background.data());
      },
      free_lock);
}
