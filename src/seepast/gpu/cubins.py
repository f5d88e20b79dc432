"""Kernels as machine code of one GPU: compiled once per source, compiler and GPU, and kept on disk."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from threading import Lock

from ..threads import on_threads
from . import nvrtc

log = logging.getLogger("seepast")

KERNELS = Path(__file__).parent / "kernels"
SHARED = ("cubic.h", "people_pixel.h", "pixel.h", "planes.h")  # with the C++ core; installed beside the kernels
CHECKOUT = Path(__file__).parents[3] / "cpp"  # where a checkout has them
# no contraction: the same bits as the CPU; what is annotated with nothing is for the device, constants of headers too
OPTIONS = ("--std=c++17", "--fmad=false", "--device-as-default-execution-space")
STANDARD = {  # what the shared headers include of the host's library
    "cstdint": "#pragma once\n"
    "typedef signed char int8_t; typedef short int16_t; typedef int int32_t; typedef long long int64_t;\n"
    "typedef unsigned char uint8_t; typedef unsigned short uint16_t; typedef unsigned int uint32_t;\n"
    "typedef unsigned long long uint64_t;\n"
    "typedef decltype(sizeof(0)) size_t;\n",
}
_said, _one = False, Lock()


def files() -> list[str]:
    """All kernel files, without folder and ending."""
    return sorted(path.stem for path in KERNELS.glob("*.cu"))


@cache
def headers() -> dict[str, str]:
    """Text of every header that a kernel may include, by name."""
    shared = [CHECKOUT / name if (CHECKOUT / name).exists() else KERNELS / name for name in SHARED]
    paths = [*shared, *(path for path in KERNELS.glob("*.h") if path.name not in SHARED)]
    return {**{path.name: path.read_text(encoding="utf-8") for path in paths}, **STANDARD}


def compiled(file: str, architecture: int, major: int, *options: str) -> tuple[bytes, str]:
    """The cubin of kernels/<file>.cu for compute capability `architecture` (90 = 9.0) by the compiler of CUDA `major`,
    and what that said. Raises BackendError."""
    source = (KERNELS / f"{file}.cu").read_text(encoding="utf-8")
    said = (*OPTIONS, f"--gpu-architecture=sm_{architecture}", *options)
    return nvrtc.compiler(major).compile(source, f"{file}.cu", headers(), said)


def cubin(file: str, architecture: int, major: int) -> bytes:
    """As `compiled`, from the disk if it is there, which it is afterwards if the disk lets itself be written to."""
    place = _place(file, architecture, major)
    try:
        return place.read_bytes()
    except OSError:
        pass
    _say_so(architecture)
    code, _ = compiled(file, architecture, major)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_suffix(f".{os.getpid()}.part")
        part.write_bytes(code)
        part.replace(place)
    except OSError as error:
        log.debug("compiled kernels are not kept: %s", error)
    return code


def prepare(architecture: int, major: int) -> None:
    """Compile what is not kept yet, on all cores."""
    missing = [file for file in files() if not _place(file, architecture, major).exists()]
    on_threads(lambda i: cubin(missing[i], architecture, major), len(missing))


def _place(file: str, architecture: int, major: int) -> Path:
    return folder() / f"{file}-{architecture}-{_key(file, architecture, major)}.cubin"


def folder() -> Path:
    """Where compiled kernels are kept: ~/.cache/seepast/cubins, or below XDG_CACHE_HOME."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "seepast" / "cubins"


def _key(file: str, architecture: int, major: int) -> str:
    """Of everything that the machine code depends on."""
    return hashlib.sha256("\0".join(_ingredients(file, architecture, major)).encode()).hexdigest()[:20]


def _ingredients(file: str, architecture: int, major: int) -> Iterator[str]:
    yield from (str(architecture), str(nvrtc.compiler(major).version), *OPTIONS)
    yield (KERNELS / f"{file}.cu").read_text(encoding="utf-8")
    for name, text in sorted(headers().items()):
        yield from (name, text)


def _say_so(architecture: int) -> None:
    global _said
    with _one:
        if not _said:
            log.info(
                "compiling for a GPU of compute capability %d.%d: seconds, and only this once",
                *divmod(architecture, 10),
            )
        _said = True
