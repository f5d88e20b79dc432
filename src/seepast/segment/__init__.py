"""Segmenters: where in the images of one instant something may move. Networks in ONNX files, or your own.

    segmenter = open_segmenter("onnx:pphumanseg.onnx")
    masks = segmenter(images)

A kind of segmenter is one entry in SEGMENTERS; a single one of your own needs none: "module:factory" names it.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from .dataset import SegmentedDataset
from .models import find_model
from .onnx_segmenter import OnnxSegmenter
from .presets import PRESETS
from .protocol import Segmenter

__all__ = ["PRESETS", "SEGMENTERS", "OnnxSegmenter", "SegmentedDataset", "Segmenter", "open_segmenter"]


def _open_onnx(rest: str, classes: Sequence[str] | None, threads: int) -> Segmenter:
    """rest: MODEL[:preset], where MODEL is a file or the name of a public model that `seepast models get` fetched."""
    name, colon, preset = rest.rpartition(":")
    if not colon or rest.lower().endswith(".onnx"):  # a colon may also be part of the path
        name, preset = rest, ""
    path, usual = find_model(name)
    return OnnxSegmenter(path, preset or usual, classes, threads=threads)


# kind -> what opens it: (what stands after "kind:", classes, threads) -> Segmenter
SEGMENTERS: dict[str, Callable[[str, Sequence[str] | None, int], Segmenter]] = {"onnx": _open_onnx}


def open_segmenter(spec: str, classes: Sequence[str] | None = None, *, threads: int = 0) -> Segmenter:
    """Make the segmenter that `spec` names.

    spec     "onnx:MODEL.onnx", "onnx:MODEL.onnx:preset", "onnx:NAME" of a model fetched before, or "module:factory" and
             "file.py:factory": factory() or, where classes are given, factory(classes=[...]) returns a Segmenter or a
             plain function from K images to K masks
    classes  names or numbers of what may move; None = people
    threads  for networks; 0 = as many as there are cores

    Raises ModelError for what cannot be found or used, OptionsError for classes that the network does not know, and
    MissingExtraError where onnxruntime is needed and missing.
    """
    kind, colon, rest = spec.partition(":")
    if colon and kind in SEGMENTERS:
        return SEGMENTERS[kind](rest, classes, threads)
    module, colon, factory = spec.rpartition(":")
    if not (colon and module and factory):
        raise ModelError(f"--segmenter {spec}: write onnx:MODEL.onnx, onnx:MODEL.onnx:PRESET or MODULE:FACTORY")
    return _open_own(spec, module, factory, classes)


def _open_own(spec: str, module: str, factory: str, classes: Sequence[str] | None) -> Segmenter:
    try:
        loaded = _load_file(Path(module)) if module.endswith(".py") else _load_module(module)
        make = getattr(loaded, factory)
        made = make() if classes is None else make(classes=list(classes))
    except Exception as error:  # whatever a stranger's module may do
        raise ModelError(f"--segmenter {spec}: {type(error).__name__}: {error}; mend {module}") from error
    if not callable(made):
        raise ModelError(f"--segmenter {spec}: {factory} returned a {type(made).__name__}, which cannot be called")
    return _Own(spec, made, Path(loaded.__file__ or ""), classes)


class _Own:
    """A user's segmenter, described by where it comes from and the hash of its file, and by what it says itself."""

    def __init__(self, spec: str, segment: Callable[..., Any], file: Path, classes: Sequence[str] | None):
        self._segment = segment
        self._said: dict[str, Any] = {"kind": spec}
        if file.is_file():
            self._said["file_sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
        if classes is not None:
            self._said["classes"] = list(classes)
        if hasattr(segment, "describe"):
            self._said.update(segment.describe())

    def __call__(self, images: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
        return self._segment(images)

    def describe(self) -> Mapping[str, Any]:
        return self._said


def _load_file(path: Path) -> Any:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    found = importlib.util.spec_from_file_location(path.stem, path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def _load_module(name: str) -> Any:
    """Import a module that is installed or lies in the working directory."""
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(here)
