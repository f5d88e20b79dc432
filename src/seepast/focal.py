"""Plain synthetic aperture refocusing: the average of the cameras' rays through one focal plane.

The baseline that light-field people know (Isaksen et al. 2000; the paper's eq. 1 with a constant depth): what
lies on the plane is sharp, what is off it is smeared, people included unless their rays are left out. The median in
place of the mean (Vaish et al. 2006) drops what only a few cameras see, without any mask.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .backends.reference import bilinear, inside, neighbours, quarter_positions, ray_offsets
from .errors import InputError
from .geometry import ArrayGeometry
from .rectify import NO_RAY

DYNAMIC = 127  # a ray of at least this many 254ths of P(dynamic) is left out of the masked average


@dataclass(frozen=True)
class Aperture:
    """Which rays make a pixel, and how: by their "mean", or by their "median", colour by colour.

    cameras  indices of those that take part; None: all
    """

    cameras: tuple[int, ...] | None = None
    blend: Literal["mean", "median"] = "mean"


WIDE_OPEN = Aperture()


def refocus_at(
    images: Sequence[np.ndarray],
    geometry: ArrayGeometry,
    disparity: float | np.ndarray,
    dynamic: np.ndarray | None = None,
    aperture: Aperture = WIDE_OPEN,
) -> np.ndarray:
    """What the rays that meet on a focal surface make of it, as seen from the reference camera.

    images     K rectified views, uint8 [H, W] or [H, W, 3]
    disparity  of the surface, px over the full array: one number for a fronto-parallel plane, or [H, W]
    dynamic    uint8 [K, H, W], 254ths of P(dynamic), NO_RAY outside a view (Rectification.dynamic): rays that
               are probably dynamic are left out (paper eq. 2). None: every ray inside its view counts

    Returns uint8 like one image; black where no ray is left. Raises InputError.
    """
    width, height = geometry.size
    if len(images) != geometry.cameras or any(np.shape(image)[:2] != (height, width) for image in images):
        raise InputError(
            f"images: refocusing needs the {geometry.cameras} rectified views of {width}x{height} px, one per camera"
        )
    cameras = range(geometry.cameras) if aperture.cameras is None else aperture.cameras
    if not cameras or not all(0 <= k < geometry.cameras for k in cameras):
        raise InputError(f"aperture: cameras {tuple(cameras)} must be one or more of 0 .. {geometry.cameras - 1}")
    d = np.broadcast_to(np.asarray(disparity, np.float32), (height, width))
    rays = [_ray(images[k], geometry, k, d, None if dynamic is None else dynamic[k]) for k in cameras]
    blend = _mean if aperture.blend == "mean" else _median
    made = np.floor(blend([r[0] for r in rays], [r[1] for r in rays]) + np.float32(0.5)).astype(np.uint8)
    return made.reshape(np.shape(images[0]))


def _ray(
    image: np.ndarray, geometry: ArrayGeometry, camera: int, d: np.ndarray, dynamic: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Colour float32 [H, W, C] of one camera's ray through every pixel, and whether it counts, bool [H, W]."""
    y, x = np.mgrid[: d.shape[0], : d.shape[1]]
    xq, row = quarter_positions(geometry, camera, x, y, d)
    used = inside(xq, row, d.shape)
    if dynamic is not None:
        row, left, right = neighbours(xq, row, d.shape)
        p = np.maximum(dynamic[row, left], dynamic[row, right])
        used &= (p < DYNAMIC) & (p != NO_RAY)
    return bilinear(np.atleast_3d(image), x, y, *ray_offsets(geometry, camera, x, y, d)), used


def _mean(colours: list[np.ndarray], used: list[np.ndarray]) -> np.ndarray:
    total = np.zeros_like(colours[0])
    count = np.zeros(used[0].shape, np.float32)
    for colour, counts in zip(colours, used, strict=True):
        total += np.where(counts[..., None], colour, np.float32(0))
        count += counts
    return total / np.maximum(count, 1)[..., None]


def _median(colours: list[np.ndarray], used: list[np.ndarray]) -> np.ndarray:
    """The mean of the two middle ones where their number is even; 0 where it is 0."""
    rays, counts = np.stack(colours), np.stack(used)
    ordered = np.sort(np.where(counts[..., None], rays, np.float32(np.inf)), axis=0)
    n = counts.sum(axis=0)[None, ..., None]
    low, high = (np.take_along_axis(ordered, np.maximum(at, 0), axis=0)[0] for at in ((n - 1) // 2, n // 2))
    seen = n[0] > 0
    return np.where(seen, (np.where(seen, low, 0) + np.where(seen, high, 0)) / np.float32(2), np.float32(0))
