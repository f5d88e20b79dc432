"""Matching of the many-view method on a GPU: stages of reference_multiview.py, and the same for all views at once.

The plural functions are those to call: one launch has enough work for the whole GPU, and one frame few launches. Arrays
are the device's (gpu.device) and stay there, but for the number of chunks of `windows_of_views`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from ..candidates import CHUNK, EIGHTHS, Candidates, DisparityGrid
from ..geometry import ArrayGeometry
from ..gpu import device, tables
from ..many import LUMA, UNITS, PairCosts, Penalties

__all__ = [
    "aggregate",
    "aggregates",
    "describe",
    "everything",
    "volume",
    "volumes",
    "windows",
    "windows_of_views",
]

TILE = (32, 8)  # threads of most kernels: a pixel each
MOST_BYTES = 1 << 29  # of what paths add to the costs: views that need more are aggregated one after the other
ENOUGH_THREADS = 1 << 19  # fill any GPU; with fewer a pixel's chunks are shared among threads
VOLUME_OF = ((5, "volume_5"), (6, "volume_6"), (9, "volume_9"), (16, "volume_16"))  # by the most cameras


@dataclass(frozen=True, eq=False)
class Features:
    """Every view at its pixels and half way between them: gpu/kernels/matching.h.

    samples  uint32 [K, 2, H, W, 2]: census; colour and flags
    valid    uint32 [K, 2, H, W]: static neighbours
    """

    samples: Any
    valid: Any


@dataclass(frozen=True, eq=False)
class DeviceCandidates(Candidates):
    """Candidates whose arrays are the device's. `count` gives their number, and may wait for it."""

    count: Callable[[], int]

    @property
    def chunks(self) -> int:
        return self.count()

    def where(self, wanted: Any) -> DeviceCandidates:
        return DeviceCandidates(self.grid, self.active * wanted, self.start, self.count)


def _tiles(shape: tuple[int, ...], depth: int) -> tuple[int, int, int]:
    """Grid of TILEs over [height, width], `depth` deep."""
    return -(-shape[1] // TILE[0]), -(-shape[0] // TILE[1]), depth


def _int(n: float) -> np.int32:
    return np.int32(n)


# ---------------------------------------------------------------------------------------------- describe


def describe(colour: Any, static: Any) -> Features:
    here, (K, height, width) = device.current(), static.shape
    samples = here.xp.empty((K, 2, height, width, 2), np.uint32)
    valid = here.xp.empty((K, 2, height, width), np.uint32)
    args = [colour, static, _int(height), _int(width), tables.constant(LUMA), samples, valid]
    here.launch("census", "census", grid=_tiles((height, width), K), block=TILE, args=args)
    return Features(samples, valid)


# --------------------------------------------------------------------------------------------- candidates


def windows(
    disparity: Any,
    where: Any,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
    within: Any = None,
) -> Candidates:
    within = within if within is None else within[None]
    return windows_of_views(disparity[None], where[None], ratio, grid, reach, spread, shape, within)[0]


def windows_of_views(
    disparity: Any,
    where: Any,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
    within: Any = None,
    whole: int = -1,
) -> list[DeviceCandidates]:
    """`windows` of n views: disparity uint16, where bool [n, h, w]; within bool [n, H, W], of all but `whole`."""
    here, (n, rows, columns), (height, width) = device.current(), disparity.shape, shape
    xp, pixels, block, counted = here.xp, height * width, 256, 1024
    around = xp.empty((n, rows, columns), np.uint64)
    origin, spacing = UNITS // EIGHTHS * grid.first, UNITS // EIGHTHS * grid.step
    numbers = (rows, columns, ratio, origin, spacing, grid.count, reach, spread)
    here.launch(
        "windows", "windows_around", grid=_tiles((rows, columns), n), block=TILE,
        args=[disparity, where, *map(_int, numbers), around],
        shared=8 * (2 * spread + 2 * TILE[1]) * (2 * spread + TILE[0]),
    )  # fmt: skip
    active, start = xp.empty((n, height, width), np.uint64), xp.empty((n, pixels + 1), np.int32)
    blocks = -(-pixels // counted)
    sums, totals = xp.empty((n, blocks), np.int32), xp.empty(n, np.int32)
    limits = [where, _int(0)] if within is None else [within, _int(1)]
    args = [around, *limits, *map(_int, (whole, rows, columns, ratio, height, width)), active, sums]
    here.launch("windows", "windows_active", grid=(blocks, n), block=(block,), args=args)
    args = [active, _int(pixels), sums, start, totals]
    here.launch("windows", "windows_start", grid=(blocks, n), block=(block,), args=args)
    chunks = _fetched(here, totals)
    return [DeviceCandidates(grid, active[k], start[k], partial(chunks, k)) for k in range(n)]


def _fetched(here: device.Device, counts: Any) -> Callable[[int], int]:
    """Numbers on their way to the host: whoever asks first waits, and the device has other work until then."""
    host, mark = here.fetch(counts), here.mark()

    def count(k: int) -> int:
        here.wait(mark)
        return int(host[k])

    return count


def everything(grid: DisparityGrid, shape: tuple[int, ...]) -> DeviceCandidates:
    """Candidates.all on the device."""
    here: Any = device.current()
    active, start = _everything(here, grid.count // CHUNK, tuple(shape))
    chunks = grid.count // CHUNK * active.size
    return DeviceCandidates(grid, active, start, lambda: chunks)


@lru_cache(maxsize=8)
def _everything(here: device.Device, chunks: int, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """The same from frame to frame."""
    active = here.xp.full(shape, np.uint64((1 << chunks) - 1), dtype=np.uint64)
    return active, here.xp.arange(active.size + 1, dtype=np.int32) * np.int32(chunks)


# ------------------------------------------------------------------------------------------------- volume


def volume(features: Features, geometry: ArrayGeometry, candidates: Candidates, costs: PairCosts) -> Any:
    return volumes(features, [geometry], [candidates], costs)[0]


def volumes(
    features: Features, views: Sequence[ArrayGeometry], candidates: Sequence[Candidates], costs: PairCosts
) -> list[Any]:
    """`volume` of n views, whose candidates are of one grid: uint8 [chunks, CHUNK] of each."""
    here: Any = device.current()
    n = len(views)
    K, _, height, width, _ = features.samples.shape
    ends = np.cumsum([0, *(c.chunks for c in candidates)])
    rows = here.xp.empty((int(ends[-1]), CHUNK), np.uint8)
    out = [rows[a:b] for a, b in pairwise(ends)]
    if not n or not ends[-1]:
        return out
    grid = candidates[0].grid
    offsets, centres, which = _geometry(here, tuple(views))
    shifts = here.xp.empty((n * grid.count * K + 16, 8), np.float32)  # 16: that may be read, but do not count
    numbers = (grid.first, grid.step, grid.count, K, n, height)
    blocks = -(-n * grid.count * K // 256)
    args = [offsets, which, *map(_int, numbers), shifts]
    here.launch("volume", "volume_shifts", grid=(blocks,), block=(256,), args=args)
    slices = next(s for s in (1, 2, 4) if s == 4 or s * n * height * width >= ENOUGH_THREADS)
    at = tables.addresses([(c.active, c.start, o) for c, o in zip(candidates, out, strict=True)])
    scale = tables.constant(costs.census_scale)
    apart = tables.constant(np.array([costs.apart_of(K, v.reference) for v in views], np.int32))
    params = (costs.few, costs.colour_cap, costs.lone, costs.unseen)
    here.launch(
        "volume", next(name for most, name in VOLUME_OF if most >= K),
        grid=_tiles((height, width), n * slices), block=TILE,
        args=[features.samples, features.valid, *map(_int, (K, height, width)), at, which, apart, centres,
              shifts, _int(grid.count), _int(slices), scale, *map(_int, params)],
    )  # fmt: skip
    return out


@lru_cache(maxsize=64)
def _geometry(here: device.Device, views: tuple[ArrayGeometry, ...]) -> tuple[Any, Any, Any]:
    """offsets float32 [n, K, 5], principal points float32 [n, 2] and own cameras int32 [n] of views, on the device."""
    return (
        tables.constant(np.stack([v.offsets for v in views])),
        tables.constant(np.array([v.center for v in views], np.float32)),
        tables.constant(np.array([v.reference for v in views], np.int32)),
    )


# ---------------------------------------------------------------------------------------------- aggregate


def aggregate(
    costs: Any,
    image: Any,
    static: Any,
    candidates: Candidates,
    penalties: Penalties,
    paths: int = 8,
    otherwise: Any = None,
) -> Any:
    rest = None if otherwise is None else [otherwise]
    return aggregates([costs], [image], [static], [candidates], penalties, paths, rest)[0]


def aggregates(
    costs: Iterable[Any],
    images: Sequence[Any],
    static: Sequence[Any],
    candidates: Sequence[Candidates],
    penalties: Penalties,
    paths: int = 8,
    otherwise: Sequence[Any] | None = None,
) -> Any:
    """`aggregate` of n views, whose candidates are of one grid: uint16 [n, H, W]."""
    costs = list(costs)
    here, n, (height, width) = device.current(), len(costs), static[0].shape
    found = here.xp.empty((n, height, width), np.uint16)
    way = np.uint8 if max(int(penalties.large.max()), penalties.dynamic) < 256 else np.uint16
    share = paths * CHUNK * np.dtype(way).itemsize
    for first, last in _batches([share * len(c) for c in costs]):
        some = slice(first, last)
        rest = [0] * (last - first) if otherwise is None else [tables.address(o) for o in otherwise[some]]
        ends = np.cumsum([0, *(len(c) for c in costs[some])])
        at = np.array([
            [*map(tables.address, (c.active, c.start, cost, image, view)), other, end]
            for c, cost, image, view, other, end in zip(
                candidates[some], costs[some], images[some], static[some], rest, ends[:-1], strict=True)
        ], np.uint64)  # fmt: skip
        _choose(found[some], at, int(ends[-1]), candidates[0].grid, penalties, paths, way)
    smooth = here.xp.empty_like(found)
    asked = [0] * n if otherwise is None else [tables.address(c.active) for c in candidates]
    args = [found, tables.constant(np.array(asked, np.uint64)), _int(height), _int(width), smooth]
    here.launch("aggregate", "median", grid=_tiles((height, width), n), block=TILE, args=args)
    return smooth


def _batches(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Runs of views, whose sizes together are not more than MOST_BYTES, or one view's."""
    found, first, taken = [], 0, 0
    for k, size in enumerate(sizes):
        if taken and taken + size > MOST_BYTES:
            found.append((first, k))
            first, taken = k, 0
        taken += size
    return [*found, (first, len(sizes))]


def _choose(
    found: Any, at: np.ndarray, rows: int, grid: DisparityGrid, penalties: Penalties, paths: int, way: type
) -> None:
    """Every pixel's winner, before the median, into `found` uint16 [n, H, W]; `at` uint64 [n, 7]: aggregate.cu View."""
    here, (n, height, width) = device.current(), found.shape
    addresses, large = tables.constant(at), tables.constant(penalties.large)
    ways, kind = here.xp.empty((paths, rows, CHUNK), way), "bytes" if way is np.uint8 else "words"
    lines = 4  # of a block
    here.launch(
        "aggregate", f"paths_in_{kind}", grid=(-(-max(height, width) // lines), paths, n), block=(16 * lines,),
        args=[addresses, *map(_int, (height, width, grid.count)), np.int64(rows), _int(penalties.small), large,
              _int(penalties.dynamic), ways],
        shared=4 * 2 * lines * (grid.count + 4),
    )  # fmt: skip
    here.launch(
        "aggregate", f"winners_of_{kind}", grid=(-(-height * width // 256), n), block=(256,),
        args=[addresses, *map(_int, (height * width, grid.first, grid.step, paths)), np.int64(rows), ways, found],
    )  # fmt: skip
