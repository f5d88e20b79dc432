"""Plain refocusing of recordings: on the plane of the wall all cameras agree."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import save, write_recording
from seepast import cli
from seepast.errors import OutputError
from seepast.export.video import write_video

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


# -------------------------------------------------------------------------------------------- sweeps, videos


def sharpness(picture: np.ndarray) -> float:
    return float(cv2.Laplacian(picture[:, FAR:-FAR], cv2.CV_64F).std())


def run(recording: Path, *settings: str) -> int:
    return cli.main(["refocus", str(recording), *settings])


def test_a_sweep_is_sharpest_at_the_wall(recording: Path) -> None:
    out = recording.parent / "sweep"
    assert run(recording, "--out", str(out), "--sweep", "1.2", "9.6", "8") == 0
    pictures = [cv2.imread(str(path)) for path in sorted((out / "000000").glob("*.png"))]
    assert len(pictures) == 8  # at 8, 7 ... 1 px: the fifth is at 4
    assert int(np.argmax([sharpness(np.asarray(p)) for p in pictures])) == 4
    wall, _ = refocused(recording, "--disparity", str(FAR))
    assert np.array_equal(np.asarray(pictures[4])[:, FAR:], wall)


@pytest.mark.parametrize("ending", [".mp4", ".avi", ".mkv"])
def test_a_sweep_as_a_video(recording: Path, ending: str) -> None:
    video = recording.parent / f"sweep{ending}"
    assert run(recording, "--sweep", "1.2", "9.6", "8", "--video", str(video), "--fps", "5") == 0
    assert [p.name for p in recording.parent.iterdir() if p.name.startswith(".")] == []
    reader, pictures = cv2.VideoCapture(str(video)), []
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(5)
    while (read := reader.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == 8 and pictures[0].shape == (36, 48, 3)
    assert int(np.argmax([sharpness(p) for p in pictures])) == 4
    before = video.read_bytes()
    assert run(recording, "--sweep", "1", "9", "3", "--video", str(video)) == 2, "is there already"
    assert video.read_bytes() == before


def test_a_video_that_fails_leaves_nothing_and_spoils_nothing(tmp_path: Path) -> None:
    video = tmp_path / "made.mp4"
    video.write_bytes(b"before")

    def failing():
        yield np.zeros((36, 48), np.uint8)
        raise OutputError("disk full")

    with pytest.raises(OutputError, match="disk full"):
        write_video(video, failing(), 10)
    assert video.read_bytes() == b"before" and list(tmp_path.iterdir()) == [video]


def test_cameras_and_median(recording: Path) -> None:
    alone, wall = refocused(recording, "--disparity", "12", "--cameras", "cam0")
    assert (alone == wall).mean() > 0.9 and (alone != wall).any(), "the person stands in cam0"
    median, _ = refocused(recording, "--disparity", str(FAR), "--aperture", "median")
    assert abs(median - wall).max() <= 1, "two of three cameras see the wall"
    masked, _ = refocused(recording, "--disparity", str(FAR), "--aperture", "masked-mean")
    assert abs(masked - wall).max() <= 1


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("--disparity", "4"), "--out"),
        (("--out", "o"), "--sweep"),
        (("--out", "o", "--depth", "2", "--sweep", "1", "2", "3"), "either"),
        (("--out", "o", "--sweep", "0", "2", "3"), "above 0"),
        (("--out", "o", "--sweep", "1", "2", "1"), "planes"),
        (("--out", "o", "--depth", "2", "--cameras", "cam0,cam9"), "cam9"),
        (("--out", "o", "--depth", "2", "--frame", "x"), "--frame"),
        (("--video", "o.gif", "--depth", "2"), ".mp4"),
        (("--video", "o.mp4", "--depth", "2", "--fps", "0"), "--fps"),
    ],
)
def test_what_cannot_be_done_is_told(
    recording: Path, settings: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.chdir(recording.parent)
    assert run(recording, *settings) == 2
    assert says in capsys.readouterr().err and not (recording.parent / "o").exists()
