"""Every stage of the cuda backend, run on the CPU, against the NumPy reference: bit for bit, from the same input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arrays import Scene, make_scene, noise_scene
from cuda_on_cpu import EmulatedDevice, StrictDevice
from seepast import confidence
from seepast.backends import cpu, cuda, reference
from seepast.candidates import DisparityGrid, Prior
from seepast.evidence import UNCHANGED
from seepast.frames import Frame
from seepast.gpu import device
from seepast.gpu.morphology import dilated, eroded
from seepast.pipeline import Clock, see_past
from seepast.rectify import NO_RAY
from test_stages import OPTIONS, SCENES, SMALL, Case, assert_same, case, random_labels

every_scene = pytest.mark.parametrize("name", SCENES)


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


def features_of(this: Case) -> cuda.Features:
    if cuda not in this.features:
        this.features[cuda] = cuda.describe(this.scene.grey)
    return this.features[cuda]


def both(found) -> None:
    """`found(backend)` of the reference and of cuda are the same."""
    assert_same([found(reference), found(cuda)])


# ------------------------------------------------------------------------------------ describe, support, prior


@every_scene
def test_describe(name):
    found = cuda.describe(case(name).scene.grey)
    assert_same([case(name).features[reference], np.moveaxis(found.gradients, -1, 1)])
    assert_same([cpu.describe(case(name).scene.grey).descriptors, found.descriptors])


def test_describe_clips_the_steepest_edges():
    grey = np.zeros((2, 9, 71), np.uint8)
    grey[0, :, 35:] = 255
    grey[1, 4:] = 255
    for image in (grey, 255 - grey):
        assert_same([reference.describe(image), np.moveaxis(cuda.describe(image).gradients, -1, 1)])


@pytest.mark.parametrize("reach", [0, 1, 3, 4, 15, 16, 17, 64])
@pytest.mark.parametrize("shape", [(2, 75, 83), (1, 1, 40), (3, 33, 1)])
def test_morphology(reach, shape):
    masks = np.random.default_rng(reach).random(shape) < 1 / (1 + reach) ** 2
    padded = np.pad(masks, ((0, 0), (reach, reach), (reach, reach)))
    near = np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1,) * 2, axis=(1, 2)).any((-2, -1))
    before = masks.copy()
    assert_same([near, dilated(masks, reach)])
    assert_same([~near, eroded(~masks, reach)])
    assert np.array_equal(masks, before)


@pytest.mark.parametrize("share", [0, 0.0002, 0.01, 1])
def test_neighbourhood(share):
    wanted = np.random.default_rng(0).random((171, 190)) < share
    both(lambda backend: backend.neighbourhood(wanted))


@every_scene
def test_support(name):
    features_of(case(name))
    assert_same([case(name).points, case(name).support(cuda)])


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
    features_of(case(name))
    both(lambda backend: case(name).support(backend, **changed))


def test_support_on_a_grid_of_more_candidates_than_lanes():
    this = Case(make_scene(2, (150, 40)))
    this.grid = DisparityGrid.of(OPTIONS.updated({"range.max_disparity": 100, "range.step": 0.125}).range, 150)
    features_of(this)
    both(this.support)
    assert len(this.support(cuda)) > 20


@pytest.mark.parametrize("period", [31, 32, 33, 64])
def test_support_on_a_pattern_that_comes_again(period):
    """As far away as a warp has lanes, so that one lane has the match and its rival."""
    scene = make_scene(2, (150, 40), masks="none")
    row = np.random.default_rng(period).integers(0, 256, (40, period), np.uint8)
    for k in range(2):
        scene.views[k] = np.roll(np.tile(row, (1, 6)), -12 * k, axis=1)[:, :150]
    this = Case(scene)
    this.grid = DisparityGrid.of(OPTIONS.updated({"range.max_disparity": 100}).range, 150)
    features_of(this)
    both(lambda backend: this.support(backend, **{"support.min_agreeing": 0}))


def test_support_of_an_array_far_off_its_line():
    """Rays of other cameras cross many of the reference's rows: where they end cannot be told from one."""
    scene = noise_scene(3, (61, 55))
    crooked = scene.geometry.positions * (1, 40, 1)
    scene.dynamic[:] = 0
    scene.dynamic[0, 40:] = 254
    this = Case(replace(scene, geometry=replace(scene.geometry, positions=crooked)))
    features_of(this)
    permissive = {"support.uniqueness": 1.0, "support.max_cost": 255, "support.left_right": 16}
    changed = {**permissive, "support.texture": 0, "support.min_agreeing": 0, "support.grid": 2}
    both(lambda backend: this.support(backend, **changed))
    assert (this.support(cuda, **changed)[:, 1] >= 40).sum() >= 10


@pytest.mark.parametrize("share", [0, 0.02, 1])
def test_support_near_what_is_wanted(share):
    this = case("5, step")
    near = np.random.default_rng(2).random(this.shape) < share
    features_of(this)
    both(
        lambda backend: backend.support(
            this.features[backend], this.static, this.geometry, this.grid, OPTIONS.support, near
        )
    )


@every_scene
def test_prior(name):
    def found(backend):
        prior = case(name).prior_of(backend, case(name).points)
        return prior.mean, prior.cells

    both(found)


@pytest.mark.parametrize("points", [0, 1, 2, 3, 40])
@pytest.mark.parametrize("max_step", [0, 8, 4096])
def test_prior_of_scattered_points(points, max_step):
    """Steep triangles, slivers, points in a row, disparities beyond the grid."""
    rng, this = np.random.default_rng(points), case("5, last, no-ray borders")
    height, width = this.shape
    places = rng.permutation(height * width)[:points]
    scattered = np.column_stack([places % width, places // width, rng.uniform(-3, 70, points)]).astype(np.float32)

    def found(backend):
        prior = this.prior_of(backend, scattered, **{"prior.max_step": max_step, "prior.neighbour_radius": 2.0})
        return prior.mean, prior.cells

    both(found)


def test_prior_of_points_that_leave_rows_and_columns_bare(monkeypatch):
    """No triangle reaches the borders: rows are filled along themselves, then the others from above and below."""
    for module in (reference, cuda):
        monkeypatch.setattr(module, "with_corners", lambda points, shape: points)
    points = np.array([(20, 9, 5), (61, 13, 30), (33, 27, 12)], np.float32)
    this = case("5, step")
    both(lambda backend: this.prior_of(backend, points).mean)


# ----------------------------------------------------------------------------------------------------- disparity


@every_scene
def test_disparity(name):
    features_of(case(name))
    both(case(name).disparity)


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
    features_of(case(name))
    both(lambda backend: case(name).disparity(backend, **changed))


@pytest.mark.parametrize("name", ["3, middle, residual", "16, residual"])
def test_disparity_of_any_prior(name):
    """A prior that jumps from pixel to pixel, beyond the grid too, and cells with any candidates."""
    this, rng = case(name), np.random.default_rng(7)
    mean = rng.integers(-40, 8 * 75, this.shape).astype(np.int32)
    cells = (rng.random(this.prior.cells.shape) < 0.1).astype(np.uint8)
    cells[0, 0] = 0
    features_of(this)
    both(lambda backend: this.disparity(backend, Prior(mean, cells), **{"prior.radius": 2.0}))


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
    features_of(this)
    both(lambda backend: this.disparity(backend, static=static))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 1.0])
def test_disparity_where_wanted(share):
    this = case("5, step")
    wanted = np.random.default_rng(2).random(this.shape) < share
    features_of(this)
    both(lambda backend: this.disparity(backend, wanted=wanted))


def test_disparity_on_a_grid_that_starts_late_and_steps_far():
    this = case("3, middle, residual")
    options = OPTIONS.updated({"range.min_disparity": 5.3, "range.max_disparity": 31, "range.step": 0.375})
    grid = DisparityGrid.of(options.range, 75)
    features_of(this)

    def found(backend):
        prior = backend.prior(this.points, this.shape, grid, options.prior)
        features = this.features[backend]
        return backend.disparity(features, this.static, this.geometry, prior, grid, this.wanted, options)

    both(found)


@pytest.mark.parametrize("passes", [0, 1, 5])
@pytest.mark.parametrize("name", ["5, step", "textureless", "one row", "one column"])
def test_smooth(name, passes):
    this, options = case(name), OPTIONS.updated({"disparity.median_passes": passes}).disparity
    before = this.random_disparity.copy()
    both(lambda backend: backend.smooth(this.random_disparity, this.prior, this.wanted, options))
    assert np.array_equal(this.random_disparity, before)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.02, 1.0])
@every_scene
def test_affected(name, share):
    this = case(name)
    changed = np.random.default_rng(11).random(this.static.shape) < share
    options = OPTIONS.updated({"prior.radius": 2})
    both(lambda backend: backend.affected(changed, this.geometry, this.prior, this.grid, this.wanted, options))


# -------------------------------------------------------------------------------------------------- segmentation


@pytest.mark.parametrize("name", SMALL)
def test_segmentation(name):
    this = case(name)
    d = this.disparity(reference)
    features_of(this)
    both(lambda backend: this.segmentation(backend, d))


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
    this = case(name)
    dynamic = np.random.default_rng(4).integers(0, 256, this.scene.dynamic.shape, np.uint8)
    features_of(this)
    both(lambda backend: this.segmentation(backend, this.random_disparity, dynamic, **changed))


@pytest.mark.parametrize("K, size, beta", [(9, (40, 21), 0.00002), (16, (15, 9), 0.00001), (16, (15, 9), 0.00015)])
def test_segmentation_over_all_sets_of_many_cameras(K, size, beta):
    """Against the cpu backend, which is held to the reference there: that takes its time over 2^16 sets."""
    this = Case(noise_scene(K, size, reference=3, seed=4))
    features_of(this)
    changed = {"segmentation.beta": beta}
    found = [this.segmentation(backend, this.random_disparity / 6, **changed) for backend in (cpu, cuda)]
    assert_same(found)
    if beta < 0.0001:
        assert (found[1][1] != UNCHANGED).mean() > 0.005


@pytest.mark.parametrize("value", [0, 254, NO_RAY])
def test_segmentation_of_masks_of_one_value(value):
    this = case("3, middle, residual")
    features_of(this)
    both(lambda b: this.segmentation(b, this.random_disparity, np.full_like(this.scene.dynamic, value)))


# ------------------------------------------------------------------------------------- masks, refocus, confidence


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
        both(lambda backend, arguments=arguments: backend.masks(*arguments))
        after = [a for a in arguments if isinstance(a, np.ndarray)]
        assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("kind", ["none", "one", "all", "any", "gaps"])
@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
@pytest.mark.parametrize("median", [False, True], ids=["bare", "median"])
@pytest.mark.parametrize("K", [2, 5, 16])
def test_refocus(kind, colour, median, K):
    scene: Scene = make_scene(K, (73, 37), reference=K // 2, residual=True, colour=colour, seed=K)
    this, rng = Case(scene), np.random.default_rng(8)
    labels, options = random_labels(this, kind), OPTIONS.updated({"refocus.median": median}).refocus
    for share in (0.5, 0.0, 1.0):
        keep = rng.random(this.shape) < share
        arguments = scene.colour, labels, this.geometry, this.random_disparity, keep, options
        both(lambda backend, arguments=arguments: backend.refocus(*arguments))


def test_fill_unseen():
    this, rng = case("5, step"), np.random.default_rng(3)
    background = rng.integers(0, 256, (*this.shape, 3), np.uint8)
    coverage = (rng.random(this.shape) < 0.1).astype(np.uint8)
    coverage[:, 50:] = 0
    before = background.copy()
    both(lambda backend: backend.fill_unseen(background, coverage, this.random_disparity))
    assert np.array_equal(background, before)


@pytest.mark.parametrize("name", ["5, step", "16, residual", "one row", "one column"])
def test_confidence_and_depth(name):
    this = case(name)
    labels, d = random_labels(this, "gaps"), this.random_disparity.copy()
    d[: this.shape[0] // 2] = np.round(d[: this.shape[0] // 2] / 30) + 0.25
    d[0, 0] = -1
    for reference_camera in (0, this.geometry.reference):
        expected = confidence.of_labels(d, labels, reference_camera)
        found = cuda.evidence(d, labels, reference_camera)
        assert_same([expected, found])
        table = confidence.PAPER.table
        assert_same([table[expected], cuda.probability(found, table)])
    assert_same([this.geometry.depth(d), cuda.depth(d, this.geometry)])


def test_flatness_at_every_step():
    """Confidence is for disparities in eighths, but its steps are 32nds."""
    d = np.full((15 * 14, 13), 10, np.float32)
    for i, step in enumerate(n + over for n in confidence.STEPS for over in (0, 1)):
        d[15 * i + 7, 6] += np.float32(step) / 32
    labels = np.ones(d.shape, np.uint16)
    found = cuda.evidence(d, labels, 0)
    assert_same([confidence.of_labels(d, labels, 0), found])
    assert set(found.ravel() & 7) == set(range(8))


def test_download():
    some = np.arange(3)
    found = cuda.download({"one": some, "many": (some, some)})
    assert_same([some, found["one"]])
    assert len(found["many"]) == 2


# --------------------------------------------------------------------------------------------- launches and grids


def test_the_same_result_from_another_grid_of_blocks(emulated, monkeypatch):
    """Few blocks that work off a long list, and many that find it empty."""
    this = case("noise")
    features_of(this)
    changed = {"segmentation.beta": 0.002, "disparity.lone_variance": 1000}
    expected = this.segmentation(cuda, this.random_disparity, **changed)
    monkeypatch.setattr(cuda, "PERSISTENT", 1)
    assert_same([expected, this.segmentation(cuda, this.random_disparity, **changed)])


def test_a_round_takes_few_launches(emulated):
    """What CuPy takes to launch a kernel is a good part of what the kernel takes itself."""
    this = case("5, step")
    features = cuda.describe(this.scene.grey)
    points = cuda.support(features, this.static, this.geometry, this.grid, OPTIONS.support)
    prior = cuda.prior(points, this.shape, this.grid, OPTIONS.prior)
    before_rounds = len(emulated.launches)
    d = cuda.disparity(features, this.static, this.geometry, prior, this.grid, this.wanted, OPTIONS)
    d = cuda.smooth(d, prior, this.wanted, OPTIONS.disparity)
    found = cuda.segmentation(features, this.scene.dynamic, this.geometry, d, this.wanted, OPTIONS)
    cuda.masks(*found, this.geometry, d, this.wanted, this.scene.dynamic, this.static)
    assert before_rounds == 9
    assert len(emulated.launches) - before_rounds == 11


@pytest.mark.parametrize("dynamic_only", [False, True])
@pytest.mark.parametrize("name", ["3, middle, residual", "5, last, no-ray borders", "noise", "all dynamic"])
def test_the_whole_method(name, dynamic_only):
    """All rounds on the GPU, with what lies between the stages."""
    this, used = case(name), StrictDevice()
    views = this.scene.colour, this.scene.grey, this.scene.dynamic
    options = OPTIONS.updated({"segmentation.max_rounds": 4, "segmentation.beta": 0.002})
    expected, rounds = see_past(Frame(*views), this.geometry, options, cpu, dynamic_only, Clock())
    with device.use(used):
        frame = Frame(*(used.upload(view) for view in views))
        found, same = see_past(frame, this.geometry, options, cuda, dynamic_only, Clock())
        found = cuda.download(found)
    assert rounds == same
    assert expected.keys() == found.keys()
    for part in expected:
        assert_same([expected[part], found[part]])
