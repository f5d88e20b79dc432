"""Images sampled at the places of a fixed-point map (pixel_maps.fixed_point), edges continued.

Bilinear sampling is the core's where there is one, in half of OpenCV's time; both give the same bits.
"""

from __future__ import annotations

import cv2
import numpy as np

from .backends import core

INTERPOLATION = {"cubic": cv2.INTER_CUBIC, "linear": cv2.INTER_LINEAR}
_NO_MASK = np.empty((0, 0), np.uint8)

FixedPoint = tuple[np.ndarray, np.ndarray]  # int16 [H, W, 2], uint16 [H, W]


def sampled(
    image: np.ndarray, places: FixedPoint, interpolation: str, rows: slice, out: np.ndarray | None = None
) -> np.ndarray:
    """uint8 [h, w] or [h, w, C] at `rows` of the places: uint8 [n, W] or [n, W, C]; `out`, if given, is written."""
    whole, fraction = (part[rows] for part in places)
    if interpolation == "linear" and _core_takes(image):
        out = np.empty((*fraction.shape, *image.shape[2:]), np.uint8) if out is None else out
        if image.ndim == 2:
            core().sample_plane(image, whole, fraction, out)
        else:
            core().sample_colour(image, _NO_MASK, whole, fraction, out, _NO_MASK)
        return out
    return cv2.remap(image, whole, fraction, INTERPOLATION[interpolation], dst=out, borderMode=cv2.BORDER_REPLICATE)


def sampled_together(
    image: np.ndarray, mask: np.ndarray, places: FixedPoint, rows: slice, out: np.ndarray, mask_out: np.ndarray
) -> None:
    """Both bilinear, into `out` uint8 [n, W, 3] and `mask_out` uint8 [n, W]: maps are read and places found once."""
    whole, fraction = (part[rows] for part in places)
    if _core_takes(image):
        core().sample_colour(image, mask, whole, fraction, out, mask_out)
    else:
        sampled(image, places, "linear", rows, out)
        sampled(mask, places, "linear", rows, mask_out)


def _core_takes(image: np.ndarray) -> bool:
    kind = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    return core() is not None and kind and min(image.shape[:2]) > 1 and image.flags.c_contiguous
