"""Backends: one method, several implementations with the same function names, arrays in and arrays out."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import BackendError, MissingExtraError
from ..gpu import device

log = logging.getLogger("seepast")

BACKENDS = ("cpu", "cuda", "reference")
SPINS = 3000  # turns, about a tenth of a millisecond, that an idle thread waits for the next loop before it sleeps


def get(name: str) -> ModuleType:
    """The backend module `name`; "auto" is the fastest one that works here. Raises BackendError, MissingExtraError."""
    if name == "auto":
        name = _fastest()
    if name not in BACKENDS:
        raise BackendError(f"backend {name!r} is unknown: choose auto or one of {', '.join(BACKENDS)}")
    if name == "cuda":
        device.current()
    try:
        with _idle_threads_soon_sleep():
            return importlib.import_module(f".{name}", __name__)
    except ImportError as error:
        raise BackendError(
            f"backend {name!r} cannot be loaded ({error}): reinstall seepast with a C++ compiler, or use "
            "--backend reference"
        ) from error


@cache
def _fastest() -> str:
    """ "cuda" where CuPy is installed and finds a GPU that works, else "cpu"; says so once where CuPy finds none."""
    if importlib.util.find_spec("cupy") is None:
        return "cpu"
    try:
        device.current()
    except (BackendError, MissingExtraError) as error:
        log.warning("%s; going on with --backend cpu", error)
        return "cpu"
    return "cuda"


def on_host(array: Any) -> np.ndarray:
    """The same in NumPy's memory: of any array, a device's too."""
    return array if isinstance(array, np.ndarray) else device.current().download(array)


@cache
def core() -> ModuleType | None:
    """The C++ core, for what is no stage of a backend; None where it was not built."""
    try:
        with _idle_threads_soon_sleep():
            return importlib.import_module("seepast._core")
    except ImportError:
        return None


@contextmanager
def _idle_threads_soon_sleep() -> Iterator[None]:
    """Idle threads of the loops soon sleep, where the user has not said otherwise.

    GNU's OpenMP lets them spin for milliseconds, which takes a core from whoever reads the next frame meanwhile (a
    fifth of all processor time of preset "paper"). But one that sleeps is late for the next loop: if it is not far,
    waiting for it takes less. GNU's looks at the environment once, when it is loaded.
    """
    said = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys()
    if not said:
        os.environ["GOMP_SPINCOUNT"] = str(SPINS)
    try:
        yield
    finally:
        if not said:
            del os.environ["GOMP_SPINCOUNT"]


def multiview(backend: ModuleType) -> ModuleType:
    """The many-view stages of the same backend."""
    return importlib.import_module(f"{backend.__name__}_multiview")


def people(many_view: ModuleType) -> ModuleType:
    """The stages of the masks' refinement of the same backend, given its many-view stages."""
    return importlib.import_module(many_view.__name__.replace("_multiview", "_people"))


def set_threads(backend: ModuleType, threads: int) -> None:
    """Threads for the frames to come, where the backend has any; 0 = all cores. Never changes a result."""
    if hasattr(backend, "set_threads"):
        backend.set_threads(threads)
