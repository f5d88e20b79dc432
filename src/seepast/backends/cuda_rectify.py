"""Stage "rectify" of the backend `cuda`: images and masks of all cameras in one launch, and refined masks back in one.

Bit for bit what frames.py does with cv2.remap of OpenCV 5. OpenCV 4 rounds its weights of cubic interpolation: 0.3 %
of the values of an image of noise differ by one grey level there (OpenCV 4.12; tests/test_gpu_rectify.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ..frames import Frame
from ..gpu import device, tables
from ..rectify import Rectification

FRACTIONS = 32  # of a pixel, that cv2.remap knows


def rectified_frame(
    rectification: Rectification,
    images: Sequence[Any],
    masks: Sequence[Any],
    interpolation: str = "cubic",
    threads: int = 0,
    out: Frame | None = None,
    *,
    grey: bool = True,
) -> Frame:
    """frames.rectified_frame: K images uint8 [h, w] or [h, w, 3] and K masks uint8 [h, w], NumPy's or the device's, as
    a Frame of the device's arrays. threads and out mean nothing here."""
    used, K = device.current(), len(images)
    width, height = rectification.geometry.size
    images, masks = [on_device(image) for image in images], [on_device(mask) for mask in masks]
    channels = images[0].shape[2] if images[0].ndim == 3 else 1
    maps = _kept(rectification).from_input
    colour = used.xp.empty((K, height, width, channels), np.uint8)
    only = colour[..., 0] if channels == 1 else used.xp.empty((K, height, width), np.uint8)
    frame = Frame(colour, only, used.xp.empty((K, height, width), np.uint8))
    used.launch(
        "rectify", "rectify", grid=(-(-width // 32), -(-height // 8), K), block=(32, 8),
        args=[
            tables.addresses([images]), tables.addresses([masks]), _sizes(rectification), maps.places, maps.whole,
            maps.fraction, maps.mark, tables.constant(cubic_weights()), np.int32(interpolation == "cubic"),
            np.int32(grey), np.int32(height), np.int32(width), np.int32(channels), frame.colour, frame.grey,
            frame.dynamic,
        ],
    )  # fmt: skip
    return frame


def input_masks(rectification: Rectification, dynamic: Any, masks: Sequence[Any], threads: int = 0) -> tuple[Any, ...]:
    """frames.input_masks: dynamic uint8 [K, H, W] of the device, `masks` NumPy's or the device's; K masks uint8 [h, w]
    of the device, one behind the other in one piece of memory."""
    used, K = device.current(), len(masks)
    width, height = rectification.geometry.size
    masks, maps = [on_device(mask) for mask in masks], _kept(rectification).to_input
    starts = np.cumsum([0, *(mask.size for mask in masks)], dtype=np.int64)
    out = used.xp.empty(int(starts[-1]), np.uint8)
    used.launch(
        "rectify", "to_input", grid=(-(-max(mask.size for mask in masks) // 256), K), block=(256,),
        args=[
            dynamic, tables.addresses([masks]), _sizes(rectification), tables.constant(starts), maps.places,
            maps.whole, maps.fraction, maps.mark, np.int32(height), np.int32(width), out,
        ],
    )  # fmt: skip
    return tuple(out[starts[k] : starts[k + 1]].reshape(masks[k].shape) for k in range(K))


def on_device(array: Any) -> Any:
    """A C-contiguous array of the device: uploaded if it is NumPy's."""
    used = device.current()
    return used.upload(array) if isinstance(array, np.ndarray) else used.xp.ascontiguousarray(array)


def _sizes(rectification: Rectification) -> Any:
    return tables.constant(np.array([camera.resolution for camera in rectification.cameras], np.int32))


@dataclass(frozen=True)
class _Maps:
    """One direction's maps of the cameras that have any, one behind the other, on the device.

    places    where a camera's maps are: int32 number or int64 pixel; -1 for one that passes through
    whole     int16 [.., 2] and fraction uint16: pixel_maps.fixed_point
    mark      uint8: no_ray, or 1 where the rectified view does not reach the pixel
    """

    places: Any
    whole: Any
    fraction: Any
    mark: Any


@dataclass(frozen=True)
class _BothWays:
    from_input: _Maps
    to_input: _Maps


_maps: WeakKeyDictionary[Rectification, dict[Any, _BothWays]] = WeakKeyDictionary()


def _kept(rectification: Rectification) -> _BothWays:
    """The maps of a rectification on the device in use: uploaded once, for as long as it lives."""
    on_devices, used = _maps.setdefault(rectification, {}), device.current()
    if used not in on_devices:
        K = range(len(rectification.cameras))
        forth = [rectification.from_input(k) for k in K]
        back = [None if rectification.passes_through(k) else rectification.to_input(k) for k in K]
        slots = np.cumsum([fixed is not None for fixed in forth]) - 1
        starts = np.cumsum([0, *(0 if fixed is None else fixed[1].size for fixed in back[:-1])])
        on_devices[used] = _BothWays(_uploaded(forth, slots.astype(np.int32)), _uploaded(back, starts))
    return on_devices[used]


Fixed = tuple[np.ndarray, np.ndarray, np.ndarray] | None


def _uploaded(maps: Sequence[Fixed], places: np.ndarray) -> _Maps:
    bent = [fixed for fixed in maps if fixed is not None]
    nothing = np.zeros(2, np.int16), np.zeros(1, np.uint16), np.zeros(1, np.uint8)  # no launch takes an empty array
    columns = zip(*bent, strict=True) if bent else ([part] for part in nothing)
    whole, fraction, mark = (np.concatenate([part.ravel() for part in column]) for column in columns)
    there = np.array([fixed is not None for fixed in maps])
    keep = device.current().keep  # frames are rectified in one lane, masks go back in another
    return _Maps(
        keep(np.where(there, places, -1).astype(places.dtype)),
        keep(whole),
        keep(fraction),
        keep(mark.astype(np.uint8)),
    )


@cache
def cubic_weights() -> np.ndarray:
    """float32 [32, 4]: cv2.remap's weights of the four pixels from one before a position on, by its 32nds; cubic
    convolution with A = -0.75 (Keys 1981), the last one what the others leave of 1."""
    x, A, one = np.arange(FRACTIONS, dtype=np.float32) / np.float32(FRACTIONS), np.float32(-0.75), np.float32(1)

    def near(t: np.ndarray) -> np.ndarray:
        return ((A + 2) * t - (A + 3)) * t * t + one

    before = ((A * (x + one) - 5 * A) * (x + one) + 8 * A) * (x + one) - 4 * A
    first, second = near(x), near(one - x)
    return np.stack([before, first, second, one - before - first - second], axis=-1).astype(np.float32)
