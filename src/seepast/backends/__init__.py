"""Backends: one method, several implementations with the same function names, arrays in and arrays out."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import ModuleType

from ..errors import BackendError

BACKENDS = ("cpu", "reference")


def get(name: str) -> ModuleType:
    """The backend module `name`; "auto" is the fastest one that works here. Raises BackendError."""
    if name == "auto":
        name = BACKENDS[0]
    if name not in BACKENDS:
        raise BackendError(f"backend {name!r} is unknown: choose auto or one of {', '.join(BACKENDS)}")
    try:
        with _idle_threads_sleep():
            return importlib.import_module(f".{name}", __name__)
    except ImportError as error:
        raise BackendError(
            f"backend {name!r} cannot be loaded ({error}): reinstall seepast with a C++ compiler, or use "
            "--backend reference"
        ) from error


@lru_cache(maxsize=1)
def core() -> ModuleType | None:
    """The C++ core, for what is no stage of a backend; None where it was not built."""
    try:
        with _idle_threads_sleep():
            return importlib.import_module("seepast._core")
    except ImportError:
        return None


@contextmanager
def _idle_threads_sleep() -> Iterator[None]:
    """Idle threads of the loops sleep, where the user has not said otherwise.

    GNU's OpenMP lets them spin for milliseconds, which takes a core from whoever reads the next frame meanwhile (a
    fifth of all processor time of preset "paper"). It looks at the environment once, when it is loaded.
    """
    said = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys()
    if not said:
        os.environ["OMP_WAIT_POLICY"] = "passive"
    try:
        yield
    finally:
        if not said:
            del os.environ["OMP_WAIT_POLICY"]


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
