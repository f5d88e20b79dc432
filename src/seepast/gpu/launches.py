"""Launches of one thread per pixel, and their arguments."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry import ArrayGeometry
from . import device
from .tables import views_table

ACROSS, DOWN = 32, 8  # threads of a block


def launch_tiles(file: str, kernel: str, shape: tuple[int, ...], *args: Any, rows: int = DOWN, shared: int = 0) -> None:
    """A thread per pixel of `shape` (views, height, width) in blocks of ACROSS x DOWN threads, which see to `rows` rows
    of pixels."""
    views, height, width = shape
    grid = (-(-width // ACROSS), -(-height // rows), views)
    device.current().launch(file, kernel, grid=grid, block=(ACROSS, DOWN), args=args, shared=shared)


def launch_line(file: str, kernel: str, count: int, *args: Any) -> None:
    """A thread per element of `count`, in blocks of 256."""
    device.current().launch(file, kernel, grid=(-(-count // 256),), block=(256,), args=args)


def int32(*values: int) -> list[np.int32]:
    return [np.int32(v) for v in values]


def view_table(view: ArrayGeometry) -> tuple[Any, np.float32, np.float32]:
    """The array as seen from one camera: offsets float32 [1, K, 5] on the device, and the view's centre."""
    return views_table([view])[0], np.float32(view.center[0]), np.float32(view.center[1])
