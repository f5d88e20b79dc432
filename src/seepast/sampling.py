"""Images sampled at the places of a fixed-point map (pixel_maps.fixed_point), edges continued.

Bilinear sampling is the core's where there is one, in half of OpenCV's time; both give the same bits.
"""

from __future__ import annotations

from types import ModuleType

import cv2
import numpy as np

from .backends import core

INTERPOLATION = {"cubic": cv2.INTER_CUBIC, "linear": cv2.INTER_LINEAR}
NO_RAY = 255  # in the result of Rectification.dynamic: this rectified pixel has no source pixel
MAX_DYNAMIC = 254  # P(dynamic) = 1 there
_NO_MASK = np.empty((0, 0), np.uint8)

FixedPoint = tuple[np.ndarray, np.ndarray]  # int16 [H, W, 2], uint16 [H, W]


def sampled(
    image: np.ndarray, places: FixedPoint, interpolation: str, rows: slice, out: np.ndarray | None = None
) -> np.ndarray:
    """uint8 [h, w] or [h, w, C] at `rows` of the places: uint8 [n, W] or [n, W, C]; `out`, if given, is written."""
    whole, fraction = (part[rows] for part in places)
    own = _core_for(image) if interpolation == "linear" else None
    if own is not None:
        out = np.empty((*fraction.shape, *image.shape[2:]), np.uint8) if out is None else out
        if image.ndim == 2:
            own.sample_plane(image, whole, fraction, out)
        else:
            own.sample_colour(image, _NO_MASK, whole, fraction, _NO_MASK, out, _NO_MASK)
        return out
    return cv2.remap(image, whole, fraction, INTERPOLATION[interpolation], dst=out, borderMode=cv2.BORDER_REPLICATE)


def sampled_together(
    image: np.ndarray,
    mask: np.ndarray,
    places: FixedPoint,
    rows: slice,
    out: np.ndarray,
    mask_out: np.ndarray,
    no_ray: np.ndarray | None = None,
) -> None:
    """Both bilinear, into `out` uint8 [n, W, 3] and `mask_out` uint8 [n, W]: maps are read and places found once.

    no_ray  uint8 [n, W], 255 or 0: what the mask is there; it is 254 at most elsewhere. None: as sampled
    """
    whole, fraction = (part[rows] for part in places)
    own = _core_for(image)
    if own is not None:
        own.sample_colour(image, mask, whole, fraction, _NO_MASK if no_ray is None else no_ray, out, mask_out)
        return
    sampled(image, places, "linear", rows, out)
    sampled(mask, places, "linear", rows, mask_out)
    if no_ray is not None:
        np.maximum(np.minimum(mask_out, MAX_DYNAMIC, out=mask_out), no_ray, out=mask_out)


def works_alone(image: np.ndarray, threads: int) -> bool:
    """Whether `sampled_together` takes as many threads as there are to be (0: all cores) to a whole view by itself."""
    own = _core_for(image) if image.ndim == 3 else None
    if own is not None:
        own.set_threads(threads)
    return own is not None


def _core_for(image: np.ndarray) -> ModuleType | None:
    """The core, if there is one that takes such an image."""
    kind = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    return core() if kind and min(image.shape[:2]) > 1 and image.flags.c_contiguous else None
