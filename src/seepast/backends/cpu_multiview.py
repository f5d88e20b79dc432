"""The C++ core under the stage names of reference_multiview.py: shapes and glue here, loops in cpp/."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import _core
from ..candidates import CHUNK, EIGHTHS, Candidates, DisparityGrid
from ..confidence import CLOSE
from ..confidence import STEPS as FLATNESS_STEPS
from ..geometry import ArrayGeometry
from ..many import CONFIDENT, LUMA, PLANE, UNITS, PairCosts, Penalties, VoteWeights, camera_pairs
from .cpu import _bytes, _grid
from .host import (
    beside,
    inner_span,
    probability,
    three_channels,
)
from .one_by_one import OneByOne
from .reference import FOREGROUND_WEIGHT, NEARER
from .workspace import Workspace

__all__ = [
    "aggregate",
    "aggregates",
    "averaged",
    "beside",
    "blend",
    "clear_of_masks",
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
    "planes",
    "planes_of_views",
    "probability",
    "ray_count",
    "three_channels",
    "volume",
    "volumes",
    "votes",
    "votes_of_views",
    "windows",
    "windows_of_views",
    "witnesses",
]

_views = OneByOne(sys.modules[__name__])
votes_of_views = _views.votes_of_views
planes_of_views = _views.planes_of_views
everything = Candidates.all
workspace = Workspace()  # of temporary arrays; those that a result may hold are fresh
EVERYWHERE = np.empty(0, np.int32)  # stands for the starts of chunks of no pixel in particular
EVERY_PIXEL = np.empty((0, 0), np.uint8)  # stands for a mask of all pixels
STEPS = np.array(FLATNESS_STEPS, np.uint16)


@dataclass(frozen=True, eq=False)
class Features:
    """What rows are described from while they are matched: colour uint8 [K, H, W, 3], static bool [K, H, W]."""

    colour: np.ndarray
    static: np.ndarray


def describe(colour: np.ndarray, static: np.ndarray) -> Features:
    """Nothing yet: what `volumes` describes of a row is in the cache when it is matched, and no longer than that."""
    return Features(colour, static)


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
    for k in range(K):
        kept = EVERY_PIXEL if within is None or k == whole else _bytes(within[k])
        _core.windows(disparity[k], _bytes(where[k]), ratio, _grid(grid), reach, spread, kept, active[k], start[k])
    return [Candidates(grid, a, s) for a, s in zip(active, start, strict=True)]


def landings(hidden: np.ndarray, disparity: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    out = workspace.zeros((geometry.cameras, *hidden.shape), bool)
    _core.landings(geometry.offsets, *geometry.center, _bytes(hidden), disparity, _bytes(out))
    return out


def volume(features: Features, geometry: ArrayGeometry, candidates: Candidates, costs: PairCosts) -> np.ndarray:
    return volumes(features, [geometry], [candidates], costs)[0]


def volumes(
    features: Features, views: list[ArrayGeometry], candidates: list[Candidates], costs: PairCosts
) -> list[np.ndarray]:
    if not views:  # nothing is asked for
        return []
    pairs = [np.array(p, np.int32).reshape(-1, 2) for v in views for p in camera_pairs(v.cameras, v.reference)]
    out = workspace.empty((sum(c.chunks for c in candidates), CHUNK), np.uint8)
    _core.volumes(
        np.stack([v.offsets for v in views]), np.array([v.center for v in views], np.float32),
        np.array([v.reference for v in views], np.int32), features.colour, _bytes(features.static), LUMA,
        _grid(candidates[0].grid), _stacked([c.active for c in candidates]), _stacked([c.start for c in candidates]),
        np.concatenate(pairs), np.array([len(p) for p in pairs], np.int32).reshape(-1, 2), costs.census_scale,
        costs.few, costs.colour_cap, costs.lone, costs.unseen, out,
    )  # fmt: skip
    ends = np.cumsum([c.chunks for c in candidates])
    return np.split(out, ends[:-1])


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """np.stack(arrays), without a copy where they lie one behind the other in the memory of one array."""
    first, whole = arrays[0], arrays[0].base
    places = [a.ctypes.data - first.ctypes.data for a in arrays]
    if (
        isinstance(whole, np.ndarray)
        and whole.flags.c_contiguous
        and all(a.base is whole and a.flags.c_contiguous and a.shape == first.shape for a in arrays)
        and places == [i * first.nbytes for i in range(len(arrays))]
    ):
        offset = first.ctypes.data - whole.ctypes.data
        return np.ndarray((len(arrays), *first.shape), first.dtype, buffer=whole, offset=offset)
    return np.stack(arrays)


def aggregate(
    costs: np.ndarray,
    image: np.ndarray,
    static: np.ndarray,
    candidates: Candidates,
    penalties: Penalties,
    paths: int = 8,
    otherwise: np.ndarray | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """`out`, where the disparities go, must not be `otherwise`."""
    found = workspace.empty(static.shape, np.uint16)
    found[...] = UNITS // EIGHTHS * candidates.grid.first if otherwise is None else otherwise
    size = _core.aggregate_scratch(*static.shape, candidates.grid.count, paths, len(costs))
    scratch = workspace.empty((size,), np.uint16)
    _core.aggregate(
        costs, image, _bytes(static), _grid(candidates.grid), candidates.active, candidates.start, penalties.small,
        penalties.large, penalties.dynamic, paths, scratch, found,
    )  # fmt: skip
    out = workspace.empty(found.shape, np.uint16) if out is None else out
    _core.median(found, out)
    return out


def aggregates(
    costs: Iterable[np.ndarray],
    images: Sequence[np.ndarray],
    static: Sequence[np.ndarray],
    candidates: Sequence[Candidates],
    penalties: Penalties,
    paths: int = 8,
    otherwise: Sequence[np.ndarray] | None = None,
) -> np.ndarray:
    out = workspace.empty((len(images), *static[0].shape), np.uint16)
    for i, volume in enumerate(costs):
        kept = None if otherwise is None else otherwise[i]
        aggregate(volume, images[i], static[i], candidates[i], penalties, paths, kept, out[i])
    return out


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
    shown, passing = np.empty(disparity.shape, np.uint16), workspace.empty(disparity.shape, np.uint16)
    close = workspace.empty(disparity.shape, np.uint8)
    _core.labels(
        geometry.offsets, *geometry.center, geometry.reference, disparity, disparities, _bytes(static),
        EVERY_PIXEL if wanted is None else _bytes(wanted), tolerance, CLOSE, shown, passing, close,
    )  # fmt: skip
    return shown, passing, close


def evidence(d: np.ndarray, static: np.ndarray, close: np.ndarray, shown: np.ndarray) -> np.ndarray:
    out = workspace.empty(d.shape, np.uint8)
    _core.evidence(d, _bytes(static), close, shown, STEPS, out)
    return out


def ray_count(labels: np.ndarray) -> np.ndarray:
    out = np.empty(labels.shape, np.uint8)
    _core.ray_count(labels, out)
    return out


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
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """`out`, if given, is where both go."""
    start = EVERYWHERE if candidates is None else candidates.start
    confidence, sure = out or (workspace.empty(disparity.shape, np.uint8), workspace.empty(disparity.shape, bool))
    _core.graded(
        geometry.offsets, *geometry.center, geometry.reference, disparity, disparities, _bytes(static), start,
        tolerance, CONFIDENT, lone, doubtful, confidence, _bytes(sure),
    )  # fmt: skip
    return confidence, sure


def graded_of_views(
    found: np.ndarray,
    static: np.ndarray,
    views: Sequence[ArrayGeometry],
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Sequence[Candidates | None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    confidence, sure = np.zeros(found.shape, np.uint8), np.zeros(found.shape, bool)
    for k, view in enumerate(views):
        own = None if candidates is None else candidates[k]
        if candidates is None or own is not None:
            graded(found[k], found, static, view, tolerance, lone, doubtful, own, (confidence[k], sure[k]))
    return confidence, sure


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
    out = np.empty(colour.shape[1:], np.uint8)
    _core.blend(
        geometry.offsets,
        *geometry.center,
        geometry.reference,
        colour,
        rays,
        _bytes(clear),
        near,
        edge,
        disparity,
        _bytes(wanted),
        out,
    )
    return out


def fill_unseen(background: np.ndarray, coverage: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    out = background.copy()
    _core.fill_unseen(coverage, disparity, NEARER, FOREGROUND_WEIGHT, out)
    return out
