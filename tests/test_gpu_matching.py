"""Matching's kernels, run on the CPU: bit for bit what reference_multiview says, one view or all at once."""

from __future__ import annotations

import numpy as np
import pytest

from arrays import noise_scene
from cuda_on_cpu import EmulatedDevice
from seepast.backends import cpu_multiview as cpu
from seepast.backends import cuda_matching as cuda
from seepast.backends import reference_multiview as reference
from seepast.candidates import CHUNK, Candidates, DisparityGrid
from seepast.gpu import device
from seepast.many import UNITS
from test_multiview import (
    COSTS,
    FINAL,
    FIRST,
    KINDS,
    SOME_COSTS,
    STEEPEST,
    VOLUME_GRIDS,
    Case,
    assert_same,
    case,
    some_candidates,
)

SCENES = (
    "2 cameras",
    "3, middle, residual",
    "5, last, no-ray borders",
    "9, middle",
    "16, residual",
    "all dynamic",
    "no mask",
    "noise",
    "noise of 7",
    "one row",
    "one column",
)
every_scene = pytest.mark.parametrize("name", SCENES)


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


def known(candidates: Candidates) -> cuda.DeviceCandidates:
    count = int(candidates.start[-1])
    return cuda.DeviceCandidates(candidates.grid, candidates.active, candidates.start, lambda: count)


# ---------------------------------------------------------------------------------------------- describe


@every_scene
def test_describe(name):
    c = case(name)
    expected, found = reference.describe(c.colour, c.static), cuda.describe(c.colour, c.static)
    assert_same(expected.census, found.samples[..., 0])
    colour = found.samples[..., 1:].view(np.uint8)
    assert_same(expected.colour, colour[..., :3])
    assert_same(expected.valid, found.valid)
    clear = (expected.valid == (1 << 24) - 1) & expected.static
    assert_same(colour[..., 3], expected.static.astype(np.uint8) + 2 * clear.astype(np.uint8))


# --------------------------------------------------------------------------------------------- candidates


@pytest.mark.parametrize("ratio", [1, 2, 3])
@pytest.mark.parametrize(("reach", "spread"), [(64, 4), (16, 0), (300, 16)])
def test_windows(ratio, reach, spread):
    rng = np.random.default_rng(reach)
    for h, w in ((9, 41), (23, 70), (1, 3)):
        disparity = rng.integers(0, 1600, (3, h, w)).astype(np.uint16)
        disparity[1] = disparity[1, 0, 0]
        disparity[2, :, : w // 2] = 65535
        where = rng.random((3, h, w)) < (0.3, 1.0, 0.8)[ratio - 1]
        where[1] &= h > 1  # a view without any
        shape = h * ratio + ratio // 2, w * ratio + ratio // 3
        for grid in (DisparityGrid(29, 8, 64), DisparityGrid(-3, 1, 1024), DisparityGrid(0, 4, 48)):
            for limits in ((), (rng.random((3, *shape)) < 0.7,), (rng.random((3, *shape)) < 0.7, 2)):
                given = disparity, where, ratio, grid, reach, spread, shape, *limits
                for e, f in zip(cpu.windows_of_views(*given), cuda.windows_of_views(*given), strict=True):
                    assert_same((e.active, e.start), (f.active, f.start))
                    assert e.chunks == f.chunks
    alone = cuda.windows(disparity[0], where[0], ratio, grid, reach, spread, shape)
    assert_same(alone.active, reference.windows(disparity[0], where[0], ratio, grid, reach, spread, shape).active)


class Late(EmulatedDevice):
    """Numbers arrive on the host when somebody waits for them, and not before."""

    def fetch(self, array):
        self.source, self.host = array, np.full_like(array, -1)
        return self.host

    def wait(self, mark):
        self.host[:] = self.source


def test_the_host_waits_for_the_number_of_chunks():
    disparity, where = np.full((2, 5, 6), 300, np.uint16), np.ones((2, 5, 6), bool)
    with device.use(Late()) as late:
        found = cuda.windows_of_views(disparity, where, 1, DisparityGrid(0, 4, 64), 8, 1, (5, 6))
        assert (late.host == -1).all()
        assert [c.chunks for c in found] == [c.start[-1] for c in found]


def test_everything():
    for chunks in (1, 5, 64):
        grid = DisparityGrid(3, 4, CHUNK * chunks)
        expected, found = Candidates.all(grid, (7, 5)), cuda.everything(grid, (7, 5))
        assert_same((expected.active, expected.start), (found.active, found.start))
        assert expected.chunks == found.chunks
    half = np.indices((7, 5)).sum(0) % 2 == 0
    assert_same(expected.where(half).active, found.where(half).active)


# ------------------------------------------------------------------------------------------------- volume


@every_scene
@pytest.mark.parametrize("kind", KINDS)
def test_volume(name, kind):
    c = case(name)
    expected, found = cpu.describe(c.colour, c.static), cuda.describe(c.colour, c.static)
    views = [c.views[k] for k in c.some_views]
    for grid, costs in zip(VOLUME_GRIDS, SOME_COSTS, strict=True):
        candidates = some_candidates(grid, c.static.shape[1:], kind)
        first, *others = (cpu.volume(expected, view, candidates, costs) for view in views)
        assert_same(first, cuda.volume(found, views[0], candidates, costs))
        of_views = cuda.volumes(found, views, [known(candidates)] * len(views), costs)
        for one, many in zip(others, of_views[1:], strict=True):
            assert_same(one, many)


@pytest.mark.parametrize("cameras", range(2, 17))
def test_volume_of_any_number_of_cameras(cameras):
    c = Case(noise_scene(cameras, (41, 9), reference=cameras // 2, seed=cameras))
    candidates = known(Candidates.all(VOLUME_GRIDS[1], c.static.shape[1:]))
    features = cpu.describe(c.colour, c.static)
    views = [c.views[k] for k in c.some_views]
    for costs in SOME_COSTS:
        found = cuda.volumes(cuda.describe(c.colour, c.static), views, [candidates] * len(views), costs)
        for view, of_view in zip(views, found, strict=True):
            assert_same(cpu.volume(features, view, candidates, costs), of_view)


def test_volumes_of_views_with_candidates_of_their_own():
    c = case("5, last, no-ray borders")
    grid = VOLUME_GRIDS[1]
    candidates = [some_candidates(grid, c.static.shape[1:], kind) for kind in KINDS]
    candidates[1] = candidates[1].where(np.zeros(c.static.shape[1:], bool))
    candidates[1] = Candidates.of(grid, candidates[1].active)  # a view that is not matched
    views = [c.views[k] for k in (4, 0, 2, 1)]
    features = cpu.describe(c.colour, c.static)
    expected = [cpu.volume(features, view, which, COSTS) for view, which in zip(views, candidates, strict=True)]
    found = cuda.volumes(cuda.describe(c.colour, c.static), views, [known(which) for which in candidates], COSTS)
    for one, many in zip(expected, found, strict=True):
        assert_same(one, many)


def test_cameras_that_see_nothing_of_a_candidate():
    """A camera so far ahead that 1 - d az is 0 or below at some candidates."""
    c = case("noise")
    geometry = c.geometry.seen_from(0)
    geometry.positions[2, 2] = 8 * geometry.focal[0] * geometry.baseline / 64  # az = 1 / 8: d = 8 px is beside it
    candidates = Candidates.all(DisparityGrid(0, 8, 32), c.static.shape[1:])
    assert (1 - candidates.grid.values * geometry.offsets[2, 2] == 0).any()
    given = geometry, candidates, COSTS
    expected = cpu.volume(cpu.describe(c.colour, c.static), *given)
    assert_same(expected, cuda.volume(cuda.describe(c.colour, c.static), *given))


# ---------------------------------------------------------------------------------------------- aggregate


LADDER = ((1, FIRST, "random"), (3, FINAL, "clustered"), (8, FIRST, "all"), (5, STEEPEST, "holes"))


@pytest.mark.parametrize("name", ["3, middle, residual", "noise", "all dynamic", "one row", "one column"])
@pytest.mark.parametrize("paths", [8, 4])
@pytest.mark.parametrize(("chunks", "penalties", "kind"), [*LADDER, (64, STEEPEST, "clustered")])
def test_aggregate(name, paths, chunks, penalties, kind):
    c, part = case(name), np.s_[:17, :37]
    image, static, otherwise = (np.ascontiguousarray(a[0][part]) for a in (c.colour, c.static, c.disparities))
    grid = DisparityGrid(3, 1 + 16 // chunks, 16 * chunks)
    candidates = some_candidates(grid, static.shape, kind)
    costs = np.random.default_rng(7).integers(0, 256, (candidates.start[-1], CHUNK), np.uint8)
    if chunks == 8:
        costs = np.minimum(costs // 40, 3)  # many equal sums
    given = costs, image, static, candidates, penalties, paths
    assert_same(cpu.aggregate(*given, otherwise), cuda.aggregate(*given, otherwise))
    if chunks == 5:
        assert_same(cpu.aggregate(*given), cuda.aggregate(*given))


@pytest.mark.parametrize("paths", [8, 4])
def test_paths_leap_over_what_is_not_matched(paths):
    rng = np.random.default_rng(5)
    shape = 45, 67
    y, x = np.indices(shape)
    grid = DisparityGrid(3, 4, 80)
    candidates = some_candidates(grid, shape, "clustered").where((x // 33 + y // 21) % 2 == 0)
    image, otherwise = rng.integers(0, 90, (*shape, 3), np.uint8), np.full(shape, 7, np.uint16)
    costs = rng.integers(0, 256, (candidates.chunks, CHUNK), np.uint8)
    given = costs, image, rng.random(shape) < 0.9, candidates, FIRST, paths, otherwise
    assert_same(cpu.aggregate(*given), cuda.aggregate(*given))


@pytest.mark.parametrize("most", [1 << 29, 1])
def test_aggregates_of_views_with_candidates_of_their_own(monkeypatch, most):
    monkeypatch.setattr(cuda, "MOST_BYTES", most)  # 1: view after view
    c = case("noise")
    grid, rng = DisparityGrid(5, 4, 80), np.random.default_rng(3)
    candidates = [some_candidates(grid, c.static.shape[1:], kind) for kind in KINDS]
    candidates[2] = candidates[2].where(c.choice[0])  # rows of a volume of which only some are looked at
    costs = [rng.integers(0, 256, (which.start[-1], CHUNK), np.uint8) for which in candidates]
    found = cuda.aggregates(iter(costs), c.colour, c.static, candidates, FIRST, 4, c.disparities)
    for k in range(4):
        given = costs[k], c.colour[k], c.static[k], candidates[k], FIRST, 4, c.disparities[k]
        assert_same(reference.aggregate(*given), found[k])


def test_all_views_in_a_few_launches(emulated):
    """Launches are what a small image's time goes into."""
    c = case("one row")
    shape = c.static.shape[1:]
    where, grid = np.ones(c.static.shape, bool), DisparityGrid(0, 4, 128)
    candidates = cuda.windows_of_views(c.disparities, where, 1, grid, UNITS, 1, shape)
    costs = cuda.volumes(cuda.describe(c.colour, c.static), c.views, candidates, COSTS)
    cuda.aggregates(costs, c.colour, c.static, candidates, FIRST)
    assert len(emulated.launches) == 3 + 1 + 2 + 3


def test_strides_are_refused():
    """Kernels that take addresses cannot see them."""
    c = case("noise")
    candidates = known(Candidates.all(DisparityGrid(0, 8, 16), c.static.shape[1:]))
    costs = np.zeros((candidates.chunks, CHUNK), np.uint8)
    with pytest.raises(ValueError, match="not contiguous"):
        cuda.aggregate(costs, c.colour[0][:, ::-1], c.static[0], candidates, FIRST)
