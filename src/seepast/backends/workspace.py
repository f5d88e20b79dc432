"""Memory of the cpu backend's big arrays, used again frame after frame once nobody holds them any more.

Fresh pages cost more than most of the work in them, and a heap that shrinks between frames, as other software's big
arrays make it, returns all of them.
"""

from __future__ import annotations

import math
import sys
import threading
from bisect import bisect_left, insort
from collections.abc import Sequence
from itertools import islice

import numpy as np
from numpy.typing import DTypeLike

LEAST = 1 << 16  # bytes: less is taken from the heap
LARGER = 3  # times as much memory as is asked for will do, where nothing smaller is free
FORGOTTEN = 256  # arrays later, memory that was not used again is returned


class _Memory:
    """Bytes, and whether an array lies in them that somebody holds: all its views hold `bytes` as their base."""

    def __init__(self, size: int) -> None:
        self.bytes = np.empty(size, np.uint8)
        self.last_use = 0
        self._alone = self._holders()  # what this Python counts where nobody else holds them

    def _holders(self) -> int:
        return sys.getrefcount(self.bytes)

    @property
    def free(self) -> bool:
        return self._holders() == self._alone

    def size(self) -> int:
        return self.bytes.size


class Workspace(threading.local):
    """Every thread has memory of its own. An array, or any view of it, keeps its memory for as long as somebody holds
    it, on whatever thread: what reaches a user is never written over."""

    def __init__(self) -> None:
        self._pool: list[_Memory] = []  # the smallest first
        self._taken = 0

    def empty(self, shape: Sequence[int], dtype: DTypeLike) -> np.ndarray:
        """np.empty(shape, dtype), where possible in memory of an array before that nobody holds any more."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size < LEAST:
            return np.empty(shape, dtype)
        return np.ndarray(shape, dtype, buffer=self._memory(size))

    def zeros(self, shape: Sequence[int], dtype: DTypeLike) -> np.ndarray:
        """np.zeros(shape, dtype), likewise."""
        out = self.empty(shape, dtype)
        out.fill(0)
        return out

    def _memory(self, size: int) -> np.ndarray:
        self._taken += 1
        best = self._smallest_free(size)
        if best is None:
            self._pool = [m for m in self._pool if not self._superseded(m, size)]
            best = _Memory(rounded(size))
            insort(self._pool, best, key=_Memory.size)
        best.last_use = self._taken
        return best.bytes

    def _smallest_free(self, size: int) -> _Memory | None:
        for memory in islice(self._pool, bisect_left(self._pool, size, key=_Memory.size), None):
            if memory.bytes.size > LARGER * size:
                break
            if memory.free:
                return memory
        return None

    def _superseded(self, memory: _Memory, size: int) -> bool:
        """Memory of `size` will do instead, or nobody has asked for as much for long; what a user keeps is theirs."""
        alike = memory.free and size < LARGER * memory.bytes.size < LARGER * size
        return alike or self._taken - memory.last_use > FORGOTTEN


def rounded(size: int) -> int:
    """Somewhat more bytes, so that frames that need a little more than those before find room."""
    step = 1 << (size.bit_length() - 4)
    return -(-size // step) * step
