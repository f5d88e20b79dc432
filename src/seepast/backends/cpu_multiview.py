"""The C++ core under the stage names of reference_multiview.py: shapes and glue here, loops in cpp/."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .. import _core
from ..candidates import CHUNK, EIGHTHS, Candidates, DisparityGrid
from ..confidence import CLOSE
from ..confidence import STEPS as FLATNESS_STEPS
from ..geometry import ArrayGeometry
from ..many import CONFIDENT, LIGHT, LUMA, PLANE, UNITS, PairCosts, Penalties, VoteWeights, camera_pairs
from .cpu import _bytes, _grid, view_arrays, workspace
from .host import (
    beside,
    inner_span,
    three_channels,
)
from .one_by_one import OneByOne
from .reference import FOREGROUND_WEIGHT, NEARER

__all__ = [
    "aggregate",
    "aggregates",
    "averaged",
    "beside",
    "blend",
    "clear_of_masks",
    "copied",
    "describe",
    "double_rows",
    "enlarged",
    "everything",
    "evidence",
    "fill_unseen",
    "graded",
    "graded_of_views",
    "half_rows",
    "inner_span",
    "labels",
    "landings",
    "mapped",
    "planes",
    "planes_of_views",
    "three_channels",
    "told",
    "volume",
    "volumes",
    "votes",
    "votes_of_views",
    "windows",
    "windows_of_views",
    "witnessed",
    "witnesses",
]

_views = OneByOne(sys.modules[__name__])
planes_of_views = _views.planes_of_views
everything = Candidates.all
MOST_SCRATCH = 1 << 24  # entries of 16 bits that the paths of several views take together
EVERYWHERE = np.empty((0, 0), np.int32)  # stands for the starts of chunks of no pixel in particular
EVERY_PIXEL = np.empty((0, 0), np.uint8)  # stands for a mask of all pixels
ALL_PIXELS = np.empty((0, 0, 0), np.uint8)  # and for one of every view
STEPS = np.array(FLATNESS_STEPS, np.uint16)


@dataclass(frozen=True, eq=False)
class Features:
    """What rows are described from while they are matched: colour uint8 [K, H, W, 3], static bool [K, H, W]."""

    colour: np.ndarray
    static: np.ndarray


def describe(colour: np.ndarray, static: np.ndarray) -> Features:
    """Nothing yet: what `volumes` describes of a row is in the cache when it is matched, and no longer than that."""
    return Features(colour, static)


def copied(array: np.ndarray) -> np.ndarray:
    out = workspace.empty(array.shape, array.dtype)
    np.copyto(out, array)
    return out


def mapped(colour: np.ndarray, tables: np.ndarray) -> np.ndarray:
    out = workspace.empty(colour.shape, np.uint8)
    for view, table, to in zip(colour, tables, out, strict=True):
        cv2.LUT(view, np.ascontiguousarray(table.T)[None], dst=to)
    return out


def averaged(
    colour: np.ndarray, static: np.ndarray, size: tuple[int, int], scale: int
) -> tuple[np.ndarray, np.ndarray]:
    shape = len(static), size[1], size[0]
    small, small_static = workspace.empty((*shape, 3), np.uint8), workspace.empty(shape, bool)
    _core.averaged(np.ascontiguousarray(colour), _bytes(static), scale, small, _bytes(small_static))
    return small, small_static


def enlarged(views: np.ndarray, ratio: int, shape: tuple[int, ...], factor: int = 1) -> np.ndarray:
    if ratio == factor == 1:
        return views
    out = workspace.empty((len(views), *shape), views.dtype)
    small, whole = (_bytes(v) if v.dtype == bool else v for v in (views, out))
    _core.enlarged(np.ascontiguousarray(small), ratio, factor, whole)
    return out


def half_rows(colour: np.ndarray, static: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    K, height, width = static.shape
    small = workspace.empty((K, height // 2, width, 3), np.uint8)
    small_static = workspace.empty(small.shape[:-1], bool)
    _core.half_rows(np.ascontiguousarray(colour), _bytes(static), small, _bytes(small_static))
    return small, small_static


def double_rows(views: np.ndarray, height: int) -> np.ndarray:
    out = workspace.empty((len(views), height, views.shape[2]), np.uint16)
    _core.double_rows(np.ascontiguousarray(views), out)
    return out


def windows(
    disparity: np.ndarray,
    where: np.ndarray,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
    within: np.ndarray | None = None,
) -> Candidates:
    within = within if within is None else within[None]
    return windows_of_views(disparity[None], where[None], ratio, grid, reach, spread, shape, within)[0]


def windows_of_views(
    disparity: np.ndarray,
    where: np.ndarray,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
    within: np.ndarray | None = None,
    whole: int = -1,
) -> list[Candidates]:
    K = len(disparity)
    active = workspace.empty((K, *shape), np.uint64)
    start = workspace.empty((K, shape[0] * shape[1] + 1), np.int32)
    kept = ALL_PIXELS if within is None else _bytes(within)
    _core.windows(
        np.ascontiguousarray(disparity), _bytes(where), ratio, _grid(grid), reach, spread, kept, whole, active, start
    )
    return [Candidates(grid, a, s) for a, s in zip(active, start, strict=True)]


def landings(hidden: np.ndarray, low: np.ndarray, high: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    out = workspace.zeros((geometry.cameras, *hidden.shape), bool)
    _core.landings(geometry.offsets, *geometry.center, _bytes(hidden), low, high, _bytes(out))
    return out


def witnessed(
    hidden: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    most: int,
    tolerance: int,
) -> np.ndarray:
    out = workspace.zeros(static.shape, bool)
    _core.witnessed(
        geometry.offsets, *geometry.center, _bytes(hidden), disparities, _bytes(static), geometry.nearest_first, most,
        tolerance, _bytes(out),
    )  # fmt: skip
    return out


def volume(features: Features, geometry: ArrayGeometry, candidates: Candidates, costs: PairCosts) -> np.ndarray:
    return volumes(features, [geometry], [candidates], costs)[0]


def volumes(
    features: Features, views: list[ArrayGeometry], candidates: list[Candidates], costs: PairCosts
) -> list[np.ndarray]:
    if not views:  # nothing is asked for
        return []
    numbers = [(v.cameras, v.reference) for v in views]
    pairs = [np.array(p, np.int32).reshape(-1, 2) for of in numbers for p in camera_pairs(*of, costs.apart_of(*of))]
    out = workspace.empty((sum(c.chunks for c in candidates), CHUNK), np.uint8)
    _core.volumes(
        *view_arrays(views), np.array([v.reference for v in views], np.int32), features.colour,
        _bytes(features.static), LUMA, _grid(candidates[0].grid), _stacked([c.active for c in candidates]),
        _stacked([c.start for c in candidates]), np.concatenate(pairs),
        np.array([len(p) for p in pairs], np.int32).reshape(-1, 2), costs.census_scale, costs.few, costs.colour_cap,
        costs.lone, costs.unseen, out,
    )  # fmt: skip
    ends = np.cumsum([c.chunks for c in candidates])
    return np.split(out, ends[:-1])


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """np.stack(arrays), without a copy where they lie one behind the other in the memory of one array."""
    if isinstance(arrays, np.ndarray):
        return np.ascontiguousarray(arrays)
    if len(arrays) == 1:
        return np.ascontiguousarray(arrays[0])[None]
    if all(a.shape == arrays[0].shape for a in arrays) and (found := _in_one(arrays)) is not None:
        return found.reshape(len(arrays), *arrays[0].shape)
    return np.stack(arrays)


def _joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """np.concatenate(arrays), likewise."""
    if len(arrays) == 1:
        return np.ascontiguousarray(arrays[0])
    found = _in_one(arrays)
    return np.concatenate(arrays) if found is None else found.reshape(-1, *arrays[0].shape[1:])


def _in_one(arrays: Sequence[np.ndarray]) -> np.ndarray | None:
    """All elements as one array, where the arrays lie one behind the other in the memory of one; else None."""
    first, whole = arrays[0], arrays[0].base
    if not (isinstance(whole, np.ndarray) and whole.flags.c_contiguous):
        return None
    begin = place = _address(first)
    for a in arrays:
        if not (a.base is whole and a.flags.c_contiguous and _address(a) == place and a.dtype == first.dtype):
            return None
        place += a.nbytes
    size = sum(a.size for a in arrays)
    return np.ndarray((size,), first.dtype, buffer=whole, offset=begin - _address(whole))


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def aggregate(
    costs: np.ndarray,
    image: np.ndarray,
    static: np.ndarray,
    candidates: Candidates,
    penalties: Penalties,
    paths: int = 8,
    otherwise: np.ndarray | None = None,
) -> np.ndarray:
    kept = None if otherwise is None else [otherwise.copy()]
    return aggregates([costs], [image], [static], [candidates], penalties, paths, kept)[0]


def aggregates(
    costs: Iterable[np.ndarray],
    images: Sequence[np.ndarray],
    static: Sequence[np.ndarray],
    candidates: Sequence[Candidates],
    penalties: Penalties,
    paths: int = 8,
    otherwise: Sequence[np.ndarray] | None = None,
) -> np.ndarray:
    """What is found may be written over `otherwise`."""
    grid, shape = candidates[0].grid, (len(images), *static[0].shape)
    most = max(int(penalties.large.max()), penalties.dynamic)
    need = [_core.aggregate_scratch(*shape[1:], grid.count, paths, most, of.chunks) for of in candidates]
    batches, waiting = list(_batches(need)), iter(costs)
    if otherwise is not None and len(batches) == 1:
        out = _stacked(otherwise)
    else:  # costs that are made later may look at what is found now
        out = workspace.empty(shape, np.uint16)
        out[...] = UNITS // EIGHTHS * grid.first if otherwise is None else _stacked(otherwise)
    for some in batches:
        polled = candidates[some]
        scratch = workspace.empty((sum(need[some]),), np.uint16)
        _core.aggregates(
            _joined([next(waiting) for _ in polled]), _stacked(images[some]), _bytes(_stacked(static[some])),
            _grid(grid), _stacked([of.active for of in polled]), _stacked([of.start for of in polled]),
            penalties.small, penalties.large, penalties.dynamic, paths, otherwise is None, scratch, out[some],
        )  # fmt: skip
        del scratch  # what the next ones take
    return out


def _batches(sizes: Sequence[int]) -> Iterator[slice]:
    """Views that go along together: as many as MOST_SCRATCH lets, or one."""
    first = taken = 0
    for k, size in enumerate(sizes):
        if k > first and taken + size > MOST_SCRATCH:
            yield slice(first, k)
            first, taken = k, 0
        taken += size
    yield slice(first, len(sizes))


def witnesses(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    skip: int,
    tolerance: int,
) -> tuple[np.ndarray, np.ndarray]:
    agree, farther = (workspace.empty(disparity.shape, np.uint8) for _ in range(2))
    _core.witnesses(
        geometry.offsets, *geometry.center, disparity, disparities, _bytes(static), skip, tolerance, agree, farther
    )
    return agree, farther.view(bool)


def labels(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    tolerance: int,
    wanted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    shown, rays = workspace.empty(disparity.shape, np.uint16), workspace.empty(disparity.shape, np.uint16)
    close = workspace.empty(disparity.shape, np.uint8)
    _core.labels(
        geometry.offsets, *geometry.center, geometry.reference, disparity, disparities, _bytes(static),
        EVERY_PIXEL if wanted is None else _bytes(wanted), tolerance, CLOSE, shown, rays, close,
    )  # fmt: skip
    return shown, rays, close


def evidence(d: np.ndarray, static: np.ndarray, close: np.ndarray, shown: np.ndarray) -> np.ndarray:
    out = workspace.empty(d.shape, np.uint8)
    _core.evidence(d, _bytes(static), close, shown, STEPS, out)
    return out


def told(
    d: np.ndarray, evidence: np.ndarray, table: np.ndarray, shown: np.ndarray, keep: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    disparity, sure = workspace.empty(d.shape, np.float32), workspace.empty(d.shape, np.float32)
    coverage = workspace.empty(d.shape, np.uint8)
    _core.told(d, evidence, table, shown, EVERY_PIXEL if keep is None else _bytes(keep), disparity, sure, coverage)
    return disparity, sure, coverage


def clear_of_masks(static: np.ndarray) -> np.ndarray:
    out = workspace.empty(static.shape, bool)
    _core.clear_of_masks(_bytes(static), _bytes(out))
    return out


def graded(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Candidates | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    asked = [candidates] if candidates is not None else None
    confidence, sure = _graded([geometry], [0], disparity[None], disparities, static, tolerance, lone, doubtful, asked)
    return confidence[0], sure[0]


def graded_of_views(
    found: np.ndarray,
    static: np.ndarray,
    views: Sequence[ArrayGeometry],
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Sequence[Candidates | None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    if candidates is None:
        return _graded(views, range(len(views)), found, found, static, tolerance, lone, doubtful, None)
    asked = {k: of for k, of in enumerate(candidates) if of is not None}
    own = [views[k] for k in asked]
    return _graded(own, list(asked), found, found, static, tolerance, lone, doubtful, list(asked.values()))


def _graded(
    views: Sequence[ArrayGeometry],
    places: Sequence[int],
    found: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Sequence[Candidates] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """`graded` of the views whose disparities are at `places` of found [n, H, W]; 0 elsewhere."""
    confidence, sure = workspace.empty(found.shape, np.uint8), workspace.empty(found.shape, bool)
    for i in set(range(len(found))).difference(places):
        confidence[i] = sure[i] = 0
    if not views:
        return confidence, sure
    start = EVERYWHERE if candidates is None else _stacked([of.start for of in candidates])
    _core.graded(
        *view_arrays(views), np.array([v.reference for v in views], np.int32), np.array(places, np.int32),
        np.ascontiguousarray(found), disparities, _bytes(static), start, tolerance, CONFIDENT, lone, doubtful,
        confidence, _bytes(sure),
    )  # fmt: skip
    return confidence, sure


def votes_of_views(
    costs: Sequence[np.ndarray],
    disparities: np.ndarray,
    confidence: np.ndarray,
    statics: Sequence[np.ndarray],
    views: Sequence[ArrayGeometry],
    candidates: Sequence[Candidates],
    skips: Sequence[int],
    weights: VoteWeights,
    outs: Sequence[np.ndarray] | None = None,
) -> Iterator[np.ndarray]:
    """One behind the other in one array if `outs` is None, so that `aggregates` can take them as they are."""
    if outs is None:
        joined = workspace.empty((sum(map(len, costs)), CHUNK), np.uint8)
        outs = np.split(joined, np.cumsum([len(c) for c in costs])[:-1])
    for volume, static, view, of, skip, out in zip(costs, statics, views, candidates, skips, outs, strict=True):
        yield votes(volume, disparities, confidence, static, view, of, skip, weights, out)


def votes(
    costs: np.ndarray,
    disparities: np.ndarray,
    confidence: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    candidates: Candidates,
    skip: int,
    weights: VoteWeights,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """`out`, where the energies go, may be `costs`."""
    if out is None:
        out = workspace.empty(costs.shape, np.uint8)
    if out is not costs:
        np.copyto(out, costs)
    _core.votes(
        geometry.offsets, *geometry.center, costs, disparities, confidence, _bytes(static), _grid(candidates.grid),
        candidates.active, candidates.start, skip, weights.base, weights.gain, weights.hide, weights.volume,
        weights.visible, out,
    )  # fmt: skip
    return out


def planes(
    disparity: np.ndarray, trusted: np.ndarray, wanted: np.ndarray, image: np.ndarray, static: np.ndarray
) -> np.ndarray:
    out = workspace.empty(disparity.shape, disparity.dtype)
    _core.planes(
        disparity, _bytes(trusted), _bytes(wanted), image, _bytes(static), PLANE.radius, PLANE.stride, PLANE.gate,
        PLANE.need, PLANE.ridge, PLANE.table, out,
    )  # fmt: skip
    return out


def blend(
    colour: np.ndarray,
    rays: np.ndarray,
    clear: np.ndarray,
    near: np.ndarray,
    edge: float,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
) -> np.ndarray:
    out = workspace.empty(colour.shape[1:], np.uint8)
    _core.blend(
        geometry.offsets,
        *geometry.center,
        geometry.reference,
        colour,
        rays,
        _bytes(clear),
        near,
        geometry.nearest_first,
        LIGHT,
        edge,
        disparity,
        _bytes(wanted),
        out,
    )
    return out


def fill_unseen(background: np.ndarray, coverage: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    out = workspace.empty(background.shape, np.uint8)
    np.copyto(out, background)
    _core.fill_unseen(coverage, disparity, NEARER, FOREGROUND_WEIGHT, out)
    return out
