"""Coarse to fine: the array at one resolution, and what was found there told to the next finer one.

Only the coarsest level looks through the whole range of disparities. Every finer one is matched in a window around
what the coarser one found (Candidates), so that its cost hardly depends on the range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType

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
    def of(colour: np.ndarray, static: np.ndarray, geometry: ArrayGeometry, scale: int, backend: ModuleType) -> Level:
        if scale == 1:
            return Level(1, geometry, colour, static)
        small = reduced(geometry, scale)
        return Level(scale, small, *backend.averaged(colour, static, small.size, scale))

    @property
    def views(self) -> tuple[ArrayGeometry, ...]:
        """The array as seen from every camera."""
        return self.geometry.views


class Pictures:
    """The views of one instant, and the reduced ones that were asked for, each made once.

    colour uint8 [K, H, W, 3], static bool [K, H, W] of full-size views
    """

    def __init__(self, colour: np.ndarray, static: np.ndarray, geometry: ArrayGeometry, backend: ModuleType) -> None:
        self._whole, self._backend = (geometry, colour, static), backend
        self._half_rows: tuple[ArrayGeometry, np.ndarray, np.ndarray] | None = None
        self._levels: dict[tuple[int, bool], Level] = {}

    @property
    def colour(self) -> np.ndarray:
        return self._whole[1]

    def level(self, scale: int, half_rows: bool) -> Level:
        """The views `scale` times smaller; with `half_rows` after every two of their rows were averaged into one."""
        if (scale, half_rows) not in self._levels:
            geometry, colour, static = self._rows_of_two if half_rows else self._whole
            self._levels[scale, half_rows] = Level.of(colour, static, geometry, scale, self._backend)
        return self._levels[scale, half_rows]

    @property
    def _rows_of_two(self) -> tuple[ArrayGeometry, np.ndarray, np.ndarray]:
        if self._half_rows is None:
            geometry, colour, static = self._whole
            self._half_rows = (of_half_rows(geometry), *self._backend.half_rows(colour, static))
        return self._half_rows


@dataclass(frozen=True, eq=False)
class Views:
    """What a level found in every view: disparity uint16 [K, h, w] in 32nds of one of its pixels over the array, and
    confidence uint8 [K, h, w] in 20ths."""

    level: Level
    disparity: np.ndarray
    confidence: np.ndarray

    def at(self, level: Level, backend: ModuleType) -> np.ndarray:
        """The disparities on a finer level, every pixel repeated: uint16 [K, H, W] in 32nds of its pixels."""
        ratio = self.level.scale // level.scale
        return backend.enlarged(self.disparity, ratio, level.static.shape[1:], ratio)


def scales(geometry: ArrayGeometry, o: MultiviewOptions) -> list[int]:
    """What the levels are reduced by, coarsest first: powers of `finer` down to 1."""
    found = [1]
    width, height = geometry.size
    while (coarser := o.finer * found[0]) <= min(o.coarsest, height) and width // coarser >= LEAST_WIDTH:
        found.insert(0, coarser)
    return found


@lru_cache(maxsize=64)  # the same object for every frame: backends keep tables by it
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


@lru_cache(maxsize=64)
def of_half_rows(geometry: ArrayGeometry) -> ArrayGeometry:
    """The array with every two rows averaged into one: the same disparities, on half as many pixels."""
    (fx, fy), (cx, cy), (width, height) = geometry.focal, geometry.center, geometry.size
    return replace(
        geometry,
        focal=(fx, fy / 2),
        center=(cx, (cy - 0.5) / 2),
        size=(width, height // 2),
        shifts=geometry.shifts * np.array([1.0, 0.5]),
    )


def level_grid(span: tuple[float, float], scale: int, step: float) -> DisparityGrid:
    """Candidates of a level for a span (low, high) of disparities in px of full-size views, `step` px of the level
    apart; farther where they would be more than a Candidates can hold."""
    low, high = (EIGHTHS * d / scale for d in span)
    first, spacing = int(np.floor(low)), max(1, round(EIGHTHS * step))
    spacing = max(spacing, int(np.ceil((high - first) / (MOST_CHUNKS * CHUNK - 1))))
    count = int(np.ceil((high - first) / spacing)) + 1
    return DisparityGrid(first, spacing, -(-count // CHUNK) * CHUNK)
