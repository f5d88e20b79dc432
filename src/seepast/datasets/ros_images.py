"""Pixels of ROS image messages: sensor_msgs/Image (REP 118 and image_encodings.hpp) and sensor_msgs/CompressedImage."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ..errors import DatasetError
from .eight_bits import EightBits
from .png import decode_png8

# channels, and what makes BGR or grey of them: None = they are that, else a cv2.COLOR_ code; _DEEP: of 16 bits each
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUYV),
}
_DEEP = {name.replace("8", "16"): kind for name, kind in _ENCODINGS.items() if "8" in name}
_PNG, _JPEG, _JPEG_END = b"\x89PNG", b"\xff\xd8", b"\xff\xd9"


def decode_message(where: str, message: Any, deep: EightBits | None = None) -> np.ndarray:
    """uint8 [h, w] grey or [h, w, 3] BGR of an Image (it has `encoding`) or CompressedImage (it has `format`).

    deep  what makes 8 bits of 16; None: they are refused

    Transparency is dropped. Raises DatasetError, beginning with `where`: too many bits, an unknown encoding, too few
    bytes, damaged compressed data.
    """
    return _raw(where, message, deep) if hasattr(message, "encoding") else _compressed(where, message, deep)


def _raw(where: str, message: Any, deep: EightBits | None) -> np.ndarray:
    encoding = str(message.encoding)
    (channels, code), wide = _encoding(where, encoding, deep is not None), encoding in _DEEP
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * (2 if wide else 1)
    if min(height, width) < 1 or step < row or message.data.size < step * (height - 1) + row:
        raise DatasetError(
            f"{where}: holds {message.data.size} bytes in rows of {step}, too few for {width}x{height} "
            f"{message.encoding}; the message is damaged: record it again, or cut it out of the bag"
        )
    padded = np.zeros(step * height, np.uint8)  # the last row may come without its padding
    data = message.data[: padded.size]
    padded[: data.size] = data
    image = np.ascontiguousarray(padded.reshape(height, step)[:, :row])
    if wide:
        assert deep is not None
        image = deep(where, image.view(">u2" if message.is_bigendian else "<u2"))
    if channels > 1:
        image = image.reshape(height, width, channels)
    return image if code is None else cv2.cvtColor(image, code)


def _encoding(where: str, encoding: str, deep: bool) -> tuple[int, int | None]:
    known = {**_ENCODINGS, **(_DEEP if deep else {})}
    if encoding in known:
        return known[encoding]
    if encoding in _DEEP:
        raise DatasetError(f"{where}: encoding {encoding} has 16 bits; a mask is mono8, 255 * P(dynamic)")
    if "16" in encoding or "32" in encoding or "64" in encoding:
        raise DatasetError(
            f"{where}: encoding {encoding} has no grey levels of 8 or 16 bits; scale such images to mono8 or bgr8, by "
            "one factor for all cameras and frames, and record or convert the bag with these"
        )
    raise DatasetError(f"{where}: encoding {encoding!r} is not known; convert to one of {', '.join(known)}")


def _compressed(where: str, message: Any, deep: EightBits | None) -> np.ndarray:
    if "compressedDepth" in str(message.format):
        raise DatasetError(f"{where}: is a depth image; name the topic of the camera's picture")
    data = message.data.tobytes()
    if data.startswith(_PNG):
        return decode_png8(where, data, deep, drop_alpha=True)
    if data.startswith(_JPEG) and data.rfind(_JPEG_END, len(data) // 2) < 0:  # OpenCV would fill what is missing
        raise DatasetError(f"{where}: truncated JPEG ({len(data)} bytes, no end marker); cut it out of the bag")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        raise DatasetError(
            f"{where}: cannot be decoded (format {message.format!r}, {len(data)} bytes); cut it out of the bag, or "
            "record sensor_msgs/Image, JPEG or PNG"
        )
    if image.dtype == np.uint16 and deep is not None:
        image = deep(where, image)
    if image.dtype != np.uint8:
        raise DatasetError(f"{where}: has more than 8 bits; scale such images to 8 bits, the same way for all cameras")
    return np.ascontiguousarray(image[..., :3]) if image.ndim == 3 else image
