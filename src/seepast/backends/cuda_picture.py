"""The many-view method's last stages on the GPU: planes, blend, and the evidence on disparities.

Names, arguments and results are those of reference_multiview.py and host.py; arrays are the device's.
"""

from __future__ import annotations

import numpy as np

from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.launches import int32, launch_line, launch_tiles, view_table
from ..gpu.tables import constant
from ..many import LIGHT, UNITS
from .cuda import probability

__all__ = ["blend", "evidence", "planes", "planes_of_views", "ray_count", "told"]

PLANE_TILE = (64, 16)  # plane_fit.cu: pixels of a block


def planes(disparity, trusted, wanted, image, static):
    return _planes("planes", disparity[None], trusted, wanted, image, static)[0]


def planes_of_views(found, sure, colour, static):
    """`planes` of every view [K, H, W], trusted where static and another view agrees, wanted where none does."""
    return _planes("planes_of_views", found, sure, colour, static)


def _planes(kernel: str, found, *args):
    out = device.current().xp.empty_like(found)
    views, height, width = found.shape
    grid = (-(-width // PLANE_TILE[0]), -(-height // PLANE_TILE[1]), views)
    device.current().launch(
        "plane_fit", kernel, grid=grid, block=(256,), args=[found, *args, *int32(height, width), out]
    )
    return out


def blend(colour, rays, clear, near: np.ndarray, edge: float, geometry: ArrayGeometry, disparity, wanted):
    """near float32 [K]: a NumPy array."""
    out = device.current().xp.empty(colour.shape[1:], np.uint8)
    numbers = *int32(geometry.cameras, geometry.reference, *rays.shape), out
    launch_tiles(
        "blend", "blend", (1, *rays.shape), *view_table(geometry), colour, rays, clear, constant(near),
        constant(geometry.nearest_first), LIGHT, np.float32(edge), disparity, wanted, *numbers,
    )  # fmt: skip
    return out


def evidence(d, static, close, shown):
    out = device.current().xp.empty(d.shape, np.uint8)
    launch_tiles("witness", "evidence", (1, *d.shape), d, static, close, shown, *int32(*d.shape), out, rows=32)
    return out


def told(d, evidence, table: np.ndarray, shown, keep=None):
    disparity, sure = d.astype(np.float32) / np.float32(UNITS), probability(evidence, table)
    if keep is not None:
        disparity, sure = (np.where(keep, np.float32(0), of) for of in (disparity, sure))
    return disparity, sure, ray_count(shown)


def ray_count(labels):
    out = device.current().xp.empty(labels.shape, np.uint8)
    launch_line("level", "ray_count", labels.size, labels, np.int32(labels.size), out)
    return out
