"""Video files in, one per camera."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import SIZE, save
from seepast.cli import main
from seepast.datasets import open_dataset
from seepast.datasets.video import Video, VideoDataset
from seepast.errors import DatasetError, RigError
from seepast.rig import Rig


def picture(camera: int, frame: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Of one colour, so that lossy codecs keep it."""
    return np.full((size[1], size[0], 3), (10 + 60 * camera, 5 * frame, 100), np.uint8)


def write_video(path: Path, frames: list[np.ndarray], codec: str = "FFV1", fps: float = 20) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), fps, size)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def make(path: Path, counts: tuple[int, ...] = (40, 40, 40), suffix: str = "avi", codec: str = "FFV1") -> Path:
    for k, count in enumerate(counts):
        write_video(path / f"cam{k}.{suffix}", [picture(k, n) for n in range(count)], codec)
    Rig.linear(len(counts), focal=48.0, spacing=0.1, size=SIZE).to_kalibr(path / "rig.yaml")
    return path


@pytest.mark.parametrize(("suffix", "codec", "error"), [("avi", "FFV1", 0), ("avi", "MJPG", 4), ("mp4", "mp4v", 6)])
def test_every_frame_in_any_order(tmp_path: Path, suffix: str, codec: str, error: int) -> None:
    dataset = open_dataset(make(tmp_path / "r", suffix=suffix, codec=codec), masks="none")
    assert isinstance(dataset, VideoDataset)
    assert list(dataset.stamps) == [f"{n:06d}" for n in range(40)]
    for n in (0, 1, 2, 17, 39, 16, 3, 4):
        for k, image in enumerate(dataset.frame(f"{n:06d}").images):
            assert abs(image.astype(int) - picture(k, n)).max() <= error, (n, k)


def test_longer_videos_lose_their_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "seepast"):
        dataset = open_dataset(make(tmp_path / "r", (40, 33, 35)), masks="none")
    assert len(dataset.stamps) == 33 and len(list(dataset)) == 33
    assert [str(d) for d in dataset.dropped] == [
        "7 images: cam0 goes on after cam1 has ended",
        "2 images: cam2 goes on after cam1 has ended",
    ]
    assert "cam0.avi: its last 7 frames are dropped" in caplog.text


def test_masks_in_pictures_or_in_videos(tmp_path: Path) -> None:
    path = make(tmp_path / "r", (3, 3))
    for k in range(2):
        grey = [np.full((SIZE[1], SIZE[0], 3), 50 * k + n, np.uint8) for n in range(3)]
        write_video(path / "moving" / f"cam{k}.mkv", grey)
        for n in range(3):
            save(path / "masks" / f"cam{k}" / f"{n:06d}.png", np.full(SIZE[::-1], 50 * k + n, np.uint8))
    for masks in ("masks", "moving"):
        dataset = open_dataset(path, masks=masks)
        assert [[int(m[0, 0]) for m in f.masks or ()] for f in dataset] == [[0, 50], [1, 51], [2, 52]]
    write_video(path / "moving" / "cam1.mkv", [np.zeros((SIZE[1], SIZE[0], 3), np.uint8)])
    with pytest.raises(DatasetError, match=r"cam1\.mkv: has 1 masks for 3 frames"):
        open_dataset(path, masks="moving")


def test_a_run_and_a_forced_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = make(tmp_path / "r", (2, 2))
    arguments = ["--out", str(tmp_path / "out"), "--preset", "paper", "--masks", "none"]
    assert main(["run", str(path), "--reader", "video", *arguments]) == 0
    assert "2 frames" in capsys.readouterr().out
    assert main(["run", str(path), "--reader", "folder", *arguments]) == 2
    assert "cam0: missing" in capsys.readouterr().err


def test_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    path = make(tmp_path / "r", (3, 3))
    (path / "cam1.avi").rename(path / "left.avi")
    with pytest.raises(DatasetError, match=r"no video of cam1 \(there is: cam0\.avi, left\.avi\)"):
        open_dataset(path, masks="none")
    write_video(path / "cam1.avi", [picture(1, n, (64, 48)) for n in range(3)])
    with pytest.raises(DatasetError, match=r"cam1\.avi, frame 0: is 64x48, but .*rig\.yaml says 48x36"):
        open_dataset(path, masks="none").frame("000000")
    write_video(path / "cam1.avi", [picture(1, n) for n in range(3)], fps=25)
    with pytest.raises(DatasetError, match=r"cam1\.avi: has 25 frames per second, cam0\.avi 20"):
        open_dataset(path, masks="none")
    (path / "cam1.avi").write_bytes(b"RIFF no video")
    with pytest.raises(DatasetError, match=r"cam1\.avi: cannot be opened as a video"):
        open_dataset(path, masks="none")
    (path / "rig.yaml").unlink()
    with pytest.raises(RigError, match="no calibration"):
        open_dataset(path, masks="none")


def test_a_truncated_video_ends_where_it_was_cut(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8) for _ in range(40)]
    file = write_video(tmp_path / "cam0.avi", frames, "MJPG")
    whole = Video(file)
    assert (whole.frames, whole.size, whole.fps) == (40, SIZE, 20.0)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    cut = Video(file)
    assert 10 < cut.frames < 25
    for n in range(cut.frames):
        assert cut.read(n).shape == (SIZE[1], SIZE[0], 3)
