"""Pictures as a video file that appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from ..errors import OptionsError, OutputError
from .atomic import replacing

CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v"}  # that the encoders within OpenCV's wheels write


def check_video_path(path: Path) -> None:
    """Raises OptionsError if the ending is none that `write_video` knows."""
    if path.suffix.lower() not in CODECS:
        raise OptionsError(f"{path}: the ending says what is written, one of {', '.join(CODECS)}")


def write_video(path: Path, pictures: Iterable[np.ndarray], frames_per_second: float) -> int:
    """Write uint8 [H, W] or [H, W, 3] BGR pictures of one size to `path`; returns their number.

    Raises OptionsError for an ending that is not in CODECS, OutputError if the file cannot be written.
    """
    check_video_path(path)
    with replacing(path) as part:
        writer, written = None, 0
        try:
            for picture in pictures:
                colour = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture
                if writer is None:
                    writer = _opened(part, path, colour, frames_per_second)
                writer.write(np.ascontiguousarray(colour))
                written += 1
        finally:
            if writer is not None:
                writer.release()
        if not part.is_file() or not part.stat().st_size:
            raise OutputError(f"{path}: no picture was written to it; look at free space, or leave --video away")
    return written


def _opened(part: Path, path: Path, first: np.ndarray, frames_per_second: float) -> cv2.VideoWriter:
    code = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
    writer = cv2.VideoWriter(str(part), code, frames_per_second, (first.shape[1], first.shape[0]))
    if not writer.isOpened():
        raise OutputError(f"{path}: this OpenCV cannot write {path.suffix}; take another ending, or numbered PNGs")
    return writer
