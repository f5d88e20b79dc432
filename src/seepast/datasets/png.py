"""Strict reading of PNG files as 8-bit images.

OpenCV decodes a truncated PNG into an image whose lower part is missing and says nothing, so the file's
chunks are checked first (PNG specification, section 5: lengths, CRCs and the closing IEND).
"""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np

from ..errors import DatasetError
from .eight_bits import EightBits

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_png8(path: Path, deep: EightBits | None = None) -> np.ndarray:
    """uint8 [h, w] (grey) or [h, w, 3] (BGR) from a complete PNG without transparency.

    deep  what makes 8 bits of 16; None: they are refused

    Raises DatasetError, naming the file: missing, not a PNG, truncated, damaged, 16-bit or with alpha.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error}); restore the file") from None
    return decode_png8(path, data, deep)


def decode_png8(
    path: Path | str, data: bytes, deep: EightBits | None = None, *, drop_alpha: bool = False
) -> np.ndarray:
    """`read_png8` of bytes that are in memory already; `path` names them in errors."""
    bit_depth = _bit_depth_of_whole_file(path, data)
    if bit_depth > 8 and deep is None:
        raise DatasetError(f"{path}: {bit_depth} bits per channel; convert it to 8 bits (scaled, not cut off) first")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is not None and image.dtype == np.uint16 and deep is not None:
        image = deep(path, image)
    if image is None or image.dtype != np.uint8:
        raise DatasetError(f"{path}: cannot be decoded as a PNG of 8 or 16 bits; copy or export it again")
    if drop_alpha and image.ndim == 3 and image.shape[2] == 4:
        image = np.ascontiguousarray(image[..., :3])
    if image.ndim == 3 and image.shape[2] not in (1, 3):
        raise DatasetError(f"{path}: has an alpha channel; save it as plain grey or BGR without transparency")
    return image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image


def _bit_depth_of_whole_file(path: Path | str, data: bytes) -> int:
    """Bits per channel of a PNG whose critical chunks are all there and undamaged."""
    if not data.startswith(_SIGNATURE):
        what = "the file is empty" if not data else "not a PNG file"
        raise DatasetError(f"{path}: {what}; images and masks must be PNG")
    bit_depth, at = 0, len(_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if end > len(data):
            break
        checksum = int.from_bytes(data[end - 4 : end], "big")
        if kind[:1].isupper() and zlib.crc32(memoryview(data)[at + 4 : end - 4]) != checksum:  # critical
            raise DatasetError(f"{path}: damaged PNG (wrong checksum); copy it again")
        if kind == b"IHDR":
            bit_depth = data[at + 16]
        if kind == b"IEND" and bit_depth:
            return bit_depth
        at = end
    raise DatasetError(f"{path}: truncated PNG ({len(data)} bytes, no end marker); copy or record it again")
