"""Messages as bytes and back: CDR (OMG DDSI-RTPS, plain XCDR1), which is what every ROS 2 middleware on DDS sends.

The cyclonedds package would make a list of integers of every image, a hundred times slower.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from .messages import CameraInfo, CompressedImage, Image, Message

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
SECOND = 10**9  # ns


def encode(message: Message) -> bytes:
    """The message with the header of its encoding, as DDS sends it."""
    writer = _Writer()
    writer.header(message.stamp, message.frame_id)
    if isinstance(message, Image):
        writer.numbers("I", message.height, message.width)
        writer.text(message.encoding)
        writer.numbers("B", message.is_bigendian)
        writer.numbers("I", message.step)
        writer.blob(message.data)
    elif isinstance(message, CompressedImage):
        writer.text(message.format)
        writer.blob(message.data)
    else:
        writer.numbers("I", message.height, message.width)
        writer.text(message.distortion_model)
        writer.numbers("I", len(message.d))
        for values in (message.d, message.k, message.r, message.p):
            writer.numbers("d", *values)
        writer.numbers("I", *(0 for _ in ("binning_x", "binning_y", "x_offset", "y_offset", "height", "width")))
        writer.numbers("?", False)  # roi.do_rectify
    return bytes(writer.buffer)


def decode(kind: type[Message], data: bytes) -> Message:
    """The message of that kind; pixels are a view of `data`. Its bytes must be whole: DDS has checked them."""
    reader = _Reader(data)
    stamp, frame_id = reader.header()
    if kind is CompressedImage:
        return CompressedImage(stamp, frame_id, reader.text(), reader.blob())
    height, width = reader.numbers("I", 2)
    words = reader.text()
    if kind is Image:
        (big,), (step,) = reader.numbers("B"), reader.numbers("I")
        return Image(stamp, frame_id, height, width, words, step, reader.blob(), big)
    (count,) = reader.numbers("I")
    d, k, r, p = (reader.numbers("d", n) for n in (count, 9, 9, 12))
    return CameraInfo(stamp, frame_id, height, width, k, p, r, d, words)


class _Writer:
    """Every number is aligned to its own size, counted from behind the four bytes of the encoding."""

    def __init__(self) -> None:
        self.buffer = bytearray(LITTLE_ENDIAN)

    def numbers(self, code: str, *values: Any) -> None:
        if values:
            self.buffer += bytes(-(len(self.buffer) - len(LITTLE_ENDIAN)) % struct.calcsize(code))
            self.buffer += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, text: str) -> None:
        encoded = text.encode() + b"\0"
        self.numbers("I", len(encoded))
        self.buffer += encoded

    def blob(self, data: np.ndarray) -> None:
        self.numbers("I", data.nbytes)
        self.buffer += data.data

    def header(self, stamp: int, frame_id: str) -> None:
        self.numbers("i", stamp // SECOND)
        self.numbers("I", stamp % SECOND)
        self.text(frame_id)


class _Reader:
    def __init__(self, data: bytes):
        self._data, self._at = data, len(LITTLE_ENDIAN)
        self._order = "<" if data[1] & 1 else ">"

    def numbers(self, code: str, count: int = 1) -> tuple[Any, ...]:
        if not count:
            return ()
        self._at += -(self._at - len(LITTLE_ENDIAN)) % struct.calcsize(code)
        values = struct.unpack_from(f"{self._order}{count}{code}", self._data, self._at)
        self._at += count * struct.calcsize(code)
        return values

    def text(self) -> str:
        (length,) = self.numbers("I")
        self._at += length
        return self._data[self._at - length : self._at].rstrip(b"\0").decode(errors="replace")

    def blob(self) -> np.ndarray:
        (length,) = self.numbers("I")
        return np.frombuffer(self._data, np.uint8, length, self._at)

    def header(self) -> tuple[int, str]:
        (seconds,), (nanoseconds,) = self.numbers("i"), self.numbers("I")
        return seconds * SECOND + nanoseconds, self.text()
