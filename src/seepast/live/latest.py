"""A short queue in which the newer displaces the older: who is slow sees the present, not an ever older past."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """At most `room` items between threads; `displaced` counts those that made room for newer ones."""

    def __init__(self, room: int = 1):
        self._items: deque[T] = deque(maxlen=room)
        self._changed = threading.Condition()
        self.displaced = 0

    def put(self, item: T) -> None:
        with self._changed:
            self.displaced += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify()

    def get(self, timeout: float) -> T | None:
        """The oldest item, or None if none comes within that many seconds."""
        with self._changed:
            if not self._items:
                self._changed.wait(timeout)
            return self._items.popleft() if self._items else None
