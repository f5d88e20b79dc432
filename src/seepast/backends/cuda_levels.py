"""What lies between the many-view stages on the GPU: levels, and masks moved between views.

Names, arguments and results are those of host.py; arrays are the device's.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.launches import int32, launch_line, launch_tiles, view_table
from ..gpu.morphology import dilated, eroded
from ..gpu.tables import constant
from .host import interpolated

__all__ = [
    "averaged",
    "beside",
    "clear_of_masks",
    "copied",
    "double_rows",
    "enlarged",
    "half_rows",
    "inner_span",
    "landings",
    "mapped",
    "three_channels",
    "witnessed",
]

BINS = 1 << 16
MOST_RADIUS = 15  # level.cu grow_disc


def mapped(colour, tables: np.ndarray):
    out = device.current().xp.empty_like(colour)
    K, height, width, channels = colour.shape
    launch_tiles(
        "level", "mapped", (K, height, width), colour, device.current().upload(tables),
        *int32(height, width, channels), out,
    )  # fmt: skip
    return out


def copied(array):
    return array.copy()


def three_channels(colour):
    """Grey views as BGR: uint8 [K, H, W, C] -> [K, H, W, 3]."""
    if colour.shape[-1] == 3:
        return colour
    xp = device.current().xp
    return xp.ascontiguousarray(xp.broadcast_to(colour, (*colour.shape[:-1], 3)))


def averaged(colour, static, size: tuple[int, int], scale: int):
    xp, K, (width, height) = device.current().xp, len(colour), size
    small, small_static = xp.empty((K, height, width, 3), np.uint8), xp.empty((K, height, width), bool)
    launch_tiles(
        "level", "averaged", (K, height, width), colour, static,
        *int32(*static.shape[1:], scale, height, width), small, small_static,
    )  # fmt: skip
    return small, small_static


def enlarged(views, ratio: int, shape: tuple[int, ...], factor: int = 1):
    """Views uint16 or bool."""
    if ratio == factor == 1:
        return views
    out = device.current().xp.empty((len(views), *shape), views.dtype)
    kernel = {1: "enlarge_bytes", 2: "enlarge_words"}[views.dtype.itemsize]
    launch_tiles("level", kernel, out.shape, views, *int32(*views.shape[1:], ratio, factor, *shape), out)
    return out


def half_rows(colour, static):
    xp, (K, height, width) = device.current().xp, static.shape
    small, small_static = xp.empty((K, height // 2, width, 3), np.uint8), xp.empty((K, height // 2, width), bool)
    launch_tiles("level", "half_rows", small_static.shape, colour, static, *int32(height, width), small, small_static)
    return small, small_static


def double_rows(views, height: int):
    out = device.current().xp.empty((len(views), height, views.shape[2]), views.dtype)
    launch_tiles("level", "double_rows", out.shape, views, *int32(*views.shape[1:], height), out)
    return out


def beside(views, across: int, down: int):
    return dilated(views, across, down)


def landings(hidden, low, high, geometry: ArrayGeometry):
    out = device.current().xp.zeros((geometry.cameras, *hidden.shape), bool)
    launch_tiles(
        "level", "landings", (1, *hidden.shape), *view_table(geometry), hidden, low, high,
        *int32(geometry.cameras, *hidden.shape), out,
    )  # fmt: skip
    return out


def witnessed(hidden, disparities, static, geometry: ArrayGeometry, most: int, tolerance: int):
    out = device.current().xp.zeros(static.shape, bool)
    launch_tiles(
        "level", "witnessed", (1, *hidden.shape), *view_table(geometry), hidden, disparities, static,
        constant(geometry.nearest_first), *int32(most, tolerance, geometry.cameras, *hidden.shape), out,
    )  # fmt: skip
    return out


def clear_of_masks(static):
    return grown(static, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)), erode=True)


def grown(masks, disc: np.ndarray, erode: bool = False):
    """bool [V, H, W] dilated, or eroded, by a disc uint8 [2 r + 1, 2 r + 1]; what is outside never counts."""
    out, radius = device.current().xp.empty_like(masks), len(disc) // 2
    reach = constant(disc.sum(1, dtype=np.int32) // 2 - (disc.sum(1) == 0).astype(np.int32))
    small = radius <= MOST_RADIUS
    launch_tiles(
        "level", "grow_disc" if small else "grow_large_disc", masks.shape, masks, reach,
        *int32(radius, *masks.shape[1:], erode), out, rows=32 if small else 8,
    )  # fmt: skip
    return out


def inner_span(disparity, agree, static, scale: int, reach: int, percentiles: Sequence[float]) -> np.ndarray | None:
    """float64 [n] on the host, which waits for 2 n + 1 numbers: they decide how much is launched next."""
    xp, (height, width) = device.current().xp, disparity.shape[1:]
    small = xp.ascontiguousarray(static[:, scale // 2 :: scale, scale // 2 :: scale][:, :height, :width])
    bins, found = xp.zeros(BINS, np.int32), xp.empty(1 + 2 * len(percentiles), np.int32)
    shares = np.asarray(percentiles, np.float64) / 100
    launch_line(
        "span", "count_disparities", disparity.size, disparity, agree, eroded(small, reach),
        np.int32(disparity.size), bins,
    )  # fmt: skip
    device.current().launch(
        "span", "ranks", grid=(1,), block=(1024,), args=[bins, constant(shares), np.int32(len(shares)), found]
    )
    count, *values = device.current().download(found).tolist()
    return interpolated(shares * (count - 1), np.array(values, np.float64).reshape(-1, 2)) if count else None
