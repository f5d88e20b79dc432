"""From a camera's image to what a network wants to see, and back to where that lies in the image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

Size = tuple[int, int]  # width, height
LETTERBOX_GREY = 114.0  # what YOLO networks are trained to see around an image


@dataclass(frozen=True)
class Placement:
    """Where an image lies in the network's input: input pixel = (image pixel + 1/2) * scale + offset - 1/2.

    size    (width, height) of the image, px
    scale   along x and y;  offset  of its corner, px of the input
    """

    size: Size
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Preparation:
    """How an image becomes a network's input: (value / scale - mean) / std per channel, in the order of `channels`.

    channels  "RGB" or "BGR"
    fit       "stretch" to the input's size; "letterbox": shrink or grow to fit, grey around; "shorter": the shorter
              side to `size[1]`, the longer at most size[0], then zeros to a multiple of 32; "none": as it is
    size      (width, height) of the input where the model leaves it open
    """

    channels: str = "RGB"
    scale: float = 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    fit: str = "stretch"
    size: Size = (512, 512)

    def __call__(self, image: np.ndarray, size: Size | None, raw: bool = False) -> tuple[np.ndarray, Placement]:
        """float32 [h, w, 3] for one image, uint8 [h, w] grey or [h, w, 3] BGR, and where the image lies in it.

        size: the model's own input size, None where it takes any; raw: bytes as they are, for models of uint8 input.
        Bilinear, pixel centres half a pixel inside, as cv2.resize has it.
        """
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
        fit = "stretch" if size is not None and self.fit in ("none", "shorter") else self.fit
        canvas, inside, placement = _placed(bgr, fit, size or self.size)
        values = canvas[..., ::-1] if self.channels == "RGB" else canvas
        if raw:
            return values, placement
        mean, std = (np.array(v, np.float32) for v in (self.mean, self.std))
        values = (values / np.float32(self.scale) - mean) / std
        if fit == "shorter":
            height, width = inside
            values[height:], values[:, width:] = 0, 0
        return values, placement


def _placed(image: np.ndarray, fit: str, size: Size) -> tuple[np.ndarray, tuple[int, int], Placement]:
    """float32 canvas [h, w, 3] that holds the image, the (height, width) it takes of it, and its placement."""
    height, width = image.shape[:2]
    if fit == "none":
        size = (width, height)
    new = _resized(width, height, fit, size)
    if fit == "shorter":
        size = (-(-new[0] // 32) * 32, -(-new[1] // 32) * 32)
    corner = ((size[0] - new[0]) // 2, (size[1] - new[1]) // 2) if fit == "letterbox" else (0, 0)
    canvas = np.full((size[1], size[0], 3), LETTERBOX_GREY if fit == "letterbox" else 0, np.float32)
    canvas[corner[1] : corner[1] + new[1], corner[0] : corner[0] + new[0]] = (
        image if new == (width, height) else cv2.resize(image, new, interpolation=cv2.INTER_LINEAR)
    )
    scale = (new[0] / width, new[1] / height)
    return canvas, new[::-1], Placement((width, height), scale, (float(corner[0]), float(corner[1])))


def _resized(width: int, height: int, fit: str, size: Size) -> Size:
    if fit in ("stretch", "none"):
        return size
    if fit == "letterbox":
        ratio = min(size[0] / width, size[1] / height)
    else:
        ratio = min(size[1] / min(width, height), size[0] / max(width, height))
    return max(1, round(width * ratio)), max(1, round(height * ratio))
