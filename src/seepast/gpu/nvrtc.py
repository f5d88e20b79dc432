"""NVIDIA's run-time compiler: .cu text to the machine code of one GPU. It needs no GPU and no driver.

The library comes with the extras cuda12 and cuda13 (the packages nvidia-cuda-nvrtc-cu12 and nvidia-cuda-nvrtc), or with
an installed CUDA toolkit. Functions and options: the NVRTC manual, docs.nvidia.com/cuda/nvrtc.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import os
from collections.abc import Mapping, Sequence
from ctypes import byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from pathlib import Path

from ..errors import BackendError

IN_WHEELS = {12: "cuda_nvrtc/lib/libnvrtc.so.12", 13: "cu13/lib/libnvrtc.so.13"}  # below site-packages/nvidia
IN_TOOLKIT = ("lib64", "lib", "targets/x86_64-linux/lib", "targets/aarch64-linux/lib", "targets/sbsa-linux/lib")


class Compiler:
    """The libnvrtc of one version of CUDA."""

    def __init__(self, library: ctypes.CDLL):
        self._library = library
        library.nvrtcGetErrorString.restype = c_char_p
        major, minor = c_int(), c_int()
        self._call("nvrtcVersion", byref(major), byref(minor))
        self.version = major.value, minor.value

    def compile(self, source: str, name: str, headers: Mapping[str, str], options: Sequence[str]) -> tuple[bytes, str]:
        """The cubin of a .cu text, and what the compiler said about it. Raises BackendError with its message.

        headers  text by the name that `#include` gives; options as on the compiler's command line
        """
        program, count = c_void_p(), len(headers)
        texts = (c_char_p * count)(*(text.encode() for text in headers.values()))
        names = (c_char_p * count)(*(header.encode() for header in headers))
        self._call("nvrtcCreateProgram", byref(program), source.encode(), name.encode(), count, texts, names)
        try:
            said = (c_char_p * len(options))(*(option.encode() for option in options))
            status = self._library.nvrtcCompileProgram(program, len(options), said)
            log = self._text(program, "ProgramLog").rstrip(b"\0").decode(errors="replace").strip()
            if status:
                raise BackendError(f"{name}: CUDA {self.version[0]}.{self.version[1]} does not compile it: {log}")
            return self._text(program, "CUBIN"), log
        finally:
            self._call("nvrtcDestroyProgram", byref(program))

    def _text(self, program: c_void_p, what: str) -> bytes:
        size = c_size_t()
        self._call(f"nvrtcGet{what}Size", program, byref(size))
        text = ctypes.create_string_buffer(size.value)
        self._call(f"nvrtcGet{what}", program, text)
        return text.raw

    def _call(self, function: str, *arguments: object) -> None:
        status = getattr(self._library, function)(*arguments)
        if status:
            raise BackendError(f"{function}: {self._library.nvrtcGetErrorString(status).decode()}")


@cache
def compiler(major: int) -> Compiler:
    """The compiler of CUDA `major`. Raises BackendError where there is none."""
    for place in (*_places(major), f"libnvrtc.so.{major}"):
        try:
            return Compiler(ctypes.CDLL(place))
        except OSError:
            continue
    raise BackendError(
        f"backend 'cuda' finds no compiler libnvrtc.so.{major}: pip install 'seepast[cuda{major}]', or set CUDA_HOME "
        "to an installed toolkit"
    )


def _places(major: int) -> list[str]:
    """Where the library lies: in wheels, in toolkits."""
    found = importlib.util.find_spec("nvidia")
    wheels = [Path(folder) for folder in found.submodule_search_locations or ()] if found else []
    toolkits = [Path(os.environ[name]) for name in ("CUDA_HOME", "CUDA_PATH") if name in os.environ]
    toolkits.append(Path("/usr/local/cuda"))
    places = [folder / IN_WHEELS[major] for folder in wheels if major in IN_WHEELS]
    places += [toolkit / folder / f"libnvrtc.so.{major}" for toolkit in toolkits for folder in IN_TOOLKIT]
    return [str(place) for place in places if place.exists()]
