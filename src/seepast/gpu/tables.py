"""Small tables that kernels read, kept on the device by their contents: the next frame finds them there."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np

from ..geometry import ArrayGeometry
from . import device

KEPT = 1024  # tables, each of some hundred bytes: what several frames use, since kernels read them later

_tables: OrderedDict[tuple[Any, ...], Any] = OrderedDict()
_one = Lock()


def constant(values: np.ndarray) -> Any:
    """The device's array with the contents of a NumPy array; nobody may write to it."""
    here = device.current()
    key = here, values.dtype.str, values.shape, values.tobytes()
    with _one:
        if key not in _tables:
            _tables[key] = here.keep(values)
        _tables.move_to_end(key)
        while len(_tables) > KEPT:
            _tables.popitem(last=False)
        return _tables[key]


def address(array: Any) -> int:
    """Where a device's array begins. Raises ValueError unless it is C-contiguous: kernels take no strides."""
    if not array.flags.c_contiguous:
        raise ValueError(f"an array of shape {array.shape} goes to a kernel by its address and is not contiguous")
    return int(array.ctypes.data if isinstance(array, np.ndarray) else array.data.ptr)


def addresses(arrays: Sequence[Sequence[Any]]) -> Any:
    """uint64 [rows, columns] on the device: where the arrays begin, for kernels that work on many views at once.

    Memory that is freed and taken again has the same addresses from frame to frame, so this too is mostly there. The
    arrays must outlive the launch (on one stream they do: memory is reused behind it).
    """
    return constant(np.array([[address(array) for array in row] for row in arrays], np.uint64))


def views_table(views: Sequence[ArrayGeometry]) -> tuple[Any, Any]:
    """The array as seen from each of V cameras: offsets float32 [V, K, 5] and centers float32 [V, 2] on the device."""
    return _views_table(device.current(), tuple(views))


@lru_cache(maxsize=64)
def _views_table(here: device.Device, views: tuple[ArrayGeometry, ...]) -> tuple[Any, Any]:
    offsets = np.stack([view.offsets for view in views])
    return here.keep(offsets), here.keep(np.array([view.center for view in views], np.float32))
