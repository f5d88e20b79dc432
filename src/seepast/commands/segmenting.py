"""What the commands that take --segmenter and --classes share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..errors import OptionsError

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..segment import Segmenter
    from .source import Source

SegmenterName = Annotated[
    str | None,
    Parameter(
        name="--segmenter",
        show_default=False,
        help="What makes the masks, in place of files: onnx:MODEL.onnx, onnx:MODEL.onnx:PRESET, onnx:NAME of a model "
        "that `seepast models get` fetched, or MODULE:FACTORY of your own.",
    ),
]
Classes = Annotated[
    str | None,
    Parameter(
        name="--classes",
        show_default=False,
        help="What may move, for the segmenter: names or numbers, separated by commas (default: person).",
    ),
]


def opened_segmenter(spec: str | None, classes: str | None, masks: str | None, threads: int = 0) -> Segmenter | None:
    """The segmenter that the options of a command name; None: masks come from files. Raises SeepastError."""
    if spec is None:
        if classes is not None:
            raise OptionsError("--classes: chooses what a segmenter looks for; add --segmenter, or leave it out")
        return None
    if masks is not None:
        raise OptionsError("--masks and --segmenter: masks come from files or from a segmenter; leave one of them out")
    from ..segment import open_segmenter

    words = None if classes is None else [word.strip() for word in classes.split(",") if word.strip()]
    if words == []:
        raise OptionsError("--classes: names nothing; write it as --classes person,car")
    return open_segmenter(spec, words, threads=threads)


def opened_recording(source: Source, path: Path, masks: str | None, segmenter: Segmenter | None) -> Dataset:
    """The recording with its masks from files, or from `segmenter` where there is one. Raises SeepastError."""
    from ..datasets import NO_MASKS

    if segmenter is None:
        return source.open(path, masks)
    from ..segment import SegmentedDataset

    return SegmentedDataset(source.open(path, NO_MASKS), segmenter)
