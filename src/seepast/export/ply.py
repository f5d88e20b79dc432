"""Coloured points, one binary PLY per frame, which MeshLab, CloudCompare, Blender and Open3D read.

Points are in the rectified reference view: x right, y down, z forward, metres. Every point keeps how many cameras saw
it, `coverage`, and its `confidence` where the run wrote one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from .atomic import write_bytes
from .protocol import ExportOptions
from .reading import View, Written, colour
from .times import seconds

_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write: path/<stamp>.ply of the pixels of known depth."""
    for time, frame in frames:
        comments = (
            f"seepast frame {frame.stamp} at {seconds(time)} s",
            f"metres in the rectified view of {view.camera}: x right, y down, z forward",
            "coverage: how many cameras saw the point, 0 = a guess",
        )
        write_bytes(path / f"{frame.stamp}.ply", ply_bytes(vertices(view, frame), comments))


def vertices(view: View, frame: Written) -> np.ndarray:
    """A structured array of x y z float32, red green blue coverage uint8 and, where there is one, confidence float32.

    In the order of pixels, row by row, without those of unknown depth.
    """
    known = frame.depth > 0
    x, y, z = view.points(frame.depth)[known].T
    blue, green, red = colour(frame.background)[known].T
    fields = {"x": x, "y": y, "z": z, "red": red, "green": green, "blue": blue, "coverage": frame.coverage[known]}
    if frame.confidence is not None:
        fields["confidence"] = frame.confidence[known]
    made = np.empty(len(x), [(name, "<f4" if values.dtype == np.float32 else "|u1") for name, values in fields.items()])
    for name, values in fields.items():
        made[name] = values
    return made


def ply_bytes(points: np.ndarray, comments: Iterable[str] = ()) -> bytes:
    """A binary little-endian PLY 1.0 of one element "vertex", from a structured array of float32 and uint8 fields."""
    assert points.dtype.names is not None
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {len(points)}")
    header += [f"property {_TYPES[points.dtype[name].str]} {name}" for name in points.dtype.names]
    return "\n".join([*header, "end_header", ""]).encode() + points.tobytes()
