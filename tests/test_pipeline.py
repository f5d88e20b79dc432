"""reconstruct and Reconstructor, from a rig, images and masks as people have them to the Result."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest

import seepast
from arrays import FAR, NEAR, SPACING, Scene, all_label_energies, make_scene, painted, texture
from seepast.backends import reference as reference_backend
from seepast.errors import BackendError, InputError, OptionsError, RigError, SeepastError
from seepast.frames import to_bytes
from seepast.options import Options
from seepast.pipeline import STAGES, Reconstructor, reconstruct
from seepast.rectify import NO_RAY, rectify
from seepast.rig import Camera, Rig

OPTIONS = Options.preset("paper").updated({"range.max_disparity": 60})


def rig_of(scene: Scene) -> Rig:
    """The rig, as a user has it, whose rectified array is the scene's (a straight one)."""
    size, geometry = scene.geometry.size, scene.geometry
    return Rig.linear(geometry.cameras, focal=geometry.focal[0], spacing=SPACING, size=size)


def assert_equal(a: seepast.Result, b: seepast.Result) -> None:
    for name in ("background", "disparity", "depth", "coverage", "labels"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype, name
        assert np.array_equal(x, y), f"{name}: {(x != y).mean():.1%} differ"
    assert len(a.masks) == len(b.masks)
    assert all(np.array_equal(x, y) for x, y in zip(a.masks, b.masks, strict=True))
    assert a.rounds == b.rounds


# ------------------------------------------------------------------------------------------ cpu against reference

CASES: list[tuple[int, tuple[int, int], int, bool, str]] = [
    # cameras, size, reference, colour, masks
    (2, (53, 37), 0, False, "exact"),
    (2, (48, 32), 1, True, "soft"),
    (3, (61, 39), 1, True, "soft"),
    (3, (45, 31), 2, False, "none"),
    (5, (57, 35), 0, True, "exact"),
    (5, (49, 27), 2, False, "soft"),
    (5, (57, 33), 4, False, "all"),
    (9, (41, 21), 4, False, "soft"),
]


@pytest.mark.parametrize("dynamic_only", [False, True], ids=["full", "dynamic-only"])
@pytest.mark.parametrize("cameras, size, reference, colour, masks", CASES)
def test_both_backends_give_one_result(cameras, size, reference, colour, masks, dynamic_only):
    scene = make_scene(cameras, size, reference=reference, colour=colour, masks=masks, noise=1, seed=cameras)
    run: dict[str, Any] = {"options": OPTIONS.updated({"range.step": 1.0}), "reference": reference}
    results = [
        reconstruct(list(scene.views), scene.masks, rig_of(scene), backend=b, dynamic_only=dynamic_only, **run)
        for b in ("cpu", "reference")
    ]
    assert_equal(*results)
    assert [r.backend for r in results] == ["cpu", "reference"]
    shape = size[::-1]
    assert results[0].background.shape == ((*shape, 3) if colour else shape)
    assert results[0].background.dtype == np.uint8
    assert results[0].disparity.shape == results[0].depth.shape == results[0].coverage.shape == shape
    assert results[0].labels.dtype == np.uint16
    assert int(results[0].labels.max()) < 1 << cameras
    assert [m.shape for m in results[0].masks] == [shape] * cameras


@pytest.mark.parametrize("reference", [0, 7, 15])
def test_16_cameras(reference, monkeypatch):
    """test_stages shows that this way of summing over the 65536 sets is the reference's."""
    monkeypatch.setattr(reference_backend, "label_energies", all_label_energies)
    scene = make_scene(16, (11, 7), reference=reference, masks="soft", seed=reference)
    run: dict[str, Any] = {"options": OPTIONS.updated({"range.step": 4, "segmentation.max_rounds": 2})}
    results = [
        reconstruct(list(scene.views), scene.masks, rig_of(scene), backend=b, reference=reference, **run)
        for b in ("cpu", "reference")
    ]
    assert_equal(*results)
    assert results[0].labels.max() > 15


# ------------------------------------------------------------------------------------------------ what comes out


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(5, (96, 64), colour=True)


@pytest.fixture(scope="module")
def result(scene) -> seepast.Result:
    return reconstruct(list(scene.views), scene.masks, rig_of(scene), options=OPTIONS)


def test_the_scene_behind_the_person_comes_out(scene, result):
    hidden = scene.person[0]
    assert np.abs(result.background.astype(float) - scene.background)[hidden].mean() < 12
    assert (np.abs(result.disparity - FAR) < 1).mean() > 0.98
    assert (result.coverage[hidden] >= 1).all()


def test_depth_is_focal_length_times_baseline_over_disparity(scene, result):
    assert result.geometry.baseline == pytest.approx(4 * SPACING)
    known = result.disparity > 0
    assert result.depth[known] == pytest.approx(120 * 4 * SPACING / result.disparity[known], rel=1e-5)
    assert result.depth.dtype == np.float32
    assert np.median(result.depth) == pytest.approx(120 * 0.4 / FAR, rel=0.1)


def test_coverage_counts_the_labels(result):
    assert np.array_equal(result.coverage, sum((result.labels >> k & 1) for k in range(16)))


def test_static_pixels_of_a_rectified_rig_are_the_inputs(scene, result):
    kept = ~scene.person[0]
    assert np.array_equal(result.background[kept], scene.views[0][kept])
    free = OPTIONS.updated({"refocus.keep_reference": False})
    mixed = reconstruct(list(scene.views), scene.masks, rig_of(scene), options=free)
    assert not np.array_equal(mixed.background[kept], scene.views[0][kept])


def test_timings_and_the_rest_of_the_result(result):
    assert tuple(result.timings) == STAGES
    assert all(ms > 0 for ms in result.timings.values())
    assert 1 <= result.rounds <= OPTIONS.segmentation.max_rounds
    assert result.options == OPTIONS
    assert result.backend == "cpu"


def test_without_masks_nothing_is_dynamic(scene):
    found = reconstruct(list(scene.views), None, rig_of(scene), options=OPTIONS)
    zeros = [np.zeros(scene.views.shape[1:3], np.uint8)] * 5
    assert_equal(found, reconstruct(list(scene.views), zeros, rig_of(scene), options=OPTIONS))
    assert np.array_equal(found.background, scene.views[0])


def test_masks_of_all_kinds_say_the_same(scene, result):
    people = list(scene.person)
    for kind in (people, [p.astype(np.float32) for p in people], [p.astype(np.float64) for p in people]):
        assert_equal(result, reconstruct(list(scene.views), kind, rig_of(scene), options=OPTIONS))


def test_masks_all_dynamic_leave_nothing(scene):
    everywhere = [np.full(scene.views.shape[1:3], 255, np.uint8)] * 5
    found = reconstruct(list(scene.views), everywhere, rig_of(scene), options=OPTIONS)
    assert not found.coverage.any()
    assert all((mask == 255).all() for mask in found.masks)


def test_exact_masks_come_back_as_they_went_in(scene, result):
    for given, refined in zip(scene.masks, result.masks, strict=True):
        assert (given != refined).mean() < 0.001
        assert set(np.unique(given)) == {0, 255}


def test_grey_images_may_have_a_channel_axis(scene):
    grey = list(scene.grey)
    a, b = (reconstruct(v, scene.masks, rig_of(scene), options=OPTIONS) for v in (grey, [g[..., None] for g in grey]))
    assert_equal(a, b)
    assert a.background.ndim == 2


@pytest.mark.parametrize("dynamic_only", [False, True])
def test_frames_do_not_leave_traces(scene, result, dynamic_only):
    """The same input gives the same result whatever came between, whatever the threads; inputs stay as they were."""
    images, masks = [v.copy() for v in scene.views], [m.copy() for m in scene.masks]
    run = Reconstructor(rig_of(scene), options=OPTIONS, dynamic_only=dynamic_only, threads=2)
    first = run(images, masks)
    kept = [np.copy(a) for a in (first.background, first.disparity, first.labels, *first.masks)]
    run([255 - v for v in images], [255 - m for m in masks])
    again = run(images, masks)
    assert_equal(first, again)
    now = (first.background, first.disparity, first.labels, *first.masks)
    assert all(np.array_equal(a, b) for a, b in zip(kept, now, strict=True))
    alone = Reconstructor(rig_of(scene), options=OPTIONS, dynamic_only=dynamic_only, threads=1)
    assert_equal(first, alone(images, masks))
    assert np.array_equal(images, scene.views)
    assert np.array_equal(masks, scene.masks)
    if not dynamic_only:
        assert_equal(first, result)


def test_inputs_may_be_read_only_views_of_any_layout(scene, result):
    images = [np.asfortranarray(v) for v in scene.views]
    masks = [np.repeat(m, 2, axis=1)[:, ::2] for m in scene.masks]
    for array in (*images, *masks):
        array.flags.writeable = False
    assert not images[0].flags.c_contiguous
    assert_equal(result, reconstruct(images, masks, rig_of(scene), options=OPTIONS))


def test_the_reference_goes_by_name_too(scene):
    a, b = (
        reconstruct(list(scene.grey), scene.masks, rig_of(scene), options=OPTIONS, reference=r) for r in (3, "cam3")
    )
    assert_equal(a, b)
    assert a.geometry.reference == 3


def test_dynamic_only_flags_the_rest_as_not_estimated(scene, result):
    found = reconstruct(list(scene.views), scene.masks, rig_of(scene), options=OPTIONS, dynamic_only=True)
    kept, hidden = ~scene.person[0], scene.person[0]
    assert np.array_equal(found.background[kept], scene.views[0][kept])
    assert not found.disparity[kept].any()
    assert not found.depth[kept].any()
    assert (found.coverage[kept] == 1).all()
    assert (np.abs(found.disparity - FAR)[hidden] < 1).mean() > 0.98
    assert np.abs(found.background.astype(float) - result.background)[hidden].mean() < 2


def test_masks_are_scaled_back_to_bytes():
    scaled = to_bytes(np.array([0, 1, 127, 128, 253, 254, NO_RAY], np.uint8))
    assert scaled.dtype == np.uint8
    assert scaled.tolist() == [0, 1, 127, 129, 254, 255, 255]


@pytest.mark.parametrize("settings", [{}, {"reference": 2}, {"cameras": 2}], ids=str)
def test_dynamic_only_comes_to_rest(settings):
    """Labels stand still after a few rounds; the result is not whatever the last round allowed left."""
    scene = make_scene(**settings, masks="soft")
    options = OPTIONS.updated({"segmentation.max_rounds": 12})
    run: dict[str, Any] = {"options": options, "reference": scene.geometry.reference, "dynamic_only": True}
    rounds = reconstruct(list(scene.views), scene.masks, rig_of(scene), **run).rounds
    assert rounds < 6


@pytest.mark.parametrize("rounds", [2, 3, 4])
@pytest.mark.parametrize("dynamic_only", [False, True])
def test_the_masks_agree_with_the_labels(dynamic_only, rounds):
    """The reference's own ray is in the labels where its refined mask says static, and nowhere else."""
    scene = make_scene(5, (96, 64), masks="soft")
    options = OPTIONS.updated({"segmentation.max_rounds": rounds})
    found = reconstruct(list(scene.views), scene.masks, rig_of(scene), options=options, dynamic_only=dynamic_only)
    own = (found.labels & 1).astype(bool)
    assert np.array_equal(own, found.masks[0] < 128)


# -------------------------------------------------------------------------------------- a rig that is not rectified

RAW_SIZE = (120, 90)


def crooked_rig(cameras: int = 4) -> Rig:
    """Cameras of slightly different lenses, turned by a degree or two, off their line by millimetres."""
    rng, made = np.random.default_rng(2), []
    for k in range(cameras):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rng.uniform(-0.03, 0.03, 3))[0]
        pose[:3, 3] = -pose[:3, :3] @ [0.1 * k, *rng.uniform(-0.003, 0.003, 2)]
        intrinsics = (130.0 + k, 131.0 + k, 59.0 + k, 45.0 - k)
        made.append(Camera(f"cam{k}", "pinhole", "radtan", intrinsics, (-0.15, 0.05, 0.001, -0.001), RAW_SIZE, pose))
    return Rig(tuple(made))


WALL, PERSON = 5.0, 1.1  # metres
BOX = (-0.15, 0.0, -0.2, 0.2)  # m: left, right, top, bottom of the person


def photograph(camera: Camera, wall: np.ndarray, clothes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distorted image uint8 [h, w, 3] of a wall and a box before it, and the box's mask uint8 [h, w]."""
    w, h = camera.resolution
    u, v = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    rays = camera.unproject(np.stack([u, v], -1)) @ camera.rotation
    center = camera.center

    def at(depth: float) -> np.ndarray:
        return center + rays * ((depth - center[2]) / rays[..., 2])[..., None]

    far, near = at(WALL), at(PERSON)
    image = painted(wall, 60 + 24 * far[..., 0], 45 + 24 * far[..., 1])
    left, right, top, bottom = BOX
    box = (near[..., 0] > left) & (near[..., 0] < right) & (near[..., 1] > top) & (near[..., 1] < bottom)
    dressed = painted(clothes, 60 + 110 * near[..., 0], 45 + 110 * near[..., 1])
    return np.where(box[..., None], dressed, image), box.astype(np.uint8) * 255


@pytest.mark.parametrize("reference", [0, 2])
def test_a_distorted_rotated_rig(reference):
    rng, rig = np.random.default_rng(3), crooked_rig()
    wall, clothes = texture((400, 400), rng), texture((400, 400), rng)
    taken = [photograph(camera, wall, clothes) for camera in rig.cameras]
    images, masks = [t[0] for t in taken], [t[1] for t in taken]
    found = reconstruct(images, masks, rig, options=OPTIONS, reference=reference)
    rectification = rectify(rig, reference)
    hidden = rectification.dynamic(reference, masks[reference]) == 254
    assert hidden.sum() > 300

    wall_disparity = found.geometry.focal_baseline / WALL  # nearly everywhere: the view is hardly turned against it
    assert (np.abs(found.disparity - wall_disparity)[hidden] < 1).mean() > 0.95
    assert found.geometry.size == RAW_SIZE

    # masks come back in each camera's own distorted pixels
    for given, refined in zip(masks, found.masks, strict=True):
        assert refined.shape == RAW_SIZE[::-1]
        assert refined.dtype == np.uint8
        off = (given >= 128) != (refined >= 128)
        assert off.mean() < 0.02
        assert off[cv2.erode(given, np.ones((5, 5))) > 0].mean() < 0.02
    rim = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5))).astype(bool)
    valid = rectification.dynamic(reference, np.zeros(RAW_SIZE[::-1], np.uint8)) == 0
    kept, view = valid & ~rim, rectification.image(reference, images[reference])
    assert np.array_equal(found.background[kept], view[kept])


def test_a_distorted_rig_in_both_backends():
    rng, rig = np.random.default_rng(4), crooked_rig(3)
    wall, clothes = texture((400, 400), rng), texture((400, 400), rng)
    images, masks = zip(*(photograph(camera, wall, clothes) for camera in rig.cameras), strict=True)
    options = OPTIONS.updated({"range.step": 1, "range.max_disparity": 40, "segmentation.max_rounds": 2})
    run: dict[str, Any] = {"options": options, "reference": 1}
    assert_equal(*(reconstruct(images, masks, rig, backend=b, **run) for b in ("cpu", "reference")))


# ----------------------------------------------------------------------------------------------------- bad input

RIG = Rig.linear(3, focal=60, spacing=0.1, size=(32, 24))
GREY = [np.zeros((24, 32), np.uint8)] * 3
MASKS = [np.zeros((24, 32), np.uint8)] * 3
COLOUR = np.zeros((24, 32, 3), np.uint8)


def with_(items: Sequence[np.ndarray], place: int, item: Any) -> list[Any]:
    return [item if i == place else it for i, it in enumerate(items)]


BAD: dict[str, tuple[Any, Any, str]] = {
    "two images": (GREY[:2], MASKS, r"images: 2 given.*3 cameras.*one per camera"),
    "four masks": (GREY, MASKS + MASKS[:1], r"masks: 4 given.*3 cameras.*one per camera"),
    "image of another size": (with_(GREY, 1, GREY[0][:, 1:]), MASKS, r"image of cam1 is 31x24.*32x24.*resize"),
    "image turned": (with_(GREY, 2, np.zeros((32, 24), np.uint8)), MASKS, r"image of cam2 is 24x32.*32x24"),
    "16-bit image": (with_(GREY, 2, np.zeros((24, 32), np.uint16)), MASKS, r"image of cam2 is uint16.*8-bit.*scale"),
    "float image": (with_(GREY, 0, np.zeros((24, 32))), MASKS, r"image of cam0 is float64.*uint8"),
    "alpha": (with_(GREY, 1, np.zeros((24, 32, 4), np.uint8)), MASKS, r"image of cam1 has shape \(24, 32, 4\).*alpha"),
    "a row of pixels": (with_(GREY, 0, np.zeros(32, np.uint8)), MASKS, r"image of cam0 has shape \(32,\).*\[h, w\]"),
    "no image": (with_(GREY, 1, None), MASKS, r"image of cam1"),
    "grey and colour": (with_(GREY, 1, COLOUR), MASKS, r"some are grey and some colour.*convert"),
    "mask of another size": (GREY, with_(MASKS, 2, MASKS[0][::2, ::2]), r"mask of cam2 is 16x12.*32x24.*resize"),
    "mask in colour": (GREY, with_(MASKS, 1, COLOUR), r"mask of cam1 has shape.*one channel"),
    "mask beyond 1": (GREY, with_(MASKS, 1, np.full((24, 32), 1.5)), r"mask of cam1.*0\.\.1"),
    "mask below 0": (GREY, with_(MASKS, 1, np.full((24, 32), -0.1, np.float32)), r"mask of cam1.*0\.\.1"),
    "mask with NaN": (GREY, with_(MASKS, 0, np.full((24, 32), np.nan)), r"mask of cam0.*NaN"),
    "mask of ints": (GREY, with_(MASKS, 0, np.zeros((24, 32), np.int64)), r"mask of cam0 is int64.*uint8.*bool.*float"),
    "no mask": (GREY, with_(MASKS, 1, None), r"mask of cam1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_frames_are_refused_by_name(case):
    images, masks, message = BAD[case]
    with pytest.raises(InputError) as error:
        reconstruct(images, masks, RIG)
    assert re.search(message, str(error.value)), str(error.value)
    assert isinstance(error.value, SeepastError)
    assert isinstance(error.value, ValueError)


def test_a_backend_must_exist():
    with pytest.raises(BackendError, match=r"'abacus'.*choose auto or one of cpu, cuda, reference"):
        Reconstructor(RIG, backend="abacus")


@pytest.mark.parametrize("reference", [3, -4, "cam7"])
def test_a_reference_must_exist(reference):
    with pytest.raises(RigError):
        Reconstructor(RIG, reference=reference)


def test_a_preset_must_exist():
    with pytest.raises(OptionsError, match=r"'papre' is unknown.*paper"):
        Options.preset("papre")


@pytest.mark.parametrize(
    "key, value, message",
    [
        ("disparity.beta", -1, r"disparity\.beta: -1.* outside 0 \.\. 10"),
        ("disparity.beta", 11, r"disparity\.beta: 11"),
        ("disparity.beta", float("nan"), r"disparity\.beta: nan"),
        ("disparity.beta", float("inf"), r"disparity\.beta: inf"),
        ("disparity.beta", "much", r"disparity\.beta: 'much' is not a number"),
        ("disparity.beta", None, r"disparity\.beta: None is not a number"),
        ("support.grid", 0, r"support\.grid: 0 is outside 1 \.\. 64 px"),
        ("support.grid", 2.5, r"support\.grid: 2\.5 is not a whole number"),
        ("support.grid", float("nan"), r"support\.grid: nan is not a whole number"),
        ("support.grid", float("inf"), r"support\.grid: inf is not a whole number"),
        ("refocus.median", 2, r"refocus\.median: 2 is neither true nor false"),
        ("refocus.median", "perhaps", r"refocus\.median: 'perhaps'"),
        ("disparity.bta", 1, r"'disparity\.bta' does not exist: did you mean disparity\.beta"),
        ("disparity", 1, r"'disparity' does not exist"),
        ("nothing.beta", 1, r"'nothing\.beta' does not exist"),
        ("", 1, r"'' does not exist"),
    ],
)
def test_bad_options_are_refused_by_name(key, value, message):
    with pytest.raises(OptionsError) as error:
        OPTIONS.updated({key: value})
    assert re.search(message, str(error.value)), str(error.value)


def test_options_come_back_from_their_flat_form():
    changed = OPTIONS.updated({"disparity.beta": "0.5", "support.grid": "7", "refocus.median": "off"})
    assert changed.disparity.beta == 0.5
    assert changed.support.grid == 7
    assert changed.refocus.median is False
    assert Options().updated(changed.flat()) == changed
    assert OPTIONS.disparity.beta != 0.5
    with pytest.raises(AttributeError):
        changed.disparity.beta = 1.0  # type: ignore[misc]


def test_a_range_with_nothing_in_it_is_refused():
    with pytest.raises(OptionsError, match=r"min_disparity.*max_disparity"):
        Reconstructor(RIG, options=OPTIONS.updated({"range.min_disparity": 60}))
    with pytest.raises(OptionsError, match="min_disparity"):  # 0 means 0.45 x 32 px
        Reconstructor(RIG, options=OPTIONS.updated({"range.max_disparity": 0, "range.min_disparity": 15}))


def test_the_person_is_nearer_than_the_wall():
    assert NEAR > FAR
    assert PERSON < WALL


def test_masks_that_nobody_refines_come_back_as_they_went_in():
    rng, rig = np.random.default_rng(5), crooked_rig(3)
    images = [rng.integers(0, 256, (*RAW_SIZE[::-1], 3), np.uint8) for _ in rig.cameras]
    masks = [cv2.GaussianBlur(rng.integers(0, 256, RAW_SIZE[::-1], np.uint8), (0, 0), 3) for _ in rig.cameras]
    options = Options.preset("fast").updated({"range.max_disparity": 40, "people.enabled": False})
    found = reconstruct(images, masks, rig, options=options)
    for given, returned in zip(masks, found.masks, strict=True):
        np.testing.assert_array_equal(returned, given)
        assert not np.may_share_memory(returned, given)
