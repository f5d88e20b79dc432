"""What every camera sees, people included, at a coarse look; and the disparities that the static scene spans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from .candidates import CHUNK, Candidates, DisparityGrid
from .geometry import ArrayGeometry
from .levels import Level, Pictures, level_grid, scales
from .many import UNITS, PairCosts, Penalties
from .options import Options

CLEAR = 10  # px: surfaces that near to people may be theirs
INNER = (0.3, 99.7)  # percentiles of the disparities that are believed
SPARE = 5  # px of the span's margin that it can do without
SAMPLE = tuple(float(p) for p in (np.arange(64) + 0.5) / 0.64)  # percentiles that stand for all


@dataclass(frozen=True)
class Look:
    """From where surfaces are looked at: the numbers of some cameras, whose views are reduced `scale` times; with
    `half_rows` after their rows were averaged two by two."""

    scale: int
    cameras: tuple[int, ...]
    half_rows: bool = False


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What every camera that was looked from sees, people included.

    level      the reduced views, nothing masked
    cameras    that were looked from; there is nothing of the others
    disparity  uint16 [K, h, w] in 32nds of a reduced pixel
    agree      bool [K, h, w]: another view confirms it
    half_rows  the level is of half as many rows
    """

    level: Level
    cameras: tuple[int, ...]
    disparity: np.ndarray
    agree: np.ndarray
    half_rows: bool = False

    @property
    def scale(self) -> int:
        return self.level.scale

    def rows(self, views: np.ndarray) -> np.ndarray:
        """Of full-size views [K, H, W] the rows that this was made from; where every two were averaged, the first."""
        return views[:, :: 1 + self.half_rows]

    def at_full_size(self, shape: tuple[int, ...], backend: ModuleType) -> np.ndarray:
        """float32 [K, *shape] px over the array."""
        return backend.enlarged(self.disparity, self.scale, shape).astype(np.float32) * np.float32(self.scale / UNITS)


def surfaces(
    pictures: Pictures,
    geometry: ArrayGeometry,
    look: Look,
    options: Options,
    backend: ModuleType,
    before: Surfaces | None = None,
) -> Surfaces:
    """Semi-global matching of reduced views, without any mask, through the whole range.

    before  an earlier look: what it found at the same scale is not looked for again
    """
    o = options.multiview
    if before is None or before.scale != look.scale or before.half_rows != look.half_rows:
        level = pictures.level(look.scale, look.half_rows)
        level = replace(level, static=np.ones_like(level.static))
        before = Surfaces(level, (), np.zeros_like(level.static, np.uint16), level.static, look.half_rows)
    level, found = before.level, before.disparity
    new = [k for k in look.cameras if k not in before.cameras]
    low, *_, high = search_range(geometry, options).values
    every = backend.everything(level_grid((low, high), look.scale, 1.0), level.static.shape[1:])
    penalties = Penalties.of(o.small_penalty, o.large_penalty, o.least_penalty, 0)
    features, costs = backend.describe(level.colour, level.static), PairCosts.of(o)
    candidates = [every] * len(new)
    volumes = backend.volumes(features, [level.views[k] for k in new], candidates, costs)
    of_new = ([of[k] for k in new] for of in (level.colour, level.static))
    for k, view in zip(new, backend.aggregates(volumes, *of_new, candidates, penalties, o.paths), strict=True):
        found[k] = view
    cameras = *before.cameras, *new
    agree = _confirmed(level, cameras, found, every, round(UNITS * o.tolerance), backend)
    return Surfaces(level, cameras, found, agree, look.half_rows)


def _confirmed(
    level: Level, cameras: tuple[int, ...], found: np.ndarray, every: Candidates, tolerance: int, backend: ModuleType
) -> np.ndarray:
    looked = np.zeros_like(level.static)
    for k in cameras:
        looked[k] = True
    asked = [every if k in cameras else None for k in range(len(found))]
    return backend.graded_of_views(found, looked, level.views, tolerance, 0, 0, asked)[1]


def looks(geometry: ArrayGeometry, options: Options) -> list[Look]:
    """The looks at all surfaces, one after the other until the masks are known well enough. Masks that are found to be
    exact, and the range, want no more than the first: a few views, and coarse ones."""
    (width, height), o = geometry.size, options.people
    few, every = few_cameras(geometry), tuple(range(geometry.cameras))
    if not o.enabled:
        return [Look(max(1, min(options.multiview.range_scale, width // 64, height)), few)]
    half = options.multiview.half_rows and height > 1
    first = _halved(width, height // 2 if half else height, min(o.first_width, o.surface_width))
    close = _halved(width, height, o.surface_width)
    return list(dict.fromkeys([Look(first, few, half), Look(first, every, half), Look(close, every)]))


def few_cameras(geometry: ArrayGeometry) -> tuple[int, ...]:
    """Those at both ends of the array, and the wanted one or, where that is at an end, the middle one."""
    line = [int(k) for k in np.argsort(geometry.positions[:, 0], kind="stable")]
    ends, r = (line[0], line[-1]), geometry.reference
    return tuple(sorted({*ends, line[len(line) // 2] if r in ends else r}))


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
    least, *_, most = search_range(geometry, options).values
    percentiles, clear = (*INNER, *SAMPLE), CLEAR // seen.scale
    inner = backend.inner_span(seen.disparity, seen.agree, seen.rows(static), seen.scale, clear, percentiles)
    if inner is None:
        return float(np.floor(least)), float(most)
    first, last, *sample = inner * (seen.scale / UNITS)
    margin = max(2.0, 0.04 * (last - first)) + 10
    high = float(min(most, last + margin))
    return well_placed((least, first - margin), high, np.array(sample), geometry, options), high


def well_placed(
    lows: tuple[float, float], high: float, sample: np.ndarray, geometry: ArrayGeometry, options: Options
) -> float:
    """Where a span up to `high` begins: in whole pixels at the larger of `lows`, or up to a chunk below, but not below
    the first of them, or up to SPARE above the second: wherever the fewest chunks are matched.

    What the coarsest level matches grows with the span; finer ones match every chunk that a window around a disparity
    touches. Where disparities like those of `sample`, float64 [n] px, lie in the middle of chunks, that is one each.
    """
    o, (coarsest, *finer) = options.multiview, scales(geometry, options.multiview)
    length = CHUNK * options.range.step  # px of a level
    low, highest = np.floor(max(lows)), np.floor(lows[1]) + SPARE
    starts = max(low, highest) - np.arange(length * max(finer, default=0) + 1)
    starts = starts[(starts >= lows[0]) | (starts == low)]
    chunks = geometry.cameras * np.ceil((high - starts) / (length * coarsest)) / coarsest**2
    for scale in finer:
        behind = (sample - starts[:, None]) / scale
        touched = np.floor((behind + o.window + options.range.step) / length) - np.floor((behind - o.window) / length)
        chunks += (geometry.cameras if o.fine_views else 2) * (touched.mean(1) + 1) / scale**2
    return float(starts[chunks.argmin()])
