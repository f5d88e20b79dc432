"""Coarse to fine: the array at one resolution, and what was found there told to the next finer one.

Only the coarsest level looks through the whole range of disparities. Every finer one is matched in a window around
what the coarser one found (Candidates), so that its cost hardly depends on the range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from .candidates import CHUNK, EIGHTHS, DisparityGrid
from .geometry import ArrayGeometry
from .options import MultiviewOptions

LEAST_WIDTH = 64  # px: no level is narrower
MOST_CHUNKS = 64  # bits of Candidates.active


@dataclass(frozen=True, eq=False)
class Level:
    """The array with `scale` x `scale` pixels averaged into one.

    geometry  of the reduced views
    colour    uint8 [K, h, w, 3]
    static    bool [K, h, w]: every pixel that was averaged is static
    """

    scale: int
    geometry: ArrayGeometry
    colour: np.ndarray
    static: np.ndarray

    @staticmethod
    def of(colour: np.ndarray, static: np.ndarray, geometry: ArrayGeometry, scale: int) -> Level:
        if scale == 1:
            return Level(1, geometry, colour, static)
        small = reduced(geometry, scale)
        width, height = (n * scale for n in small.size)
        colour = np.stack([cv2.resize(v[:height, :width], small.size, interpolation=cv2.INTER_AREA) for v in colour])
        rows = np.logical_and.reduce([static[:, i:height:scale, :width] for i in range(scale)])
        return Level(scale, small, colour, np.logical_and.reduce([rows[:, :, i::scale] for i in range(scale)]))

    @property
    def views(self) -> list[ArrayGeometry]:
        """The array as seen from every camera."""
        return [self.geometry.seen_from(k) for k in range(self.geometry.cameras)]


@dataclass(frozen=True, eq=False)
class Views:
    """What a level found in every view: disparity uint16 [K, h, w] in 32nds of one of its pixels over the array, and
    confidence uint8 [K, h, w] in 20ths."""

    level: Level
    disparity: np.ndarray
    confidence: np.ndarray

    def at(self, level: Level) -> np.ndarray:
        """The disparities on a finer level, every pixel repeated: uint16 [K, H, W] in 32nds of its pixels."""
        ratio = self.level.scale // level.scale
        return enlarged(self.disparity, ratio, level.static.shape[1:]) * np.uint16(ratio)


def scales(geometry: ArrayGeometry, o: MultiviewOptions) -> list[int]:
    """What the levels are reduced by, coarsest first: powers of two down to 1."""
    found = [1]
    while 2 * found[0] <= o.coarsest and geometry.size[0] // (2 * found[0]) >= LEAST_WIDTH:
        found.insert(0, 2 * found[0])
    return found


def reduced(geometry: ArrayGeometry, scale: int) -> ArrayGeometry:
    """The array with `scale` x `scale` pixels averaged into one."""
    if scale == 1:
        return geometry
    width, height = geometry.size
    cx, cy = ((c - (scale - 1) / 2) / scale for c in geometry.center)
    return replace(
        geometry,
        focal=(geometry.focal[0] / scale, geometry.focal[1] / scale),
        center=(cx, cy),
        size=(max(1, width // scale), max(1, height // scale)),
        shifts=geometry.shifts / scale,
    )


def enlarged(views: np.ndarray, ratio: int, shape: tuple[int, ...]) -> np.ndarray:
    """Views of reduced size with every pixel repeated, up to `shape`: [K, h, w] -> [K, H, W]."""
    if ratio == 1:
        return views
    return np.stack([_enlarged(view, ratio, shape) for view in views])


def _enlarged(view: np.ndarray, ratio: int, shape: tuple[int, ...]) -> np.ndarray:
    # OpenCV knows no bool; its nearest neighbour is the same for whole ratios, and much faster than repeat
    bytes_or_words = view.view(np.uint8) if view.dtype == bool else view
    size = view.shape[1] * ratio, view.shape[0] * ratio
    whole = cv2.resize(np.ascontiguousarray(bytes_or_words), size, interpolation=cv2.INTER_NEAREST).view(view.dtype)
    after = [(0, max(0, want - have)) for want, have in zip(shape, whole.shape, strict=True)]
    if any(n for _, n in after):
        whole = np.pad(whole, after, mode="edge")
    return whole[: shape[0], : shape[1]]


def level_grid(span: tuple[float, float], scale: int, step: float) -> DisparityGrid:
    """Candidates of a level for a span (low, high) of disparities in px of full-size views, `step` px of the level
    apart; farther where they would be more than a Candidates can hold."""
    low, high = (EIGHTHS * d / scale for d in span)
    first, spacing = int(np.floor(low)), max(1, round(EIGHTHS * step))
    spacing = max(spacing, int(np.ceil((high - first) / (MOST_CHUNKS * CHUNK - 1))))
    count = int(np.ceil((high - first) / spacing)) + 1
    return DisparityGrid(first, spacing, -(-count // CHUNK) * CHUNK)


def beside(views: np.ndarray, reach: int) -> np.ndarray:
    """bool [K, h, w] grown by `reach` px along rows and columns."""
    square = np.ones((2 * reach + 1,) * 2, np.uint8)
    return np.stack([cv2.dilate(np.ascontiguousarray(view).view(np.uint8), square) > 0 for view in views])


def landings(hidden: np.ndarray, disparity: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    """Where the rays of the reference's pixels `hidden` bool [h, w], disparity px [h, w], end in each view:
    bool [K, h, w]."""
    out = np.zeros((geometry.cameras, *hidden.shape), bool)
    y, x = np.nonzero(hidden)
    d = disparity[y, x]
    for k in range(geometry.cameras):
        u, v = (np.rint(p).astype(np.int64) for p in geometry.warp(k, x, y, d))
        there = (u >= 0) & (u < hidden.shape[1]) & (v >= 0) & (v < hidden.shape[0])
        out[k, v[there], u[there]] = True
    return out
