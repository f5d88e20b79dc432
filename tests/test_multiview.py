"""The many-view method: every stage of the cpu backend against NumPy, bit for bit, and what it must do."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from arrays import Scene, array, make_scene, noise_scene
from seepast import Options, _core, multiview
from seepast.backends import cpu_multiview as cpu
from seepast.backends import cpu_people
from seepast.backends import reference_multiview as reference
from seepast.backends.reference import half_positions
from seepast.candidates import CHUNK, Candidates, DisparityGrid
from seepast.confidence import VIEWS, ray_count
from seepast.frames import Frame
from seepast.levels import Pictures
from seepast.many import (
    CONFIDENT,
    CUBIC,
    LUMA,
    REACH,
    UNITS,
    PairCosts,
    Penalties,
    VoteWeights,
    camera_pairs,
    cubic_weights,
)
from seepast.people import trusted
from seepast.picture import camera_weights
from seepast.pipeline import Clock
from seepast.surfaces import SPARE, Look, few_cameras, looks, static_span, surfaces, well_placed

OPTIONS = Options.preset("accurate").updated({"range.max_disparity": 60, "people.enabled": False})
SOME_COSTS = PairCosts.of(OPTIONS.multiview), PairCosts.of(Options.preset("fast").multiview, wanted=0)
COSTS, WEIGHTS = PairCosts.of(OPTIONS.multiview), VoteWeights.of(OPTIONS.multiview)
FIRST, FINAL = Penalties.of(8, 150, 20, 60), Penalties.of(4, 40, 15, 40)
VOLUME_GRIDS = (DisparityGrid(29, 8, 32), DisparityGrid(3, 3, 80))
STEEPEST = Penalties.of(200, 1000, 1000, 1000)  # the largest that options allow
KINDS = ("all", "random", "clustered", "holes")


def some_candidates(grid: DisparityGrid, shape: tuple[int, int], kind: str) -> Candidates:
    """Every pixel at all chunks; at any that chance will; at a run of them that moves slowly, and here and there
    another; or at that one in blocks, and not at all in between."""
    chunks, rng = grid.count // CHUNK, np.random.default_rng(grid.count)
    whole = np.uint64((1 << chunks) - 1)
    if kind == "all":
        return Candidates.all(grid, shape)
    if kind == "random":
        return Candidates.of(grid, np.maximum(rng.integers(0, 1 << 64, shape, np.uint64) & whole, np.uint64(1)))
    y, x = np.mgrid[: shape[0], : shape[1]]
    first, second = (((x // 13 + y // 7 + more) * 5 % chunks).astype(np.uint64) for more in (0, 2))
    near = np.uint64(1) << first | np.uint64(2) << first
    active = (near | np.where(x % 11 < 4, np.uint64(1) << second, np.uint64(0))) & whole
    if kind == "holes":
        active[(x // 9 + y // 5) % 3 == 1] = 0
    return Candidates.of(grid, active)


def sparse(scene: Scene) -> Scene:
    """The same with so few static pixels that many have no static neighbour, or few."""
    dynamic = np.where(np.random.default_rng(6).random(scene.dynamic.shape) < 0.9, 254, scene.dynamic)
    return replace(scene, dynamic=dynamic.astype(np.uint8))


GRIDS = (DisparityGrid(0, 4, 45), DisparityGrid(29, 8, 32), DisparityGrid(3, 3, 7))

SCENES = {
    "2 cameras": lambda: make_scene(2, (83, 31), colour=True),
    "3, middle, residual": lambda: make_scene(3, (75, 33), reference=1, residual=True, masks="soft", colour=True),
    "5, step": lambda: make_scene(5, (131, 24), surface="step", noise=2, colour=True),
    "5, last, no-ray borders": lambda: make_scene(5, (81, 27), reference=4, residual=True, no_ray=4, masks="soft"),
    "9, middle": lambda: make_scene(9, (73, 21), reference=4, surface="slanted"),
    "16, residual": lambda: make_scene(16, (69, 18), reference=3, residual=True, masks="soft"),
    "all dynamic": lambda: make_scene(3, (60, 20), masks="all"),
    "no mask": lambda: make_scene(3, (70, 25), masks="none", residual=True),
    "noise": lambda: noise_scene(4, (67, 23)),
    "noise of 7": lambda: noise_scene(7, (65, 19), reference=2, seed=3),
    "lonely pixels": lambda: sparse(noise_scene(4, (66, 23), seed=5)),
    "one row": lambda: noise_scene(3, (50, 1)),
    "one column": lambda: noise_scene(3, (1, 20), residual=False),
}
every_scene = pytest.mark.parametrize("name", SCENES)
STEEP = {"3, middle, residual": 30.0, "noise": 20.0}  # scenes whose cameras lie far apart in depth: many runs in a row


class Case:
    """A scene, and random stand-ins for what earlier stages would have found."""

    def __init__(self, scene: Scene, steep: float = 1.0):
        self.colour = cpu.three_channels(scene.colour)
        self.static = scene.dynamic <= 127
        geometry = scene.geometry
        geometry.positions[:, 2] *= steep
        self.views = [geometry.seen_from(k) for k in range(geometry.cameras)]
        self.geometry = geometry
        rng = np.random.default_rng(4)
        flat = rng.integers(0, 60 * UNITS, (len(self.static), 1, 1))
        rough = rng.integers(-2 * UNITS, 2 * UNITS, self.static.shape)
        self.disparities = (flat + rough).clip(0).astype(np.uint16)
        self.confidence = np.where(self.static, rng.choice([3, 14, CONFIDENT], self.static.shape), 0).astype(np.uint8)
        self.noise = rng.integers(0, 256, (*self.static.shape[1:], 45), np.uint8)
        self.choice = rng.random((2, *self.static.shape[1:])) < 0.5

    @property
    def some_views(self) -> list[int]:
        return sorted({0, self.geometry.reference, self.geometry.cameras - 1})


@cache
def case(name: str) -> Case:
    return Case(SCENES[name](), STEEP.get(name, 1.0))


def assert_same(first, second) -> None:
    first, second = ((r if isinstance(r, tuple) else (r,)) for r in (first, second))
    for a, b in zip(first, second, strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert np.array_equal(a, b), f"{(a != b).mean():.1%} differ, first at {np.argwhere(a != b)[0]}"


@pytest.fixture(autouse=True)
def threads():
    _core.set_threads(3)
    yield
    _core.set_threads(0)


# ------------------------------------------------------------------------------------- what is compared, and where


def test_samples_are_pixels_and_lie_half_way_between():
    c = case("noise")
    found = reference.describe(c.colour, c.static)
    padded, width = np.pad(c.colour.astype(int), ((0, 0), (0, 0), (1, 2), (0, 0)), mode="edge"), c.colour.shape[2]

    def half_way(values: np.ndarray) -> np.ndarray:
        first, second, third, fourth = (values[:, :, i : i + width] for i in range(4))
        return (9 * (second + third) - (first + fourth) + 8) >> 4

    assert_same(found.colour[:, 0], c.colour)
    assert_same(found.colour[:, 1], half_way(padded).clip(0, 255).astype(np.uint8))
    luma = padded @ LUMA
    two_left = REACH.index((0, -2))
    for p, samples in enumerate((luma[:, :, 1 : 1 + width], half_way(luma).clip(0, 65535))):
        assert_same((found.census[:, p, :, 2:] >> two_left & 1).astype(bool), samples[..., :-2] < samples[..., 2:])
    both = np.append(c.static[..., :-1] & c.static[..., 1:], np.zeros((*c.static.shape[:2], 1), bool), axis=-1)
    assert_same(found.static, np.stack([c.static, both], 1))


@pytest.mark.parametrize(("reference_camera", "d", "halves"), [
    (0, 0.25, 0), (0, 0.2501, -1), (0, 0.75, -1), (0, 0.76, -2), (1, 0.24, 0), (1, 0.25, 1), (1, 0.75, 2), (1, 7, 14),
])  # fmt: skip
def test_rays_end_at_the_nearest_half_pixel(reference_camera, d, halves):
    geometry = make_scene(2, (20, 5), reference=reference_camera).geometry
    x = np.arange(20)[None]
    xh, row = half_positions(geometry, 1 - reference_camera, x, np.full_like(x, 3), np.float32(d))
    assert_same((xh, row), ((2 * x + halves).astype(np.int32), np.full_like(x, 3, np.int32)))


# -------------------------------------------------------------------------------------------- backends agree


def test_volumes_that_are_held_are_not_written_over():
    c = case("5, step")
    k, grid = c.geometry.reference, VOLUME_GRIDS[0]
    features = cpu.describe(c.colour, c.static)
    everything = Candidates.all(grid, c.static.shape[1:])
    held = cpu.volume(features, c.views[k], everything, COSTS)
    was = held[:7].copy()
    cpu.volume(features, c.views[k], everything, replace(COSTS, few=1, colour_cap=2, lone=3, unseen=4))
    assert_same(held[:7], was)
    row = held[3]
    del held
    cpu.volume(features, c.views[k], everything, replace(COSTS, few=1, colour_cap=2, lone=3, unseen=4))
    assert_same(row, was[3])


@pytest.mark.parametrize("shape", [(8, 8), (13, 70), (35, 66)])
@pytest.mark.parametrize("scale", [2, 4, 8])
def test_averaged(shape, scale):
    rng = np.random.default_rng(scale)
    colour, static = rng.integers(0, 256, (3, *shape, 3), np.uint8), rng.random((3, *shape)) < 0.9
    size = max(1, shape[1] // scale), max(1, shape[0] // scale)
    for pictures in (colour, colour // 64 * 64):  # the latter full of halves
        for found, expected in zip(*(b.averaged(pictures, static, size, scale) for b in (cpu, reference)), strict=True):
            assert_same(found, expected)


@pytest.mark.parametrize("height", [2, 3, 40, 41])
def test_half_rows_and_back(height):
    rng = np.random.default_rng(height)
    colour, static = rng.integers(0, 256, (3, height, 37, 3), np.uint8), rng.random((3, height, 37)) < 0.8
    for found, expected in zip(*(b.half_rows(colour, static) for b in (cpu, reference)), strict=True):
        assert_same(found, expected)
    small, small_static = cpu.half_rows(colour, static)
    assert_same(small[:, 0], np.floor(colour[:, :2].mean(1) + 0.5).astype(np.uint8))
    assert_same(small_static[:, 0], static[:, :2].all(1))
    views = rng.integers(0, 9000, (3, height // 2, 37), np.uint16)
    whole = cpu.double_rows(views, height)
    assert_same(whole, reference.double_rows(views, height))
    assert_same(whole[:, 1], views[:, 0])
    assert_same(whole[:, -1], views[:, -1])


@pytest.mark.parametrize("ratio", [1, 2, 3])
def test_enlarged(ratio):
    rng = np.random.default_rng(ratio)
    words, marks = rng.integers(0, 9000, (3, 6, 7), np.uint16), rng.random((3, 6, 7)) < 0.5
    for shape in ((6 * ratio, 7 * ratio), (6 * ratio + 1, 7 * ratio - 1), (6 * ratio - 2, 7 * ratio + 2)):
        for given in ((words, ratio, shape), (marks, ratio, shape), (words, ratio, shape, 3)):
            if ratio > 1 or shape == (6, 7):
                assert_same(*(b.enlarged(*given) for b in (reference, cpu)))


def test_views_that_were_made_together_are_matched_without_a_copy():
    views, shape, grid = 3, (120, 160), DisparityGrid(0, 8, 64)
    disparity, where = np.full((views, 60, 80), 300, np.uint16), np.ones((views, 60, 80), bool)
    candidates = cpu.windows_of_views(disparity, where, 2, grid, UNITS, 1, shape)
    for part in ([c.active for c in candidates], [c.start for c in candidates]):
        stacked = cpu._stacked(part)
        assert np.shares_memory(stacked, part[0])
        assert_same(stacked, np.stack(part))
        for others in (part[1:], part[:1]):
            assert_same(cpu._stacked(others), np.stack(others))
        for others in (part[::-1], part[::2], [part[0], part[0].copy(), part[2]]):
            stacked = cpu._stacked(others)
            assert not np.shares_memory(stacked, part[0])
            assert_same(stacked, np.stack(others))


@every_scene
def test_landings(name):
    c = case(name)
    for k in c.some_views:
        d = c.disparities[k] / np.float32(UNITS)
        for high in (d, d + np.float32(0.75), d[::-1, ::-1].copy()):
            assert_same(*(b.landings(~c.static[k], d, high, c.views[k]) for b in (reference, cpu)))


def test_nothing_that_is_hidden_is_out_of_reach():
    scene = make_scene(5, (100, 40))
    level = pictures_of(scene).level(1, False)
    hidden, o = ~level.static[0], OPTIONS.multiview
    reach = multiview.within_reach(level, (4.0, 30.0), o, cpu)
    assert hidden.any() and not reach.all()
    for d in (4.0, 11.3, 30.0):
        at = np.full(hidden.shape, d, np.float32)
        assert not (cpu.landings(hidden, at, at, level.geometry) & ~reach).any()


@every_scene
def test_witnessed(name):
    c = case(name)
    for k in c.some_views:
        for most, tolerance in ((15, UNITS), (2, UNITS), (1, 20 * UNITS)):
            given = ~c.static[k], c.disparities, c.static, c.views[k], most, tolerance
            assert_same(*(b.witnessed(*given) for b in (reference, cpu)))


def test_no_more_views_are_asked_than_are_needed():
    scene = make_scene(5, (100, 40))
    geometry, shape = scene.geometry, (5, 40, 100)
    hidden = np.zeros(shape[1:], bool)
    hidden[20, 60] = True
    d = np.full(shape, 8 * UNITS, np.uint16)
    assert list(geometry.nearest_first) == [0, 1, 2, 3, 4]
    assert list(geometry.views[4].nearest_first) == [4, 3, 2, 1, 0]

    def asked(d: np.ndarray, static: np.ndarray, most: int) -> list[int]:
        return [k for k, view in enumerate(cpu.witnessed(hidden, d, static, geometry, most, UNITS)) if view.any()]

    everywhere = np.ones(shape, bool)
    assert asked(d, everywhere, 2) == [0, 1, 2]
    assert asked(d, everywhere, 15) == [0, 1, 2, 3, 4]
    blind, other = everywhere.copy(), d.copy()
    blind[1] = False
    other[1] += 2 * UNITS
    assert asked(d, blind, 2) == asked(other, everywhere, 2) == [0, 1, 2, 3]


@every_scene
@pytest.mark.parametrize("kind", KINDS)
def test_volume(name, kind):
    c = case(name)
    features = reference.describe(c.colour, c.static), cpu.describe(c.colour, c.static)
    for k in c.some_views:
        for grid, costs in zip(VOLUME_GRIDS, SOME_COSTS, strict=True):
            candidates = some_candidates(grid, c.static.shape[1:], kind)
            found = (
                b.volume(f, c.views[k], candidates, costs) for b, f in zip((reference, cpu), features, strict=True)
            )
            assert_same(*found)


@every_scene
def test_volumes(name):
    """All views at once, rows of them here and there: what is kept of the rows before must be the right ones."""
    c = case(name)
    grid, rng = VOLUME_GRIDS[0], np.random.default_rng(3)
    candidates = []
    for k in c.some_views:
        rows = rng.random(c.static.shape[1]) < (0.1, 0.5, 0.9)[k % 3]
        some = np.where(rows[:, None], rng.integers(0, 1 << (grid.count // CHUNK), c.static.shape[1:]), 0)
        candidates.append(Candidates.of(grid, some.astype(np.uint64)))
    views = [c.views[k] for k in c.some_views]
    found = [b.volumes(b.describe(c.colour, c.static), views, candidates, COSTS) for b in (reference, cpu)]
    for expected, volume in zip(*found, strict=True):
        assert_same(expected, volume)


@pytest.mark.parametrize("chunks", [1, 5, 64])
@pytest.mark.parametrize("shape", [(1, 1), (3, 70), (41, 13)])
def test_chunk_starts(chunks, shape):
    bits = np.random.default_rng(chunks).random((*shape, chunks)) < 0.4
    active = (bits.astype(np.uint64) << np.arange(chunks, dtype=np.uint64)).sum(-1, dtype=np.uint64)
    found = Candidates.of(DisparityGrid(0, 8, CHUNK * chunks), active)
    assert_same(found.start, np.append(0, np.cumsum(bits.sum(-1))).astype(np.int32))
    assert_same(found.mask, bits.repeat(CHUNK, -1))
    everything = Candidates.all(found.grid, shape)
    assert_same(everything.start, Candidates.of(found.grid, everything.active).start)


@every_scene
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("paths", [8, 4])
def test_aggregate(name, kind, paths):
    c = case(name)
    rng = np.random.default_rng(7)
    shape = c.static.shape[1:]
    for chunks, penalties in ((1, FIRST), (3, FINAL), (8, FIRST), (64 if shape[0] * shape[1] < 1500 else 11, STEEPEST)):
        grid = DisparityGrid(3, 1 + 16 // chunks, 16 * chunks)
        candidates = some_candidates(grid, shape, kind)
        costs = rng.integers(0, 256, (candidates.start[-1], CHUNK), np.uint8)
        if chunks == 8:
            costs = np.minimum(costs // 40, 3)  # many equal sums
        if chunks == 3:
            costs |= 192  # paths whose costs gather fast
        assert_same(
            *(
                b.aggregate(costs, c.colour[0], c.static[0], candidates, penalties, paths, c.disparities[0])
                for b in (reference, cpu)
            )
        )


@pytest.mark.parametrize("before", [0, 20000, 32767, 65535])
def test_aggregate_does_not_depend_on_what_was_in_its_memory(monkeypatch, before):
    monkeypatch.setattr(
        cpu.workspace, "empty", lambda shape, kind: np.full(shape, np.array(before, np.uint16).astype(kind), kind)
    )
    rng = np.random.default_rng(2)
    shape, grid = (41, 60), DisparityGrid(3, 5, 64)
    image, static = rng.integers(0, 256, (*shape, 3), np.uint8), rng.random(shape) < 0.8
    for kind in KINDS:  # disparities at the ends of what is matched, where there is nothing beside them
        candidates = some_candidates(grid, shape, kind)
        costs = rng.integers(0, 256, (candidates.chunks, CHUNK), np.uint8)
        costs[:, [0, -1]] //= 8
        given = costs, image, static, candidates, FIRST, 4, np.zeros(shape, np.uint16)
        assert_same(*(b.aggregate(*given) for b in (reference, cpu)))


def scattered(shape: tuple[int, int], chunks: int, kind: str) -> np.ndarray:
    """Active chunks of pixels most of which are not matched at all: uint64 [H, W]."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[: shape[0], : shape[1]]
    kept = {
        "none": x < 0,
        "one pixel": (x == shape[1] // 2) & (y == shape[0] // 3),
        "isolated": rng.random(shape) < 0.05,
        "one column": x == shape[1] - 1,
        "one row": y == shape[0] - 1,
        "top": y < 2,
        "bottom corner": (y > shape[0] - 4) & (x > shape[1] - 4),
        "empty rows": (y // 3 % 2 == 0) & (x % 40 > 4),
        "rows unlike": rng.random(shape) < 0.7,
    }[kind]
    first = (y // 4 % 2 + x // 9 % 3).astype(np.uint64) % np.uint64(chunks)
    wide = np.where(rng.random(shape) < 0.1, np.uint64(5), np.uint64(1)) << first
    return np.where(kept, wide & np.uint64((1 << chunks) - 1), np.uint64(0))


@pytest.mark.parametrize("kind", ["none", "one pixel", "isolated", "one column", "one row", "top", "bottom corner",
                                  "empty rows", "rows unlike"])  # fmt: skip
@pytest.mark.parametrize("paths", [8, 4])
@pytest.mark.parametrize("shape", [(37, 83), (2, 3), (1, 40), (40, 1)], ids=str)
def test_aggregate_where_little_is_matched(shape, paths, kind):
    rng = np.random.default_rng(5)
    grid = DisparityGrid(3, 5, 64)
    every = Candidates.all(grid, shape)
    some = Candidates.of(grid, scattered(shape, 4, kind))
    image, static = rng.integers(0, 256, (*shape, 3), np.uint8), rng.random(shape) < 0.8
    otherwise = rng.integers(0, 4000, shape).astype(np.uint16)
    for candidates in (some, every.where(some.active > 0)):
        costs = rng.integers(0, 256, (candidates.chunks, CHUNK), np.uint8)
        for penalties, fallback in ((FIRST, otherwise), (STEEPEST, None)):
            assert_same(
                *(b.aggregate(costs, image, static, candidates, penalties, paths, fallback) for b in (reference, cpu))
            )


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 70), (31, 33), (64, 4)], ids=str)
def test_medians_of_all_that_is_matched(shape):
    """Without penalties every pixel has its own cheapest candidate, before the median."""
    rng = np.random.default_rng(shape[1])
    grid = DisparityGrid(0, 8, CHUNK)
    free = replace(STEEPEST, small=0, large=np.zeros_like(STEEPEST.large), dynamic=0)
    image, static = np.zeros((*shape, 3), np.uint8), np.ones(shape, bool)
    for some in (np.ones(shape, bool), rng.random(shape) < 0.7):
        candidates = Candidates.all(grid, shape).where(some)
        costs = rng.integers(0, 256, (shape[0] * shape[1], CHUNK), np.uint8)
        otherwise = rng.integers(0, 16, shape).astype(np.uint16) * UNITS
        found = [b.aggregate(costs, image, static, candidates, free, 4, otherwise) for b in (reference, cpu)]
        assert_same(*found)
        if some.all():
            assert len(np.unique(found[1])) > (shape[0] * shape[1] > 100)


@pytest.mark.parametrize("most", [0, 1 << 24])
def test_aggregates_of_views_whose_costs_are_made_of_what_is_found(monkeypatch, most):
    """Costs that are made when they are asked for see the disparities as they were, in one batch or several."""
    monkeypatch.setattr(cpu, "MOST_SCRATCH", most)
    c = case("5, step")
    K, shape = len(c.static), c.static.shape[1:]
    candidates = [some_candidates(VOLUME_GRIDS[0], shape, "clustered") for _ in range(K)]
    results = []
    for b in (reference, cpu):
        found = c.disparities.copy()
        costs = (
            np.full((of.chunks, CHUNK), np.uint8(found.sum() % 97)) + np.arange(CHUNK, dtype=np.uint8)
            for of in candidates
        )
        results.append(b.aggregates(costs, c.colour, c.static, candidates, FIRST, 4, found))
    assert_same(*results)


def test_long_paths_keep_their_numbers_small():
    """Where all is dear, costs gather along the path: over 700 pixels they would leave 16 bits."""
    rng = np.random.default_rng(1)
    for shape in ((3, 700), (700, 3)):
        candidates = some_candidates(DisparityGrid(0, 4, 64), shape, "clustered")
        costs = rng.integers(200, 256, (candidates.start[-1], CHUNK), np.uint8)
        image = rng.integers(0, 256, (*shape, 3), np.uint8)
        found = [b.aggregate(costs, image, np.ones(shape, bool), candidates, STEEPEST) for b in (reference, cpu)]
        assert_same(*found)


@every_scene
@pytest.mark.parametrize("skip", [-1, 1])
def test_witnesses_and_labels(name, skip):
    c = case(name)
    for k in c.some_views:
        d = c.disparities[k]
        assert_same(*(b.witnesses(d, c.disparities, c.static, c.views[k], skip, UNITS) for b in (reference, cpu)))
        for wanted in (None, c.choice[0]):
            assert_same(*(b.labels(d, c.disparities, c.static, c.views[k], 48, wanted) for b in (reference, cpu)))


@every_scene
def test_evidence_rays_and_what_is_clear_of_masks(name):
    c = case(name)
    r = c.geometry.reference
    flat = (c.disparities // 40 * 40)[r]
    for d in (c.disparities[r], flat, np.full_like(flat, 400)):
        shown, _, close = reference.labels(d, c.disparities, c.static, c.geometry, 48)
        evidence = cpu.evidence(d, c.static[r], close, shown)
        assert_same(reference.evidence(d, c.static[r], close, shown), evidence)
        for keep in (None, c.static[r]):
            told = (b.told(d, evidence, VIEWS.table, shown, keep) for b in (reference, cpu))
            for expected, found in zip(*told, strict=True):
                assert_same(expected, found)
    every = np.arange(1 << 16, dtype=np.uint16).reshape(64, -1)
    counted = (b.told(every, (every >> 8).astype(np.uint8), VIEWS.table, every) for b in (reference, cpu))
    for expected, found in zip(*counted, strict=True):
        assert_same(expected, found)
    for static in (c.static, c.choice, c.static[:, :3, :2]):
        assert_same(*(b.clear_of_masks(np.ascontiguousarray(static)) for b in (reference, cpu)))


VOTED = (DisparityGrid(29, 8, 32), DisparityGrid(0, 3, 160), DisparityGrid(3, 1, 48), DisparityGrid(0, 20, 112))


@every_scene
@pytest.mark.parametrize("grid", VOTED, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_votes(name, grid, kind):
    c = case(name)
    candidates = some_candidates(grid, c.static.shape[1:], kind)
    costs = np.random.default_rng(1).integers(0, 256, (candidates.start[-1], CHUNK), np.uint8)
    rough = np.random.default_rng(2).integers(0, grid.values[-1] * UNITS, c.static.shape).astype(np.uint16)
    for k, skip in ((0, 0), (c.geometry.reference, -1)):
        for weights in (WEIGHTS, VoteWeights(7680, 3, 6, 128), replace(WEIGHTS, visible=False)):
            for d in (c.disparities, rough):
                given = d, c.confidence, c.static[k], c.views[k], candidates, skip, weights
                expected = reference.votes(costs, *given)
                assert_same(expected, cpu.votes(costs, *given))
                written = costs.copy()
                assert cpu.votes(written, *given, out=written) is written
                assert_same(expected, written)


@every_scene
@pytest.mark.parametrize("kind", [None, "holes", "random"])
def test_graded(name, kind):
    c = case(name)
    grid = DisparityGrid(0, 8, 3 * CHUNK)
    candidates = None if kind is None else some_candidates(grid, c.static.shape[1:], kind)
    for k in c.some_views:
        given = c.disparities[k], c.disparities, c.static, c.views[k], UNITS, 14, 3, candidates
        for found, expected in zip(cpu.graded(*given), reference.graded(*given), strict=True):
            assert_same(found, expected)


@every_scene
def test_planes(name):
    c = case(name)
    smooth = (c.disparities[0] // 8 + 300).astype(np.uint16)
    for d in (smooth, c.disparities[0]):
        found = [b.planes(d, c.choice[0], c.choice[1], c.colour[0], c.static[0]) for b in (reference, cpu)]
        assert_same(*found)


@every_scene
def test_blend(name):
    c = case(name)
    rays = np.random.default_rng(2).integers(0, 1 << len(c.static), c.choice[0].shape).astype(np.uint16)
    clear = cpu.clear_of_masks(c.static)
    for k in c.some_views:
        near = camera_weights(c.views[k], OPTIONS.multiview)
        given = rays, clear, near, 0.3, c.views[k], c.disparities[k], c.choice[0]
        assert_same(*(b.blend(c.colour, *given) for b in (reference, cpu)))


@pytest.mark.parametrize(
    "name", ["2 cameras", "3, middle, residual", "5, last, no-ray borders", "noise", "all dynamic"]
)
@pytest.mark.parametrize("dynamic_only", [False, True])
def test_whole_method(name, dynamic_only):
    scene = SCENES[name]()
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    found = [multiview.see_past(frame, scene.geometry, OPTIONS, b, dynamic_only, Clock())[0] for b in (reference, cpu)]
    assert found[0].keys() == found[1].keys()
    assert_same(*(tuple(f.values()) for f in found))
    own = frame.dynamic[scene.geometry.reference] <= 127
    assert np.array_equal(found[0]["background"][own], scene.colour[scene.geometry.reference][own])
    assert found[0]["background"].shape == scene.colour.shape[1:]
    if dynamic_only:
        assert not found[0]["disparity"][own].any()
        assert (found[0]["coverage"][own] == 1).all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_change_nothing(threads):
    scene = make_scene(5, (120, 50), reference=2, residual=True, colour=True, masks="soft")
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    found = []
    for count in (3, threads):
        _core.set_threads(count)
        found.append(tuple(multiview.see_past(frame, scene.geometry, OPTIONS, cpu, False, Clock())[0].values()))
    assert_same(*found)


# -------------------------------------------------------------------------------------------- the method itself


def seen(scene: Scene, **changed) -> dict[str, np.ndarray]:
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    return multiview.see_past(frame, scene.geometry, OPTIONS.updated(changed), cpu, False, Clock())[0]


@pytest.mark.parametrize("reference_camera", [0, 2, 4])
@pytest.mark.parametrize("residual", [False, True])
def test_finds_what_people_hide(reference_camera, residual):
    scene = make_scene(5, (140, 64), reference=reference_camera, residual=residual, colour=True, noise=1)
    found = seen(scene)
    hidden = scene.person[reference_camera] & (scene.seen_by() > 0)
    assert hidden.sum() > 200
    wrong = np.abs(found["disparity"] - scene.disparity) > 1
    assert wrong[hidden].mean() < 0.05
    assert wrong.mean() < 0.05
    error = np.abs(found["background"].astype(int) - scene.background)[hidden]
    assert np.median(error) <= 8
    assert (found["coverage"][hidden] > 0).mean() > 0.9


def test_never_seen_pixels_are_flagged():
    scene = make_scene(3, (120, 60), colour=True)
    scene.dynamic[:, 20:40, 30:60] = 254
    found = seen(scene)
    blind = np.zeros(scene.disparity.shape, bool)
    blind[24:36, 46:56] = True  # the wall at 12 px moves the masks by up to 12
    assert (found["coverage"][blind] == 0).all()
    assert np.array_equal(found["coverage"], ray_count(found["labels"]))


def test_planes_straighten_slants():
    """A slanted wall of whole-pixel steps with a doubtful strip: the strip comes back on the wall's plane."""
    x = np.mgrid[:40, :60][1]
    truth = UNITS * 20 + 8 * x
    d = truth.copy()
    strip = (x >= 25) & (x < 33)
    d[strip] = truth[:, 25:26].repeat(60, 1)[strip] + 20
    found = cpu.planes(d.astype(np.uint16), ~strip, strip, np.full((40, 60, 3), 90, np.uint8), np.ones((40, 60), bool))
    assert np.abs(found.astype(int) - truth)[strip].max() < np.abs(d - truth)[strip].max() / 2
    assert np.array_equal(found[~strip], d[~strip])


def pictures_of(scene: Scene) -> Pictures:
    return Pictures(cpu.three_channels(scene.colour), scene.dynamic <= 127, scene.geometry, cpu)


def span_of(scene: Scene) -> tuple[float, float]:
    options = OPTIONS.updated({"people.enabled": False})
    (look,) = looks(scene.geometry, options)
    seen = surfaces(pictures_of(scene), scene.geometry, look, options, cpu)
    return static_span(seen, scene.dynamic <= 127, scene.geometry, options, cpu)


@pytest.mark.parametrize(
    ("size", "scales"), [((720, 540), [4, 2]), ((430, 370), [2, 1]), ((200, 99), [1]), ((720, 1), [1])]
)
def test_the_first_look_is_the_coarser_one(size, scales):
    geometry = replace(case("5, step").geometry, size=size)
    few, every = few_cameras(geometry), tuple(range(5))
    found = [Look(scales[0], few), *(Look(scale, every) for scale in scales)]
    assert looks(geometry, Options.preset("accurate")) == found
    coarse = Options.preset("accurate").updated({"people.surface_width": 250})
    assert looks(geometry, coarse) == found[:2]
    half = size[1] > 1  # rows in the looks that may be enough
    found = [Look(scales[0], few, half), Look(scales[0], every, half), Look(scales[-1], every)]
    assert looks(geometry, Options.preset("fast")) == list(dict.fromkeys(found))


@pytest.mark.parametrize(
    ("cameras", "reference", "few"),
    [(2, 0, (0, 1)), (3, 1, (0, 1, 2)), (5, 2, (0, 2, 4)), (5, 4, (0, 2, 4)), (16, 3, (0, 3, 15))],
)
def test_few_cameras_are_the_ends_and_one_between(cameras, reference, few):
    geometry = array(cameras, (64, 48)).seen_from(reference)
    assert few_cameras(geometry) == few
    if cameras < 4:
        assert len(looks(geometry, Options.preset("accurate"))) == 1


def test_a_second_look_from_all_cameras_finds_what_one_look_does():
    scene = make_scene(5, (140, 64), colour=True)
    pictures, options = pictures_of(scene), OPTIONS
    few, every = Look(2, (0, 2, 4)), Look(2, (0, 1, 2, 3, 4))
    first = surfaces(pictures, scene.geometry, few, options, cpu)
    assert not first.disparity[[1, 3]].any() and not first.agree[[1, 3]].any() and first.agree[few.cameras,].any()
    whole = surfaces(pictures, scene.geometry, every, options, cpu)
    second = surfaces(pictures, scene.geometry, every, options, cpu, first)
    assert sorted(second.cameras) == sorted(whole.cameras)
    assert np.array_equal(second.disparity, whole.disparity) and np.array_equal(second.agree, whole.agree)


def test_a_mask_that_is_missing_where_nobody_looked_from_is_noticed():
    scene = make_scene(5, (140, 64), colour=True, person=False)
    dynamic = np.zeros_like(scene.dynamic)
    for k, view in enumerate(dynamic):  # somebody flat on the wall, whose disparity is 12 px
        view[10:50, 60 - 3 * k : 100 - 3 * k] = 254
    seen = surfaces(pictures_of(scene), scene.geometry, Look(2, (0, 2, 4)), OPTIONS, cpu)
    options = OPTIONS.people
    assert trusted(dynamic, seen, options, cpu_people)
    for wrong in (0, 254):
        missing = dynamic.copy()
        missing[1] = wrong
        assert not trusted(missing, seen, options, cpu_people)


def test_span_of_the_static_scene():
    low, high = span_of(make_scene(5, (140, 64), colour=True))  # the wall is at 12 px, the person at 44
    assert low <= 10
    assert 14 <= high <= 34


def test_span_begins_where_few_chunks_are_touched_but_never_above_what_is_seen():
    geometry, options = replace(make_scene(5, (140, 64), colour=True).geometry, size=(720, 540)), Options.preset("fast")
    plane = np.linspace(15.5, 16.5, 64)
    start = well_placed((0.0, 3.2), 80.0, plane, geometry, options)
    assert 0 <= start <= 3 + SPARE
    into = (plane - start) % (CHUNK * options.range.step)
    window, step = options.multiview.window, options.range.step
    assert into.min() >= window and into.max() <= CHUNK * step - window - step, "windows within one chunk"
    for first in (0.5, 4.0, 8.0, 11.0):  # far things, at the end of the search
        assert 0 <= well_placed((0.0, first - 12), 80.0, plane, geometry, options) <= max(0, first - 12 + SPARE)
    assert well_placed((-0.4, 3.2), 80.0, plane, geometry, options) >= -1


def test_span_where_nothing_is_sure_is_the_whole_search():
    low, high = span_of(make_scene(3, (120, 60), masks="all", colour=True))
    assert low == 0
    assert high >= 60


def test_camera_pairs():
    assert camera_pairs(3, 1, 1) == ([(1, 0), (1, 2)], [(0, 2)])
    assert camera_pairs(2, 0, 15) == ([(0, 1)], [])
    assert camera_pairs(5, 1, 1)[1] == [(0, 2), (2, 3), (3, 4)]
    assert len(camera_pairs(5, 2, 15)[1]) == 6
    own, others = camera_pairs(16, 5, 2)
    assert len(own) == 15 and len(others) == 14 + 13
    assert all(5 not in pair for pair in others)
    costs = replace(COSTS, apart=1, wanted=2)
    assert [costs.apart_of(5, k) >= 3 for k in range(5)] == [False, False, True, False, False]
    assert [costs.apart_of(16, k) for k in (1, 2)] == [1, 2]


def test_cubic_weights_are_keys():
    assert np.allclose(cubic_weights(np.float32(0)), [0, 1, 0, 0], atol=1e-6)
    assert np.allclose(cubic_weights(np.float32(0.25)), np.array([-9, 111, 29, -3]) / 128, atol=1e-6)
    assert np.allclose(cubic_weights(np.float32(0.5)), CUBIC / 128, atol=1e-6)
    assert np.allclose(cubic_weights(np.float32(0.75)), np.array([-3, 29, 111, -9]) / 128, atol=1e-6)
