"""What the pipeline asks of the backend `cuda` around the stages: lanes, in which upload, work and download of
successive frames overlap; arrays in and out; faults."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from ..gpu import device

QUEUES = True  # stages return before their work is done


def received(image: Any) -> Any:
    """An image or mask of the user's: NumPy's array, or the device's where the object's memory is on a GPU already."""
    if hasattr(image, "__cuda_array_interface__"):
        return device.current().adopt(image)
    if not isinstance(image, np.ndarray) and hasattr(image, "__dlpack_device__"):
        kind, _ = image.__dlpack_device__()
        return device.current().adopt(image) if kind != DLPACK_CPU else np.from_dlpack(image)
    return np.asarray(image)


DLPACK_CPU = 1  # kDLCPU of dlpack.h


def lane(name: str) -> AbstractContextManager[None]:
    return device.current().lane(name)


def mark() -> Any:
    return device.current().mark()


def after(mark: Any) -> None:
    device.current().after(mark)


def fetched(found: dict[str, Any], keep: bool = False) -> Callable[[], dict[str, Any]]:
    """As of host.py. What was found stays alive until it is there: its memory must not be used again before."""
    used = device.current()
    done = used.mark()
    if keep:  # the frame's own memory, of another lane, must not be used again before either

        def ready() -> dict[str, Any]:
            used.wait(done)
            return {name: _each(lambda part: _upload(used, part), value) for name, value in found.items()}

        return ready
    with used.lane("download"):
        used.after(done)
        there = {name: _each(lambda part: _fetch(used, part), value) for name, value in found.items()}
        arrived = used.mark()

    def waited() -> dict[str, Any]:
        used.wait(arrived)
        found.clear()
        return there

    return waited


def _upload(used: device.Device, part: Any) -> Any:
    return used.upload(part) if isinstance(part, np.ndarray) else part


def _fetch(used: device.Device, part: Any) -> np.ndarray:
    return part if isinstance(part, np.ndarray) else used.fetch(part)


def _each(function: Callable[[Any], Any], value: Any) -> Any:
    return tuple(function(part) for part in value) if isinstance(value, tuple) else function(value)


def faults() -> AbstractContextManager[None]:
    return device.current().faults()
