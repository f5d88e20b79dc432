"""One instant of the array: input checked, then rectified."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from . import sampling
from .errors import InputError
from .rectify import Rectification
from .rig import Rig
from .threads import on_threads

_STRIP = 2**16 - 1  # pixels; OpenCV divides what has more


@dataclass(frozen=True, eq=False)
class Frame:
    """Rectified views: colour uint8 [K, H, W, C], grey uint8 [K, H, W], dynamic uint8 [K, H, W].

    dynamic is in 254ths of P(dynamic); rectify.NO_RAY (255) where a view has no source pixel.
    """

    colour: np.ndarray
    grey: np.ndarray
    dynamic: np.ndarray


def check_frame(
    rig: Rig,
    images: Sequence[Any],
    masks: Sequence[Any] | None,
    received: Callable[[Any], np.ndarray] = np.asarray,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Images and masks as uint8 arrays of the rig's sizes. Raises InputError naming the camera and the mend.

    received  makes an array of what was given: a backend's of the same name
    """
    K = len(rig.cameras)
    if len(images) != K:
        raise InputError(f"images: {len(images)} given, the rig has {K} cameras: give one per camera, in its order")
    if masks is None:
        masks = [np.zeros(camera.resolution[::-1], np.uint8) for camera in rig.cameras]
    if len(masks) != K:
        raise InputError(f"masks: {len(masks)} given, the rig has {K} cameras: give one per camera, in its order")
    given = zip(rig.cameras, images, strict=True)
    checked = [_image(camera.name, received(image), camera.resolution) for camera, image in given]
    if len({image.ndim for image in checked}) > 1:
        raise InputError("images: some are grey and some colour: convert them all to one kind")
    return checked, [_mask(c.name, received(mask), c.resolution) for c, mask in zip(rig.cameras, masks, strict=True)]


def _image(name: str, image: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.dtype != np.uint8:
        raise InputError(f"image of {name} is {image.dtype}: seepast takes 8-bit images; scale it to uint8")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"image of {name} has shape {image.shape}: give [h, w] grey or [h, w, 3] BGR, without alpha")
    _size("image", name, image, resolution)
    return image


def _mask(name: str, mask: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    if mask.ndim != 2:
        raise InputError(f"mask of {name} has shape {mask.shape}: give one channel [h, w] of P(dynamic)")
    _size("mask", name, mask, resolution)
    if mask.dtype == np.uint8:
        return mask
    if mask.dtype == bool:
        return mask.astype(np.uint8) * np.uint8(255)
    if mask.dtype.kind == "f":
        if not (np.isfinite(mask).all() and mask.min() >= 0 and mask.max() <= 1):
            raise InputError(f"mask of {name} has values outside 0..1 or NaN: a float mask is P(dynamic)")
        return np.rint(mask * 255).astype(np.uint8)
    raise InputError(f"mask of {name} is {mask.dtype}: give uint8 (255 * P), bool, or float P(dynamic) in 0..1")


def _size(what: str, name: str, array: np.ndarray, resolution: tuple[int, int]) -> None:
    if array.shape[:2] != (resolution[1], resolution[0]):
        raise InputError(
            f"{what} of {name} is {array.shape[1]}x{array.shape[0]}, the rig says {resolution[0]}x{resolution[1]}: "
            "use the calibration of this size, or resize"
        )


def rectified_frame(
    rectification: Rectification,
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    interpolation: str = "cubic",
    threads: int = 0,
    out: Frame | None = None,
    *,
    grey: bool = True,
) -> Frame:
    """Stage "rectify": all cameras' images and masks in the common orientation and intrinsics.

    interpolation as of `Rectification.image`; threads 0 = all cores, and the result does not depend on it. `out`, a
    frame that nobody needs any more, is written to and returned if it has the right shape: fresh memory takes longer
    to get than to fill. Without `grey` that of colour views is not set, for methods that do not look at it.
    """
    K, (width, height), channels = len(images), rectification.geometry.size, images[0].shape[2:] or (1,)
    if out is None or out.colour.shape != (K, height, width, *channels):
        colour = np.empty((K, height, width, *channels), np.uint8)
        only = colour[..., 0] if channels == (1,) else np.empty((K, height, width), np.uint8)
        out = Frame(colour, only, np.empty((K, height, width), np.uint8))
    frame = out
    images, masks = [np.ascontiguousarray(i) for i in images], [np.ascontiguousarray(m) for m in masks]
    said = [mask if cv2.countNonZero(mask) else None for mask in masks]
    own_threads = interpolation == "linear" and not grey and sampling.works_alone(images[0], threads)
    whole = [k for k in range(K) if own_threads and not rectification.passes_through(k)]
    for k in whole:
        rectification.together(k, images[k], masks[k], frame.colour[k], frame.dynamic[k])
    work = [(k, rows) for k in range(K) if k not in whole for rows in _strips(width, height)]

    def views(number: int) -> None:
        k, rows = work[number]
        _rectified(rectification, k, rows, images[k], said[k], interpolation, frame)
        if grey and channels == (3,):
            cv2.cvtColor(frame.colour[k, rows], cv2.COLOR_BGR2GRAY, dst=frame.grey[k, rows])

    on_threads(views, len(work), threads)
    return frame


def _rectified(
    rectification: Rectification,
    k: int,
    rows: slice,
    image: np.ndarray,
    mask: np.ndarray | None,
    interpolation: str,
    frame: Frame,
) -> None:
    """These rows of camera k's colour and dynamic; mask None: nothing moves."""
    colour = (frame.grey if image.ndim == 2 else frame.colour)[k, rows]
    dynamic = frame.dynamic[k, rows]
    if rectification.passes_through(k):
        colour[...] = image[rows]
    elif mask is not None and image.ndim == 3 and interpolation == "linear":
        rectification.together(k, image, mask, colour, dynamic, rows)
        return
    else:
        rectification.image(k, image, interpolation, colour, rows)
    rectification.dynamic(k, mask, dynamic, rows)


def input_masks(
    rectification: Rectification, dynamic: np.ndarray, masks: Sequence[np.ndarray], threads: int = 0
) -> tuple[np.ndarray, ...]:
    """Refined P(dynamic) of the rectified views, uint8 [K, H, W] in 254ths, as K masks uint8 [h, w] of 255 * P in the
    cameras' own pixels; `masks` are what came in."""

    masks = [np.ascontiguousarray(mask) for mask in masks]

    def in_bytes(k: int) -> np.ndarray:
        if not rectification.passes_through(k):
            rectification.to_input(k)  # the maps, at the first frame
        return to_bytes(dynamic[k])

    refined = on_threads(in_bytes, len(masks), threads)
    bent = [k for k in range(len(masks)) if not rectification.passes_through(k)]
    found = [np.empty_like(masks[k]) if k in bent else refined[k] for k in range(len(masks))]
    work = [(k, rows) for k in bent for rows in _strips(*masks[k].shape[::-1])]

    def views(number: int) -> None:
        k, rows = work[number]
        rectification.masks_to_input(k, refined[k], masks[k], found[k][rows], rows)

    on_threads(views, len(work), threads)
    return tuple(found)


def _strips(width: int, height: int) -> Iterator[slice]:
    """Rows with so few pixels that OpenCV takes no threads of its own, and that maps and pixels stay in the cache from
    one step to the next."""
    step = max(1, _STRIP // width)
    return (slice(top, min(top + step, height)) for top in range(0, height, step))


def to_bytes(dynamic: np.ndarray) -> np.ndarray:
    """254ths of P(dynamic) -> 255ths; pixels without a ray (255) count as dynamic."""
    scaled = dynamic + (dynamic >= 128)
    return np.subtract(scaled, dynamic == 255, out=scaled)
