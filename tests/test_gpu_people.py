"""Kernels of the mask refinement, run on the CPU (cuda_on_cpu), against the specification, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from cuda_on_cpu import EmulatedDevice
from seepast import people
from seepast.backends import cuda_people, reference_people
from seepast.gpu import device
from seepast.options import Options, PeopleOptions
from test_people import (
    OPTIONS,
    SCENES,
    SMALL,
    Steps,
    every_scene,
    frame_of,
    random_surfaces,
    shifted,
    surfaces_of,
    surprise_of,
)


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


def both(call) -> list:
    return [call(backend) for backend in (reference_people, cuda_people)]


@every_scene
@pytest.mark.parametrize("kind", ["true", "random"])
@pytest.mark.parametrize("options", [OPTIONS, SMALL], ids=["stride", "full"])
def test_refinement_equals_reference(name: str, kind: str, options: PeopleOptions) -> None:
    scene = SCENES[name]()
    surfaces = surfaces_of(scene) if kind == "true" else random_surfaces(scene)
    eager = Options(people=options).updated({"people.trusted": 0, "people.least_area": 0}).people
    geometry = shifted(scene.geometry) if kind == "random" else scene.geometry
    found = both(lambda b: people.refine_people(frame_of(scene), surfaces, geometry, eager, b))
    assert np.array_equal(*found)


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_every_loop_equals_reference(stride: int, channels: int) -> None:
    s = Steps(stride, channels)
    rng, shape = s.rng, (3, s.h, s.w)
    assert np.array_equal(*both(lambda b: b.witnesses(s.scene.dynamic, s.surfaces, s.geometry, 9)))
    assert len(set(both(lambda b: b.disagreement(s.saw, stride)))) == 1
    assert len(set(both(lambda b: b.surface_range(s.surfaces)))) == 1
    cells = people.object_cells(s.geometry, reference_people.surface_range(s.surfaces), OPTIONS)
    floor, again = both(lambda b: b.sloping(s.surfaces + s.floor, 1.0, 4, stride))
    assert np.array_equal(floor, again) and 100 < (floor > 0).sum() < floor.size - 100
    (mean, sums), (mean_gpu, sums_gpu) = both(
        lambda b: b.object_grid(s.saw, s.surfaces, s.geometry, cells, stride, floor)
    )
    assert np.array_equal(mean, mean_gpu)
    assert np.array_equal(sums, sums_gpu)
    grid = people.blurred(sums, 0.5)
    share, again = both(lambda b: b.object_slice(grid, mean, s.surfaces, s.geometry, cells, stride))
    assert np.array_equal(share, again)
    for step in (1, 2):
        assert np.array_equal(*both(lambda b: b.share_histograms(share, mean, step)))  # noqa: B023
    levels = np.arange(500, 3500, 250, dtype=np.int32)
    assert np.array_equal(*both(lambda b: b.border_counts(share, mean, s.surfaces, levels, 2.0, stride)))
    person, sure = rng.integers(0, 2, shape, np.uint8), rng.integers(-1, 2, shape, np.int8)
    for a, b in zip(*both(lambda b: b.histograms(s.scene.dynamic, s.colour, person, stride)), strict=True):
        assert np.array_equal(a, b)
    surprise = surprise_of(s, sure, both)
    for radius in (0, 1, 3):
        assert np.array_equal(*both(lambda b: b.within(person, radius)))  # noqa: B023
    assert np.array_equal(*both(lambda b: b.colour_moments(s.colour, sure, stride, people.BLOCK)))
    table = rng.normal(0, 2, (3, people.LEVELS)).astype(np.float32)
    said, again = both(lambda b: b.log_odds(s.saw, table, stride))
    assert np.array_equal(said, again)
    blobs = (rng.random(shape) < 0.99).astype(np.uint8)
    assert np.array_equal(*both(lambda b: b.sure_labels(blobs, said, PeopleOptions(inner=1, outer=2, sure_said=0))))
    colours = rng.normal(0, 2, people.COLOURS**3).astype(np.float32)
    terms = people.Terms(np.float32([-3, 0, 1]), 0.5, 4.0, colours, rng.normal(0, 3, (3, people.LEVELS)).astype("f4"))
    some = sure[:, ::2, ::2].copy()
    for size in (8, 16, 24):
        linear = rng.normal(0, 0.003, (3, -(-35 // size), -(-61 // size), 4)).astype(np.float32)
        given = said, s.scene.dynamic, s.colour, linear, some, surprise, terms, stride, 2, size
        assert np.array_equal(*both(lambda b: b.potentials(*given)))  # noqa: B023
    costs = people.field_costs(channels, PeopleOptions(contrast=60, depth_step=20))
    u = rng.integers(-7680, 7681, shape).astype(np.int16)
    belief, again = both(lambda b: b.field(u, s.colour, s.surfaces, costs, stride))
    assert np.array_equal(belief, again)
    assert again.dtype == np.int16


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (70, 1), (9, 31), (9, 32), (33, 65)])
def test_chains_of_every_length(shape) -> None:
    rng = np.random.default_rng(sum(shape))
    u = rng.integers(-3000, 3000, (2, *shape)).astype(np.int16)
    colour, surfaces = rng.integers(0, 30, (2, *shape, 3), np.uint8), rng.uniform(0, 9, (2, *shape)).astype(np.float32)
    costs = people.field_costs(3, PeopleOptions())
    assert np.array_equal(*both(lambda b: b.field(u, colour, surfaces, costs, 1)))


@pytest.mark.parametrize("grow", [False, True])
def test_probability(grow: bool) -> None:
    rng = np.random.default_rng(0)
    belief = rng.integers(-(1 << 15), 1 << 15, (3, 33, 41)).astype(np.int16)
    belief[1] //= 50
    dynamic = rng.choice([0, 100, people.NO_RAY], belief.shape).astype(np.uint8)
    table = people.probabilities(PeopleOptions())
    assert np.array_equal(*both(lambda b: b.probability(belief, dynamic, table, grow)))
