"""A loop over the cameras on several threads. NumPy and OpenCV let go of Python's lock while they work."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def on_threads(function: Callable[[int], T], count: int, threads: int = 0) -> list[T]:
    """[function(0), ..., function(count - 1)], worked off by `threads` threads; 0: one per core.

    The calling thread is one of them, and the others end with the call: what forks finds none. An exception of
    `function` is raised here, the lowest number's if there are several.
    """
    helpers = min(threads or cores(), count) - 1
    found: list[Any] = [None] * count
    failed: list[BaseException | None] = [None] * count
    todo, lock = iter(range(count)), threading.Lock()

    def work() -> None:
        while True:
            with lock:
                number = next(todo, count)
            if number == count:
                return
            try:
                found[number] = function(number)
            except BaseException as error:
                failed[number] = error

    started = [threading.Thread(target=work, daemon=True) for _ in range(helpers)]
    for thread in started:
        thread.start()
    work()
    for thread in started:
        thread.join()
    for error in failed:
        if error is not None:
            raise error
    return found


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
