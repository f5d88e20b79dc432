"""The C++ core under the stage names of reference_multiview.py: shapes and glue here, loops in cpp/."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import cv2
import numpy as np

from .. import _core
from ..candidates import CHUNK, Candidates, DisparityGrid
from ..geometry import ArrayGeometry
from ..many import CONFIDENT, CUBIC, LUMA, PLANE, PairCosts, Penalties, VoteWeights, camera_pairs
from .cpu import _bytes, _grid
from .reference import FOREGROUND_WEIGHT, NEARER

__all__ = [
    "aggregate", "blend", "confidence_of", "describe", "fill_unseen", "graded", "labels", "planes", "volume", "votes",
    "windows", "witnesses"
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Features:
    """planes uint8 [K, H, PLANES, stride], unclear uint64 [K, H, 2, stride / 64 + 1]: cpp/multiview.h FeatureRows."""

    planes: np.ndarray
    unclear: np.ndarray


def describe(colour: np.ndarray, static: np.ndarray) -> Features:
    K, height, width = static.shape
    stride = -(-width // _core.BLOCK) * _core.BLOCK + 2 * _core.BLOCK
    planes = np.empty((K, height, _core.PLANES, stride), np.uint8)
    unclear = np.empty((K, height, 2, stride // 64 + 1), np.uint64)
    _core.census(np.zeros((K, 5), np.float32), colour, _bytes(static), CUBIC, LUMA, planes, unclear)
    return Features(planes, unclear)


def windows(
    disparity: np.ndarray,
    where: np.ndarray,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
) -> Candidates:
    active, start = np.empty(shape, np.uint64), np.empty(shape[0] * shape[1] + 1, np.int32)
    _core.windows(disparity, _bytes(where), ratio, _grid(grid), reach, spread, active, start)
    return Candidates(grid, active, start)


def volume(features: Features, geometry: ArrayGeometry, candidates: Candidates, costs: PairCosts) -> np.ndarray:
    pairs = (np.array(p, np.int32).reshape(-1, 2) for p in camera_pairs(geometry.cameras, geometry.reference))
    out = np.empty((int(candidates.start[-1]), CHUNK), np.uint8)
    _core.volume(
        geometry.offsets, *geometry.center, features.planes, features.unclear, geometry.reference,
        _grid(candidates.grid), candidates.active, candidates.start, *pairs, costs.census_scale, costs.few,
        costs.colour_cap, costs.lone, costs.unseen, out,
    )  # fmt: skip
    return out


def aggregate(
    costs: np.ndarray,
    image: np.ndarray,
    static: np.ndarray,
    candidates: Candidates,
    penalties: Penalties,
    paths: int = 8,
    otherwise: np.ndarray | None = None,
) -> np.ndarray:
    out = np.empty(static.shape, np.uint16)
    scratch = _scratch(_core.aggregate_scratch(*static.shape, candidates.grid.count, paths, len(costs)))
    _core.aggregate(
        costs, image, _bytes(static), _grid(candidates.grid), candidates.active, candidates.start, penalties.small,
        penalties.large, penalties.dynamic, paths, scratch, out,
    )  # fmt: skip
    if otherwise is not None:
        np.copyto(out, otherwise, where=candidates.active == 0)
    return cv2.medianBlur(out, 5)


_kept = threading.local()


def _scratch(size: int) -> np.ndarray:
    """uint16 [size], the same memory for every call of a thread: fresh pages would cost more than the sums."""
    if getattr(_kept, "sums", None) is None or _kept.sums.size < size:
        _kept.sums = np.empty(size, np.uint16)
    return _kept.sums[:size]


def witnesses(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    skip: int,
    tolerance: int,
) -> tuple[np.ndarray, np.ndarray]:
    agree, farther = np.empty(disparity.shape, np.uint8), np.empty(disparity.shape, np.uint8)
    _core.witnesses(
        geometry.offsets, *geometry.center, disparity, disparities, _bytes(static), skip, tolerance, agree, farther
    )
    return agree, farther.view(bool)


def labels(
    disparity: np.ndarray, disparities: np.ndarray, static: np.ndarray, geometry: ArrayGeometry, tolerance: int
) -> tuple[np.ndarray, np.ndarray]:
    shown, passing = np.empty(disparity.shape, np.uint16), np.empty(disparity.shape, np.uint16)
    _core.labels(
        geometry.offsets, *geometry.center, geometry.reference, disparity, disparities, _bytes(static), tolerance,
        shown, passing,
    )  # fmt: skip
    return shown, passing


def confidence_of(agree: np.ndarray, farther: np.ndarray, static: np.ndarray, lone: int, doubtful: int) -> np.ndarray:
    out = np.empty(agree.shape, np.uint8)
    _core.confidence_of(agree, _bytes(farther), _bytes(static), CONFIDENT, lone, doubtful, out)
    return out


def graded(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    tolerance: int,
    lone: int,
    doubtful: int,
) -> tuple[np.ndarray, np.ndarray]:
    confidence, sure = np.empty(disparity.shape, np.uint8), np.empty(disparity.shape, np.uint8)
    _core.graded(
        geometry.offsets, *geometry.center, geometry.reference, disparity, disparities, _bytes(static), tolerance,
        CONFIDENT, lone, doubtful, confidence, sure,
    )  # fmt: skip
    return confidence, sure.view(bool)


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
        out = costs.copy()
    _core.votes(
        geometry.offsets, *geometry.center, costs, disparities, confidence, _bytes(static), _grid(candidates.grid),
        candidates.active, candidates.start, skip, weights.base, weights.gain, weights.hide, weights.volume,
        weights.visible, out,
    )  # fmt: skip
    return out


def planes(
    disparity: np.ndarray, trusted: np.ndarray, wanted: np.ndarray, image: np.ndarray, static: np.ndarray
) -> np.ndarray:
    out = np.empty_like(disparity)
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
