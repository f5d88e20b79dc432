"""Plain refocusing of recordings: on the plane of the wall all cameras agree."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import save, write_recording
from seepast import cli

FAR = 4  # px: the wall of write_recording moves 2 px from camera to camera, 4 over three of them
DEPTH = "2.4"  # metres: f * B / d = 48 px * 0.2 m / 4 px
BOX = (slice(12, 24), slice(20, 30))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A white person stands before the wall in cam0 alone, and is masked there alone."""
    path = write_recording(tmp_path / "rec")
    image, mask = cv2.imread(str(path / "cam0" / "000000.png")), np.zeros((36, 48), np.uint8)
    assert image is not None
    save(tmp_path / "wall.png", image)
    image[BOX], mask[BOX] = 255, 255
    save(path / "cam0" / "000000.png", image)
    for k in range(3):
        save(path / "masks" / f"cam{k}" / "000000.png", mask if k == 0 else np.zeros_like(mask))
    return path


def refocused(recording: Path, *settings: str) -> tuple[np.ndarray, np.ndarray]:
    """(what came out, the wall), where all three cameras look."""
    out = recording.parent / "out"
    assert cli.main(["refocus", str(recording), "--out", str(out), "--overwrite", *settings]) == 0
    images = [cv2.imread(str(path)) for path in (out / "000000.png", recording.parent / "wall.png")]
    made, wall = (np.asarray(image).astype(int)[:, FAR:] for image in images)
    return made, wall


@pytest.mark.parametrize("plane", [("--disparity", str(FAR)), ("--depth", DEPTH)])
def test_masked_refocusing_on_the_wall_removes_the_person(recording: Path, plane: tuple[str, str]) -> None:
    made, wall = refocused(recording, *plane, "--masked")
    assert abs(made - wall).max() <= 1


def test_unmasked_refocusing_leaves_a_ghost_of_a_third(recording: Path) -> None:
    made, wall = refocused(recording, "--disparity", str(FAR))
    person = np.zeros(wall.shape[:2], bool)
    person[BOX[0], BOX[1].start - FAR : BOX[1].stop - FAR] = True
    assert abs(made - wall)[~person].max() <= 1
    assert abs(made - (2 * wall + 255) / 3)[person].max() <= 1


def test_another_plane_is_blurred(recording: Path) -> None:
    made, wall = refocused(recording, "--disparity", "12", "--masked")
    assert abs(made - wall).mean() > 10


def test_what_is_there_is_kept_without_overwrite(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refocused(recording, "--disparity", str(FAR))
    assert "rec: 1 frame refocused at 4.00 px" in capsys.readouterr().out
    out = str(recording.parent / "out")
    assert cli.main(["refocus", str(recording), "--out", out, "--disparity", "4"]) == 2
    assert "--overwrite" in capsys.readouterr().err
