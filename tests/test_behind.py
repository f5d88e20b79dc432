"""Objects beside what the other cameras see behind them: the same on every backend, and what it is for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from arrays import FAR, NEAR, Scene, make_scene, noise_scene
from cuda_on_cpu import EmulatedDevice
from seepast import behind, multiview, people
from seepast.backends import (
    cpu_multiview,
    cpu_people,
    cuda_multiview,
    cuda_people,
    reference_multiview,
    reference_people,
)
from seepast.gpu import device
from seepast.levels import Pictures
from seepast.options import Options, PeopleOptions
from seepast.rectify import NO_RAY
from seepast.surfaces import looks, surfaces
from test_people import OPTIONS, SMALL, frame_of, mean_iou, surfaces_of

BACKENDS = {
    "reference": (reference_multiview, reference_people),
    "cpu": (cpu_multiview, cpu_people),
    "cuda": (cuda_multiview, cuda_people),
}
SCENES = {
    "2 cameras": lambda: make_scene(2, (83, 61), colour=True),
    "3, middle, residual, grey": lambda: make_scene(3, (75, 53), reference=1, residual=True),
    "5, no-ray borders": lambda: make_scene(5, (97, 64), reference=4, residual=True, no_ray=4, colour=True),
    "16": lambda: make_scene(16, (57, 29), reference=3, residual=True, colour=True),
    "noise": lambda: noise_scene(4, (91, 43)),
}


def regions(scene: Scene, kind: str, stride: int) -> np.ndarray:
    """On the lattice: around the person, everywhere, or nowhere."""
    if kind != "person":
        return np.full_like(people.lattice(scene.grey, stride), kind == "everything")
    reach = np.ones((1, 1) if scene.person.mean() > 0.2 else (9, 9))  # noise is full of holes as it is
    wide = np.stack([cv2.dilate(one.astype(np.uint8), reach) for one in scene.person])
    return np.ascontiguousarray(people.lattice(wide, stride))


def surprise(scene: Scene, objects: np.ndarray, stride: int, preset: str, backend: str) -> np.ndarray:
    options = Options.preset(preset).updated({"range.max_disparity": 60})
    views, masks = BACKENDS[backend]
    pictures = Pictures(views.three_channels(scene.colour), scene.dynamic != NO_RAY, scene.geometry, views)
    seen = surfaces(pictures, scene.geometry, looks(scene.geometry, options)[-1], options, views)
    return behind.surprise(
        scene.dynamic, pictures, seen, scene.geometry, options, views, masks, multiview.unhidden, objects, stride
    )


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kind", ["person", "everything", "nothing"])
@pytest.mark.parametrize(("preset", "stride"), [("fast", 2), ("accurate", 1)])
def test_backends_agree(name: str, kind: str, preset: str, stride: int) -> None:
    scene = SCENES[name]()
    objects = regions(scene, kind, stride)
    expected = surprise(scene, objects, stride, preset, "reference")
    assert np.array_equal(surprise(scene, objects, stride, preset, "cpu"), expected)
    with device.use(EmulatedDevice()):
        assert np.array_equal(surprise(scene, objects, stride, preset, "cuda"), expected)
    known = expected != people.NO_SAY
    assert known.any() == (kind == "person") and expected[known].max(initial=0) < people.LEVELS
    assert not known[scene.dynamic == NO_RAY].any()


@pytest.mark.parametrize("preset", ["fast", "accurate"])
def test_people_differ_from_what_is_behind_and_gaps_do_not(preset: str) -> None:
    scene = make_scene(5, (192, 128), reference=2, colour=True, noise=2)
    found = surprise(scene, regions(scene, "person", 1), 1, preset, "cpu")
    known = found != people.NO_SAY
    beside = known & ~scene.person
    assert known[scene.person].mean() > 0.9
    assert np.median(found[known & scene.person]) >= 12 and np.median(found[beside]) <= 8


def test_a_head_that_no_mask_shows_comes_back() -> None:
    scene = make_scene(5, (192, 128), colour=True)
    dynamic = scene.dynamic.copy()
    for view, person in zip(dynamic, scene.person, strict=True):
        top = np.flatnonzero(person.any(1))[0]
        view[top : top + 16] = 0
    given = frame_of(scene, dynamic), surfaces_of(scene), scene.geometry, SMALL
    without = people.refine_people(*given, cpu_people)
    known = people.refine_people(
        *given, cpu_people, lambda objects, stride: surprise(scene, objects, stride, "fast", "cpu")
    )
    assert mean_iou(without, scene.person) < 0.9 < 0.96 < mean_iou(known, scene.person)


def floor_scene() -> tuple[Scene, np.ndarray]:
    """A person that stands on a floor; the surface of every view."""
    scene = make_scene(5, (192, 128))
    ramp = np.maximum(FAR, FAR + 1.2 * (np.arange(128) - 70)).astype(np.float32)[:, None]
    return scene, np.where(scene.person, np.float32(NEAR), np.broadcast_to(ramp, scene.person.shape))


def test_floors_slope_and_people_do_not() -> None:
    scene, ground = floor_scene()
    floor = reference_people.sloping(ground, 1.0, 3, 1) > 0
    clear = np.stack([cv2.dilate(one.astype(np.uint8), np.ones((9, 1))) for one in scene.person]) == 0
    assert floor[:, 75:125][clear[:, 75:125]].all()
    assert not floor[:, :68].any() and not floor[:, 125:].any()
    inside = np.stack([cv2.erode(one.astype(np.uint8), np.ones((7, 1))) for one in scene.person]) > 0
    assert not floor[inside].any()


@pytest.mark.parametrize("backend", [reference_people, cpu_people])
def test_the_floor_that_a_person_stands_on_takes_no_part_in_them(backend) -> None:
    scene, ground = floor_scene()
    saw = reference_people.witnesses(scene.dynamic, ground, scene.geometry, 2.0)
    region = people.object_region(saw, ground, scene.geometry, 1, PeopleOptions(working_width=192), backend)
    assert region is not None and region[scene.person].mean() > 0.95 and region[~scene.person].mean() < 0.03
    cells = people.object_cells(scene.geometry, backend.surface_range(ground), OPTIONS)
    floor = backend.sloping(ground, 1.0, 3, 1)
    shares = []
    for left_out in (floor, np.zeros_like(floor)):
        mean, sums = backend.object_grid(saw, ground, scene.geometry, cells, 1, left_out)
        share = backend.object_slice(people.blurred(sums, 0.8), mean, ground, scene.geometry, cells, 1)
        shares.append(np.median(share[scene.person]) / people.SHARE)
    assert shares[0] > 0.95 and shares[1] < 0.8
