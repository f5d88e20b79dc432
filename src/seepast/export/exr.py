"""One multi-channel OpenEXR per frame, for compositing and for tools that want floats.

    R G B (or Y)   half, the stored 8-bit values / 255: as the camera encoded them, not linearised
    Z              float, metres along the optical axis; +inf = unknown, so that it composites behind everything
    disparity      float, px over the array; 0 = unknown
    coverage       half, how many cameras saw the pixel; 0 = a guess
    confidence     float, where the run wrote one

The header carries stamp, seconds, fx, fy, cx, cy, baseline and focalBaseline (Z = focalBaseline / disparity). Masks
live in their own cameras' pixels and stay out.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..extras import require
from .protocol import ExportOptions
from .reading import View, Written
from .times import seconds

COMMENT = "R G B as stored, not linearised; Z in metres, inf = unknown; disparity in px, 0 = unknown"


def write_exr(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write: path/<stamp>.exr, ZIP compressed. Raises MissingExtraError without the package OpenEXR."""
    openexr = require("OpenEXR", "exr", "seepast export --to exr")
    path.mkdir(parents=True, exist_ok=True)
    for time, frame in frames:
        header = {
            "compression": openexr.ZIP_COMPRESSION,
            "type": openexr.scanlineimage,
            **attributes(view, frame.stamp, time),
        }
        with openexr.File(header, channels(frame)) as file:
            try:
                file.write(str(path / f"{frame.stamp}.exr"))
            except RuntimeError as error:  # how a full disk shows
                raise OSError(str(error)) from error


def attributes(view: View, stamp: str, time: int) -> dict[str, Any]:
    (fx, fy), (cx, cy) = view.focal, view.center
    camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "baseline": view.baseline, "focalBaseline": view.focal_baseline}
    return {"comments": COMMENT, "stamp": stamp, "seconds": seconds(time), "camera": view.camera, **camera}


def channels(frame: Written) -> dict[str, np.ndarray]:
    """Channel name -> contiguous float16 or float32 [H, W]."""
    image = (frame.background / np.float32(255)).astype(np.float16)
    planes = {"Y": image} if image.ndim == 2 else {name: image[..., 2 - i] for i, name in enumerate("RGB")}
    planes["Z"] = np.where(frame.depth > 0, frame.depth, np.float32(np.inf))
    planes["disparity"] = frame.disparity
    planes["coverage"] = frame.coverage.astype(np.float16)
    if frame.confidence is not None:
        planes["confidence"] = frame.confidence
    return {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
