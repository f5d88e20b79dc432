"""Delaunay triangulation of the support points, by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np


def with_corners(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Adds the four image corners, each at the disparity of the support point nearest to it.

    points float32 [N >= 1, 3] (x, y, d); returns float32 [N + 4 or fewer, 3]. With them the triangulation
    covers the whole image.
    """
    height, width = shape
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], np.float32)
    distance = ((points[None, :, :2] - corners[:, None]) ** 2).sum(-1)
    added = np.column_stack([corners, points[distance.argmin(1), 2]])[distance.min(1) > 0]
    return np.concatenate([points, added]).astype(np.float32)


def delaunay(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Delaunay triangles of distinct whole-pixel points: float32 [N, >= 2] (x, y ...) -> int32 [T, 3] indices."""
    height, width = shape
    division = cv2.Subdiv2D((0, 0, width, height))
    division.insert(points[:, :2].astype(np.float32))  # type: ignore[call-overload]  # takes arrays, and fast
    corners = np.asarray(division.getTriangleList(), np.float32).reshape(-1, 3, 2)
    # OpenCV also lists triangles of its own bounding triangle; their corners lie outside the image.
    real = ((corners >= 0) & (corners <= (width - 1, height - 1))).all((1, 2))
    corners = corners[real].astype(np.int64)
    index = np.full((height, width), -1, np.int32)
    index[points[:, 1].astype(int), points[:, 0].astype(int)] = np.arange(len(points))
    return index[corners[..., 1], corners[..., 0]].astype(np.int32)
