"""Video files in: cam0.mp4, cam1.mp4 ... (or avi, mkv, mov, webm) beside rig.yaml; frame n of all is one instant."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..errors import DatasetError
from .protocol import Dropped, OpenOptions
from .recording import MaskFolder, Recording, find_rig, mask_path

log = logging.getLogger("seepast")

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mjpeg")
TAIL = 25  # frames that a container may promise beyond its last one
FPS_RATIO = 1.0005  # containers round; 29.97 and 30 frames per second are .1 % apart


def is_video_dataset(path: Path) -> bool:
    return path.is_dir() and _video(path, "cam0") is not None and not (path / "cam0").is_dir()


def _video(folder: Path, camera: str) -> Path | None:
    return next((f for f in sorted(folder.glob(f"{camera}.*")) if f.suffix.lower() in VIDEO_SUFFIXES), None)


class Video:
    """One video file, decoded forward; going back starts again from its beginning.

    frames  how many can be read; size (width, height) px; fps frames per second as the container says
    """

    def __init__(self, path: Path):
        """Raises DatasetError for a file that OpenCV cannot decode."""
        self.path = path
        self._open()
        self.size = (self._get(cv2.CAP_PROP_FRAME_WIDTH), self._get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frames = self._count()
        if not self.frames:
            raise DatasetError(f"{path}: not one frame can be decoded; copy it again, or convert it with ffmpeg")
        self._open()

    def read(self, index: int) -> np.ndarray:
        """Frame `index`, uint8 [h, w, 3] BGR; what lies between is decoded, but not converted. Raises DatasetError."""
        if index < self._next:
            self._open()
        while self._next < index and self._capture.grab():
            self._next += 1
        decoded, image = self._capture.read() if self._next == index else (False, None)
        if not decoded or image is None:
            raise DatasetError(
                f"{self.path}: frame {self._next} of {self.frames} cannot be decoded, the file is damaged there; copy "
                "it again, or convert it with ffmpeg"
            )
        self._next += 1
        return image

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        self._next = 0
        if not self._capture.isOpened():
            raise DatasetError(f"{self.path}: cannot be opened as a video; copy it again, or convert it with ffmpeg")

    def _get(self, what: int) -> int:
        return int(self._capture.get(what))

    def _count(self) -> int:
        """The container's count if it is right to within TAIL, which seeking to the end tells; else count."""
        promised = self._get(cv2.CAP_PROP_FRAME_COUNT)
        start = max(promised - TAIL, 0)
        found = promised > 0 and self._capture.set(cv2.CAP_PROP_POS_FRAMES, start)
        if found and self._get(cv2.CAP_PROP_POS_FRAMES) == start:
            readable = start + self._grab_all(TAIL + 1)
            if start < readable <= promised:
                return readable
        self._open()
        return self._grab_all(2**62)

    def _grab_all(self, at_most: int) -> int:
        grabbed = 0
        while grabbed < at_most and self._capture.grab():
            grabbed += 1
        return grabbed


class VideoDataset(Recording):
    """A folder with one video per camera.

    stamps   frame numbers, six digits, from 000000
    dropped  the frames that only longer videos have

    Colour is BGR, also of grey videos. Masks are <masks>/<camera>/<stamp>.png, or <masks>/cam0.mp4 ... of as many
    frames. Raises RigError, DatasetError.
    """

    def __init__(self, path: str | Path, options: OpenOptions | None = None):
        path, options = Path(path), options or OpenOptions()
        rig, rig_file = find_rig(path, options)
        names = [camera.name for camera in rig.cameras]
        self._videos = [_open(path, name) for name in names]
        _check_equal_rate(self._videos)
        counts = [video.frames for video in self._videos]
        masks = mask_path(path, options.masks)
        super().__init__(path, rig, rig_file, [f"{n:06d}" for n in range(min(counts))], masks)
        self.dropped = _surplus(names, counts)
        for video, count in zip(self._videos, counts, strict=True):
            if count > min(counts):
                log.warning("%s: its last %d frames are dropped, another video ends", video.path, count - min(counts))
        self._mask_videos: list[Video] = []
        if masks is not None and _video(masks, names[0]):
            self._mask_videos = [_open(masks, name) for name in names]
            _check_long_enough(self._mask_videos, len(self.stamps))
        elif masks is not None:
            self._folder = MaskFolder(masks, names, [[(stamp,) for stamp in self.stamps]] * len(names))

    def _images(self, index: int) -> Sequence[np.ndarray]:
        return [video.read(index) for video in self._videos]

    def _masks(self, index: int) -> Sequence[np.ndarray]:
        if self._mask_videos:
            return [cv2.cvtColor(video.read(index), cv2.COLOR_BGR2GRAY) for video in self._mask_videos]
        return [self._folder.read(k, index) for k in range(len(self.rig))]

    def _where(self, camera: int, index: int) -> str:
        return f"{self._videos[camera].path}, frame {index}"


def _open(folder: Path, camera: str) -> Video:
    path = _video(folder, camera)
    if path is None:
        known = ", ".join(sorted(p.name for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)) or "none"
        raise DatasetError(f"{folder}: no video of {camera} (there is: {known}); name the files cam0.mp4, cam1.mp4 ...")
    return Video(path)


def _check_equal_rate(videos: Sequence[Video]) -> None:
    slowest, fastest = (choose(videos, key=lambda video: video.fps) for choose in (min, max))
    if slowest.fps > 0 and fastest.fps > FPS_RATIO * slowest.fps:
        raise DatasetError(
            f"{fastest.path}: has {fastest.fps:g} frames per second, {slowest.path.name} {slowest.fps:g}; frame n of "
            "all must be one instant: convert them to one rate from synchronised recordings"
        )


def _check_long_enough(masks: Sequence[Video], frames: int) -> None:
    for video in masks:
        if video.frames < frames:
            raise DatasetError(f"{video.path}: has {video.frames} masks for {frames} frames; make the others")


def _surplus(names: Sequence[str], counts: Sequence[int]) -> tuple[Dropped, ...]:
    shortest = names[int(np.argmin(counts))]
    return tuple(
        Dropped(count - min(counts), f"{name} goes on after {shortest} has ended")
        for name, count in zip(names, counts, strict=True)
        if count > min(counts)
    )
