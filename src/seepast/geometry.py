"""The rectified array: K cameras of one orientation and one intrinsic matrix, and the warp W_k between them.

Conventions, used everywhere in seepast:

* pixel centres lie at integer coordinates, x to the right, y down (OpenCV);
* positions are camera centres in metres in the rectified reference camera's frame (x right, y down, z forward);
* disparity d is in pixels over the full array: d = fx * B / Z, with Z the depth in the *reference* camera and
  B the distance from the reference to the farthest camera. It is never negative; 0 means infinitely far
  (in outputs: unknown).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

MAX_CAMERAS = 16  # labels of one reference pixel are one uint16, bit k = ray k


@dataclass(frozen=True, eq=False)
class ArrayGeometry:
    """Geometry of a rectified array as seen from its reference camera.

    focal      (fx, fy) px, shared by all cameras
    center     (cx, cy) px, the reference view's principal point c
    size       (width, height) px of every rectified view
    positions  float64[K, 3] camera centres in metres, reference at the origin
    reference  index of the reference camera
    baseline   B in metres, the unit of disparity: reference to farthest camera unless given
    shifts     float64[K, 2] px, each view's principal point less the reference's: arrays whose cameras converge,
               by shifted sensors or by rectification, keep all of their pixels. 0 unless given
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]
    positions: np.ndarray
    reference: int = 0
    baseline: float = 0.0
    shifts: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        if not self.baseline:
            farthest = float(np.linalg.norm(self.positions - self.positions[self.reference], axis=1).max())
            object.__setattr__(self, "baseline", farthest)
        if not len(self.shifts):
            object.__setattr__(self, "shifts", np.zeros((self.cameras, 2)))

    @property
    def cameras(self) -> int:
        return len(self.positions)

    @property
    def focal_baseline(self) -> float:
        """f * B in px * m: depth = focal_baseline / disparity."""
        return self.focal[0] * self.baseline

    @cached_property
    def offsets(self) -> np.ndarray:
        """float32[K, 5] of (ax, ay, az, sx, sy): W_k(x, d) = c + (x - c - d (ax, ay)) / (1 - d az) + (sx, sy).

        ax = bx / B, ay = (by / B) (fy / fx), az = bz / (fx B), METHOD "rectify"; (sx, sy) the view's shift.
        """
        fx, fy = self.focal
        unit = self.positions / self.baseline
        found = np.column_stack([unit[:, 0], unit[:, 1] * (fy / fx), unit[:, 2] / fx, self.shifts]).astype(np.float32)
        found.flags.writeable = False
        return found

    @cached_property
    def nearest_first(self) -> np.ndarray:
        """int32 [K]: cameras by their distance from the reference, which is the first."""
        distance = np.linalg.norm(self.positions - self.positions[self.reference], axis=1)
        distance[self.reference] = -1
        found = np.argsort(distance, kind="stable").astype(np.int32)
        found.flags.writeable = False
        return found

    @cached_property
    def views(self) -> tuple[ArrayGeometry, ...]:
        """The array as seen from every camera."""
        return tuple(self.seen_from(k) for k in range(self.cameras))

    def seen_from(self, camera: int) -> ArrayGeometry:
        """The same array with another camera as its origin; disparities keep the unit (px over *this* B).

        With Z measured in that camera, W between it and camera k has the offsets a_k - a_camera, so all
        reference views can share one disparity scale.
        """
        cx, cy = np.array(self.center) + self.shifts[camera]
        return replace(
            self,
            positions=self.positions - self.positions[camera],
            reference=camera,
            center=(float(cx), float(cy)),
            shifts=self.shifts - self.shifts[camera],
        )

    def warp(self, camera: int, x: np.ndarray, y: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """W_k: reference pixels (x, y) at disparity d -> (x, y) in `camera`, float32, same shape as the inputs."""
        ax, ay, az, sx, sy = self.offsets[camera]
        cx, cy = np.float32(self.center[0]), np.float32(self.center[1])
        x, y, d = (np.asarray(v, np.float32) for v in (x, y, d))
        scale = np.float32(1) / (np.float32(1) - d * az)
        return cx + (x - cx - d * ax) * scale + sx, cy + (y - cy - d * ay) * scale + sy

    def depth(self, disparity: np.ndarray) -> np.ndarray:
        """Metres in the reference camera, float32; 0 where the disparity is 0 (unknown)."""
        disparity = np.asarray(disparity, np.float32)
        known = disparity > 0
        return np.where(known, np.float32(self.focal_baseline) / np.where(known, disparity, 1), 0).astype(np.float32)
