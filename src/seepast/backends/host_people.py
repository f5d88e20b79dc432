"""What the backends `cpu` and `reference` share in the masks' refinement (people.py): NumPy and OpenCV do it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from ..options import PeopleOptions
from ..people import NO_SAY, SHARE, UNKNOWN, Terms
from ..rectify import NO_RAY

__all__ = ["disagreement", "potentials_by", "probability", "share_histograms", "sure_labels", "surface_range", "within"]


def disagreement(saw: np.ndarray, step: int) -> float:
    """How far the views' masks differ on common surface points: sum |P_k - P_j| / sum max(P_k, P_j), in 0..1.

    Of every step-th pixel along both axes of saw (`witnesses`). Exact masks differ only where a surface is wrong, by
    some per cent; 0 where nobody says anything.
    """
    saw = saw[:, ::step, ::step]
    low = high = 0
    for k in range(len(saw)):
        own = saw[k, ..., k]
        for j in range(len(saw)):
            if j != k:
                both = (own != NO_SAY) & (saw[k, ..., j] != NO_SAY)
                low += int(np.minimum(own, saw[k, ..., j])[both].sum(dtype=np.int64))
                high += int(np.maximum(own, saw[k, ..., j])[both].sum(dtype=np.int64))
    return 1 - low / high if high else 0.0


def surface_range(surfaces: np.ndarray) -> tuple[float, float]:
    """Of surfaces float32 [K, H, W]: 99th percentile of every eighth pixel along both axes, and the largest of all."""
    return float(np.percentile(surfaces[:, ::8, ::8], 99)), float(surfaces.max())


def share_histograms(share: np.ndarray, mean: np.ndarray, step: int) -> np.ndarray:
    """By share (`object_slice`) of every step-th lattice pixel: how many, and the sum of `mean`: int64 [2, SHARE + 1].
    Without those whose share is UNKNOWN."""
    share, mean = share[:, ::step, ::step], mean[:, ::step, ::step]
    known = share != UNKNOWN
    counts = np.bincount(share[known], minlength=SHARE + 1)
    return np.stack([counts, np.bincount(share[known], mean[known], SHARE + 1).astype(np.int64)])


def sure_labels(region: np.ndarray, said: np.ndarray, options: PeopleOptions) -> np.ndarray:
    """int8 [K, h, w] on the lattice: 1 deep inside the region where the cameras' P says so too, -1 well outside."""
    inner, outer = (disc(r) for r in (options.inner, options.outer))
    out = np.zeros(region.shape, np.int8)
    for k, view in enumerate(region):
        out[k][(cv2.erode(view, inner) > 0) & (said[k] > np.float32(options.sure_said))] = 1
        out[k][cv2.dilate(view, outer) == 0] = -1
    return out


def within(region: np.ndarray, radius: int) -> np.ndarray:
    """Pixels at most `radius` from one that is 1: uint8 [K, h, w] of as many."""
    return np.stack([cv2.dilate(view, disc(radius)) for view in region])


def disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)


def upsampled(blocks: np.ndarray, size: int, shape: tuple[int, int]) -> np.ndarray:
    """One value per size x size pixels -> per pixel, linear between their centres: float32 [H, W, n]."""
    whole = cv2.resize(blocks, (blocks.shape[1] * size, blocks.shape[0] * size), interpolation=cv2.INTER_LINEAR)
    missing = [(0, max(0, n - m)) for n, m in zip(shape, whole.shape, strict=False)]
    whole = np.pad(whole, [*missing, (0, 0)], "edge") if np.any(missing) else whole
    return np.ascontiguousarray(whole[: shape[0], : shape[1]])


def potentials_by(potential: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """`potentials` of a backend, whose `potential` is that of one camera."""

    def potentials(
        said, dynamic, colour, linear, sure, surprise, terms: Terms, stride: int, cell: int, size: int
    ) -> np.ndarray:
        """`potential` of all cameras: int16 [K, h, w]. linear float32 [K, r, c, 4]: one value per size x size pixels of
        the images, linear between their centres; the rest as for one camera, with K as first axis."""
        labels = (upsampled(blocks, size, dynamic.shape[1:]) for blocks in linear)
        views = zip(said, dynamic, colour, labels, sure, surprise, terms.behind, strict=True)
        return np.stack([potential(*view, terms, stride, cell) for view in views])

    return potentials


def probability(belief: np.ndarray, dynamic: np.ndarray, table: np.ndarray, grow: bool) -> np.ndarray:
    """254ths of P(dynamic) by belief int16 [K, H, W], table uint8 [256] of quarter nats from -128 on: uint8 [K, H, W],
    NO_RAY where dynamic has it; grow: of the largest belief of a pixel and its four neighbours."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    out = np.empty_like(dynamic)
    for k, view in enumerate(belief):
        quarter = np.clip((view - 1) >> 6, -128, 127).astype(np.int8).view(np.uint8) ^ 128
        p = cv2.LUT(quarter, table)
        out[k] = np.where(dynamic[k] == NO_RAY, np.uint8(NO_RAY), cv2.dilate(p, cross) if grow else p)
    return out
