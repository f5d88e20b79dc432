"""The device that the backend `cuda` works on: where arrays live and kernels run.

`current()` is the machine's GPU, through CuPy. Tests put another one there (`use`), which runs the same kernels on the
CPU with NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from threading import Lock
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from ..errors import BackendError, MissingExtraError

Size = tuple[int, ...]


class Device(Protocol):
    """Where arrays live (`xp`, a module with NumPy's functions) and kernels run."""

    xp: ModuleType

    @property
    def name(self) -> str:
        """What it is, for people."""

    def __hash__(self) -> int:
        """Tables are kept by device."""

    def launch(self, file: str, kernel: str, *, grid: Size, block: Size, args: Sequence[Any], shared: int = 0) -> None:
        """One launch of a kernel of kernels/<file>.cu behind what was launched before; returns at once.

        grid, block  up to three numbers each
        args         C-contiguous arrays of xp, and NumPy scalars of exactly the parameters' types
        shared       bytes of shared memory for SEEPAST_SHARED
        """

    def upload(self, array: np.ndarray) -> Any:
        """The array of xp with the contents of a NumPy array."""

    def keep(self, array: np.ndarray) -> Any:
        """The same for what all lanes read: it is there when this returns."""

    def download(self, array: Any) -> np.ndarray:
        """The NumPy array with the contents of an array of xp, once all that was queued before has run."""

    def fetch(self, array: Any) -> np.ndarray:
        """The same without waiting: it is filled when a later `mark` of this lane has passed."""

    def synchronize(self) -> None:
        """Wait for everything that was queued."""

    def lane(self, name: str) -> AbstractContextManager[None]:
        """Within: what this thread queues runs in the order of the lane `name`, beside other lanes."""

    def mark(self) -> Any:
        """A mark behind what was queued so far in the current lane."""

    def after(self, mark: Any) -> None:
        """What is queued from now on in the current lane waits until `mark` has passed."""

    def wait(self, mark: Any) -> None:
        """Wait until `mark` has passed."""

    def adopt(self, array: Any) -> Any:
        """The same memory as an array of xp, of any object with __cuda_array_interface__ or DLPack on this device."""

    def faults(self) -> AbstractContextManager[None]:
        """Within: faults of the device are raised as DeviceError."""


_used: Device | None = None
_found: Device | Exception | None = None
_one = Lock()


def current() -> Device:
    """The device in use: the machine's GPU unless `use` says otherwise. Raises BackendError or MissingExtraError."""
    global _found
    if _used is not None:
        return _used
    with _one:
        if _found is None:
            from .cuda_device import CudaDevice

            try:
                _found = CudaDevice()
            except (BackendError, MissingExtraError) as error:
                _found = error
    if isinstance(_found, Exception):
        raise _found
    return _found


@contextmanager
def use(device: Device) -> Iterator[Device]:
    """Within: `current()` is `device`."""
    global _used
    before, _used = _used, device
    try:
        yield device
    finally:
        _used = before
