"""Maps from the pixels of one image to those of another: made quickly, and in the form that cv2.remap likes best.

A map goes through a lens, which costs a hundred operations a pixel (Newton's method on the way back), but it is
smooth: a polynomial through a few hundred of its values gives all the others to within rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

PixelMap = Callable[[np.ndarray], np.ndarray]  # pixels float64 (..., 2) -> pixels (..., 2), NaN where there is none

NODES = 24  # of the polynomial, along each axis
MAX_ERROR = 1e-3  # px: a thirtieth of the step of `fixed_point`
_CHECKED = 2 * NODES + 1  # places along each axis, borders included, where the polynomial is held against the map
_SMALL_PRODUCT = 2**18  # multiplications: OpenBLAS takes one thread up to here


def dense(mapped: PixelMap, size: tuple[int, int]) -> np.ndarray:
    """float32[2, H, W]: x and y of `mapped` at every pixel of an image of `size` (width, height).

    Within MAX_ERROR px of `mapped` itself, and rounding: from the polynomial through NODES x NODES Chebyshev points,
    as products of barycentric interpolation matrices (Berrut & Trefethen 2004, eq. 4.2), if it is that close at all
    of _CHECKED x _CHECKED other places; else, as where the lens ends within the image, computed pixel by pixel.
    """
    smooth = _interpolated(mapped, size) if min(size) > _CHECKED else None
    if smooth is not None:
        return smooth
    x, y = np.meshgrid(*(np.arange(length, dtype=np.float64) for length in size))
    return np.ascontiguousarray(np.moveaxis(mapped(np.stack([x, y], axis=-1)), -1, 0), np.float32)


def _interpolated(mapped: PixelMap, size: tuple[int, int]) -> np.ndarray | None:
    """The polynomial's values at every pixel, or None if it is no good."""
    nodes = np.moveaxis(mapped(_grid(*(_chebyshev(length) for length in size))), -1, 0)
    if not np.isfinite(nodes).all():
        return None
    places = [np.linspace(0, length - 1, _CHECKED) for length in size]
    truth = np.moveaxis(mapped(_grid(*places)), -1, 0)
    across, down = (_barycentric(length, tuple(at)) for length, at in zip(size, places, strict=True))
    if not (abs(down @ nodes @ across.T - truth) < MAX_ERROR).all():  # NaN is no good either
        return None
    across, down = (_barycentric(length, None) for length in size)
    return _product(down @ nodes, np.ascontiguousarray(across.T))


def _product(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """float32[2, H, W] rows[2, H, n] @ matrix[n, W], in pieces for which no BLAS starts threads: waiting for one
    another while cores are busy with something else, they took fifty times as long."""
    out = np.empty((*rows.shape[:2], matrix.shape[1]), np.float32)
    step = max(1, _SMALL_PRODUCT // matrix.size)
    for c in range(len(rows)):
        for y in range(0, rows.shape[1], step):
            out[c, y : y + step] = rows[c, y : y + step] @ matrix
    return out


def _grid(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y), axis=-1)


def _chebyshev(length: int) -> np.ndarray:
    """NODES Chebyshev points of the second kind over the pixels 0 .. length - 1, both ends included."""
    return (length - 1) / 2 * (1 - np.cos(np.pi * np.arange(NODES) / (NODES - 1)))


@lru_cache(maxsize=8)
def _barycentric(length: int, at: tuple[float, ...] | None) -> np.ndarray:
    """float64[N, NODES]: values at the nodes -> values `at` N places, None for every pixel."""
    places = np.arange(length, dtype=np.float64) if at is None else np.array(at)
    weights = np.where(np.arange(NODES) % 2, -1.0, 1.0)
    weights[[0, -1]] /= 2
    difference = places[:, None] - _chebyshev(length)
    hit = difference == 0
    terms = weights / np.where(hit, 1.0, difference)
    matrix = terms / terms.sum(axis=1, keepdims=True)
    return np.where(hit.any(axis=1, keepdims=True), hit, matrix)


def inside(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """bool[H, W]: where pixels [2, H, W] lie on the image: half a pixel beyond the outer centres does, NaN not."""
    x, y = pixels
    return (x >= -0.5) & (x <= size[0] - 0.5) & (y >= -0.5) & (y <= size[1] - 0.5)


def fixed_point(pixels: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """cv2.remap's fastest map form, 1/32 px, int16[H, W, 2] and uint16[H, W], of pixels [2, H, W].

    Pixels outside `size` are clamped to just beyond its border.
    """
    near_x, near_y = (_between(plane, -1, length) for plane, length in zip(pixels, size, strict=True))
    whole, fraction = cv2.convertMaps(near_x, near_y, cv2.CV_16SC2)
    return whole, fraction


def _between(plane: np.ndarray, low: float, high: float) -> np.ndarray:
    """float32, clamped; `low` where NaN is. What fmin(fmax()) gives, which takes ten times as long."""
    near = np.minimum(np.maximum(plane, np.float32(low)), np.float32(high))
    if np.isnan(near.sum()):
        np.nan_to_num(near, copy=False, nan=low)
    return near
