"""The report of `seepast check`, on arrays whose faults are known."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arrays import make_scene, texture
from recordings import write_recording
from seepast import cli
from seepast.check import Report, check
from seepast.checks import masks, seeing
from seepast.checks.array import off_line
from seepast.checks.page import page
from seepast.datasets import Frame
from seepast.errors import OptionsError
from seepast.rig import Rig

SIZE, FOCAL, SPACING, STEP = (160, 120), 160.0, 0.1, 5
DEPTH = FOCAL * SPACING / STEP  # metres: neighbours see the wall STEP px apart


@dataclass(eq=False)
class Recording:
    """A textured wall at DEPTH seen by an ideal array; tests spoil it."""

    rig: Rig
    frames: list[Frame]
    name: str = "wall"
    path: Path = Path("wall")
    masks: Path | None = None
    times: np.ndarray | None = None

    @property
    def stamps(self) -> list[str]:
        return [frame.stamp for frame in self.frames]

    def frame(self, stamp: str) -> Frame:
        return self.frames[self.stamps.index(stamp)]

    def __iter__(self):
        return iter(self.frames)


def recording(cameras: int = 4, *, images=lambda k, image: image, masked=None, frames: int = 1) -> Recording:
    """`images` spoils the picture of camera k; masked: K masks for all frames."""
    wall = texture((SIZE[0] + STEP * cameras, SIZE[1]), np.random.default_rng(1))
    views = tuple(images(k, np.ascontiguousarray(wall[:, STEP * k : STEP * k + SIZE[0]])) for k in range(cameras))
    made = [Frame(str(i), views, masked) for i in range(frames)]
    return Recording(Rig.linear(cameras, focal=FOCAL, spacing=SPACING, size=SIZE), made)


@pytest.fixture(scope="module")
def sound() -> Report:
    return check(recording(), depths=(1.0, 8.0))


def test_a_sound_array_is_good_wherever_something_is_known(sound: Report) -> None:
    verdicts = {line.name: line.verdict for line in sound.lines}
    assert {name for name, verdict in verdicts.items() if verdict == "unknown"} == {"time-stamp skew", "masks"}
    assert {name for name, verdict in verdicts.items() if verdict in ("doubtful", "bad")} <= {"seen past whole"}
    assert all(line.remedy for line in sound.lines if line.verdict != "good")
    assert sound.background == pytest.approx(DEPTH, rel=0.02)  # measured from the matches


def test_a_camera_whose_rows_are_off_is_measured_and_named() -> None:
    shifted = np.array([[1.0, 0, 0], [0, 1.0, 1.5]])

    def spoil(k: int, image: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(image, shifted, SIZE, borderMode=cv2.BORDER_REFLECT) if k == 3 else image

    rows = check(recording(images=spoil)).line("rows, measured")
    assert rows.verdict == "bad" and "cam2-cam3" in rows.value and "cam2-cam3" in rows.remedy
    assert rows.figures["pairs_offset_px"]["cam2-cam3"] == pytest.approx(1.5, abs=0.1)
    assert abs(rows.figures["pairs_offset_px"]["cam0-cam1"]) < 0.05


@pytest.mark.parametrize("reference", ["cam0", "cam2"])
def test_gains_are_told_per_camera(reference: str) -> None:
    gain = {"cam0": 1.0, "cam1": 1.1, "cam2": 0.9, "cam3": 1.0}

    def spoil(k: int, image: np.ndarray) -> np.ndarray:
        return np.rint(0.9 * image * gain[f"cam{k}"]).astype(np.uint8)

    line = check(recording(images=spoil), reference).line("gain")
    for name, value in gain.items():
        assert line.figures["ratio"][name] == pytest.approx(value / gain[reference], rel=0.01), name
    assert line.figures["spread"] == pytest.approx(np.log(1.1 / 0.9), abs=0.01)
    assert line.verdict == "bad" and "lock exposure" in line.remedy


def test_a_tinted_camera_is_noticed_though_its_grey_level_is_right() -> None:
    def spoil(k: int, image: np.ndarray) -> np.ndarray:
        return np.rint(image * np.array([0.8, 0.9, 0.9 * 0.9 / 0.8]) if k == 1 else 0.9 * image).astype(np.uint8)

    line = check(recording(images=spoil)).line("gain")
    assert line.figures["spread"] < 0.01
    assert line.figures["colour"] == pytest.approx(np.log(0.9 / 0.8), abs=0.01)
    assert line.verdict == "doubtful"


def test_a_camera_that_sees_nothing_is_named_and_the_rest_is_still_told() -> None:
    line = check(recording(images=lambda k, image: 0 * image if k == 1 else image)).line("rows, measured")
    assert line.verdict == "doubtful" and "cam0-cam1, cam1-cam2" in line.remedy and "cam2-cam3" in line.value


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("level", [0, 255])
def test_images_without_anything_are_reported_not_refused(level: int) -> None:
    report = check(recording(images=lambda k, image: np.full_like(image, level), masked=boxes([0, 10, 20, 30])))
    verdicts = {line.name: line.verdict for line in report.lines}
    assert verdicts["rows, measured"] == verdicts["gain"] == "unknown" and verdicts["exposure"] == "bad"
    assert report.background == 20.0, "nothing measured: the farther of the depths"
    json.dumps(report.as_dict(), allow_nan=False)
    page(report)


def test_clipped_pixels_are_counted_in_the_camera_that_has_them() -> None:
    def spoil(k: int, image: np.ndarray) -> np.ndarray:
        image = image.copy()
        if k == 2:
            image[:, :40] = 255
        return image

    line = check(recording(images=spoil)).line("exposure")
    assert line.figures["white"] == pytest.approx([0, 0, 0.25, 0]) and "white (cam2)" in line.value
    assert line.verdict == "doubtful"


def test_a_bent_array_is_measured() -> None:
    made = recording(3)
    bent = made.rig.cameras[1].cam_from_rig.copy()
    bent[1, 3] = -0.03  # cam1 stands 3 cm low: the best line runs 1 cm below the others
    made.rig = Rig((made.rig.cameras[0], replace(made.rig.cameras[1], cam_from_rig=bent), made.rig.cameras[2]))
    line = check(made).line("linearity")
    assert line.figures["off_line_m"] == pytest.approx([0.01, 0.02, 0.01], abs=1e-9)
    assert line.figures["share"] == pytest.approx(0.1) and line.verdict in ("doubtful", "bad")
    assert line.figures["rows_px"] == pytest.approx(FOCAL * 0.03 / 1.0, rel=1e-3)
    assert "cam1" in line.remedy


def test_distance_from_the_best_line_does_not_depend_on_its_direction() -> None:
    straight = np.outer(np.arange(5), [0.3, 0.2, -0.1]) + 7
    assert off_line(straight) == pytest.approx(np.zeros(5), abs=1e-12)
    straight[2] += np.array([0.0, 0.1, 0.2]) / np.sqrt(0.05) * 0.01  # across the line
    assert off_line(straight)[2] == pytest.approx(0.008, abs=1e-6)  # 4/5 of it: the line gives way by a fifth


def test_ranges_follow_from_f_and_b(sound: Report) -> None:
    near, far = (FOCAL * 3 * SPACING / z for z in (1.0, 8.0))
    line = sound.line("disparity range")
    assert line.figures["near_px"] == pytest.approx(near) and line.figures["far_px"] == pytest.approx(far)
    assert line.figures["far_neighbour_px"] == pytest.approx(far / 3)
    step = sound.line("depth resolution").figures["near_m"]
    assert FOCAL * 3 * SPACING / (1 - step) - near == pytest.approx(0.5, rel=0.02)
    close = check(recording(), depths=(0.31, 8.0)).line("disparity range")
    assert close.verdict == "doubtful" and "range.max_disparity=155" in close.remedy


@pytest.mark.parametrize("depths", [(2.0, 1.0), (0.0, 3.0), (1.0, float("inf"))])
def test_depths_must_be_a_range(depths: tuple[float, float]) -> None:
    with pytest.raises(OptionsError, match="--depths"):
        check(recording(), depths=depths)


def test_skew_is_told_where_the_recording_knows_it() -> None:
    made = recording(frames=3)
    made.times = 10**18 + np.arange(3)[:, None] * 10**8 + np.array([0, 0, 8_000_000, 0])
    line = check(made).line("time-stamp skew")
    assert line.figures["median_ms"] == pytest.approx(8.0) and "cam2" in line.value
    assert line.figures["moved_px"] == pytest.approx(FOCAL * 0.008) and line.verdict == "doubtful"


# ------------------------------------------------------------------------------------------------ seeing past


def seen_counts(along: np.ndarray, width: float, depth: float, background: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays cast one by one at a strip: cameras [N, K] that see each background point, and the points' places."""
    points = np.linspace(-3, 3, 6001)
    crossing = along[None] + (points[:, None] - along[None]) * (depth / background)
    return (abs(crossing - 0.05) > width / 2), points


@pytest.mark.parametrize("along", [np.arange(5) * 0.165, np.array([0.3, 0.0, 0.45, 0.9]), np.array([0.0, 0.2])])
@pytest.mark.parametrize(("depth", "background"), [(1.0, 5.0), (2.5, 4.0)])
def test_the_widest_person_is_where_rays_begin_to_be_lost(along, depth: float, background: float) -> None:
    for cameras in (1, 2):
        widest = seeing.widest_seen_past(along, depth, background, cameras)
        if widest > 0.01:
            seen, _ = seen_counts(along, widest - 0.004, depth, background)
            assert seen.sum(axis=1).min() >= cameras
        seen, _ = seen_counts(along, widest + 0.004, depth, background)
        assert seen.sum(axis=1).min() < cameras


@pytest.mark.parametrize("reference", [0, 2])
def test_the_unseen_share_of_a_wide_person_agrees_with_rays(reference: int) -> None:
    along, width, depth, background = np.arange(5) * 0.1, 0.6, 2.0, 6.0
    seen, _ = seen_counts(along, width, depth, background)
    hidden = ~seen[:, reference]
    expected = (~seen.any(axis=1))[hidden].mean()
    assert seeing.unseen_share(along, width, depth, background) == pytest.approx(expected, abs=0.005)
    assert 0.5 < expected < 0.6 and seeing.unseen_share(along, 0.2, depth, background) == 0


# ------------------------------------------------------------------------------------------------------ masks


def boxes(offsets: list[int], value: int = 255) -> tuple[np.ndarray, ...]:
    made = []
    for offset in offsets:
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        mask[30:90, 90 - offset : 110 - offset] = value
        made.append(mask)
    return tuple(made)


@pytest.mark.parametrize(
    ("given", "verdict", "says"),
    [
        (boxes([0, 10, 20, 30]), "good", "6.2 % dynamic"),
        (boxes([0, 10, 20, 30], value=1), "bad", "multiply"),
        (tuple(255 - m for m in boxes([0, 10, 20, 30])), "bad", "Invert"),
        (boxes([0, 10, 20, 30], value=0), "doubtful", "segmenter fail"),
        ((*boxes([0, 10, 20]), np.full((SIZE[1], SIZE[0]), 255, np.uint8)), "doubtful", "1 of 4 all 255"),
    ],
)
def test_masks_that_mean_something_else_are_recognised(given, verdict: str, says: str) -> None:
    line = check(recording(masked=given)).line("masks")
    assert line.verdict == verdict and says in line.value + line.remedy
    assert all(line.remedy for line in check(recording(masked=given)).lines if line.verdict != "good")


def test_masks_of_one_object_agree_and_a_false_alarm_counts_by_its_area() -> None:
    given = boxes([0, 10, 20, 30])
    agreed = check(recording(masked=given)).line("masks, agreement")
    assert agreed.figures["disagreement"] < 0.02 and agreed.verdict == "good"
    alarmed = (*given[:3], given[3].copy())
    alarmed[3][100:118, 10:60] = 255
    line = check(recording(masked=alarmed)).line("masks, agreement")
    assert line.figures["disagreement"] == pytest.approx(900 / (4 * 1200 + 900), abs=0.03)


@pytest.mark.parametrize("reference", [0, 2])
def test_what_nobody_sees_agrees_with_the_truth(reference: int) -> None:
    scene = make_scene(5, (160, 96), reference=reference, masks="exact")
    y, x = np.mgrid[:96:3, :160:3]
    points = np.stack([x, y, scene.disparity[::3, ::3]], axis=-1).reshape(-1, 3)
    found = masks.hidden(scene.dynamic, scene.geometry, points, 0.0)
    truth = scene.seen_by()[found.y, found.x]
    assert len(found.x) == scene.person[reference].sum() and (found.seen == truth).mean() > 0.97


def test_a_person_wider_than_the_array_leaves_pixels_unseen() -> None:
    """Boxes 60 px wide that move 10 px from camera to camera before a wall that moves 5: 3 x 5 px come free."""
    given = []
    for k in range(4):
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        mask[:, 80 - 10 * k : 140 - 10 * k] = 255
        given.append(mask)
    line = check(recording(masked=tuple(given))).line("hidden from all")
    assert line.figures["unseen"] == pytest.approx(45 / 60, abs=0.03) and line.verdict == "bad"


# ------------------------------------------------------------------------------------------- what comes out


def test_the_page_needs_nothing_beside_itself() -> None:
    text = page(check(replace(recording(masked=boxes([0, 10, 20, 30])), name="<wall> & co")))
    assert "&lt;wall&gt; &amp; co" in text and "<wall>" not in text
    assert not re.search(r'(src|href)="(?!data:)', text)
    pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', text)
    assert len(pictures) == 4 and text.count("<svg") == 3
    for data in pictures:
        assert cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR) is not None


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec, html = write_recording(tmp_path / "rec"), tmp_path / "report.html"
    assert cli.main(["check", str(rec), "--json", "--html", str(html), "--depths", "1", "8"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["name"] == "rec" and report["checks"]["disparity range"]["far_px"] == pytest.approx(48 * 0.2 / 8)
    assert report["verdict"] in ("good", "unknown", "doubtful", "bad")
    assert html.read_text().startswith("<!DOCTYPE html>")
    assert cli.main(["check", str(rec), "--background", "-1"]) == 2
    assert "--background" in capsys.readouterr().err
