"""The kernels of seepast.gpu compiled for the CPU (emulation.h), behind the interface of seepast.gpu.device."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import seepast.gpu

from . import strict
from .memory import guarded_copy

HERE = Path(__file__).parent
KERNELS = Path(seepast.gpu.__file__).parent / "kernels"
HEADERS = (KERNELS, HERE.parents[1] / "cpp", HERE)
KERNEL = re.compile(r'extern\s+"C"\s+__global__\s+void\s+(?:__launch_bounds__\s*\([^)]*\)\s*)?(\w+)\s*\(')
COMPILE = [
    *("g++", "-std=c++17", "-O2", "-g1", "-fPIC", "-shared", "-w"),
    *("-ffp-contract=off", "-fno-strict-aliasing", "-fno-ipa-reference"),
]


class EmulatedDevice:
    """Runs kernels on the CPU, one launch at a time, with NumPy arrays; refuses what a GPU would take and misread."""

    xp = np
    name = "CUDA on the CPU"
    backwards = False  # threads of a block run in this order: what a missing barrier spoils shows in one of them

    def __init__(self) -> None:
        self._one = threading.Lock()
        self.launches: list[str] = []

    def launch(
        self,
        file: str,
        kernel: str,
        *,
        grid: Sequence[int],
        block: Sequence[int],
        args: Sequence[Any],
        shared: int = 0,
    ) -> None:
        library = compiled(str(KERNELS / f"{file}.cu"))
        what = f"{file}.{kernel}"
        call, types = _functions(library, kernel)
        values = [_value(what, i, arg, kind) for i, (arg, kind) in enumerate(_paired(what, args, types))]
        pointers = (ctypes.c_void_p * len(values))(*(v.ctypes.data for v in values))
        sizes = [(ctypes.c_uint * 3)(*_three(what, n)) for n in (grid, block)]
        if np.prod(_three(what, block)) > 1024 or shared > 227 << 10:
            raise AssertionError(f"{what}: block {tuple(block)}, {shared} bytes shared: more than a GPU has")
        with self._one:
            self.launches.append(what)
            fault = call(*sizes, shared, self.backwards, pointers)
        if fault:
            raise AssertionError(f"{what}: {fault.decode()}")

    def upload(self, array: Any) -> Any:
        return np.array(array, order="C")

    def download(self, array: Any) -> Any:
        return array

    def keep(self, array: Any) -> Any:
        return self.upload(array)

    def fetch(self, array: Any) -> Any:
        return self.download(array).copy()

    def synchronize(self) -> None:
        pass

    @contextmanager
    def lane(self, name: str) -> Iterator[None]:
        yield

    def mark(self) -> None:
        pass

    def after(self, mark: None) -> None:
        pass

    def wait(self, mark: None) -> None:
        pass

    def adopt(self, array: Any) -> Any:
        return array.host

    @contextmanager
    def faults(self) -> Iterator[None]:
        yield


class StrictDevice(EmulatedDevice):
    """The same with arrays as choosy as CuPy's (strict.py), in memory that nobody leaves unseen; threads run in the
    opposite order."""

    xp, backwards = strict.xp, True

    def launch(self, file: str, kernel: str, *, args: Sequence[Any], **how: Any) -> None:
        for i, arg in enumerate(args):
            if isinstance(arg, np.ndarray):
                raise AssertionError(f"{file}.{kernel}: argument {i} is NumPy's: upload it first")
        hosts = [arg.host if isinstance(arg, strict.Array) else arg for arg in args]
        super().launch(file, kernel, args=hosts, **how)

    def upload(self, array: Any) -> Any:
        return strict.Array(guarded_copy(array))

    def download(self, array: Any) -> Any:
        return array.host.copy()

    def adopt(self, array: Any) -> Any:
        return strict.Array(array.host)


def _three(what: str, size: Sequence[int]) -> tuple[int, int, int]:
    x, y, z = (*size, 1, 1)[:3]
    if min(x, y, z) < 1 or y > 65535 or z > 65535:
        raise AssertionError(f"{what}: a grid or block of {tuple(size)}: CUDA takes 1..65535 (x: 2^31 - 1)")
    return int(x), int(y), int(z)


def _paired(what: str, args: Sequence[Any], types: list[str]) -> list[tuple[Any, str]]:
    if len(args) != len(types):
        raise AssertionError(f"{what}: {len(args)} arguments, the kernel takes {len(types)}: {' '.join(types)}")
    return list(zip(args, types, strict=True))


def _value(what: str, i: int, arg: Any, kind: str) -> np.ndarray:
    """The bytes of one argument, as the kernel takes it."""
    if isinstance(arg, np.ndarray) and arg.ndim + arg.size > 0 and kind.startswith("*"):
        have = f"*{arg.dtype.kind}{arg.dtype.itemsize}"
        same = have == kind or kind.startswith("*V") or {have, kind} == {"*b1", "*u1"}
        if not same or not arg.flags.c_contiguous:
            raise AssertionError(
                f"{what}: argument {i} is {arg.dtype}, contiguous={arg.flags.c_contiguous}; want {kind}"
            )
        return np.array(arg.ctypes.data, np.uint64)
    if isinstance(arg, np.generic) and f"{arg.dtype.kind}{arg.dtype.itemsize}" == kind:
        return np.array(arg)
    raise AssertionError(f"{what}: argument {i} is {type(arg).__name__} {getattr(arg, 'dtype', '')}; want {kind}")


def _functions(library: ctypes.CDLL, kernel: str) -> tuple[Any, list[str]]:
    call, types = getattr(library, f"seepast_launch_{kernel}"), getattr(library, f"seepast_types_{kernel}")
    call.restype = types.restype = ctypes.c_char_p
    return call, types().decode().split()


@cache
def compiled(source: str) -> ctypes.CDLL:
    """The kernels of a .cu file as a library of this machine, kept between runs by the hash of all that is compiled."""
    path = Path(source)
    code = path.read_text()
    shims = "\n".join(f"SEEPAST_EMULATED({name})" for name in KERNEL.findall(code))
    unit = f'#include "emulation.h"\n#include "{path}"\n{shims}\n'
    headers = sorted(p for folder in HEADERS for p in folder.glob("*.h"))
    key = hashlib.sha256(b"".join([unit.encode(), code.encode(), *map(Path.read_bytes, headers)])).hexdigest()[:16]
    kept = Path(tempfile.gettempdir()) / f"seepast-emulated-{os.getuid()}"
    kept.mkdir(mode=0o700, exist_ok=True)
    library = kept / f"{path.stem}-{key}.so"
    if not library.exists():
        made = library.with_suffix(f".{os.getpid()}")
        include = [f"-I{folder}" for folder in HEADERS]
        subprocess.run([*COMPILE, *include, "-x", "c++", "-", "-o", made], input=unit, text=True, check=True)
        made.replace(library)
    return ctypes.CDLL(str(library))
