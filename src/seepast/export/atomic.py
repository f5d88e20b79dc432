"""Files that appear whole or not at all, whatever kills the process in between."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import OutputError, SeepastError

PART_SUFFIX = ".part"
# every row less the one above: depth, confidence and coverage take half the room, and a third less time, of OpenCV's
# own choice (less the pixel before); older releases of it leave no choice
PNG_FILTER = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []


def write_bytes(path: Path, data: bytes) -> None:
    """Write `path` through a hidden sibling that replaces it once complete. Raises OutputError."""
    part = path.with_name(f".{path.name}{PART_SUFFIX}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); check permissions and free space, then run again"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    write_bytes(path, (json.dumps(value, indent=1) + "\n").encode())


def write_png(path: Path, image: np.ndarray) -> None:
    """uint8 [H, W] or [H, W, 3] BGR, or uint16 [H, W]."""
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image), PNG_FILTER)
    if not encoded:
        raise OutputError(f"{path}: {image.dtype} image of shape {image.shape} cannot be encoded as PNG")
    write_bytes(path, data.tobytes())


def write_pfm(path: Path, values: np.ndarray) -> None:
    """float32 [H, W] as little-endian PFM: rows bottom-up, scale -1."""
    height, width = values.shape
    header = f"Pf\n{width} {height}\n-1.0\n".encode()
    write_bytes(path, header + np.ascontiguousarray(values[::-1], dtype="<f4").tobytes())


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a hidden path of the same name to write a file or a folder to, which takes the place of `path` at the end.

    If anything goes wrong in between, `path` stays as it was. Raises OutputError.
    """
    stage = path.with_name(f".{path.name}{PART_SUFFIX}")
    try:
        _remove(stage)
        stage.mkdir(parents=True)
        yield stage / path.name
        _take_place(stage / path.name, path, stage / ".before")
    except SeepastError:
        raise
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); check permissions and free space, then try again"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            _remove(stage)


def _take_place(new: Path, path: Path, before: Path) -> None:
    if not path.is_dir():
        os.replace(new, path)
        return
    os.replace(path, before)  # a folder that is not empty cannot be replaced in one step
    try:
        os.replace(new, path)
    except OSError:
        os.replace(before, path)
        raise


def remove_parts(folder: Path) -> None:
    """Remove what a killed run or export left half-written below `folder`."""
    for part in list(folder.rglob(f".*{PART_SUFFIX}")):
        _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
