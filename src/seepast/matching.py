"""Sparse sure matches between neighbouring rectified views: what checks of calibration and brightness rest on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from .geometry import ArrayGeometry

_MAX_ROW_SEARCH = 20.0  # px: beyond this a match is a wrong one, not a misalignment


@dataclass(frozen=True, eq=False)
class Matches:
    """N points that two rectified views both show; float32[N] each, px.

    first, second  the two cameras
    x, y           where the first shows the points; x2, y2: where the second does
    disparity      over the full array, with the depth measured in `first`; follows from x and x2 alone
    row_error      y2 less the row that W_second predicts for (x, y) at that disparity
    """

    first: int
    second: int
    x: np.ndarray
    y: np.ndarray
    x2: np.ndarray
    y2: np.ndarray
    disparity: np.ndarray
    row_error: np.ndarray

    def __len__(self) -> int:
        return len(self.x)


def neighbour_matches(images: Sequence[np.ndarray], geometry: ArrayGeometry) -> list[Matches]:
    """Matches of every two neighbours along the line, in its order: K - 1 of them.

    images: K uint8 [H, W] or [H, W, 3] rectified views. SIFT matches (mutual, distinctive), refined by
    Lucas-Kanade to some hundredths of a pixel.
    """
    order = [int(k) for k in np.argsort(geometry.positions[:, 0])]
    grey = {k: _grey(images[k]) for k in order}
    return [_match(grey[a], grey[b], geometry.seen_from(a), b) for a, b in pairwise(order)]


def _grey(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _match(first: np.ndarray, second: np.ndarray, view: ArrayGeometry, camera: int) -> Matches:
    """From the reference of `view` to `camera`."""
    start, end = _refined(first, second, *_sift_matches(first, second))
    (x, y), (x2, y2) = start.T, end.T
    ax, _, az, sx, _ = view.offsets[camera]
    straight = x2 - sx
    disparity = (x - straight) / (ax - az * (straight - np.float32(view.center[0])))
    error = y2 - view.warp(camera, x, y, disparity)[1]
    kept = (disparity > -1) & (abs(error) < _MAX_ROW_SEARCH)
    return Matches(view.reference, camera, *(v[kept] for v in (x, y, x2, y2, disparity, error)))


def _refined(
    first: np.ndarray, second: np.ndarray, start: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if not len(start):
        return start, guess
    options: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    end, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, guess.copy(), **options)
    kept = (found.ravel() > 0) & (np.linalg.norm(end - guess, axis=-1) < 2)
    return start[kept], end[kept]


def _sift_matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """float32[N, 2] pixels of mutual, distinctive matches."""
    detector: Any = cv2.SIFT.create(nfeatures=2000)
    (keys1, descriptors1), (keys2, descriptors2) = (detector.detectAndCompute(image, None) for image in (first, second))
    if descriptors1 is None or descriptors2 is None or len(keys2) < 2:
        return np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    best = [m for m, *n in cv2.BFMatcher().knnMatch(descriptors1, descriptors2, 2) if m.distance < 0.75 * n[0].distance]
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(descriptors2, descriptors1)}
    mutual = [m for m in best if back.get(m.trainIdx) == m.queryIdx]
    start = np.array([keys1[m.queryIdx].pt for m in mutual], np.float32).reshape(-1, 2)
    return start, np.array([keys2[m.trainIdx].pt for m in mutual], np.float32).reshape(-1, 2)
