"""The ROS messages that pass through `seepast serve`, the same whatever carries them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..geometry import ArrayGeometry


@dataclass(eq=False)
class Image:
    """sensor_msgs/Image. stamp: ns of the header; data: uint8, one dimension, rows of `step` bytes."""

    stamp: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    data: np.ndarray
    is_bigendian: int = 0


@dataclass(eq=False)
class CompressedImage:
    """sensor_msgs/CompressedImage: a JPEG or PNG file in `data`, uint8, one dimension."""

    stamp: int
    frame_id: str
    format: str
    data: np.ndarray


@dataclass(eq=False)
class CameraInfo:
    """sensor_msgs/CameraInfo without binning and region of interest; matrices row by row."""

    stamp: int
    frame_id: str
    height: int
    width: int
    k: Sequence[float]
    p: Sequence[float]
    r: Sequence[float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    d: Sequence[float] = field(default=(0.0, 0.0, 0.0, 0.0, 0.0))
    distortion_model: str = "plumb_bob"


Message = Image | CompressedImage | CameraInfo


def image_kind(topic: str) -> type[Image] | type[CompressedImage]:
    """What a topic of images carries: image_transport's compressed topics end in /compressed."""
    return CompressedImage if topic.rstrip("/").endswith("/compressed") else Image


def image_message(stamp: int, frame_id: str, pixels: np.ndarray) -> Image:
    """An Image of uint8 [H, W, 3] BGR, or [H, W] of uint8 (mono8) or float32 (32FC1)."""
    height, width = pixels.shape[:2]
    encoding = "bgr8" if pixels.ndim == 3 else {"u1": "mono8", "f4": "32FC1"}[pixels.dtype.str[1:]]
    data = np.ascontiguousarray(pixels)
    return Image(
        stamp=stamp,
        frame_id=frame_id,
        height=height,
        width=width,
        encoding=encoding,
        step=data.strides[0],
        data=data.reshape(-1).view(np.uint8),
        is_bigendian=int(sys.byteorder == "big" and encoding == "32FC1"),
    )


def camera_info(stamp: int, frame_id: str, geometry: ArrayGeometry) -> CameraInfo:
    """The rectified reference view: a pinhole without distortion, P = K [I | 0]."""
    (fx, fy), (cx, cy), (width, height) = geometry.focal, geometry.center, geometry.size
    k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    p = (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return CameraInfo(stamp, frame_id, height, width, k, p)
