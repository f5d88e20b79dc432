"""Every stage of the cpu backend against the NumPy reference, bit for bit, each fed with the reference's own input."""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np
import pytest

from arrays import Scene, all_label_energies, make_scene, noise_scene
from seepast import Options
from seepast.backends import cpu, reference
from seepast.candidates import DisparityGrid, Prior
from seepast.evidence import UNCHANGED
from seepast.rectify import NO_RAY

BACKENDS = (reference, cpu)
OPTIONS = Options.preset("paper").updated({"range.max_disparity": 60, "range.step": 1, "support.texture": 20})
GRID = DisparityGrid.of(OPTIONS.range, 96)
COARSE = DisparityGrid.of(OPTIONS.updated({"range.step": 4}).range, 96)

SCENES = {
    "2 cameras": lambda: make_scene(2, (83, 61)),
    "3, middle, residual": lambda: make_scene(3, (68, 37), reference=1, residual=True, masks="soft"),
    "5, step": lambda: make_scene(5, (90, 46), surface="step", noise=2),
    "5, last, no-ray borders": lambda: make_scene(5, (81, 47), reference=4, residual=True, no_ray=4, masks="soft"),
    "9, middle, slanted": lambda: make_scene(9, (61, 29), reference=4, surface="slanted"),
    "16, residual": lambda: make_scene(16, (49, 25), reference=3, residual=True, masks="soft"),
    "all dynamic": lambda: make_scene(3, (60, 40), masks="all"),
    "no mask": lambda: make_scene(3, (70, 45), masks="none", residual=True),
    "noise": lambda: noise_scene(4, (61, 35)),
    "noise, last of 2": lambda: noise_scene(2, (45, 37), reference=1, seed=5),
    "textureless": lambda: flat_scene(),
    "one row": lambda: noise_scene(3, (50, 1)),
    "one column": lambda: noise_scene(3, (1, 40), residual=False),
}
every_scene = pytest.mark.parametrize("name", SCENES)


def flat_scene() -> Scene:
    scene = make_scene(3, (70, 45))
    scene.views[:] = 93
    return scene


class Case:
    """A scene and what the reference made of it, stage by stage."""

    def __init__(self, scene: Scene):
        self.scene, self.geometry = scene, scene.geometry
        self.grid = GRID if len(scene.views) < 16 else COARSE  # the reference takes its time over 16 cameras
        self.shape = scene.grey.shape[1:]
        self.static = scene.dynamic <= 76
        rng = np.random.default_rng(1)
        self.wanted = rng.random(self.shape) < 0.8
        self.features = {reference: reference.describe(scene.grey), cpu: cpu.describe(scene.grey)}
        self.random_disparity = rng.choice(GRID.values, self.shape).astype(np.float32)

    @cached_property
    def points(self) -> np.ndarray:
        return self.support(reference)

    @cached_property
    def prior(self) -> Prior:
        return self.prior_of(reference, self.points)

    def support(self, backend, **changed) -> np.ndarray:
        options = OPTIONS.updated(changed).support
        return backend.support(self.features[backend], self.static, self.geometry, self.grid, options)

    def prior_of(self, backend, points, **changed) -> Prior:
        return backend.prior(points, self.shape, self.grid, OPTIONS.updated(changed).prior)

    def disparity(self, backend, prior=None, static=None, wanted=None, **changed) -> np.ndarray:
        static, wanted = self.static if static is None else static, self.wanted if wanted is None else wanted
        options, prior = OPTIONS.updated(changed), prior or self.prior
        return backend.disparity(self.features[backend], static, self.geometry, prior, self.grid, wanted, options)

    def segmentation(self, backend, d, dynamic=None, **changed) -> tuple[np.ndarray, np.ndarray]:
        dynamic = self.scene.dynamic if dynamic is None else dynamic
        options = OPTIONS.updated(changed)
        return backend.segmentation(self.features[backend], dynamic, self.geometry, d, self.wanted, options)


@cache
def case(name: str) -> Case:
    return Case(SCENES[name]())


def assert_same(results) -> None:
    """Of the reference and the cpu backend, given as an iterable of arrays or tuples of arrays, in their order."""
    first, second = ((r if isinstance(r, tuple) else (r,)) for r in results)
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert np.array_equal(a, b), f"{(a != b).mean():.1%} differ, first at {np.argwhere(a != b)[0]}"


# -------------------------------------------------------------------------------------- describe, support, prior


@every_scene
def test_describe(name):
    features = case(name).features
    assert_same([features[reference], features[cpu].gradients])


def test_describe_clips_the_steepest_edges():
    grey = np.zeros((2, 9, 11), np.uint8)
    grey[0, :, 5:] = 255
    grey[1, 4:] = 255
    found = reference.describe(grey)
    assert found.max() == 127
    assert found.min() == 0
    assert_same([found, cpu.describe(grey).gradients])
    assert_same([reference.describe(255 - grey), cpu.describe(255 - grey).gradients])


@every_scene
def test_support(name):
    assert_same([case(name).points, case(name).support(cpu)])


def test_the_scenes_do_have_support_points():
    found = {name: len(case(name).points) for name in SCENES}
    assert found["textureless"] == found["all dynamic"] == found["one row"] == found["one column"] == 0
    assert all(found[name] >= 10 for name in SCENES if name[0].isdigit() and name[1] in ", " and "2" not in name), found


@pytest.mark.parametrize(
    "changed",
    [
        {"support.grid": 3, "support.min_agreeing": 0},
        {"support.grid": 4, "support.left_right": 2},
        {"support.uniqueness": 1.0, "support.max_cost": 255, "support.texture": 0, "support.min_agreeing": 0},
        {"support.max_cost": 4, "support.similar": 0, "support.window": 7},
        {"support.grid": 64},
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["3, middle, residual", "noise, last of 2"])
def test_support_with_other_options(name, changed):
    assert_same(case(name).support(backend, **changed) for backend in BACKENDS)


@every_scene
def test_prior(name):
    found = [case(name).prior_of(backend, case(name).points) for backend in BACKENDS]
    assert_same((prior.mean, prior.cells) for prior in found)


@pytest.mark.parametrize("points", [0, 1, 2, 3, 40])
@pytest.mark.parametrize("max_step", [0, 8, 4096])
def test_prior_of_scattered_points(points, max_step):
    """Steep triangles, slivers, points in a row, disparities beyond the grid."""
    rng = np.random.default_rng(points)
    this = case("5, last, no-ray borders")
    height, width = this.shape
    places = rng.permutation(height * width)[:points]
    scattered = np.column_stack([places % width, places // width, rng.uniform(-3, 70, points)]).astype(np.float32)
    changed = {"prior.max_step": max_step, "prior.neighbour_radius": 2.0}
    found = [this.prior_of(backend, scattered, **changed) for backend in BACKENDS]
    assert_same((prior.mean, prior.cells) for prior in found)
    last = GRID.first + GRID.step * (GRID.count - 1)
    assert found[1].mean.min() >= GRID.first
    assert found[1].mean.max() <= last


# ----------------------------------------------------------------------------------------------------- disparity


@every_scene
def test_disparity(name):
    assert_same(case(name).disparity(backend) for backend in BACKENDS)


@pytest.mark.parametrize(
    "changed",
    [
        {"prior.radius": 0, "disparity.beta": 0.5},
        {"prior.radius": 256, "disparity.beta": 0},
        {"disparity.lone_variance": 0, "disparity.unseen_variance": 0},
        {"prior.sigma": 0.3, "prior.gamma": 1.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["5, last, no-ray borders", "noise", "2 cameras"])
def test_disparity_with_other_options(name, changed):
    assert_same(case(name).disparity(backend, **changed) for backend in BACKENDS)


@pytest.mark.parametrize("name", ["3, middle, residual", "16, residual"])
def test_disparity_of_any_prior(name):
    """A prior that jumps from pixel to pixel, beyond the grid too, and cells with any candidates."""
    this, rng = case(name), np.random.default_rng(7)
    mean = rng.integers(-40, 8 * 75, this.shape).astype(np.int32)
    cells = (rng.random(this.prior.cells.shape) < 0.1).astype(np.uint8)
    cells[0, 0] = 0
    changed = {"prior.radius": 2.0}
    assert_same(this.disparity(backend, Prior(mean, cells), **changed) for backend in BACKENDS)


@pytest.mark.parametrize("rays", ["none", "reference only", "another only", "all", "scattered"])
@pytest.mark.parametrize("name", ["3, middle, residual", "5, step"])
def test_disparity_by_number_of_static_rays(name, rays):
    this = case(name)
    static = np.zeros_like(this.static)
    if rays == "all":
        static[:] = True
    elif rays == "scattered":
        static = np.random.default_rng(3).random(static.shape) < 0.7
    elif rays != "none":
        static[this.geometry.reference - (rays == "another only")] = True
    assert_same(this.disparity(backend, static=static) for backend in BACKENDS)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 1.0])
def test_disparity_where_wanted(share):
    this = case("5, step")
    wanted = np.random.default_rng(2).random(this.shape) < share
    found = [this.disparity(backend, wanted=wanted) for backend in BACKENDS]
    assert_same(found)
    assert not found[1][~wanted].any()


def test_disparity_on_a_grid_that_starts_late_and_steps_far():
    this = case("3, middle, residual")
    options = OPTIONS.updated({"range.min_disparity": 5.3, "range.max_disparity": 31, "range.step": 0.375})
    grid = DisparityGrid.of(options.range, 75)
    found = []
    for backend in BACKENDS:
        prior = backend.prior(this.points, this.shape, grid, options.prior)
        found.append(
            backend.disparity(this.features[backend], this.static, this.geometry, prior, grid, this.wanted, options)
        )
    assert_same(found)
    assert found[0][this.wanted].min() >= 5.25


def smooth(this: Case, backend, d: np.ndarray, passes: int) -> np.ndarray:
    options = OPTIONS.updated({"disparity.median_passes": passes}).disparity
    return backend.smooth(d, this.prior, this.wanted, options)


@pytest.mark.parametrize("passes", [0, 1, 5])
@pytest.mark.parametrize("name", ["5, step", "textureless", "one row", "one column"])
def test_smooth(name, passes):
    this = case(name)
    found = [smooth(this, backend, this.random_disparity, passes) for backend in BACKENDS]
    assert_same(found)
    assert not found[1][~this.wanted].any()
    if not passes:
        assert np.array_equal(found[1][this.wanted], this.random_disparity[this.wanted])


@pytest.mark.parametrize("share", [0.0, 0.001, 0.02, 1.0])
@every_scene
def test_affected(name, share):
    this = case(name)
    changed = np.random.default_rng(11).random(this.static.shape) < share
    options = OPTIONS.updated({"prior.radius": 2})
    arguments = (changed, this.geometry, this.prior, this.grid, this.wanted, options)
    found = [backend.affected(*arguments) for backend in BACKENDS]
    assert_same(found)
    if share == 0:
        assert not found[1].any()


@pytest.mark.parametrize("name", ["3, middle, residual", "5, last, no-ray borders", "noise"])
def test_what_is_not_affected_keeps_its_disparity(name):
    """Labels that change anywhere change no disparity but where `affected` says so; and not everything is affected."""
    this, rng = case(name), np.random.default_rng(12)
    changed = np.zeros_like(this.static)
    for k in range(this.geometry.cameras):
        y, x = rng.integers(0, 20, 2)
        changed[k, y : y + 6, x + 12 : x + 20] = True
    prior = Prior(np.full(this.shape, 8 * 20, np.int32), np.zeros_like(this.prior.cells))
    options = OPTIONS.updated({"prior.radius": 2})
    before = this.disparity(cpu, prior, this.static, **{"prior.radius": 2})
    after = this.disparity(cpu, prior, this.static ^ changed, **{"prior.radius": 2})
    affected = cpu.affected(changed, this.geometry, prior, this.grid, this.wanted, options)
    assert (before != after).any()
    assert not (before != after)[~affected].any()
    assert 0.1 < affected.mean() < 0.9


# -------------------------------------------------------------------------------------------------- segmentation


SMALL = [name for name in SCENES if not name.startswith("16")]


@pytest.mark.parametrize("name", SMALL)
def test_segmentation(name):
    this = case(name)
    d = this.disparity(reference)
    assert_same(this.segmentation(backend, d) for backend in BACKENDS)


@pytest.mark.parametrize(
    "changed",
    [
        {"segmentation.beta": 0.00001, "disparity.lone_variance": 50000},
        {"segmentation.beta": 0.01},
        {"segmentation.beta": 0.002, "disparity.lone_variance": 1000, "segmentation.floor": 0.1},
        {"segmentation.beta": 10, "disparity.lone_variance": 0},
        {"segmentation.beta": 0},
        {"segmentation.floor": 0.5},
        {"segmentation.beta": 0.001, "segmentation.outlier_cost": 3},
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["noise", "noise, last of 2", "5, last, no-ray borders"])
def test_segmentation_where_labels_do_flip(name, changed):
    """Random disparities and unsure masks, on images of noise every one of the 2^K sets wins somewhere."""
    this = case(name)
    dynamic = np.random.default_rng(4).integers(0, 256, this.scene.dynamic.shape, np.uint8)
    found = [this.segmentation(backend, this.random_disparity, dynamic, **changed) for backend in BACKENDS]
    assert_same(found)
    labels, posterior = found[1]
    if 0 < changed.get("segmentation.beta", 0) < 1:
        assert (posterior != UNCHANGED).mean() > 0.001
    if changed.get("segmentation.beta") == 0.00001 and name == "noise":
        assert len(np.unique(labels[this.wanted])) == 1 << this.geometry.cameras


def test_segmentation_of_9_cameras_over_all_512_sets():
    this = Case(noise_scene(9, (40, 21), reference=5, seed=2))
    changed = {"segmentation.beta": 0.00002}
    found = [this.segmentation(backend, this.random_disparity, **changed) for backend in BACKENDS]
    assert_same(found)
    assert (found[1][1] != UNCHANGED).mean() > 0.02


def test_segmentation_of_16_cameras_over_all_65536_sets(monkeypatch):
    """The faster sum over sets that the K = 16 tests use is itself the reference's, bit for bit."""
    small, energies = Case(noise_scene(5, (23, 11), reference=2, seed=3)), []

    def both(*arguments):
        energies.append((label_energies(*arguments), all_label_energies(*arguments)))
        return energies[-1][1]

    label_energies = reference.label_energies
    monkeypatch.setattr(reference, "label_energies", both)
    small.segmentation(reference, small.random_disparity)
    assert np.array_equal(*energies[0])

    monkeypatch.setattr(reference, "label_energies", all_label_energies)
    this = Case(noise_scene(16, (15, 9), reference=3, seed=4))
    this.wanted[:] = True
    for changed in ({"segmentation.beta": 0.00001}, {"segmentation.beta": 0.00003, "segmentation.floor": 0.2}, {}):
        found = [this.segmentation(backend, this.random_disparity / 6, **changed) for backend in BACKENDS]
        assert_same(found)
        if changed:
            assert found[1][0].max() >= 1 << 15
            assert (found[1][1] != UNCHANGED).mean() > 0.005


@pytest.mark.parametrize("value", [0, 254, NO_RAY])
def test_segmentation_of_masks_of_one_value(value):
    this = case("3, middle, residual")
    dynamic = np.full_like(this.scene.dynamic, value)
    found = [this.segmentation(backend, this.random_disparity, dynamic) for backend in BACKENDS]
    assert_same(found)
    labels, posterior = found[1]
    if value == NO_RAY:
        assert not labels.any()
        assert (posterior == UNCHANGED).all()


def test_segmentation_where_not_wanted():
    this = case("5, step")
    labels, posterior = this.segmentation(cpu, this.disparity(reference))
    assert not labels[~this.wanted].any()
    assert (posterior[:, ~this.wanted] == UNCHANGED).all()


# ----------------------------------------------------------------------------------------------- refocus, masks


def random_labels(this: Case, kind: str) -> np.ndarray:
    rng, K = np.random.default_rng(6), this.geometry.cameras
    labels = {
        "none": np.zeros(this.shape, np.uint16),
        "one": np.uint16(1) << rng.integers(0, K, this.shape).astype(np.uint16),
        "all": np.full(this.shape, (1 << K) - 1, np.uint16),
        "any": rng.integers(0, 1 << K, this.shape).astype(np.uint16),
        "gaps": rng.integers(0, 1 << K, this.shape).astype(np.uint16),
    }[kind]
    if kind == "gaps":
        labels[rng.random(this.shape) < 0.4] = 0
        labels[10:25, 5:40] = 0
        labels[:, 60:] = 0
    return labels


@cache
def to_refocus(K: int, colour: bool) -> Case:
    return Case(make_scene(K, (73, 37), reference=K // 2, residual=True, colour=colour, seed=K))


@pytest.mark.parametrize("kind", ["none", "one", "all", "any", "gaps"])
@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
@pytest.mark.parametrize("median", [False, True], ids=["bare", "median"])
@pytest.mark.parametrize("K", [2, 5, 16])
def test_refocus(kind, colour, median, K):
    this, rng = to_refocus(K, colour), np.random.default_rng(8)
    scene = this.scene
    labels, d = random_labels(this, kind), this.random_disparity
    options = OPTIONS.updated({"refocus.median": median}).refocus
    for keep in (rng.random(this.shape) < 0.5, np.zeros(this.shape, bool), np.ones(this.shape, bool)):
        found = [b.refocus(scene.colour, labels, this.geometry, d, keep, options) for b in BACKENDS]
        assert_same(found)
        picture, coverage = found[1]
        assert np.array_equal(coverage == 0, labels == 0)
        seen = keep & (labels > 0)
        assert np.array_equal(picture[seen], scene.colour[scene.geometry.reference][seen])


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kind", ["one", "gaps"])
def test_masks(name, kind):
    this, rng = case(name), np.random.default_rng(9)
    labels = random_labels(this, kind)
    posterior = rng.integers(0, 255, this.scene.dynamic.shape).astype(np.uint8)
    posterior[rng.random(posterior.shape) < 0.5] = UNCHANGED
    for d in (this.random_disparity, np.zeros(this.shape, np.float32), np.round(this.random_disparity / 20) * 20):
        arguments = (labels, posterior, this.geometry, d, this.wanted, this.scene.dynamic, this.static)
        before = [np.copy(a) for a in arguments if isinstance(a, np.ndarray)]
        assert_same(backend.masks(*arguments) for backend in BACKENDS)
        after = [a for a in arguments if isinstance(a, np.ndarray)]
        assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


# ------------------------------------------------------------------------------------------------------- threads


def everything(scene: Scene) -> list[np.ndarray]:
    """All arrays that all stages of the cpu backend yield."""
    this = Case(scene)
    points = this.support(cpu)
    prior = this.prior_of(cpu, points)
    d = this.disparity(cpu, prior)
    labels, posterior = this.segmentation(cpu, d, **{"segmentation.beta": 0.01})
    refined = cpu.masks(labels, posterior, this.geometry, d, this.wanted, scene.dynamic, this.static)
    picture = cpu.refocus(scene.colour, labels, this.geometry, d, this.static[0], OPTIONS.refocus)
    return [this.features[cpu].gradients, points, prior.mean, prior.cells, d, labels, posterior, *refined, *picture]


@pytest.mark.parametrize("make", [lambda: make_scene(5, (96, 64), masks="soft", residual=True), SCENES["noise"]])
def test_threads_change_nothing(make):
    scene = make()
    try:
        runs = []
        for threads in (1, 2, 3):
            cpu.set_threads(threads)
            runs += [everything(scene), everything(scene)]
    finally:
        cpu.set_threads(0)
    for other in runs[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(runs[0], other, strict=True))
