"""An ONNX file, loaded by onnxruntime for the best processor that is there."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from ..extras import require
from .presets import Signature, Tensor

log = logging.getLogger("seepast")

PROVIDERS = ("CUDA", "MIGraphX", "ROCM", "Dml", "CoreML", "CPU")  # those of them that are there, in this order
PROBE_SIZE = (512, 512)  # width, height; a multiple of every network's stride
DATA_SUFFIXES = (".data", "_data")  # what exporters append to the name for the file with the weights
DTYPES = {"float": "float32", "double": "float64"}  # onnxruntime's names where they are not NumPy's


class OnnxModel:
    """A loaded ONNX file.

    path      the file
    digests   "sha256" of it and, where its weights lie in a file beside it, "data_sha256" of that
    provider  what runs it, such as "CPU" or "CUDA"
    metadata  what its exporter left in it, text to text
    signature what goes in and comes out

    threads: 0 = as many as there are cores. Raises ModelError, and MissingExtraError without onnxruntime.
    """

    def __init__(self, path: Path, threads: int = 0):
        runtime = require("onnxruntime", "onnx", "--segmenter onnx:...")
        self.path, self.digests = path, {"sha256": _digest(path)}
        for data in (path.with_name(path.name + suffix) for suffix in DATA_SUFFIXES):
            if data.is_file():
                self.digests["data_sha256"] = _digest(data)
        self._session = _open(runtime, path, threads)
        self.provider: str = self._session.get_providers()[0].removesuffix("ExecutionProvider")
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        inputs = [_tensor(node) for node in self._session.get_inputs()]
        if len(inputs) != 1:
            raise ModelError(f"{path}: has {len(inputs)} inputs; a network that takes nothing but an image is needed")
        self.signature = Signature(inputs[0], tuple(_tensor(node) for node in self._session.get_outputs()))

    def run(self, batch: np.ndarray) -> list[np.ndarray]:
        """All outputs for one input in the model's layout; the dtype is made the model's. Raises ModelError."""
        node = self.signature.input
        try:
            return self._session.run(None, {node.name: np.ascontiguousarray(batch, node.dtype)})
        except Exception as error:
            raise ModelError(f"it fails on an input of {list(batch.shape)} ({_first_line(error)})") from error

    def probe(self) -> None:
        """Learn the shapes of outputs that the file leaves open, from one run on a black image. Raises ModelError."""
        width, height = self.signature.size or PROBE_SIZE
        image = (height, width, 3) if self.signature.channels_last else (3, height, width)
        batch = () if len(self.signature.input.shape) == 3 else (self.signature.batch or 1,)
        outputs = self.run(np.zeros(batch + image))
        self.signature = self.signature.completed([output.shape for output in outputs])


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror or error}); name an ONNX file") from None
    return digest.hexdigest()


def _open(runtime: Any, path: Path, threads: int) -> Any:
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # what goes wrong comes as an exception
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # the cores are the method's next
    there = runtime.get_available_providers()
    wanted = [name for name in (f"{short}ExecutionProvider" for short in PROVIDERS) if name in there]
    if "CUDAExecutionProvider" in wanted and hasattr(runtime, "preload_dlls"):
        runtime.preload_dlls()  # finds the CUDA libraries that pip has installed
    try:
        session = runtime.InferenceSession(str(path), options, providers=wanted)
    except Exception as error:  # onnxruntime's errors have nothing else in common
        raise ModelError(
            f"{path}: onnxruntime cannot load it ({_first_line(error)}); fetch it again, or export it again"
        ) from error
    used = session.get_providers()
    if used[0] != wanted[0]:
        log.warning("%s: %s is there but does not start; %s runs it, slower", path, wanted[0], used[0])
    return session


def _tensor(node: Any) -> Tensor:
    shape = tuple(n if isinstance(n, int) and n > 0 else None for n in node.shape or ())
    kind = node.type.removeprefix("tensor(").removesuffix(")")
    return Tensor(node.name, shape, DTYPES.get(kind, kind))


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
