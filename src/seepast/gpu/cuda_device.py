"""The machine's GPU, through CuPy: `Device` of device.py."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from ..errors import BackendError, DeviceError
from ..extras import require
from . import cubins
from .device import Size

EXTRAS = {12: "cuda12", 13: "cuda13"}
OLDEST = {12: "525.60", 13: "580.65"}  # Linux drivers that run CUDA 12 and 13 (the toolkits' release notes, table 2)
MORE_SHARED = 48 << 10  # bytes of shared memory beyond which a kernel must be told
MOST_DYNAMIC_SHARED = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES


class CudaDevice:
    """GPU number `index`. Raises MissingExtraError without CuPy, BackendError where it finds no GPU that works."""

    def __init__(self, index: int = 0) -> None:
        self.xp: Any = require("cupy", "cuda12", "backend 'cuda'")
        self._runtime = self.xp.cuda.runtime
        self.major = self._runtime.runtimeGetVersion() // 1000
        self._check_driver(index)
        self._gpu = self.xp.cuda.Device(index)
        self.architecture = int(self._gpu.compute_capability)
        self._lanes: dict[str, Any] = {}
        self._one = threading.Lock()
        self._function, self._module = cache(self._load), cache(self._load_module)
        self._prepared = cache(lambda: cubins.prepare(self.architecture, self.major))

    def _check_driver(self, index: int) -> None:
        driver, wanted = self._runtime.driverGetVersion(), OLDEST.get(self.major, "a newer version")
        if driver == 0:
            raise BackendError("backend 'cuda' finds no NVIDIA driver: install it, or use --backend cpu")
        if driver < 1000 * self.major:
            raise BackendError(
                f"backend 'cuda': the driver knows CUDA {driver // 1000}.{driver % 1000 // 10}, CuPy is of CUDA "
                f"{self.major}: update the driver to {wanted} or later, or pip install 'seepast[cuda{driver // 1000}]'"
            )
        try:
            count = self._runtime.getDeviceCount()
        except self._runtime.CUDARuntimeError as error:
            raise BackendError(f"backend 'cuda' cannot use the GPU ({error}): use --backend cpu") from error
        if index >= count:
            raise BackendError(f"backend 'cuda' finds {count} GPUs: connect one, or use --backend cpu")

    @property
    def name(self) -> str:
        name = self._runtime.getDeviceProperties(self._gpu.id)["name"].decode()
        return f"{name}, compute capability {self.architecture / 10}, CUDA {self.major}"

    def launch(self, file: str, kernel: str, *, grid: Size, block: Size, args: Sequence[Any], shared: int = 0) -> None:
        self._function(file, kernel, shared if shared > MORE_SHARED else 0)(
            (*grid, 1, 1)[:3], (*block, 1, 1)[:3], tuple(args), shared
        )

    def _load(self, file: str, kernel: str, shared: int) -> Any:
        function = self._module(file).get_function(kernel)
        if shared:
            from cupy_backends.cuda.api import driver

            driver.funcSetAttribute(function.ptr, MOST_DYNAMIC_SHARED, shared)
        return function

    def _load_module(self, file: str) -> Any:
        self._prepared()
        module = self.xp.cuda.Module()
        module.load(cubins.cubin(file, self.architecture, self.major))
        return module

    def upload(self, array: np.ndarray) -> Any:
        return self.xp.asarray(np.ascontiguousarray(array))

    def keep(self, array: np.ndarray) -> Any:
        with self.lane("tables"):
            kept = self.upload(array)
            self.xp.cuda.get_current_stream().synchronize()
        return kept

    def download(self, array: Any) -> np.ndarray:
        return array.get()

    def fetch(self, array: Any) -> np.ndarray:
        import cupyx

        out = cupyx.empty_pinned(array.shape, array.dtype)
        return self.xp.ascontiguousarray(array).get(out=out, blocking=False)

    def synchronize(self) -> None:
        self._gpu.synchronize()

    @contextmanager
    def lane(self, name: str) -> Iterator[None]:
        with self._one:
            stream = self._lanes.setdefault(name, None) or self.xp.cuda.Stream(non_blocking=True)
            self._lanes[name] = stream
        with self._gpu, stream:
            yield

    def mark(self) -> Any:
        return self.xp.cuda.get_current_stream().record()

    def after(self, mark: Any) -> None:
        self.xp.cuda.get_current_stream().wait_event(mark)

    def wait(self, mark: Any) -> None:
        mark.synchronize()

    def adopt(self, array: Any) -> Any:
        return self.xp.asarray(array) if hasattr(array, "__cuda_array_interface__") else self.xp.from_dlpack(array)

    @contextmanager
    def faults(self) -> Iterator[None]:
        from cupy_backends.cuda.api.driver import CUDADriverError

        try:
            yield
        except self.xp.cuda.memory.OutOfMemoryError as error:
            free, total = self._gpu.mem_info
            raise DeviceError(
                f"the GPU's memory is full ({error}; {(total - free) >> 20} of {total >> 20} MB are taken): choose "
                "preset fast, give smaller images, or use --backend cpu"
            ) from error
        except (self._runtime.CUDARuntimeError, CUDADriverError) as error:
            raise DeviceError(
                f"the GPU stopped working ({error}): start again, with --backend cpu if it happens again"
            ) from error
