"""Masks refined from all views: cpu against reference bit for bit, and what the refinement is for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from arrays import FAR, NEAR, Scene, make_scene, noise_scene
from seepast import people
from seepast.backends import cpu_people, reference_people
from seepast.frames import Frame
from seepast.geometry import ArrayGeometry
from seepast.levels import Level
from seepast.many import UNITS
from seepast.options import Options, PeopleOptions
from seepast.rectify import NO_RAY
from seepast.surfaces import Surfaces

OPTIONS = PeopleOptions(working_width=48)  # the small scenes are then looked at by lattices of stride 2 and 1
SMALL = PeopleOptions(working_width=1000, inner=1, window=21, grow=False)


def surfaces_of(scene: Scene) -> np.ndarray:
    """The disparity of the nearest surface in every view of a box before a plane."""
    return np.where(scene.person, np.float32(NEAR), np.float32(FAR)).astype(np.float32)


def frame_of(scene: Scene, dynamic: np.ndarray | None = None) -> Frame:
    return Frame(scene.colour, scene.grey, scene.dynamic if dynamic is None else dynamic)


def random_surfaces(scene: Scene, seed: int = 0) -> np.ndarray:
    """Pieces of constant disparity that hardly agree between views, slanted a little."""
    rng = np.random.default_rng(seed)
    K, height, width = scene.grey.shape
    coarse = rng.uniform(0, 50, (K, height // 8 + 1, width // 8 + 1)).astype(np.float32)
    pieces = coarse.repeat(8, 1).repeat(8, 2)[:, :height, :width]
    return pieces + rng.uniform(0, 1, (K, height, width)).astype(np.float32)


def shifted(geometry: ArrayGeometry) -> ArrayGeometry:
    """The same with a principal point of its own in every view."""
    K = geometry.cameras
    shifts = np.stack([np.linspace(0, 7.3, K), np.linspace(0, -1.6, K)], 1)
    return ArrayGeometry(
        geometry.focal, geometry.center, geometry.size, geometry.positions, geometry.reference, shifts=shifts
    )


SCENES = {
    "2 cameras": lambda: make_scene(2, (83, 61), masks="soft", colour=True),
    "3, middle, residual": lambda: make_scene(3, (75, 53), reference=1, residual=True, masks="soft"),
    "5, no-ray borders": lambda: make_scene(
        5, (97, 64), reference=4, residual=True, no_ray=4, masks="soft", colour=True
    ),
    "9, middle, grey": lambda: make_scene(9, (73, 41), reference=4, masks="soft"),
    "16": lambda: make_scene(16, (57, 29), reference=3, residual=True, masks="soft", colour=True),
    "all dynamic": lambda: make_scene(3, (60, 40), masks="all"),
    "no mask": lambda: make_scene(3, (70, 45), masks="none"),
    "noise": lambda: noise_scene(4, (131, 43)),
    "noise, last of 2": lambda: noise_scene(2, (45, 37), reference=1, seed=5),
    "one row": lambda: noise_scene(3, (50, 1)),
    "one column": lambda: noise_scene(3, (1, 40), residual=False),
}
every_scene = pytest.mark.parametrize("name", SCENES)


@every_scene
@pytest.mark.parametrize("kind", ["true", "random"])
@pytest.mark.parametrize("options", [OPTIONS, SMALL], ids=["stride", "full"])
def test_cpu_equals_reference(name: str, kind: str, options: PeopleOptions) -> None:
    scene = SCENES[name]()
    surfaces = surfaces_of(scene) if kind == "true" else random_surfaces(scene)
    eager = Options(people=options).updated({"people.trusted": 0, "people.least_area": 0}).people
    geometry = shifted(scene.geometry) if kind == "random" else scene.geometry
    results = [
        people.refine_people(frame_of(scene), surfaces, geometry, eager, backend)
        for backend in (reference_people, cpu_people)
    ]
    assert np.array_equal(*results)
    assert np.array_equal(results[0] == NO_RAY, scene.dynamic == NO_RAY)


@dataclass
class Steps:
    """Inputs of the single loops: noise, so that everything happens."""

    stride: int = 1
    channels: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.scene = noise_scene(3, (61, 35), seed=self.seed)
        self.geometry = shifted(self.scene.geometry)
        self.surfaces = random_surfaces(self.scene, self.seed)
        self.colour = rng.integers(0, 256, (3, 35, 61, self.channels), np.uint8)
        self.saw = reference_people.witnesses(self.scene.dynamic, self.surfaces, self.geometry, 9)
        self.h, self.w = people.lattice(self.surfaces, self.stride).shape[1:]
        self.floor = np.clip(np.arange(35, dtype=np.float32) - 20, 0, None)[:, None]  # steps of a row: 1 px
        self.bgr = rng.integers(0, 256, (3, 35, 61, 3), np.uint8)
        near = self.bgr // 16 * 16  # steps of all sizes
        self.behind = np.where(rng.random(self.bgr.shape) < 0.7, near, rng.integers(0, 256, self.bgr.shape, np.uint8))
        self.rays = rng.integers(0, 4, (3, 35, 61), np.uint16)
        self.wanted = rng.random((3, 35, 61)) < 0.8
        self.rng = rng


def both(call) -> list:
    return [call(backend) for backend in (reference_people, cpu_people)]


def surprise_of(s: Steps, sure: np.ndarray, both) -> np.ndarray:
    """Surprise, the same on all that `both` asks, and so is how often every level comes."""
    surprise, again = both(lambda b: b.surprises(s.bgr, list(s.behind), list(s.rays), s.wanted))
    assert np.array_equal(surprise, again) and len(np.unique(surprise)) > 8
    counts, again = both(lambda b: b.surprise_counts(surprise, sure, s.stride))
    assert np.array_equal(counts, again) and counts[:, :, 8:].all()
    return surprise


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_every_loop_equals_reference(stride: int, channels: int) -> None:
    s = Steps(stride, channels)
    rng, shape = s.rng, (3, s.h, s.w)
    assert np.array_equal(*both(lambda b: b.witnesses(s.scene.dynamic, s.surfaces, s.geometry, 9)))
    assert (s.saw[0, ..., 1] != people.NO_SAY).any()
    cells = people.object_cells(s.geometry, reference_people.surface_range(s.surfaces), OPTIONS)
    assert len(set(both(lambda b: b.disagreement(s.saw, stride)))) == 1
    assert both(lambda b: b.disagreement(np.full_like(s.saw, people.NO_SAY), stride)) == [0, 0]
    floor, again = both(lambda b: b.sloping(s.surfaces + s.floor, 1.0, 4, stride))
    assert np.array_equal(floor, again) and 100 < (floor > 0).sum() < floor.size - 100
    (mean, sums), (mean_cpu, sums_cpu) = both(
        lambda b: b.object_grid(s.saw, s.surfaces, s.geometry, cells, stride, floor)
    )
    assert np.array_equal(mean, mean_cpu) and np.array_equal(sums, sums_cpu) and sums[1].sum() > 100
    grid = people.blurred(sums, 0.5)
    share, again = both(lambda b: b.object_slice(grid, mean, s.surfaces, s.geometry, cells, stride))
    assert np.array_equal(share, again) and len(np.unique(share)) > 50
    levels = np.arange(500, 3500, 250, dtype=np.int32)
    assert np.array_equal(*both(lambda b: b.border_counts(share, mean, s.surfaces, levels, 2.0, stride)))
    person, sure = rng.integers(0, 2, shape, np.uint8), rng.integers(-1, 2, shape, np.int8)
    for a, b in zip(*both(lambda b: b.histograms(s.scene.dynamic, s.colour, person, stride)), strict=True):
        assert np.array_equal(a, b) and a.sum() > 100
    surprise = surprise_of(s, sure, both)
    for radius in (0, 1, 3):
        assert np.array_equal(*both(lambda b: b.within(person, radius)))  # noqa: B023
    assert np.array_equal(*both(lambda b: b.colour_moments(s.colour, sure, stride, people.BLOCK)))
    table = rng.normal(0, 2, (3, people.LEVELS)).astype(np.float32)
    said, again = both(lambda b: b.log_odds(s.saw, table, stride))
    assert np.array_equal(said, again)
    colours = rng.normal(0, 2, people.COLOURS**3).astype(np.float32)
    terms = people.Terms(np.float32([-3, 0, 1]), 0.5, 4.0, colours, rng.normal(0, 3, (3, people.LEVELS)).astype("f4"))
    linear = rng.normal(0, 0.003, (35, 61, 4)).astype(np.float32)
    u, again = both(
        lambda b: b.potential(
            said[1],
            s.scene.dynamic[1],
            s.colour[1],
            linear,
            sure[1, ::2, ::2].copy(),
            surprise[1],
            terms.behind[1],
            terms,
            stride,
            2,
        )
    )
    assert np.array_equal(u, again) and u.std() > people.NATS
    costs = people.field_costs(channels, PeopleOptions(contrast=60, depth_step=20))
    u = rng.integers(-7680, 7681, shape).astype(np.int16)
    belief, again = both(lambda b: b.field(u, s.colour, s.surfaces, costs, stride))
    assert np.array_equal(belief, again) and not np.array_equal(belief, u)


def test_result_does_not_depend_on_threads() -> None:
    scene = make_scene(5, (97, 64), masks="soft", colour=True)
    results = []
    for threads in (1, 2):
        cpu_people.set_threads(threads)
        results.append(people.refine_people(frame_of(scene), surfaces_of(scene), scene.geometry, OPTIONS, cpu_people))
    cpu_people.set_threads(0)
    assert np.array_equal(*results)


def people_scene(**kwargs) -> Scene:
    return make_scene(5, (192, 128), colour=True, **kwargs)


def spoilt(scene: Scene, seed: int = 0) -> np.ndarray:
    """Masks as a network errs: holes in the person and false alarms, different in every view."""
    rng = np.random.default_rng(seed)
    out = scene.dynamic.copy()
    for k, view in enumerate(out):
        y, x = (v.mean() for v in np.nonzero(scene.person[k]))
        cv2.circle(view, (int(x), int(y + rng.integers(-20, 20))), 7, 0, -1)
        cv2.circle(view, (int(rng.integers(5, 40)), int(rng.integers(20, 100))), 8, 254, -1)
    return out


def mean_iou(masks: np.ndarray, truth: np.ndarray) -> float:
    people = (masks > 127) & (masks != NO_RAY)
    return float(np.mean([(m & t).sum() / (m | t).sum() for m, t in zip(people, truth, strict=True)]))


def test_errors_of_single_views_are_repaired() -> None:
    scene = people_scene()
    dynamic = spoilt(scene)
    before = mean_iou(dynamic, scene.person)
    after = people.refine_people(frame_of(scene, dynamic), surfaces_of(scene), scene.geometry, SMALL, cpu_people)
    # both surfaces are noise of the same colours, the worst case: colour learnt from one frame can only mislead
    assert before < 0.7 and mean_iou(after, scene.person) > 0.87


def seen_in(scene: Scene) -> Surfaces:
    """What a look at full size at true surfaces finds."""
    K, everywhere = len(scene.views), np.ones(scene.grey.shape, bool)
    level = Level(1, scene.geometry, scene.colour, everywhere)
    return Surfaces(level, tuple(range(K)), (surfaces_of(scene) * UNITS).astype(np.uint16), everywhere)


def test_exact_masks_are_trusted_and_others_are_not() -> None:
    scene = people_scene()
    seen, exact = seen_in(scene), scene.dynamic
    wide = np.stack([cv2.dilate(view, np.ones((1, 7), np.uint8)) for view in exact[:2]])
    for dynamic, trusted in ((exact, True), (spoilt(scene), False), (np.concatenate([wide, exact[2:]]), False)):
        for backend in (reference_people, cpu_people):
            assert people.trusted(dynamic, seen, OPTIONS, backend) == trusted
    assert people.trusted(np.zeros_like(exact), seen, OPTIONS, cpu_people)


def test_outline_share() -> None:
    masks = np.zeros((2, 20, 20), np.uint8)
    assert people.outline_share(masks) == 0
    masks[1, 5:15, 3:13] = 254
    assert np.isclose(people.outline_share(masks), 36 / 100)
    masks[0] = NO_RAY
    assert np.isclose(people.outline_share(masks), 36 / 100)
    masks[1, ::2] = 0
    assert people.outline_share(masks) == 1


@pytest.mark.parametrize("level", [0, 40, 90])
def test_empty_scene_stays_empty(level: int) -> None:
    scene = people_scene(person=False)
    rng = np.random.default_rng(1)
    dynamic = rng.integers(0, level + 1, scene.dynamic.shape, np.uint8)
    out = people.refine_people(frame_of(scene, dynamic), surfaces_of(scene), scene.geometry, SMALL, cpu_people)
    assert out.max() < 127


def test_pixels_without_a_ray_say_nothing() -> None:
    scene = people_scene()
    dynamic = spoilt(scene)
    dynamic[1:, :, -30:] = NO_RAY
    frame, surfaces = frame_of(scene, dynamic), surfaces_of(scene)
    out = people.refine_people(frame, surfaces, scene.geometry, SMALL, cpu_people)
    elsewhere = scene.colour.copy()
    elsewhere[1:, :, -30:-12] = 0  # what stands there must not matter, but to the field's costs next to it
    again = people.refine_people(Frame(elsewhere, scene.grey, dynamic), surfaces, scene.geometry, SMALL, cpu_people)
    assert (out[1:, :, -30:] == NO_RAY).all() and np.array_equal(out[1:, :, :150], again[1:, :, :150])


def test_false_alarms_of_single_views_make_no_person() -> None:
    scene = people_scene(person=False)
    dynamic = np.zeros_like(scene.dynamic)
    for k, view in enumerate(dynamic):
        cv2.circle(view, (30 + 30 * k, 40 + 15 * (k % 3)), 8, 254, -1)
    out = people.refine_people(frame_of(scene, dynamic), surfaces_of(scene), scene.geometry, SMALL, cpu_people)
    assert not out.any()


def test_a_person_that_one_view_missed_is_found_there() -> None:
    scene = people_scene(reference=2)
    dynamic = scene.dynamic.copy()
    dynamic[3] = 0
    out = people.refine_people(frame_of(scene, dynamic), surfaces_of(scene), scene.geometry, SMALL, cpu_people)
    assert mean_iou(out[3:4], scene.person[3:4]) > 0.95


def test_beliefs_above_zero_are_people() -> None:
    belief = np.array([[[-300, -1, 0, 1, 40, 20000]]], np.int16)
    table = people.probabilities(PeopleOptions())
    p = cpu_people.probability(belief, np.zeros((1, 1, 6), np.uint8), table, grow=False)[0, 0]
    assert (p[:3] < 127).all() and (p[3:] > 127).all() and (np.diff(p.astype(int)) >= 0).all()
