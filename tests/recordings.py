"""Small recordings in the folder layout, for the tests of what reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from seepast.rig import Rig

SIZE = (48, 36)


def write_recording(
    path: Path,
    *,
    cameras: int = 3,
    stamps: Sequence[str] = ("000000",),
    size: tuple[int, int] = SIZE,
    color: bool = True,
    masks: str | None = "masks",
    seed: int = 0,
) -> Path:
    """An ideal array looking at a textured wall; the masks call a box in the middle dynamic."""
    width, height = size
    path.mkdir(parents=True, exist_ok=True)
    Rig.linear(cameras, focal=float(width), spacing=0.1, size=size).to_kalibr(path / "rig.yaml")
    rng = np.random.default_rng(seed)
    for stamp in stamps:
        wall = cv2.resize(rng.integers(0, 255, (height // 3, width, 3), np.uint8), (2 * width, height))
        for k in range(cameras):
            view = wall[:, 2 * k : 2 * k + width]
            save(path / f"cam{k}" / f"{stamp}.png", view if color else view[..., 0])
            if masks:
                mask = np.zeros((height, width), np.uint8)
                mask[height // 3 : 2 * height // 3, width // 3 : width // 2] = 255
                save(path / masks / f"cam{k}" / f"{stamp}.png", mask)
    return path


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path
