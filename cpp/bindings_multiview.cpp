// Python's view of the many-view stages; see bindings.cpp.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <stdexcept>
#include <vector>

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

// As seen from the i-th of several cameras.
Array array_of(const In<float, 3>& offsets, const In<float, 2>& centers, size_t i, size_t height,
               size_t width) {
  if (offsets.shape(2) != kOffsets || offsets.shape(1) > kMaxCameras)
    throw std::invalid_argument("offsets must be [n, K <= 16, 5]");
  const float* center = centers.data() + 2 * i;
  return {static_cast<int>(offsets.shape(1)),
          static_cast<int>(height),
          static_cast<int>(width),
          center[0],
          center[1],
          offsets.data() + i * offsets.shape(1) * kOffsets};
}

template <class Value>
void bind_enlarged(nb::module_& m) {
  m.def(
      "enlarged",
      [](In<Value, 3> views, int ratio, int factor, Out<Value, 3> out) {
        enlarged(views.data(), static_cast<int>(views.shape(0)), static_cast<int>(views.shape(1)),
                 static_cast<int>(views.shape(2)), ratio, factor, static_cast<int>(out.shape(1)),
                 static_cast<int>(out.shape(2)), out.data());
      },
      nb::call_guard<nb::gil_scoped_release>());
}

}  // namespace

void bind_multiview(nb::module_& m) {
  const auto free_lock = nb::call_guard<nb::gil_scoped_release>();
  bind_enlarged<uint8_t>(m);
  bind_enlarged<uint16_t>(m);

  m.def(
      "windows",
      [](In<uint16_t, 3> disparity, In<uint8_t, 3> where, int ratio, const Grid& grid, int reach, int spread,
         In<uint8_t, 3> within, int whole, Out<uint64_t, 3> active, Out<int32_t, 2> start) {
        if (grid.count > kMostChunks * kChunk) throw std::invalid_argument("too many candidates");
        windows(static_cast<int>(disparity.shape(0)), disparity.data(), where.data(),
                static_cast<int>(disparity.shape(1)), static_cast<int>(disparity.shape(2)), ratio, grid,
                reach, spread, within.size() ? within.data() : nullptr, whole,
                static_cast<int>(active.shape(1)), static_cast<int>(active.shape(2)), active.data(),
                start.data());
      },
      free_lock);

  m.def(
      "half_rows",
      [](In<uint8_t, 4> colour, In<uint8_t, 3> is_static, Out<uint8_t, 4> small,
         Out<uint8_t, 3> small_static) {
        half_rows(static_cast<int>(is_static.shape(0)), static_cast<int>(is_static.shape(1)),
                  static_cast<int>(is_static.shape(2)), colour.data(), is_static.data(), small.data(),
                  small_static.data());
      },
      free_lock);

  m.def(
      "double_rows",
      [](In<uint16_t, 3> views, Out<uint16_t, 3> out) {
        double_rows(views.data(), static_cast<int>(views.shape(0)), static_cast<int>(views.shape(1)),
                    static_cast<int>(views.shape(2)), static_cast<int>(out.shape(1)), out.data());
      },
      free_lock);

  m.def(
      "averaged",
      [](In<uint8_t, 4> colour, In<uint8_t, 3> is_static, int scale, Out<uint8_t, 4> small,
         Out<uint8_t, 3> small_static) {
        averaged(static_cast<int>(is_static.shape(0)), static_cast<int>(is_static.shape(1)),
                 static_cast<int>(is_static.shape(2)), colour.data(), is_static.data(), scale,
                 static_cast<int>(small_static.shape(1)), static_cast<int>(small_static.shape(2)),
                 small.data(), small_static.data());
      },
      free_lock);

  m.def(
      "landings",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 2> hidden, In<float, 2> low, In<float, 2> high,
         Out<uint8_t, 3> out) {
        landings(array_of(offsets, cx, cy, low.shape(0), low.shape(1)), hidden.data(), low.data(),
                 high.data(), out.data());
      },
      free_lock);

  m.def(
      "witnessed",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 2> hidden, In<uint16_t, 3> disparities,
         In<uint8_t, 3> is_static, In<int32_t, 1> order, int most, int tolerance, Out<uint8_t, 3> out) {
        witnessed(array_of(offsets, cx, cy, hidden.shape(0), hidden.shape(1)), hidden.data(),
                  disparities.data(), is_static.data(), order.data(), most, tolerance, out.data());
      },
      free_lock);

  m.def(
      "volumes",
      [](In<float, 3> offsets, In<float, 2> centers, In<int32_t, 1> numbers, In<uint8_t, 4> colour,
         In<uint8_t, 3> is_static, In<int32_t, 1> luma, const Grid& grid, In<uint64_t, 3> active,
         In<int32_t, 2> start, In<int32_t, 2> pairs, In<int32_t, 2> counts, In<uint8_t, 1> census_scale,
         uint8_t few, uint8_t colour_cap, uint8_t lone, uint8_t unseen, Out<uint8_t, 2> out) {
        std::vector<MatchedView> views;
        const int32_t* pair = pairs.data();
        uint8_t* to = out.data();
        for (size_t i = 0; i < numbers.size(); ++i) {
          const Array array = array_of(offsets, centers, i, active.shape(1), active.shape(2));
          const int32_t *begin = start.data() + i * start.shape(1), *count = counts.data() + 2 * i;
          const Pairs with_own{pair, count[0]}, others{pair + 2 * count[0], count[1]};
          views.push_back(
              {array, numbers.data()[i], {active.data() + i * array.pixels(), begin}, with_own, others, to});
          pair += 2 * (count[0] + count[1]);
          to += static_cast<size_t>(kChunk) * begin[array.pixels()];
        }
        const PairCostParams params{census_scale.data(), few, colour_cap, lone, unseen};
        volumes(views.data(), static_cast<int>(views.size()), colour.data(), is_static.data(), luma.data(),
                grid, params);
      },
      free_lock);

  m.def("aggregate_scratch", &aggregate_scratch);
  m.def(
      "aggregates",
      [](In<uint8_t, 2> costs, In<uint8_t, 4> images, In<uint8_t, 3> is_static, const Grid& grid,
         In<uint64_t, 3> active, In<int32_t, 2> start, int small, In<uint16_t, 1> large, int dynamic,
         int paths, bool everywhere, Out<uint16_t, 1> scratch, Out<uint16_t, 3> out) {
        std::vector<AggregatedView> views;
        const size_t pixels = out.shape(1) * out.shape(2);
        const uint8_t* of_view = costs.data();
        for (size_t i = 0; i < out.shape(0); ++i) {
          const int32_t* begin = start.data() + i * start.shape(1);
          const size_t at = i * pixels;
          views.push_back({of_view, images.data() + 3 * at, is_static.data() + at, active.data() + at, begin,
                           out.data() + at});
          of_view += static_cast<size_t>(kChunk) * begin[pixels];
        }
        aggregates(views.data(), static_cast<int>(views.size()), static_cast<int>(out.shape(1)),
                   static_cast<int>(out.shape(2)), grid, Penalties{small, large.data(), dynamic}, paths,
                   everywhere, scratch.data());
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
         In<uint16_t, 3> disparities, In<uint8_t, 3> is_static, In<uint8_t, 2> wanted, int tolerance,
         int near, Out<uint16_t, 2> shown, Out<uint16_t, 2> rays, Out<uint8_t, 2> close) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        labels(array, reference, d.data(), disparities.data(), is_static.data(),
               wanted.size() ? wanted.data() : nullptr, tolerance, near, shown.data(), rays.data(),
               close.data());
      },
      free_lock);

  m.def(
      "evidence",
      [](In<uint16_t, 2> d, In<uint8_t, 2> is_static, In<uint8_t, 2> close, In<uint16_t, 2> shown,
         In<uint16_t, 1> steps, Out<uint8_t, 2> out) {
        evidence(static_cast<int>(d.shape(0)), static_cast<int>(d.shape(1)), d.data(), is_static.data(),
                 close.data(), shown.data(), steps.data(), out.data());
      },
      free_lock);

  m.def(
      "told",
      [](In<uint16_t, 2> d, In<uint8_t, 2> evidence, In<float, 1> table, In<uint16_t, 2> labels,
         In<uint8_t, 2> keep, Out<float, 2> disparity, Out<float, 2> confidence, Out<uint8_t, 2> coverage) {
        if (table.size() != 256) throw std::invalid_argument("table must be [256]");
        told(d.data(), evidence.data(), table.data(), labels.data(), keep.size() ? keep.data() : nullptr,
             d.size(), disparity.data(), confidence.data(), coverage.data());
      },
      free_lock);

  m.def(
      "clear_of_masks",
      [](In<uint8_t, 3> is_static, Out<uint8_t, 3> clear) {
        clear_of_masks(static_cast<int>(is_static.shape(0)), static_cast<int>(is_static.shape(1)),
                       static_cast<int>(is_static.shape(2)), is_static.data(), clear.data());
      },
      free_lock);

  m.def(
      "graded",
      [](In<float, 3> offsets, In<float, 2> centers, In<int32_t, 1> numbers, In<int32_t, 1> places,
         In<uint16_t, 3> d, In<uint16_t, 3> disparities, In<uint8_t, 3> is_static, In<int32_t, 2> start,
         int tolerance, uint8_t confident, uint8_t lone, uint8_t doubtful, Out<uint8_t, 3> confidence,
         Out<uint8_t, 3> sure) {
        std::vector<GradedView> views;
        for (size_t i = 0; i < numbers.size(); ++i) {
          const Array array = array_of(offsets, centers, i, d.shape(1), d.shape(2));
          if (array.cameras < 2) throw std::invalid_argument("one camera has no witnesses");
          const size_t at = places.data()[i] * array.pixels();
          views.push_back({array, numbers.data()[i], d.data() + at,
                           start.size() ? start.data() + i * start.shape(1) : nullptr, confidence.data() + at,
                           sure.data() + at});
        }
        graded(views.data(), static_cast<int>(views.size()), disparities.data(), is_static.data(), tolerance,
               Grades{confident, lone, doubtful});
      },
      free_lock);

  m.def(
      "votes",
      [](In<float, 2> offsets, float cx, float cy, In<uint8_t, 2> costs, In<uint16_t, 3> disparities,
         In<uint8_t, 3> confidence, In<uint8_t, 2> is_static, const Grid& grid, In<uint64_t, 2> active,
         In<int32_t, 1> start, int skip, int base, int gain, int hide, int volume, bool visible,
         Out<uint8_t, 2> out) {
        const Array array = array_of(offsets, cx, cy, is_static.shape(0), is_static.shape(1));
        votes(array, costs.data(), disparities.data(), confidence.data(), is_static.data(), grid,
              Chunks{active.data(), start.data()}, skip, VoteWeights{base, gain, hide, volume, visible},
              out.data());
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
         In<uint8_t, 3> clear, In<float, 1> near, In<int32_t, 1> order, float light, float edge,
         In<uint16_t, 2> d, In<uint8_t, 2> wanted, Out<uint8_t, 3> background) {
        const Array array = array_of(offsets, cx, cy, d.shape(0), d.shape(1));
        const RayWeights weights{clear.data(), near.data(), order.data(), light, edge};
        blend(array, reference, colour.data(), rays.data(), weights, d.data(), wanted.data(),
              background.data());
      },
      free_lock);
}
