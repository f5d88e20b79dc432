"""Records the calls of the C++ core, so that tests/cpp/replay.cpp can repeat them on another processor."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from seepast import _core

NOT_RECORDED = {"set_threads", "simd"}


def record(path: Path, work: Callable[[], object], patch: pytest.MonkeyPatch) -> dict[str, int]:
    """Does the work, and writes to `path` each call of the core, what it was given and what came of it.

    Returns how often every function was called.
    """
    with path.open("wb") as file, patch.context() as patched:
        recorder = Recorder(file)
        for name in dir(_core):
            function = getattr(_core, name)
            if name.startswith("_") or name in NOT_RECORDED or not callable(function):
                continue
            wrapped = recorder.making if isinstance(function, type) else recorder.calling
            patched.setattr(_core, name, wrapped(name, function))
        work()
        return recorder.calls


class Recorder:
    """A call: name, arguments, result, and of the arrays that changed their number and their bytes afterwards."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.lock = file, threading.Lock()
        self.calls: dict[str, int] = {}
        self.made: dict[int, tuple[Any, tuple]] = {}  # id of an object -> itself, its constructor's arguments

    def making(self, _: str, kind: type) -> Callable:
        def make(*arguments: Any) -> Any:
            made = kind(*arguments)
            with self.lock:
                self.made[id(made)] = made, arguments
            return made

        return make

    def calling(self, name: str, function: Callable) -> Callable:
        def call(*arguments: Any) -> Any:
            before = [packed(name) + self.values(arguments)]
            bytes_before = [a.tobytes() if isinstance(a, np.ndarray) else None for a in arguments]
            result = function(*arguments)
            changed = b""
            count = 0
            for i, (a, was) in enumerate(zip(arguments, bytes_before, strict=True)):
                if was is not None and a.tobytes() != was:
                    changed += struct.pack("<Bq", i, a.nbytes) + a.tobytes()
                    count += 1
            with self.lock:
                self.calls[name] = self.calls.get(name, 0) + 1
                self.file.write(b"".join([*before, self.value(result), struct.pack("<B", count), changed]))
            return result

        return call

    def values(self, values: tuple) -> bytes:
        return struct.pack("<B", len(values)) + b"".join(map(self.value, values))

    def value(self, value: Any) -> bytes:
        if value is None:
            return b"n"
        if isinstance(value, np.ndarray):
            shape = struct.pack(f"<B{value.ndim}q", value.ndim, *value.shape)
            return b"a" + packed(value.dtype.str[1:]) + shape + struct.pack("<q", value.nbytes) + value.tobytes()
        if isinstance(value, (bool, int, np.bool_, np.integer)):
            return b"i" + struct.pack("<q", int(value))
        if isinstance(value, (float, np.floating)):
            return b"f" + struct.pack("<d", float(value))
        return b"o" + self.values(self.made[id(value)][1])


def packed(word: str) -> bytes:
    return struct.pack("<B", len(word)) + word.encode()
