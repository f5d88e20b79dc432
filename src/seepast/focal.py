"""Plain synthetic aperture refocusing: the average of all cameras' rays through one focal plane.

The baseline that light-field people know (Isaksen et al. 2000; the paper's eq. 1 with a constant depth): what
lies on the plane is sharp, what is off it is smeared, people included unless their rays are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .backends.reference import bilinear, inside, neighbours, quarter_positions, ray_offsets
from .errors import InputError
from .geometry import ArrayGeometry
from .rectify import NO_RAY

DYNAMIC = 127  # a ray of at least this many 254ths of P(dynamic) is left out of the masked average


def refocus_at(
    images: Sequence[np.ndarray],
    geometry: ArrayGeometry,
    disparity: float | np.ndarray,
    dynamic: np.ndarray | None = None,
) -> np.ndarray:
    """The mean of the rays that meet on a focal surface, as seen from the reference camera.

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
    y, x = np.mgrid[:height, :width]
    d = np.broadcast_to(np.asarray(disparity, np.float32), (height, width))
    total = np.zeros((height, width, np.atleast_3d(images[0]).shape[2]), np.float32)
    count = np.zeros((height, width), np.float32)
    for k, image in enumerate(images):
        xq, row = quarter_positions(geometry, k, x, y, d)
        used = inside(xq, row, (height, width))
        if dynamic is not None:
            row, left, right = neighbours(xq, row, (height, width))
            p = np.maximum(dynamic[k, row, left], dynamic[k, row, right])
            used &= (p < DYNAMIC) & (p != NO_RAY)
        value = bilinear(np.atleast_3d(image), x, y, *ray_offsets(geometry, k, x, y, d))
        total += np.where(used[..., None], value, np.float32(0))
        count += used
    mean = np.floor(total / np.maximum(count, 1)[..., None] + np.float32(0.5)).astype(np.uint8)
    return mean.reshape(np.shape(images[0]))
