// Python's view of the core: NumPy arrays in and out, checked for type and contiguity by nanobind; shapes are
// the business of backends/cpu.py. Every call releases the interpreter lock.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <stdexcept>
#ifdef _OPENMP
#include <omp.h>
#endif

#include "core.h"

namespace nb = nanobind;
using namespace seepast;

void bind_multiview(nb::module_& m);  // bindings_multiview.cpp

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

void bind_people(nb::module_& m);  // bindings_people.cpp

NB_MODULE(_core, m) {
  bind_multiview(m);
  bind_people(m);
  nb::class_<Grid>(m, "Grid").def(nb::init<int, int, int>());
  nb::class_<SupportParams>(m, "SupportParams").def(nb::init<int, int, int, float, float>());
  const auto free_lock = nb::call_guard<nb::gil_scoped_release>();

  m.def("simd", [] { return simd_name(); });
  m.def("set_threads", [](int threads) {
#ifdef _OPENMP
    omp_set_num_threads(threads > 0 ? threads : omp_get_num_procs());
#else
    (void)threads;
#endif
  });

  m.def(
      "sample_colour",
      [](In<uint8_t, 3> image, In<uint8_t, 2> mask, In<int16_t, 3> whole, In<uint16_t, 2> fraction,
         In<uint8_t, 2> no_ray, Out<uint8_t, 3> out, Out<uint8_t, 2> mask_out) {
        if (image.shape(0) < 2 || image.shape(1) < 2) throw std::invalid_argument("image is too small");
        sample_colour(image.data(), mask.size() ? mask.data() : nullptr, static_cast<int>(image.shape(0)),
                      static_cast<int>(image.shape(1)), whole.data(), fraction.data(),
                      no_ray.size() ? no_ray.data() : nullptr, fraction.size(), out.data(), mask_out.data());
      },
      free_lock);

  m.def(
      "sample_plane",
      [](In<uint8_t, 2> plane, In<int16_t, 3> whole, In<uint16_t, 2> fraction, Out<uint8_t, 2> out) {
        if (plane.shape(0) < 2 || plane.shape(1) < 2) throw std::invalid_argument("plane is too small");
        sample_plane(plane.data(), static_cast<int>(plane.shape(0)), static_cast<int>(plane.shape(1)),
                     whole.data(), fraction.data(), fraction.size(), out.data());
      },
      free_lock);

  m.def(
      "describe",
      [](In<uint8_t, 3> grey, Out<int8_t, 4> gradients, Out<uint8_t, 4> descriptors) {
        describe(grey.data(), static_cast<int>(grey.shape(0)), static_cast<int>(grey.shape(1)),
                 static_cast<int>(grey.shape(2)), gradients.data(), descriptors.data());
      },
      free_lock);

  m.def(
      "support_of_camera",
      [](In<float, 2> offsets, In<float, 2> back_offsets, float cx, float cy, float back_cx, float back_cy,
         int base, int partner, In<uint8_t, 4> descriptors, In<uint8_t, 3> is_static, In<uint8_t, 2> where,
         int reference, const Grid& grid, const SupportParams& params, Out<float, 2> points) {
        static_assert(sizeof(SupportPoint) == 4 * sizeof(float));
        const size_t height = is_static.shape(1), width = is_static.shape(2);
        const Array view = array_of(offsets, cx, cy, height, width);
        const Array back_view = array_of(back_offsets, back_cx, back_cy, height, width);
        return support_of_camera(view, back_view, base, partner, descriptors.data(), is_static.data(),
                                 where.data(), reference, grid, params,
                                 reinterpret_cast<SupportPoint*>(points.data()));
      },
      free_lock);

  m.def(
      "plane_means",
      [](In<float, 2> points, In<int32_t, 2> triangles, double max_step, int gap, Out<int32_t, 2> mean) {
        plane_means(points.data(), triangles.data(), static_cast<int>(triangles.shape(0)),
                    static_cast<int>(mean.shape(0)), static_cast<int>(mean.shape(1)), max_step, gap,
                    mean.data());
      },
      free_lock);

  m.def(
      "cell_candidates",
      [](In<float, 2> points, const Grid& grid, float radius, Out<uint8_t, 3> cells) {
        cell_candidates(points.data(), static_cast<int>(points.shape(0)), static_cast<int>(cells.shape(0)),
                        static_cast<int>(cells.shape(1)), grid, radius, cells.data());
      },
      free_lock);

  m.def(
      "phase_planes",
      [](In<float, 2> offsets, In<int8_t, 4> gradients, In<uint8_t, 3> is_static, Out<int8_t, 5> phases) {
        const Array array = array_of(offsets, 0, 0, is_static.shape(1), is_static.shape(2));
        phase_planes(array, gradients.data(), is_static.data(), phases.data());
      },
      free_lock);

  m.def(
      "disparity",
      [](In<float, 2> offsets, float cx, float cy, In<int8_t, 5> phases, In<int32_t, 2> mean,
         In<uint8_t, 3> cells, const Grid& grid, In<uint8_t, 2> wanted, float beta, float lone_variance,
         float unseen_variance, int prior_radius, In<float, 1> table, Out<float, 2> d) {
        const Array array = array_of(offsets, cx, cy, mean.shape(0), mean.shape(1));
        const DisparityParams params{beta,         lone_variance, unseen_variance,
                                     prior_radius, table.data(),  static_cast<int>(table.shape(0))};
        disparity(array, phases.data(), mean.data(), cells.data(), grid, wanted.data(), params, d.data());
      },
      free_lock);

  m.def(
      "affected",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 3> changed, In<int32_t, 2> mean,
         In<uint8_t, 3> cells, const Grid& grid, In<uint8_t, 2> wanted, int radius, Out<uint8_t, 2> out) {
        const Array array = array_of(offsets, cx, cy, mean.shape(0), mean.shape(1));
        affected(array, changed.data(), mean.data(), cells.data(), grid, wanted.data(), radius, out.data());
      },
      free_lock);

  m.def(
      "segmentation",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 4> descriptors, In<uint8_t, 3> dynamic,
         In<float, 2> d, In<uint8_t, 2> wanted, double beta, double lone_variance, In<int32_t, 2> costs,
         In<uint8_t, 1> table, double scale, Out<uint16_t, 2> labels, Out<uint8_t, 3> posterior) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        const SegmentationParams params{
            beta, lone_variance, costs.data(), table.data(), static_cast<int>(table.shape(0) / 2), scale};
        segmentation(array, descriptors.data(), dynamic.data(), d.data(), wanted.data(), params,
                     labels.data(), posterior.data());
      },
      free_lock);

  m.def(
      "depth",
      [](In<float, 2> d, float focal_baseline, Out<float, 2> out) {
        depth(d.data(), d.size(), focal_baseline, out.data());
      },
      free_lock);

  m.def(
      "masks",
      [](In<float, 2> offsets, float cx, float cy, In<uint16_t, 2> labels, In<uint8_t, 3> posterior,
         In<float, 2> d, In<uint8_t, 2> wanted, Out<uint8_t, 3> dynamic, Out<uint8_t, 3> is_static) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        masks(array, labels.data(), posterior.data(), d.data(), wanted.data(), dynamic.data(),
              is_static.data());
      },
      free_lock);

  m.def(
      "refocus",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 4> colour, int reference,
         In<uint16_t, 2> labels, In<float, 2> d, In<uint8_t, 2> keep, Out<uint8_t, 3> background,
         Out<uint8_t, 2> coverage) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        refocus(array, colour.data(), static_cast<int>(colour.shape(3)), reference, labels.data(), d.data(),
                keep.data(), background.data(), coverage.data());
      },
      free_lock);

  m.def(
      "fill_unseen",
      [](In<uint8_t, 2> coverage, In<float, 2> d, float nearer, float foreground_weight,
         Out<uint8_t, 3> background) {
        fill_unseen(static_cast<int>(d.shape(0)), static_cast<int>(d.shape(1)),
                    static_cast<int>(background.shape(2)), coverage.data(), d.data(), nearer,
                    foreground_weight, background.data());
      },
      free_lock);
}
