"""What every camera sees, people included, at a coarse look; and the disparities that the static scene spans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from .candidates import DisparityGrid
from .geometry import ArrayGeometry
from .levels import Level, level_grid
from .many import UNITS, PairCosts, Penalties
from .options import Options

CLEAR = 10  # px: surfaces that near to people may be theirs
INNER = (0.3, 99.7)  # percentiles of the disparities that are believed


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What every camera sees, people included, on views reduced `scale` times.

    disparity  uint16 [K, h, w] in 32nds of a reduced pixel
    agree      bool [K, h, w]: another view confirms it
    """

    scale: int
    disparity: np.ndarray
    agree: np.ndarray

    def at_full_size(self, shape: tuple[int, ...], backend: ModuleType) -> np.ndarray:
        """float32 [K, *shape] px over the array."""
        return backend.enlarged(self.disparity, self.scale, shape).astype(np.float32) * np.float32(self.scale / UNITS)


def surfaces(
    colour: np.ndarray, geometry: ArrayGeometry, scale: int, options: Options, backend: ModuleType
) -> Surfaces:
    """Semi-global matching of every view reduced `scale` times, without any mask, through the whole range.

    colour  uint8 [K, H, W, 3]
    """
    o = options.multiview
    level = Level.of(colour, np.ones_like(colour[..., 0], bool), geometry, scale, backend)
    low, *_, high = search_range(geometry, options).values
    candidates = [backend.everything(level_grid((low, high), scale, 1.0), level.static.shape[1:])] * geometry.cameras
    penalties = Penalties.of(o.small_penalty, o.large_penalty, o.least_penalty, 0)
    features, costs = backend.describe(level.colour, level.static), PairCosts.of(o)
    volumes = backend.volumes(features, level.views, candidates, costs)
    found = backend.aggregates(volumes, level.colour, level.static, candidates, penalties, o.paths)
    _, agree = backend.graded_of_views(found, level.static, level.views, round(UNITS * o.tolerance), 0, 0)
    return Surfaces(scale, found, agree)


def looks(geometry: ArrayGeometry, options: Options) -> list[int]:
    """How often views are reduced for the look at all surfaces. The masks want more of it than the range does: the
    first look tells whether they are exact, which spares the closer one."""
    (width, height), o = geometry.size, options.people
    if not o.enabled:
        return [max(1, min(options.multiview.range_scale, width // 64, height))]
    first, close = (_halved(width, height, most) for most in (min(o.first_width, o.surface_width), o.surface_width))
    return [first, close] if first != close else [close]


def _halved(width: int, height: int, most: int) -> int:
    """How often, in powers of two, until views are at most that wide."""
    scale = 1
    while width // scale > most and 2 * scale <= height:
        scale *= 2
    return scale


def search_range(geometry: ArrayGeometry, options: Options) -> DisparityGrid:
    """What is looked through at first: options.range in whole pixels; 0.45 x the width beyond the views' own shifts."""
    wanted = replace(options.range, step=1.0)
    if not wanted.max_disparity:
        far = np.abs(geometry.offsets[:, 0]) > 0.5
        beyond = max(0.0, float((geometry.offsets[far, 3] / geometry.offsets[far, 0]).max(initial=0)))
        wanted = replace(wanted, max_disparity=min(4096.0, 0.45 * geometry.size[0] + beyond))
    return DisparityGrid.of(wanted, geometry.size[0])


def static_span(
    seen: Surfaces, static: np.ndarray, geometry: ArrayGeometry, options: Options, backend: ModuleType
) -> tuple[float, float]:
    """Lowest and highest disparity of the static scene, px of full-size views; static bool [K, H, W].

    Percentiles of the disparities that another view confirms, clear of people, and a margin.
    """
    low, *_, high = search_range(geometry, options).values
    inner = backend.inner_span(seen.disparity, seen.agree, static, seen.scale, CLEAR // seen.scale, INNER)
    if inner is not None:
        inner = inner * (seen.scale / UNITS)
        margin = max(2.0, 0.04 * (inner[1] - inner[0])) + 10
        low, high = max(low, inner[0] - margin), min(high, inner[1] + margin)
    return float(np.floor(low)), float(high)
