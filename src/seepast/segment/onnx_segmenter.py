"""A segmenter out of an ONNX network: images in, the network, masks out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError, OptionsError
from . import decode
from .classes import BY_COUNT, PEOPLE, class_numbers, names_in_model
from .onnx_model import OnnxModel
from .prepare import Placement
from .presets import HEADS, Preset, Shape, find_preset, guess_preset

log = logging.getLogger("seepast")

Prepared = tuple[np.ndarray, Placement]  # what goes in, [h, w, 3], and where the image lies in it


class OnnxSegmenter:
    """A Segmenter that runs an ONNX network; presets.PRESETS lists the kinds.

    preset   None: guessed from the shapes of its input and outputs, tried out where the file does not tell them
    classes  names or numbers of the classes that may move; None: person
    least    score below which an object does not count; None: as the preset has it
    threads  0 = as many as there are cores

    All images of an instant go through the network at once where it allows that. Raises ModelError; OptionsError for
    classes that the network does not have; MissingExtraError without onnxruntime.
    """

    def __init__(
        self,
        path: str | Path,
        preset: str | None = None,
        classes: Sequence[str] | None = None,
        *,
        least: float | None = None,
        threads: int = 0,
    ):
        self.model = OnnxModel(Path(path), threads)
        self.classes = tuple(classes or PEOPLE)
        try:
            self.preset_name = preset or _guessed(self.model)
            self.preset: Preset = find_preset(self.preset_name)
            self._channels_last = self.model.signature.channels_last
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from None
        self.least = self.preset.least if least is None else least
        self._one_by_one = self.preset.kind == "instances"  # whose objects do not say which image they are of
        self._chosen: tuple[int, ...] | None = None
        if self.preset.kind == "people" and [word.lower() for word in self.classes] != list(PEOPLE):
            raise OptionsError(f"--classes {','.join(self.classes)}: {path} knows people only; leave --classes out")
        self._choose([tensor.shape for tensor in self.model.signature.outputs], last=False)

    def describe(self) -> dict[str, Any]:
        """The model's path and SHA-256, preset, provider; classes and least score where they matter."""
        said: dict[str, Any] = {
            "kind": "onnx",
            "model": str(self.model.path.resolve()),
            **self.model.digests,
            "preset": self.preset_name,
            "provider": self.model.provider,
        }
        if self.preset.kind != "people":
            said["classes"] = list(self.classes)
        if self.preset.kind in ("instances", "prototypes"):
            said["least"] = self.least
        return said

    def __call__(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """K masks uint8 [h, w], 255 * P(dynamic), for K images uint8 [h, w] or [h, w, 3] BGR. Raises ModelError."""
        signature = self.model.signature
        raw = signature.input.dtype == "uint8"
        prepared = [self.preset.preparation(image, signature.size, raw) for image in images]
        try:
            maps = [p for group in self._groups(prepared) for p in self._maps(group)]
        except ModelError as error:
            raise ModelError(f"{self.model.path}: as '{self.preset_name}': {error}") from error
        return [np.rint(255 * p).astype(np.uint8) for p in maps]

    def _groups(self, prepared: Sequence[Prepared]) -> Iterator[Sequence[Prepared]]:
        """As many images at once as the model takes, all of one size."""
        alike = len({values.shape for values, _ in prepared}) == 1
        n = (self.model.signature.batch or len(prepared)) if alike and not self._one_by_one else 1
        return (prepared[i : i + n] for i in range(0, len(prepared), n))

    def _maps(self, group: Sequence[Prepared]) -> list[np.ndarray]:
        """float32 [h, w] P(dynamic) for each image of a group, from one run of the network."""
        batch = np.stack([values for values, _ in group])
        if not self._channels_last:
            batch = batch.transpose(0, 3, 1, 2)
        lacking = (self.model.signature.batch or 0) - len(batch)
        if lacking > 0:
            batch = np.concatenate([batch, np.repeat(batch[-1:], lacking, axis=0)])
        try:
            outputs = self.model.run(batch[0] if len(self.model.signature.input.shape) == 3 else batch)
        except ModelError as error:
            if len(group) == 1 or self.model.signature.batch:
                raise
            log.warning(
                "%s: takes images only one by one, though its shapes say otherwise (%s)", self.model.path, error
            )
            self._one_by_one = True
            return [p for prepared in group for p in self._maps([prepared])]
        self._choose([output.shape for output in outputs], last=True)
        return [self._map(outputs, i, *group[i]) for i in range(len(group))]

    def _map(self, outputs: list[np.ndarray], i: int, values: np.ndarray, placement: Placement) -> np.ndarray:
        size, chosen = (values.shape[1], values.shape[0]), self._chosen or ()
        if self.preset.kind == "instances":
            return decode.instances(_objects(outputs), placement, size, chosen, self.least)
        if self.preset.kind == "prototypes":
            rows, planes = _with_axes(outputs, 3)[i], _with_axes(outputs, 4)[i]
            found = decode.ROWS[self.preset.rows](rows, len(planes))
            return decode.prototypes(found, planes, placement, size, chosen, self.least)
        output = outputs[self.model.signature.main]
        if output.ndim < 3 or len(output) <= i:
            raise ModelError(f"its output is {list(output.shape)}, which is not one map for every image")
        if self.preset.kind == "people":
            return decode.person_map(output[i], placement, self._channels_last)
        return decode.class_map(output[i], placement, self._channels_last, chosen)

    def _choose(self, outputs: Sequence[Shape], last: bool) -> None:
        """Find the numbers of the classes that are asked for, as soon as the shapes say how many classes there are.

        last: nothing more will become known.
        """
        if self._chosen is not None or self.preset.kind == "people":
            return
        count = self._class_count(outputs)
        names = names_in_model(self.model.metadata) or self.preset.names or BY_COUNT.get(count or 0)
        if names or count or last:
            self._chosen = class_numbers(self.classes, names, count)

    def _class_count(self, outputs: Sequence[Shape]) -> int | None:
        """How many classes outputs of these shapes tell apart; None where they do not say."""
        signature = self.model.signature
        if self.preset.kind == "classes":
            shape = outputs[signature.main]
            labels = "int" in signature.outputs[signature.main].dtype
            return None if labels or len(shape) != 4 else shape[-1 if self._channels_last else 1]
        by_axes = {len(shape): shape for shape in outputs}
        if self.preset.rows not in HEADS or not {3, 4} <= set(by_axes):
            return None
        head, axis = HEADS[self.preset.rows]
        along, weights = by_axes[3][axis], by_axes[4][1]
        count = along - head - weights if along and weights else 0
        return count if count > 0 else None


def _guessed(model: OnnxModel) -> str:
    try:
        return guess_preset(model.signature)
    except ModelError as unclear:
        try:
            model.probe()
        except ModelError:
            raise unclear from None
    return guess_preset(model.signature)


def _with_axes(outputs: list[np.ndarray], axes: int) -> np.ndarray:
    for output in outputs:
        if output.ndim == axes:
            return output
    raise ModelError(f"it has no output of {axes} axes")


def _objects(outputs: list[np.ndarray]) -> decode.Detections:
    """Mask R-CNN's four outputs, told apart by type and number of axes."""
    labels = [o for o in outputs if o.ndim == 1 and o.dtype.kind in "iu"]
    scores = [o for o in outputs if o.ndim == 1 and o.dtype.kind == "f"]
    boxes = [o for o in outputs if o.ndim == 2 and o.shape[1] == 4]
    masks = [o for o in outputs if o.ndim in (3, 4)]
    if not (len(labels) == len(scores) == len(boxes) == len(masks) == 1):
        shapes = ", ".join(f"{o.dtype} {list(o.shape)}" for o in outputs)
        raise ModelError(f"its outputs are {shapes}; boxes [n, 4], labels, scores [n], masks [n, 1, h, w] are needed")
    return decode.Detections(boxes[0], labels[0], scores[0], masks[0])
