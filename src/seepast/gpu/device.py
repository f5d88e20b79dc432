"""The device that the backend `cuda` works on: where arrays live and kernels run.

`current()` is the machine's GPU, through CuPy. Tests put another one there (`use`), which runs the same kernels on the
CPU with NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, Protocol

Size = tuple[int, ...]


class Device(Protocol):
    """Where arrays live (`xp`, a module with NumPy's functions) and kernels run."""

    xp: ModuleType

    def launch(self, file: str, kernel: str, *, grid: Size, block: Size, args: Sequence[Any], shared: int = 0) -> None:
        """One launch of a kernel of kernels/<file>.cu behind what was launched before; returns at once.

        grid, block  up to three numbers each
        args         C-contiguous arrays of xp, and NumPy scalars of exactly the parameters' types
        shared       bytes of shared memory for SEEPAST_SHARED
        """

    def upload(self, array: Any) -> Any:
        """The array of xp with the contents of a NumPy array."""

    def download(self, array: Any) -> Any:
        """The NumPy array with the contents of an array of xp, once all that was launched before has run."""

    def synchronize(self) -> None:
        """Wait for everything that was launched."""


_used: Device | None = None


def current() -> Device:
    """The device in use: the machine's GPU unless `use` says otherwise. Raises BackendError where there is none."""
    if _used is None:
        raise RuntimeError("no device")
    return _used


@contextmanager
def use(device: Device) -> Iterator[Device]:
    """Within: `current()` is `device`."""
    global _used
    before, _used = _used, device
    try:
        yield device
    finally:
        _used = before
