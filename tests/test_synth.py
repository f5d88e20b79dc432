"""Synthetic recordings: their truth against their images, by geometry that the renderer does not share."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from seepast.errors import InputError, MissingExtraError, OutputError
from seepast.rectify import rectify
from seepast.rig import Camera, Rig
from seepast.synth import KINDS, depths, generate
from seepast.synth.masks import imperfect
from seepast.synth.mesh import PERSON

SIZE = (96, 72)
STAMP = "000000"


def straight(cameras: int = 4, size=SIZE) -> Rig:
    return Rig.linear(cameras, focal=1.2 * size[0], spacing=0.66 / (cameras - 1), size=size)


def crooked() -> Rig:
    """Distorted, turned by up to a few degrees, off the line, of two lens models."""
    rng = np.random.default_rng(5)
    made = []
    for k in range(3):
        rotation = cv2.Rodrigues(rng.normal(0, 0.02, 3))[0]
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (0.3 * k, 0.004 * k, -0.003 * k)
        lens = ("equidistant", (0.01, -0.02, 0.0, 0.0)) if k == 1 else ("radtan", (-0.2, 0.1, 1e-3, -5e-4))
        intrinsics = (115.0 + k, 116.0 + k, 47.0 - k, 36.0 + k)
        made.append(Camera(f"cam{k}", "pinhole", lens[0], intrinsics, lens[1], SIZE, pose))
    return Rig(tuple(made))


def recording(out: Path, rig: Rig, **options) -> Path:
    pytest.importorskip("embreex", reason="synthetic recordings are cast with embreex")
    return generate(out, rig, **{"frames": 1, "seed": 3, "noise": 0.0, "gain": 0.0, **options})


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def warp_error(folder: Path, rig: Rig, k: int, reference: int, off: float = 0.0) -> float:
    """Median grey-level difference of the background and camera k's image at the true disparity plus `off`,
    over textured pixels that camera k sees."""
    rectification = rectify(rig, reference)
    truth = folder / "truth"
    background = read(truth / "background" / f"{STAMP}.png").astype(np.float32)
    disparity = read(truth / "disparity" / f"{STAMP}.pfm")
    seen = (read(truth / "seen_by" / f"{STAMP}.png") >> k) & 1 == 1
    image = rectification.image(k, read(folder / f"cam{k}" / f"{STAMP}.png"))
    y, x = np.mgrid[0 : disparity.shape[0], 0 : disparity.shape[1]].astype(np.float32)
    at = rectification.geometry.warp(k, x, y, disparity + off)
    moved = cv2.remap(image, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    grey = background.mean(-1)
    textured = abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) > 40
    assert (seen & textured).sum() > 100
    return float(np.median(abs(moved - background).mean(-1)[seen & textured]))


@pytest.mark.parametrize("make, reference", [(straight, 0), (straight, 2), (crooked, 0), (crooked, 1)])
def test_background_moved_by_the_disparity_is_what_the_cameras_see(tmp_path, make, reference):
    rig = make()
    folder = recording(tmp_path / "made", rig, reference=reference)
    for k in range(len(rig.cameras)):
        true = warp_error(folder, rig, k, reference)
        assert true < 8, k
        if k != reference:  # the reference's own pixels stay where they are whatever the disparity
            assert warp_error(folder, rig, k, reference, 3.0) > 1.5 * true, k


def test_points_lie_on_the_planes_of_the_room_by_the_poses_that_are_written(tmp_path):
    rig = crooked()
    folder = recording(tmp_path / "made", rig, frames=2, background_depth=(4.0, 9.0))
    rectification = rectify(rig, 0)
    geometry = rectification.geometry
    poses = np.loadtxt(folder / "truth" / "poses.txt", comments="#")
    assert poses.shape == (2, 8)
    for line in poses:
        disparity = read(folder / "truth" / "disparity" / f"{int(line[0]):06d}.pfm").astype(float)
        y, x = np.mgrid[0 : disparity.shape[0], 0 : disparity.shape[1]]
        z = geometry.focal_baseline / disparity
        rays = [(x - geometry.center[0]) / geometry.focal[0], (y - geometry.center[1]) / geometry.focal[1]]
        rectified = np.stack([rays[0] * z, rays[1] * z, z], -1)
        world = rectified @ rectification.rotation_from_cam[0] @ rotation(line[4:]).T + line[1:4]
        assert world[..., 2].max() == pytest.approx(9, abs=2e-4)  # the far wall
        assert (abs(world[..., 2] - 9) < 2e-4).mean() > 0.05
        assert world[..., 1].max() == pytest.approx(1.5, abs=2e-4)  # the floor
        assert (abs(world[..., 1] - 1.5) < 2e-4).mean() > 0.03


def rotation(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion (x, y, z, w), through the rotation vector."""
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-8)
    angle = 2 * np.arctan2(np.linalg.norm(q[:3]), q[3])
    return cv2.Rodrigues(q[:3] / np.linalg.norm(q[:3]) * angle)[0]


def test_masks_are_where_people_change_the_image(tmp_path):
    rig = straight()
    with_people = recording(tmp_path / "a", rig)
    without = recording(tmp_path / "b", rig, figures=0)
    for k in range(4):
        name = Path(f"cam{k}") / f"{STAMP}.png"
        mask = read(with_people / "truth" / "masks" / name)
        assert set(np.unique(mask)) == {0, 255}
        change = abs(read(with_people / name).astype(int) - read(without / name)).max(-1)
        assert change[mask == 0].max() <= 1
        assert (change[mask == 255] > 3).mean() > 0.95
        assert np.array_equal(mask, read(with_people / "masks" / name))
        assert not read(without / "truth" / "masks" / name).any()
    truth = with_people / "truth"
    background = read(truth / "background" / f"{STAMP}.png")
    assert abs(background.astype(int) - read(without / "cam0" / f"{STAMP}.png")).max() <= 1
    hidden = read(truth / "hidden" / f"{STAMP}.png")
    assert np.array_equal(hidden, read(truth / "masks" / "cam0" / f"{STAMP}.png"))
    assert np.array_equal(read(truth / "seen_by" / f"{STAMP}.png") & 1 == 1, hidden == 0)


def test_a_person_hides_from_each_camera_what_its_mask_covers(tmp_path):
    """seen_by must not claim points behind people, and must not lose points without them."""
    rig = straight()
    folder = recording(tmp_path / "made", rig)
    geometry = rectify(rig, 0).geometry
    disparity = read(folder / "truth" / "disparity" / f"{STAMP}.pfm")
    seen = read(folder / "truth" / "seen_by" / f"{STAMP}.png")
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    for k in range(4):
        xk, _ = geometry.warp(k, x, y, disparity)
        inside = (xk >= 0) & (xk <= SIZE[0] - 1)
        mask = read(folder / "truth" / "masks" / f"cam{k}" / f"{STAMP}.png")
        at = mask[y, np.clip(np.rint(xk), 0, SIZE[0] - 1).astype(int)]
        claimed = (seen >> k) & 1 == 1
        assert not (claimed & ~(inside | (abs(xk - np.clip(xk, 0, SIZE[0] - 1)) < 0.02))).any()
        assert (at[claimed] == 0).all()
        assert claimed[inside & (at == 0)].mean() > 0.85  # the rest: static things hide it


def test_nearer_static_things_hide_what_is_behind_them(tmp_path):
    """The last camera's own truth says what stands in its way to each point of the first camera's."""
    rig = straight()
    options = {"figures": 0, "background_depth": (3.0, 9.0)}
    first = recording(tmp_path / "first", rig, **options) / "truth"
    last = recording(tmp_path / "last", rig, reference=3, **options) / "truth"
    disparity, there = (read(t / "disparity" / f"{STAMP}.pfm") for t in (first, last))
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    xk = x - disparity
    inside = xk >= 0
    low = np.clip(np.floor(xk), 0, SIZE[0] - 2).astype(int)
    nearest = np.maximum(there[y, low], there[y, low + 1])
    farthest = np.minimum(there[y, low], there[y, low + 1])
    seen = (read(first / "seen_by" / f"{STAMP}.png") >> 3) & 1 == 1
    shown, blocked = inside & seen, inside & ~seen
    assert blocked.sum() > 50
    assert (farthest[shown] < disparity[shown] + 1).mean() > 0.99  # nothing stands before what is seen
    assert (nearest[blocked] > disparity[blocked] + 0.02).mean() > 0.95  # something does before what is not


def test_disparities_follow_the_depths_asked_for(tmp_path):
    rig = straight()
    folder = recording(tmp_path / "made", rig, figure_depth=(1.5, 3.0), background_depth=(4.0, 8.0))
    disparity = read(folder / "truth" / "disparity" / f"{STAMP}.pfm")
    focal_baseline = rectify(rig).geometry.focal_baseline
    middle = disparity[SIZE[1] // 2]  # floor and ceiling may come nearer
    assert focal_baseline / 8.5 < middle.min() and middle.max() < focal_baseline / 3.6
    auto = depths(rectify(rig).geometry)
    near = focal_baseline / auto.background[0] / SIZE[0]
    assert near == pytest.approx(0.205, rel=0.06)
    wide = depths(rectify(Rig.linear(4, focal=115.0, spacing=2.2, size=SIZE)).geometry)
    assert wide.background[0] == pytest.approx(10 * auto.background[0], rel=0.1)


def test_the_same_seed_gives_the_same_files_and_another_seed_others(tmp_path):
    options = {"noise": 2.0, "gain": 0.05, "masks": "all"}
    a = recording(tmp_path / "a", straight(3), **options)
    b = recording(tmp_path / "b", straight(3), **options)
    files = sorted(p.relative_to(a) for p in a.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(b) for p in b.rglob("*") if p.is_file())
    assert {f"masks_{kind}" for kind in KINDS} <= {str(f.parts[0]) for f in files}
    assert not [f for f in files if f.suffix == ".part"]
    for f in files:
        assert (a / f).read_bytes() == (b / f).read_bytes(), f
    c = recording(tmp_path / "c", straight(3), **{**options, "seed": 4})
    first = Path("cam0") / f"{STAMP}.png"
    assert abs(read(a / first).astype(int) - read(c / first)).mean() > 5


def test_noise_and_gain_are_those_asked_for(tmp_path):
    clean = recording(tmp_path / "clean", straight(3))
    noisy = recording(tmp_path / "noisy", straight(3), noise=3.0)
    louder = recording(tmp_path / "louder", straight(3), gain=0.3, reference=1)
    ratios = []
    for k in range(3):
        name = Path(f"cam{k}") / f"{STAMP}.png"
        base = read(clean / name).astype(float)
        middle = (base > 40) & (base < 180)
        assert (read(noisy / name) - base)[middle].std() == pytest.approx(3.0, rel=0.2)
        ratios.append(float((read(louder / name)[middle] / base[middle]).mean()))
    assert max(ratios) - min(ratios) > 0.03 and max(abs(r - 1) for r in ratios) <= 0.31
    background = read(louder / "truth" / "background" / f"{STAMP}.png").astype(float)
    visible = read(louder / "truth" / "hidden" / f"{STAMP}.png") == 0
    assert abs(background - read(louder / "cam1" / f"{STAMP}.png"))[visible].max() <= 1  # the reference's gain


def test_frames_move_and_are_laid_out_as_a_dataset(tmp_path):
    told = []
    folder = recording(
        tmp_path / "made",
        straight(2),
        frames=2,
        color=False,
        masks="none",
        progress=lambda i, n: told.append((i, n)),
    )
    assert told == [(1, 2), (2, 2)]
    assert not (folder / "masks").exists()
    first, second = (read(folder / "cam1" / f"{s}.png") for s in ("000000", "000001"))
    assert first.shape == (72, 96) and abs(first.astype(int) - second).mean() > 1
    again = Rig.from_kalibr(folder / "rig.yaml")
    assert np.allclose(again.centers, straight(2).centers)


def test_a_lens_that_fills_only_part_of_its_image(tmp_path):
    """A double-sphere fisheye of 120 degrees and more: black and unmasked where it sends no ray."""
    made = []
    for k in range(2):
        pose = np.eye(4)
        pose[0, 3] = -0.3 * k
        made.append(Camera(f"cam{k}", "ds", "none", (-0.2, 0.59, 20.0, 20.0, 47.5, 35.5), (), SIZE, pose))
    rig = Rig(tuple(made))
    folder = recording(tmp_path / "made", rig, figure_depth=(1.0, 2.0), background_depth=(2.0, 5.0), figures=3)
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    reached = np.isfinite(rig.cameras[0].unproject(np.stack([x, y], -1).astype(float))).all(-1)
    blank = cv2.erode((~reached).astype(np.uint8), np.ones((3, 3))) > 0
    assert blank.sum() > 100 and reached.sum() > 3000
    image, mask = (read(folder / kind / "cam0" / f"{STAMP}.png") for kind in (".", "masks"))
    assert not image[blank].any() and not mask[blank].any()
    assert (image[reached].max(-1) > 0).mean() > 0.99 and mask.any()


def test_more_than_eight_cameras_have_sixteen_bits(tmp_path):
    folder = recording(tmp_path / "made", straight(9, (48, 36)), samples=1)
    seen = read(folder / "truth" / "seen_by" / f"{STAMP}.png")
    assert seen.dtype == np.uint16 and (seen >> 8 & 1).any() and not (seen >> 9).any()


def person(shape=(380, 434), shift=0) -> np.ndarray:
    """Part numbers of a simple person (trunk, head, arms, legs) beside one piece of furniture (part 7)."""
    parts = np.ones(shape, np.int32)
    cv2.rectangle(parts, (300 + shift, 150), (380 + shift, 350), 7, -1)
    x = 150 + shift
    for part, at, axes in (
        (2, (x, 190), (38, 75)),
        (4, (x, 90), (22, 28)),
        (6, (x - 20, 300), (16, 70)),
        (8, (x + 20, 300), (16, 70)),
        (10, (x - 50, 190), (12, 60)),
        (12, (x + 50, 190), (12, 60)),
    ):
        cv2.ellipse(parts, at, axes, 0, 0, 360, PERSON + part, -1)
    return parts


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_imperfect_masks_err_as_their_kind_says():
    truth = person() >= PERSON
    scores, alike = {}, {}
    for kind in KINDS:
        views = [[imperfect(kind, person(), (7,), (s, 0, k)) >= 128 for k in range(3)] for s in range(6)]
        scores[kind] = np.mean([iou(v, truth) for seed in views for v in seed])
        if kind == "exact":
            continue
        alike[kind] = np.mean([iou(v ^ truth, seed[0] ^ truth) for seed in views for v in seed[1:]])
    assert scores["exact"] == 1
    assert 0.8 < scores["good"] < 0.95
    assert 0.5 < scores["network"] < 0.9
    assert 0.4 < scores["poor"] < 0.75
    assert alike["network"] > 0.4 > 0.33 > alike["poor"]  # a network errs alike in all views
    soft = imperfect("good", person(), (7,), (0, 0, 0))
    assert 0.01 < ((soft > 20) & (soft < 235)).mean() < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_masks_of_an_empty_room_are_dark(kind):
    empty = np.ones((60, 80), np.int32)
    mask = imperfect(kind, empty, (), (0, 0, 0))
    assert mask.dtype == np.uint8 and (mask < 128).mean() > 0.6


def test_refuses_folders_that_hold_something(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"not empty.*notes\.txt"):
        recording(tmp_path / "full", straight(2))
    with pytest.raises(OutputError, match="is a file"):
        recording(tmp_path / "full" / "notes.txt", straight(2))
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "options, message",
    [
        ({"masks": "perfect"}, "masks.*perfect.*exact, good"),
        ({"frames": 0}, "frames: 0"),
        ({"noise": float("nan")}, "noise"),
        ({"figure_depth": (4.0, 2.0)}, "figure_depth: 4 .. 2"),
        ({"background_depth": (0.0, 2.0)}, "background_depth"),
    ],
)
def test_refuses_arguments_out_of_range(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        recording(tmp_path / "made", straight(2), **options)
    assert not (tmp_path / "made").exists()


def test_names_the_extra_when_embreex_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(MissingExtraError, match=r"embreex.*seepast\[synth\]"):
        generate(tmp_path / "made", straight(2))
    assert not (tmp_path / "made").exists()
