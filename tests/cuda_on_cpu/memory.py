"""Memory that ends where nobody may read: a kernel that leaves its array falls over."""

from __future__ import annotations

import ctypes
import mmap
from typing import Any

import numpy as np

RUBBISH = 0xA5  # what new memory holds
ALIGNED = 16  # bytes: the widest loads
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]


def guarded(shape: Any, dtype: Any) -> np.ndarray:
    """An array of rubbish between two pages that cannot be read; the one behind it begins within ALIGNED bytes."""
    shape, dtype, page = np.broadcast_shapes(shape), np.dtype(dtype), mmap.PAGESIZE
    needed = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    room = -(-max(needed, 1) // ALIGNED) * ALIGNED
    pages = -(-room // page) * page
    memory = mmap.mmap(-1, pages + 2 * page)
    whole = np.frombuffer(memory, np.uint8)  # it keeps the memory
    for guard in (0, page + pages):
        if _libc.mprotect(whole.ctypes.data + guard, page, 0):
            raise OSError(ctypes.get_errno(), "mprotect")
    begin = page + pages - room
    whole[begin : begin + room] = RUBBISH
    return whole[begin : begin + needed].view(dtype).reshape(shape)


def guarded_copy(array: np.ndarray) -> np.ndarray:
    out = guarded(array.shape, array.dtype)
    out[...] = array
    return out
