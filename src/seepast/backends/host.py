"""What the backends `cpu` and `reference` share: their arrays are NumPy's, and NumPy or OpenCV does what lies between
the stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

import cv2
import numpy as np

from ..confidence import ray_count
from ..frames import input_masks, rectified_frame
from ..geometry import ArrayGeometry
from ..many import UNITS

__all__ = [
    "QUEUES",
    "after",
    "averaged",
    "beside",
    "clear_of_masks",
    "copied",
    "depth",
    "double_rows",
    "enlarged",
    "faults",
    "fetched",
    "half_rows",
    "inner_span",
    "input_masks",
    "landings",
    "lane",
    "mapped",
    "mark",
    "probability",
    "received",
    "rectified_frame",
    "three_channels",
    "told",
    "witnessed",
]
T = TypeVar("T")
QUEUES = False  # what stages are asked for is done when they return


def received(image: object) -> np.ndarray:
    """An image or mask of the user's as this backend's array."""
    return np.asarray(image)


def lane(name: str) -> AbstractContextManager[None]:
    """Within: this thread's work runs beside that of other lanes, where a backend queues work."""
    return nullcontext()


def mark() -> None:
    """A mark behind the work so far."""


def after(mark: None) -> None:
    """The work to come waits for the mark of another lane."""


def fetched(found: T, keep: bool = False) -> Callable[[], T]:
    """What a method found, a dict of arrays, on its way to NumPy's arrays; where it is when the result is called.
    keep: it stays in the backend's arrays."""
    return lambda: found


def faults() -> AbstractContextManager[None]:
    """Within: what a device fails at is raised as DeviceError."""
    return nullcontext()


def depth(disparity: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    """Metres in the reference camera: float32, 0 where the disparity is 0 (unknown)."""
    return geometry.depth(disparity)


def probability(evidence: np.ndarray, table: np.ndarray) -> np.ndarray:
    """P(|disparity error| <= 1 px over the array) of evidence bytes: float32, by table float32 [256]."""
    return cv2.LUT(evidence, table)


def told(
    d: np.ndarray, evidence: np.ndarray, table: np.ndarray, shown: np.ndarray, keep: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What results say of every pixel [H, W]: its disparity, float32 px, from d uint16 in 32nds; its probability by
    evidence; and how many rays show it, uint8. `keep` bool: where only the own ray is known, the first two are 0."""
    disparity, sure = d.astype(np.float32) / np.float32(UNITS), probability(evidence, table)
    if keep is not None:
        disparity, sure = np.where(keep, np.float32(0), disparity), np.where(keep, np.float32(0), sure)
    return disparity, sure, ray_count(shown)


def mapped(colour: np.ndarray, tables: np.ndarray) -> np.ndarray:
    """tables uint8 [K, C, 256] of every grey level, of the channels of colour uint8 [K, H, W, C]."""
    return np.stack([
        cv2.LUT(view, np.ascontiguousarray(table.T)[None]).reshape(view.shape)
        for view, table in zip(colour, tables, strict=True)
    ])  # fmt: skip


def copied(array: np.ndarray) -> np.ndarray:
    return array.copy()


def three_channels(colour: np.ndarray) -> np.ndarray:
    """Grey views as BGR: uint8 [K, H, W, C] -> [K, H, W, 3], contiguous."""
    return np.ascontiguousarray(np.broadcast_to(colour, (*colour.shape[:-1], 3)))


def averaged(
    colour: np.ndarray, static: np.ndarray, size: tuple[int, int], scale: int
) -> tuple[np.ndarray, np.ndarray]:
    """Views with `scale` x `scale` pixels averaged into one, `size` (width, height) of them: colour uint8
    [K, h, w, 3], and static bool [K, h, w] where every pixel that was averaged is."""
    width, height = (n * scale for n in size)
    small = np.stack([cv2.resize(v[:height, :width], size, interpolation=cv2.INTER_AREA) for v in colour])
    rows = np.logical_and.reduce([static[:, i:height:scale, :width] for i in range(scale)])
    return small, np.logical_and.reduce([rows[:, :, i::scale] for i in range(scale)])


def enlarged(views: np.ndarray, ratio: int, shape: tuple[int, ...], factor: int = 1) -> np.ndarray:
    """Views of reduced size with every pixel repeated, up to `shape`: [K, h, w] -> [K, H, W]; uint16 times `factor`."""
    if ratio == factor == 1:
        return views
    whole = np.stack([_enlarged(view, ratio, shape) for view in views])
    return whole if factor == 1 else whole * np.uint16(factor)


def _enlarged(view: np.ndarray, ratio: int, shape: tuple[int, ...]) -> np.ndarray:
    # OpenCV knows no bool; its nearest neighbour is the same for whole ratios, and much faster than repeat
    bytes_or_words = view.view(np.uint8) if view.dtype == bool else view
    size = view.shape[1] * ratio, view.shape[0] * ratio
    whole = cv2.resize(np.ascontiguousarray(bytes_or_words), size, interpolation=cv2.INTER_NEAREST).view(view.dtype)
    after = [(0, max(0, want - have)) for want, have in zip(shape, whole.shape, strict=True)]
    if any(n for _, n in after):
        whole = np.pad(whole, after, mode="edge")
    return whole[: shape[0], : shape[1]]


def half_rows(colour: np.ndarray, static: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every two rows averaged into one: colour uint8 [K, H, W, 3], halves rounded up, and static bool [K, H, W] where
    both are. [K, H // 2, W]."""
    end = colour.shape[1] // 2 * 2
    sums = colour[:, :end:2].astype(np.uint16) + colour[:, 1:end:2]
    return ((sums + 1) // 2).astype(np.uint8), static[:, :end:2] & static[:, 1:end:2]


def double_rows(views: np.ndarray, height: int) -> np.ndarray:
    """uint16 [K, h, W] -> [K, height, W]: every row twice, the last one to the end."""
    return views[:, np.minimum(np.arange(height) // 2, views.shape[1] - 1)]


def beside(views: np.ndarray, across: int, down: int) -> np.ndarray:
    """bool [K, h, w] grown by `across` px along rows and `down` px along columns."""
    rectangle = np.ones((2 * down + 1, 2 * across + 1), np.uint8)
    return np.stack([cv2.dilate(np.ascontiguousarray(view).view(np.uint8), rectangle) for view in views]).view(bool)


def landings(hidden: np.ndarray, low: np.ndarray, high: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    """Where the rays of the reference's pixels `hidden` bool [h, w] end in each view, at disparities from low to high,
    px float32 [h, w]: bool [K, h, w], the columns and rows between both ends."""
    out = np.zeros((geometry.cameras, *hidden.shape), bool)
    y, x = np.nonzero(hidden)
    for k in range(geometry.cameras):
        (u, v), (other_u, other_v) = (geometry.warp(k, x, y, d[y, x]) for d in (low, high))
        left, right = _between(u, other_u, hidden.shape[1])
        top, bottom = _between(v, other_v, hidden.shape[0])
        for j in range(1 + (bottom - top).max(initial=-1)):
            for i in range(1 + (right - left).max(initial=-1)):
                there = (left + i <= right) & (top + j <= bottom)
                out[k, (top + j)[there], (left + i)[there]] = True
    return out


def witnessed(
    hidden: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    most: int,
    tolerance: int,
) -> np.ndarray:
    """Where rays of the reference's pixels `hidden` bool [h, w] end, at its own disparity, in views that are asked of
    what is there: bool [K, h, w].

    The nearest view is asked first, and so on until `most` of them have seen it: their pixel there is static and
    differs by no more than `tolerance` from the disparity.
    disparities uint16 [K, h, w] in 32nds of a pixel, static bool [K, h, w].
    """
    height, width = hidden.shape
    out = np.zeros_like(static)
    out[geometry.reference] = hidden
    y, x = np.nonzero(hidden)
    d, seen = disparities[geometry.reference][y, x], np.zeros(len(x), np.int32)
    for k in geometry.nearest_first[1:]:
        u, v = (np.rint(p).astype(np.int64) for p in geometry.warp(k, x, y, d.astype(np.float32) / np.float32(UNITS)))
        there = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (seen < most)
        at = k, v[there], u[there]
        out[at] = True
        seen[there] += static[at] & (np.abs(disparities[at].astype(np.int32) - d[there]) <= tolerance)
    return out


def _between(first: np.ndarray, last: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Of whole numbers from first to last, whichever is less, the least and greatest in 0 .. count - 1."""
    low, high = np.rint(np.minimum(first, last)), np.rint(np.maximum(first, last))
    return np.maximum(low, 0).astype(np.int64), np.minimum(high, count - 1).astype(np.int64)


def clear_of_masks(static: np.ndarray) -> np.ndarray:
    """bool [K, H, W]: pixels within 2 px of a mask may hold some of the person's colour, and count little."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    return np.stack([cv2.erode(view.view(np.uint8), disc, borderValue=1) for view in static]).view(bool)


def inner_span(
    disparity: np.ndarray,
    agree: np.ndarray,
    static: np.ndarray,
    scale: int,
    reach: int,
    percentiles: Sequence[float],
) -> np.ndarray | None:
    """Percentiles of the disparities uint16 [K, h, w] that another view confirms (agree bool [K, h, w]), farther than
    `reach` px from people: float64 [n]; None where there are none.

    static  bool [K, H, W] of the full-size views, `scale` times larger
    """
    height, width = disparity.shape[1:]
    square = np.ones((2 * reach + 1,) * 2, np.uint8)
    small = static[:, scale // 2 :: scale, scale // 2 :: scale][:, :height, :width]
    found = []
    for d, view, confirmed in zip(disparity, small, agree, strict=True):
        if confirmed.any():
            clear = cv2.erode(np.ascontiguousarray(view).view(np.uint8), square, borderValue=1)
            found.append(d[clear.view(bool) & confirmed])
    sure = np.concatenate(found) if found else disparity[:0]
    if not len(sure):
        return None
    # as numpy.percentile, which sorts for so many of them
    until, ranks = np.cumsum(np.bincount(sure)), np.asarray(percentiles, np.float64) / 100 * (len(sure) - 1)
    below = np.searchsorted(until, np.floor(ranks), side="right")
    above = np.searchsorted(until, np.minimum(np.floor(ranks) + 1, len(sure) - 1), side="right")
    return interpolated(ranks, np.stack([below, above], -1).astype(np.float64))


def interpolated(ranks: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What numpy.percentile makes of ranks [n] and the values [n, 2] at floor(rank) and the next: float64 [n]."""
    low, high = values.T
    share, step = ranks - np.floor(ranks), high - low
    return np.where(share >= 0.5, high - step * (1 - share), low + step * share)
