"""Files that appear whole or not at all, whatever kills the process in between."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import OutputError

PART_SUFFIX = ".part"


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
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image))
    if not encoded:
        raise OutputError(f"{path}: {image.dtype} image of shape {image.shape} cannot be encoded as PNG")
    write_bytes(path, data.tobytes())


def write_pfm(path: Path, values: np.ndarray) -> None:
    """float32 [H, W] as little-endian PFM: rows bottom-up, scale -1."""
    height, width = values.shape
    header = f"Pf\n{width} {height}\n-1.0\n".encode()
    write_bytes(path, header + np.ascontiguousarray(values[::-1], dtype="<f4").tobytes())


def remove_parts(folder: Path) -> None:
    """Remove what a killed run left half-written below `folder`."""
    for part in folder.rglob(f".*{PART_SUFFIX}"):
        part.unlink(missing_ok=True)
