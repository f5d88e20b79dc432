// Python's view of the mask refinement's loops; shapes are the business of backends/cpu_people.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <vector>

#include "people.h"

namespace nb = nanobind;
using namespace seepast;

namespace {

template <class T, int Dimensions>
using In = nb::ndarray<const T, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
template <class T, int Dimensions>
using Out = nb::ndarray<T, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;

int size(size_t n) { return static_cast<int>(n); }

// offsets [K, K, 5] and centers [K, 2]: the array as seen from each of its cameras.
std::vector<Array> views_of(const In<float, 3>& offsets, const In<float, 2>& centers, size_t height,
                            size_t width) {
  const size_t K = offsets.shape(0);
  if (offsets.shape(1) != K || offsets.shape(2) != kOffsets || K > kMaxCameras || centers.shape(0) != K)
    throw std::invalid_argument("offsets must be [K <= 16, K, 5], centers [K, 2]");
  std::vector<Array> views;
  for (size_t k = 0; k < K; ++k)
    views.push_back({size(K), size(height), size(width), centers.data()[2 * k], centers.data()[2 * k + 1],
                     offsets.data() + k * K * kOffsets});
  return views;
}

}  // namespace

void bind_people(nb::module_& m) {
  const auto free_lock = nb::call_guard<nb::gil_scoped_release>();

  nb::class_<Cells>(m, "Cells")
      .def("__init__",
           [](Cells* cells, In<float, 1> low, In<float, 1> inverse, In<float, 1> last, In<int32_t, 1> count) {
             new (cells) Cells;
             for (int i = 0; i < 3; ++i) {
               cells->low[i] = low.data()[i], cells->inverse[i] = inverse.data()[i];
               cells->last[i] = last.data()[i], cells->count[i] = count.data()[i];
             }
           });

  m.def(
      "witnesses",
      [](In<float, 3> offsets, In<float, 2> centers, In<uint8_t, 3> dynamic, In<float, 3> surfaces,
         float tolerance, Out<uint8_t, 4> saw) {
        const auto views = views_of(offsets, centers, dynamic.shape(1), dynamic.shape(2));
        witnesses(views.data(), dynamic.data(), surfaces.data(), tolerance, saw.data());
      },
      free_lock);

  m.def(
      "disagreement",
      [](In<uint8_t, 4> saw, int step, Out<int64_t, 1> sums) {
        disagreement(saw.data(), size(saw.shape(0)), size(saw.shape(1)), size(saw.shape(2)), step,
                     sums.data());
      },
      free_lock);

  m.def(
      "sloping",
      [](In<float, 3> surfaces, float least, int rows, int stride, Out<uint16_t, 3> out) {
        sloping(size(surfaces.shape(0)), size(surfaces.shape(1)), size(surfaces.shape(2)), surfaces.data(),
                least, rows, stride, out.data());
      },
      free_lock);

  m.def(
      "object_grid",
      [](In<float, 3> offsets, In<float, 2> centers, int reference, In<uint8_t, 4> saw, In<float, 3> surfaces,
         const Cells& cells, int stride, In<uint16_t, 3> floor, Out<uint16_t, 3> mean, Out<int64_t, 4> sums) {
        const auto views = views_of(offsets, centers, surfaces.shape(1), surfaces.shape(2));
        object_grid(views.data(), reference, saw.data(), surfaces.data(), cells, stride, floor.data(),
                    mean.data(), sums.data());
      },
      free_lock);

  m.def(
      "object_slice",
      [](In<float, 3> offsets, In<float, 2> centers, int reference, In<float, 4> grid, In<uint16_t, 3> mean,
         In<float, 3> surfaces, const Cells& cells, int stride, Out<uint16_t, 3> share) {
        const auto views = views_of(offsets, centers, surfaces.shape(1), surfaces.shape(2));
        object_slice(views.data(), reference, grid.data(), mean.data(), surfaces.data(), cells, stride,
                     share.data());
      },
      free_lock);

  m.def(
      "border_counts",
      [](In<uint16_t, 3> share, In<uint16_t, 3> mean, In<float, 3> surfaces, In<int32_t, 1> thresholds,
         float step, int stride, Out<int64_t, 2> counts) {
        border_counts(size(surfaces.shape(0)), size(surfaces.shape(1)), size(surfaces.shape(2)), share.data(),
                      mean.data(), surfaces.data(), thresholds.data(), size(thresholds.shape(0)), step,
                      stride, counts.data());
      },
      free_lock);

  m.def(
      "surprise",
      [](In<uint8_t, 3> colour, In<uint8_t, 3> behind, In<uint16_t, 2> rays, In<uint8_t, 2> wanted,
         In<uint8_t, 1> levels, Out<uint8_t, 2> out) {
        surprise(wanted.size(), colour.data(), behind.data(), rays.data(), wanted.data(), levels.data(),
                 out.data());
      },
      free_lock);

  m.def(
      "surprise_counts",
      [](In<uint8_t, 3> level, In<int8_t, 3> sure, int stride, Out<int64_t, 3> counts) {
        surprise_counts(size(level.shape(0)), size(level.shape(1)), size(level.shape(2)), level.data(),
                        sure.data(), stride, counts.data());
      },
      free_lock);

  m.def(
      "people_histograms",
      [](In<uint8_t, 3> dynamic, In<uint8_t, 4> colour, In<uint8_t, 3> person, int stride,
         Out<int64_t, 3> levels, Out<int64_t, 2> colours) {
        people_histograms(size(dynamic.shape(0)), size(dynamic.shape(1)), size(dynamic.shape(2)),
                          size(colour.shape(3)), dynamic.data(), colour.data(), person.data(), stride,
                          levels.data(), colours.data());
      },
      free_lock);

  m.def(
      "colour_moments",
      [](In<uint8_t, 4> colour, In<int8_t, 3> sure, int stride, int block, Out<int32_t, 4> moments) {
        colour_moments(size(colour.shape(0)), size(colour.shape(1)), size(colour.shape(2)),
                       size(colour.shape(3)), colour.data(), sure.data(), stride, block, moments.data());
      },
      free_lock);

  m.def(
      "log_odds",
      [](In<uint8_t, 4> saw, In<float, 2> levels, int stride, Out<float, 3> out) {
        log_odds(size(saw.shape(0)), size(saw.shape(1)), size(saw.shape(2)), saw.data(), levels.data(),
                 stride, out.data());
      },
      free_lock);

  m.def(
      "potential",
      [](In<float, 2> said, In<uint8_t, 2> dynamic, In<uint8_t, 3> colour, In<float, 3> linear,
         In<int8_t, 2> sure, In<uint8_t, 2> surprise, In<float, 1> behind, In<float, 1> sure_terms,
         float said_weight, float local, In<float, 1> colours, int stride, int cell, Out<int16_t, 2> u) {
        const Terms terms{sure_terms.data(), said_weight, local, colours.data(), behind.data()};
        potential(size(dynamic.shape(0)), size(dynamic.shape(1)), size(colour.shape(2)), said.data(),
                  dynamic.data(), colour.data(), linear.data(), sure.data(), size(sure.shape(0)),
                  size(sure.shape(1)), surprise.data(), terms, stride, cell, u.data());
      },
      free_lock);

  m.def(
      "people_field",
      [](In<int16_t, 3> u, In<uint8_t, 4> colour, In<float, 3> surfaces, In<int16_t, 1> contrast,
         float depth_step, int cut, int stride, Out<int16_t, 3> belief) {
        const FieldCosts costs{contrast.data(), size(contrast.shape(0)), depth_step, cut};
        field(size(colour.shape(0)), size(colour.shape(1)), size(colour.shape(2)), size(colour.shape(3)),
              u.data(), colour.data(), surfaces.data(), costs, stride, belief.data());
      },
      free_lock);
}
