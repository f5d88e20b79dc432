"""What the method promises, on small cases that can be checked by hand (reference backend)."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from arrays import FAR, NEAR, Scene, array, make_scene, slanted, unwarped
from seepast import Options
from seepast.backends import get, reference
from seepast.candidates import DisparityGrid, Prior, prior_energy
from seepast.evidence import UNCHANGED
from seepast.frames import Frame
from seepast.geometry import ArrayGeometry
from seepast.pipeline import Clock, see_past

OPTIONS = Options.preset("paper").updated({"range.max_disparity": 60})
# (dy, dx) of the 12 horizontal and the 4 vertical samples, drawn as they lie around the pixel
DU = ("..1..", "1.1.1", ".121.", "1.1.1", "..1..")
DV = (".....", "..1..", ".1.1.", "..1..", ".....")


def pattern(drawing: tuple[str, ...]) -> list[tuple[int, int]]:
    return [
        (y - 2, x - 2)
        for y, line in enumerate(drawing)
        for x, mark in enumerate(line)
        for _ in range(int(mark) if mark != "." else 0)
    ]


def descriptor(gradients: np.ndarray, x: int, y: int) -> np.ndarray:
    """16 samples of one camera's [2, H, W] around whole pixel (x, y), edges continued: float64."""
    padded = np.pad(gradients.astype(float), ((0, 0), (2, 2), (2, 2)), mode="edge")
    return np.array([padded[g, y + 2 + dy, x + 2 + dx] for g, p in enumerate((DU, DV)) for dy, dx in pattern(p)])


def variance(samples: list[np.ndarray]) -> float:
    """The paper's: sum over the descriptor of the mean squared distance from the mean."""
    stack = np.array(samples)
    return float(((stack - stack.mean(0)) ** 2).mean(0).sum())


def random_gradients(cameras: int, size: tuple[int, int], seed: int = 0, most: int = 127) -> np.ndarray:
    return np.random.default_rng(seed).integers(-most, most + 1, (cameras, 2, size[1], size[0]), dtype=np.int8)


# ------------------------------------------------------------------------------------------- the paper's formulas


def test_descriptor_samples_where_the_drawing_says():
    assert [len(pattern(DU)), len(pattern(DV))] == [12, 4]
    gradients = random_gradients(1, (13, 11))[0]
    for x, y in ((6, 5), (0, 0), (12, 3), (7, 10)):
        found = reference.descriptor(gradients, np.array(4 * x), np.array(y))
        assert sorted(found) == sorted(descriptor(gradients, x, y))


def test_descriptor_between_pixels_is_their_mixture():
    gradients = random_gradients(1, (13, 11))[0]
    near, far = descriptor(gradients, 5, 5), descriptor(gradients, 6, 5)
    order = [reference.descriptor(gradients, np.array(4 * x), np.array(5)) for x in (5, 6)]
    found = reference.descriptor(gradients, np.array(4 * 5 + 1), np.array(5))
    assert np.abs(found - (0.75 * order[0] + 0.25 * order[1])).max() <= 0.5
    assert sorted(order[0]) == sorted(near)
    assert sorted(order[1]) == sorted(far)


@pytest.mark.parametrize("cameras", [2, 3, 5, 9])
def test_variance_by_pairs_is_the_variance_about_the_mean(cameras):
    """Var_S = sum_{i<j} |f_i - f_j|^2 / n^2, in all three places that compute it."""
    gradients, geometry = random_gradients(cameras, (17, 15)), array(cameras, (17, 15))
    static = np.ones((cameras, 15, 17), bool)
    x, y = 8, 7
    true = variance([descriptor(g, x, y) for g in gradients])
    whole, n = reference.variance_map(gradients, static, geometry, 0.0)
    assert n[y, x] == cameras
    assert true - 16 < whole[y, x] <= true * 1.0001  # every sample's share is cut to whole grey levels^2
    at = np.array([x]), np.array([y])
    assert reference.ray_variance(gradients, static, geometry, *at, np.float32(0)) == pytest.approx([true], rel=1e-5)
    f = [reference.descriptor(g, np.array([[4 * x]]), np.array([[y]])) for g in gradients]
    exists, p = [np.ones((1, 1), bool)] * cameras, [np.full((1, 1), 127, np.uint8)] * cameras
    energies = reference.label_energies(f, exists, p, OPTIONS)[0, 0]
    everything = (1 << cameras) - 1
    no_variance = energies[0] - 1024 * OPTIONS.segmentation.beta * OPTIONS.disparity.lone_variance
    expected = 1024 * OPTIONS.segmentation.beta * true
    assert energies[everything] - no_variance == pytest.approx(expected, abs=1.01 * cameras)


def test_variance_leaves_out_what_is_not_static():
    """Three rays, one of a person: the variance is that of the other two, also where the pattern reaches over."""
    gradients, geometry = random_gradients(3, (17, 15), most=60), array(3, (17, 15))
    gradients[1] = gradients[0]
    static = np.ones((3, 15, 17), bool)
    static[2, :, 8:] = False
    found, n = reference.variance_map(gradients, static, geometry, 0.0)
    assert (n[:, 8:] == 2).all()
    assert (n[:, :8] == 3).all()
    assert (found[:, 10:] == 0).all()  # the two agree
    assert (found[3:-3, 2:8] > 0).all()
    static[1:] = False
    found, n = reference.variance_map(gradients, static, geometry, 0.0)
    assert (n == 1).all()


@pytest.mark.parametrize("reference_", [0, 1, 3])
def test_rays_end_where_the_array_sees_the_surface(reference_):
    """W_k undoes the renderer's way from camera pixels to reference pixels; the stages' rays are the same warp."""
    geometry = array(4, (60, 40), reference=reference_, residual=True)
    v, u = np.mgrid[:40, :60]
    surface = slanted(geometry)
    for k in range(4):
        x, y = unwarped(geometry, k, surface)
        found = geometry.warp(k, x, y, surface(x, y))
        assert np.abs(found[0] - u).max() < 1e-3
        assert np.abs(found[1] - v).max() < 1e-3
        dx, dy = reference.ray_offsets(geometry, k, x, y, surface(x, y))
        assert np.abs(x + dx - u).max() < 1e-3
        assert np.abs(y + dy - v).max() < 1e-3

        (fx, fy), (cx, cy), (bx, by, bz) = geometry.focal, geometry.center, geometry.positions[k]
        depth = fx * geometry.baseline / surface(x, y)  # and the same by projecting points in metres
        right, down = (x - cx) / fx * depth, (y - cy) / fy * depth
        assert np.abs(fx * (right - bx) / (depth - bz) + cx + geometry.shifts[k, 0] - u).max() < 1e-3
        assert np.abs(fy * (down - by) / (depth - bz) + cy + geometry.shifts[k, 1] - v).max() < 1e-3
    assert np.ptp(geometry.shifts) > 1
    assert np.ptp(geometry.positions[:, 2]) > 0.01
    assert geometry.focal[0] != geometry.focal[1]


@pytest.mark.parametrize("gamma, sigma", [(0.005, 2.0), (0.3, 0.5), (1e-6, 8.0)])
def test_prior_energy_is_the_formula(gamma, sigma):
    table = prior_energy(OPTIONS.updated({"prior.gamma": gamma, "prior.sigma": sigma}).prior)
    for eighths in (0, 1, 5, 8, 16, 23, 4 * int(8 * sigma)):
        t = eighths / 8
        expected = -math.log(gamma + math.exp(-t * t / (2 * sigma**2)))
        assert table[min(eighths, len(table) - 1)] == pytest.approx(expected, abs=1e-4)
    assert table[-1] == pytest.approx(-math.log(gamma))
    assert abs(table[-2] - table[-1]) < 0.02  # no step into the tail
    assert (np.diff(table) >= -1e-6).all()


def test_plane_means_interpolate_and_do_not_bridge_edges():
    points = np.array([(0, 0, 10), (20, 0, 14), (0, 20, 10), (20, 20, 14)], np.float32)
    grid = DisparityGrid.of(OPTIONS.range, 21)
    flat = reference.prior(points, (21, 21), grid, OPTIONS.prior)
    expected = np.floor(8 * (10 + 4 * np.arange(21) / 20) + 0.5)
    assert (flat.mean == expected).all()
    points[:, 2] = (10, 30, 10, 30)
    edge = reference.prior(points, (21, 21), grid, OPTIONS.prior)
    assert set(np.unique(edge.mean)) == {80, 240}
    assert edge.mean[0, 3] == 80
    assert edge.mean[0, 17] == 240


def test_cells_hold_the_disparities_of_their_neighbourhood():
    grid = DisparityGrid.of(OPTIONS.range, 200)
    points = np.array([(40, 20, 30)], np.float32)  # cell row 1, column 1 of 4 x 5
    cells = reference.prior(points, (60, 150), grid, OPTIONS.prior).cells
    assert cells.shape == (4, 5, grid.count)
    near = np.abs(grid.values - 30) <= OPTIONS.prior.neighbour_radius
    assert (cells[:3, :3] == near).all()
    assert not cells[3].any()
    assert not cells[:, 3:].any()


# ------------------------------------------------------------------------------------------------ M-step, E-step

SIZE = (31, 15)  # width, height
STRAIGHT = ArrayGeometry((100.0, 100.0), (15.0, 7.0), SIZE, np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]))
WHOLE = DisparityGrid(0, 16, 6)  # 0, 2 .. 10 px: 0, 1 .. 5 px from camera to camera
M_STEP = OPTIONS.updated({"disparity.beta": 0.0005, "prior.sigma": 3.0})


def hand_energy(gradients: np.ndarray, static: np.ndarray, mu: float, x: int, y: int, d: float) -> float:
    """E(d) with the formulas of the paper, at a pixel whose rays' surroundings are all static or not at all."""
    rays = [(k, x - int(k * d / 2)) for k in range(3)]
    seen = [descriptor(gradients[k], u, y) for k, u in rays if 0 <= u < SIZE[0] and static[k, y, u]]
    few = M_STEP.disparity.lone_variance if seen else M_STEP.disparity.unseen_variance
    var = variance(seen) if len(seen) > 1 else few
    gamma, sigma = M_STEP.prior.gamma, M_STEP.prior.sigma
    return M_STEP.disparity.beta * var - math.log(gamma + math.exp(-((d - mu) ** 2) / (2 * sigma**2)))


@pytest.mark.parametrize("hidden", [(), (0,), (1, 2), (0, 1, 2)], ids=str)
def test_disparity_is_the_cheapest_candidate(hidden):
    gradients = random_gradients(3, SIZE, seed=3, most=60)
    static = np.ones((3, *SIZE[::-1]), bool)
    static[list(hidden)] = False
    prior = Prior(np.full(SIZE[::-1], 8 * 5, np.int32), np.ones((1, 1, WHOLE.count), np.uint8))
    found = reference.disparity(gradients, static, STRAIGHT, prior, WHOLE, np.ones(SIZE[::-1], bool), M_STEP)
    decided = 0
    for x, y in itertools.product(range(14, 28), range(3, 12)):  # here all rays' surroundings are inside
        energies = [hand_energy(gradients, static, 5.0, x, y, d) for d in WHOLE.values]
        lowest, second = sorted(energies)[:2]
        if second - lowest > 16.1 * M_STEP.disparity.beta:
            assert found[y, x] == WHOLE.values[int(np.argmin(energies))]
            decided += 1
    assert decided > 100 or len(hidden) > 1
    if len(hidden) > 1:  # nothing to match: 4 and 6 px are equally near mu = 5, the farther wins
        assert (found[3:12, 14:28] == 4).all()


def test_only_candidates_compete():
    """Near the prior's mean, or near a support point of the cells around: nothing else, however well it matches."""
    gradients = random_gradients(3, SIZE)
    gradients[1, :, :, :-1], gradients[2, :, :, :-2] = gradients[0, :, :, 1:], gradients[0, :, :, 2:]  # all at d = 2
    static, wanted = np.ones((3, *SIZE[::-1]), bool), np.ones(SIZE[::-1], bool)
    options = M_STEP.updated({"prior.radius": 2, "disparity.beta": 10})
    cells = np.zeros((1, 1, WHOLE.count), np.uint8)
    mean = np.full(SIZE[::-1], 8 * 8, np.int32)
    inner = (slice(3, 12), slice(10, 26))
    found = reference.disparity(gradients, static, STRAIGHT, Prior(mean, cells), WHOLE, wanted, options)
    assert set(np.unique(found[inner])) <= {6, 8, 10}
    cells[0, 0, 1] = 1
    found = reference.disparity(gradients, static, STRAIGHT, Prior(mean, cells), WHOLE, wanted, options)
    assert (found[inner] == 2).all()


def test_few_rays_do_not_win_by_being_few():
    """A good match of three beats every disparity at which only one ray, or none, is static."""
    gradients = random_gradients(3, SIZE)
    gradients[1, :, :, :-1], gradients[2, :, :, :-2] = gradients[0, :, :, 1:], gradients[0, :, :, 2:]
    gradients[1:] = np.clip(gradients[1:] + np.random.default_rng(1).integers(-4, 5, gradients[1:].shape), -127, 127)
    static = np.ones((3, *SIZE[::-1]), bool)
    static[1:, :, :10] = False  # rays of x = 16 .. 19 at d > 10 and more meet the person in cameras 1 and 2
    grid = DisparityGrid(0, 16, 12)
    flat = Prior(np.full(SIZE[::-1], 0, np.int32), np.ones((1, 1, grid.count), np.uint8))
    options = M_STEP.updated({"prior.gamma": 100})  # so flat that the prior says nothing
    found = reference.disparity(gradients, static, STRAIGHT, flat, grid, np.ones(SIZE[::-1], bool), options)
    assert (found[3:12, 15:26] == 2).all()


def test_a_lone_ray_leaves_it_to_the_prior():
    scene = make_scene(3, (60, 40))
    static = np.zeros((3, 40, 60), bool)
    static[0] = True
    grid = DisparityGrid.of(OPTIONS.range, 60)
    mean = np.random.default_rng(0).integers(0, grid.count, (40, 60)).astype(np.int32) * grid.step
    prior = Prior(mean, np.zeros((3, 2, grid.count), np.uint8))
    features, wanted = reference.describe(scene.grey), np.ones((40, 60), bool)
    found = reference.disparity(features, static, scene.geometry, prior, grid, wanted, OPTIONS)
    assert np.array_equal(found, mean / np.float32(8))


def hand_labels(rays: list[tuple[np.ndarray, int] | None], options: Options) -> list[tuple[float, int]]:
    """(energy in nats, label number) of all label sets, cheapest first; rays are (descriptor, 254ths) or missing."""
    s, out = options.segmentation, []
    for labels in itertools.product((0, 1), repeat=len(rays)):
        energy, used = 0.0, []
        for label, ray in zip(labels, rays, strict=True):
            if ray is None:
                energy += math.inf if label else 0
                continue
            dynamic = min(max(ray[1] / 254, s.floor), 1 - s.floor)
            energy -= math.log(1 - dynamic) if label else math.log(dynamic) - s.outlier_cost
            used += [ray[0]] if label else []
        energy += s.beta * (variance(used) if len(used) > 1 else options.disparity.lone_variance)
        out.append((energy, sum(label << k for k, label in enumerate(labels))))
    return sorted(out)


@pytest.mark.parametrize("beta, outlier_cost", [(0.0001, 0.0), (0.001, 1.5), (0.00002, 0.0)])
def test_segmentation_is_the_cheapest_label_set(beta, outlier_cost):
    """And the posterior of a flipped ray is the odds of the energies with and without it."""
    rng = np.random.default_rng(5)
    gradients = random_gradients(3, SIZE, seed=5)
    dynamic = rng.integers(0, 256, (3, *SIZE[::-1])).astype(np.uint8)
    d = rng.choice(WHOLE.values, SIZE[::-1]).astype(np.float32)
    options = OPTIONS.updated({"segmentation.beta": beta, "segmentation.outlier_cost": outlier_cost})
    everywhere = np.ones(SIZE[::-1], bool)
    labels, posterior = reference.segmentation(gradients, dynamic, STRAIGHT, d, everywhere, options)
    flips = 0
    for x, y in itertools.product(range(SIZE[0]), range(SIZE[1])):
        rays: list[tuple[np.ndarray, int] | None] = []
        for k in range(3):
            u = x - int(k * d[y, x] / 2)
            gone = not 0 <= u < SIZE[0] or dynamic[k, y, u] == 255
            rays.append(None if gone else (descriptor(gradients[k], u, y), int(dynamic[k, y, u])))
        ranked = hand_labels(rays, options)
        if ranked[1][0] - ranked[0][0] < 0.005:  # costs are kept in 1024ths of a nat
            continue
        assert labels[y, x] == ranked[0][1]
        energy, label = {number: e for e, number in ranked}, int(labels[y, x])
        for k, ray in enumerate(rays):
            static = label >> k & 1
            if ray is None or static == (ray[1] < 127):
                assert posterior[k, y, x] == UNCHANGED
                continue
            gain = energy[label & ~(1 << k)] - energy[label | 1 << k]
            assert posterior[k, y, x] / 254 == pytest.approx(1 / (1 + math.exp(min(gain, 50))), abs=0.02)
            flips += 1
    assert flips > 20


def test_segmentation_calls_out_the_ray_that_differs():
    """All masks unsure: four rays agree and the fifth does not: it alone turns dynamic."""
    geometry = array(5, (40, 24))
    gradients = np.repeat(random_gradients(1, (40, 24)), 5, axis=0)
    gradients[3] = random_gradients(1, (40, 24), seed=9)[0]
    dynamic = np.full((5, 24, 40), 120, np.uint8)
    d, everywhere = np.zeros((24, 40), np.float32), np.ones((24, 40), bool)
    labels, posterior = reference.segmentation(gradients, dynamic, geometry, d, everywhere, OPTIONS)
    assert (labels == 0b10111).mean() > 0.95
    refined, static = reference.masks(labels, posterior, geometry, d, everywhere, dynamic, dynamic < 127)
    assert static[[0, 1, 2, 4]].mean() > 0.95
    assert static[3].mean() < 0.05
    assert (refined[3] > 200).mean() > 0.95
    assert (refined[[0, 1, 2, 4]] == 120).mean() > 0.95  # label and prior agree there: nothing to refine


# ------------------------------------------------------------------------------------------------ masks, refocus


def test_the_nearest_surface_speaks_for_a_pixel():
    """Pixels 10 (near, static) and 6 (far; this ray an outlier) meet in camera 2's pixel 4: static it stays."""
    d = np.zeros(SIZE[::-1], np.float32)
    d[7, 10], d[7, 6] = 6, 2
    wanted = d > 0
    labels, posterior = np.full(d.shape, 0b111, np.uint16), np.full((3, *d.shape), UNCHANGED, np.uint8)
    labels[7, 6], posterior[2, 7, 6] = 0b011, 250
    prior = np.zeros((3, *d.shape), np.uint8)
    for flipped in (False, True):
        dynamic, static = reference.masks(labels, posterior, STRAIGHT, d, wanted, prior, prior < 77)
        assert static.sum() == static.size - flipped
        assert dynamic[2, 7, 4] == (250 if flipped else 0)
        assert (dynamic > 0).sum() == flipped
        d[7, 10], d[7, 6] = 0, 2  # without the near one, the far one speaks
        wanted = d > 0


def test_masks_keep_what_nobody_explains():
    prior = np.random.default_rng(0).integers(0, 256, (3, *SIZE[::-1])).astype(np.uint8)
    nobody, d = np.zeros(SIZE[::-1], bool), np.zeros(SIZE[::-1], np.float32)
    posterior = np.zeros_like(prior)
    dynamic, static = reference.masks(np.zeros(d.shape, np.uint16), posterior, STRAIGHT, d, nobody, prior, prior < 77)
    assert np.array_equal(dynamic, prior)
    assert np.array_equal(static, prior < 77)
    dynamic, _ = reference.masks(np.zeros(d.shape, np.uint16), posterior, STRAIGHT, d, ~nobody, prior, prior < 77)
    assert np.array_equal(dynamic == 255, prior == 255)  # no ray: nothing to refine


def test_refocus_averages_the_static_rays():
    colour = np.random.default_rng(0).integers(0, 256, (3, *SIZE[::-1], 3)).astype(np.uint8)
    d, labels = np.full(SIZE[::-1], 5, np.float32), np.full(SIZE[::-1], 0b111, np.uint16)  # 2.5 px to the next camera
    labels[:, 20:] = 0b101
    options = OPTIONS.updated({"refocus.median": False}).refocus
    picture, coverage = reference.refocus(colour, labels, STRAIGHT, d, np.zeros(d.shape, bool), options)
    a, b, c = colour.astype(float)
    between = (b[7, 12] + b[7, 13]) / 2  # x = 15 is seen by camera 1 at 12.5, by camera 2 at 10
    assert picture[7, 15] == pytest.approx((a[7, 15] + between + c[7, 10]) / 3, abs=0.51)
    assert picture[7, 25] == pytest.approx((a[7, 25] + c[7, 20]) / 2, abs=0.51)
    assert (coverage[:, :20] == 3).all()
    assert (coverage[:, 20:] == 2).all()


def test_the_fill_continues_the_background_and_is_flagged():
    """One unseen pixel, its four neighbours one, one, two and two px away: weights 1, 1, 1/4, 1/4."""
    colour = np.zeros((3, *SIZE[::-1], 1), np.uint8)
    labels, d = np.ones(SIZE[::-1], np.uint16), np.full(SIZE[::-1], 4, np.float32)
    labels[6:9, 10] = 0
    colour[0, 7, 9], colour[0, 7, 11], colour[0, 5, 10], colour[0, 9, 10] = 100, 50, 200, 20
    options = OPTIONS.updated({"refocus.median": False}).refocus
    keep = np.zeros(d.shape, bool)
    picture, coverage = reference.refocus(colour, labels, STRAIGHT, d, keep, options)
    assert picture[7, 10, 0] == round((100 + 50 + 200 / 4 + 20 / 4) / 2.5)
    assert np.array_equal(coverage == 0, labels == 0)
    d[7, 9] = 7  # now the 100 is foreground, and hardly counts
    picture, _ = reference.refocus(colour, labels, STRAIGHT, d, keep, options)
    assert picture[7, 10, 0] == round((1 + 50 + 200 / 4 + 20 / 4) / 1.51)


# ------------------------------------------------------------------------------------------------- whole scenes


def solved(scene: Scene, *, dynamic_only: bool = False, backend: str = "cpu", **changed) -> dict[str, np.ndarray]:
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    options = OPTIONS.updated(changed)
    found, _ = see_past(frame, scene.geometry, options, get(backend), dynamic_only, Clock())
    return found


def wrong(scene: Scene, found: dict[str, np.ndarray], where: np.ndarray) -> float:
    """Share of pixels whose disparity is off by more than 1 px."""
    return float((np.abs(found["disparity"] - scene.disparity)[where] > 1).mean())


def off(scene: Scene, found: dict[str, np.ndarray], where: np.ndarray) -> float:
    """Mean error of the picture, grey levels."""
    background = scene.background.reshape(found["background"].shape)
    return float(np.abs(found["background"].astype(float) - background)[where].mean())


WORLDS = {
    "plane": {},
    "slanted": {"surface": "slanted"},
    "last": {"reference": 4},
    "middle, residual": {"reference": 2, "residual": True},
    "two cameras": {"cameras": 2},
    "sixteen cameras": {"cameras": 16, "residual": True},
    "soft masks": {"masks": "soft"},
    "noise": {"noise": 3.0, "residual": True, "colour": True},
}


@pytest.mark.parametrize("world", WORLDS)
def test_the_background_behind_a_person_is_recovered(world):
    scene = make_scene(**WORLDS[world])
    found = solved(scene)
    hidden = scene.person[scene.geometry.reference]
    assert hidden.sum() > 300
    seen = hidden & (scene.seen_by() > 0)
    assert seen.mean() > 0.05
    assert wrong(scene, found, seen) < 0.02
    assert wrong(scene, found, ~hidden) < 0.02
    assert off(scene, found, seen) < 12  # the median alone costs a random texture 7 to 9
    assert np.array_equal(found["coverage"] == 0, found["labels"] == 0)
    assert (found["coverage"][seen] > 0).all()


def test_the_reference_backend_recovers_it_too():
    scene = make_scene(3, (73, 51))
    found = solved(scene, backend="reference")
    hidden = scene.person[0]
    assert wrong(scene, found, hidden) < 0.02
    assert off(scene, found, hidden) < 12


def test_without_the_median_the_picture_is_the_texture():
    scene = make_scene()
    found = solved(scene, **{"refocus.median": False})
    assert off(scene, found, scene.person[0]) < 1


def test_what_no_camera_sees_is_flagged():
    """A wide person close to the wall: in the middle of the hidden part no camera sees the background."""
    scene = make_scene(3)
    wide = scene.dynamic.copy()
    for k in range(3):
        shift = round((NEAR - 20) * float(scene.geometry.offsets[k, 0]))  # the mask of something at d = 20
        wide[k] = 0
        wide[k, 16:48, 38 - shift // 8 - 10 * k : 70 - 10 * k] = 254
    person = wide == 254
    scene = Scene(scene.geometry, scene.views, wide, person, scene.disparity, scene.background)
    found = solved(scene)
    unseen = scene.seen_by() == 0
    assert unseen.sum() > 100
    flagged = found["coverage"] == 0
    assert np.array_equal(flagged, found["labels"] == 0)
    assert (flagged & unseen).sum() / (flagged | unseen).sum() > 0.9


def test_masks_all_dynamic_show_nothing_and_say_so():
    found = solved(make_scene(3, masks="all"))
    assert not found["coverage"].any()
    assert not found["labels"].any()
    assert (found["dynamic"] == 254).all()


def test_a_static_thing_in_front_is_no_person():
    """Camera 4's rays to the wall that a static thing hides differ from the others, and yet must not turn dynamic."""
    for unsure in (0, 40):
        scene = make_scene(surface="step", person=False, masks="none")
        scene.dynamic[:] = unsure
        found = solved(scene)
        hides = found["labels"] & 0b11111 != 0b11111
        assert hides.sum() > (unsure > 0) * 50
        assert (found["dynamic"][4] >= 127).mean() < 0.004, unsure


@pytest.mark.parametrize("camera", [1, 4])
def test_a_camera_without_a_mask_learns_it_from_the_others(camera):
    scene = make_scene()
    scene.dynamic[camera] = 110
    dynamic = solved(scene, **{"segmentation.threshold": 0.5})["dynamic"]
    person = scene.person[camera]
    assert (dynamic[camera] >= 127)[person].mean() > 0.9
    assert (dynamic[camera] >= 127)[~person].mean() < 0.1
    others = [k for k in range(5) if k != camera]
    assert (dynamic[others] != scene.dynamic[others]).mean() < 0.01


# ------------------------------------------------------------------------------------------------- dynamic only


@pytest.mark.parametrize("world", ["plane", "middle, residual", "soft masks", "two cameras", "noise"])
def test_dynamic_only_keeps_the_rest_as_it_is(world):
    scene = make_scene(**WORLDS[world])
    found, reference_ = solved(scene, dynamic_only=True), scene.geometry.reference
    kept = found["disparity"] == 0
    assert (scene.dynamic[reference_][kept] <= 127).mean() > 0.9
    assert (found["coverage"][kept] == 1).all()
    assert (found["labels"][kept] == 1 << reference_).all()
    assert np.array_equal(found["background"][kept], scene.colour[reference_][kept])
    assert kept[scene.dynamic[reference_] == 0].all()


@pytest.mark.parametrize("world", ["plane", "middle, residual", "soft masks", "noise"])
def test_dynamic_only_finds_the_same_behind_people(world):
    """One round without medians is the full frame's, bit for bit; with them and more rounds, nearly."""
    scene = make_scene(**WORLDS[world])
    hidden = scene.dynamic[scene.geometry.reference] > 76
    bare = {"segmentation.max_rounds": 1, "disparity.median_passes": 0}
    full, only = solved(scene, **bare), solved(scene, dynamic_only=True, **bare)
    for name in ("disparity", "labels", "coverage", "background"):
        assert np.array_equal(full[name][hidden], only[name][hidden]), name
    full, only = solved(scene), solved(scene, dynamic_only=True)
    both = hidden & (only["disparity"] > 0)
    assert both.sum() > 0.75 * hidden.sum()
    assert (np.abs(full["disparity"] - only["disparity"])[both] > 1).mean() < 0.02
    assert (full["labels"] == only["labels"])[both].mean() > 0.9
    assert np.abs(full["background"].astype(float) - only["background"])[both].mean() < 2


def test_farther_is_smaller():
    assert FAR < NEAR
    geometry = array(3, (60, 40))
    assert geometry.depth(np.float32(FAR)) > geometry.depth(np.float32(NEAR))
