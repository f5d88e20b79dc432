"""A recording whose masks a segmenter makes, frame by frame, in place of those in files."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..datasets import Dataset, Frame
from ..errors import InputError
from ..frames import check_frame
from ..rig import Rig
from .protocol import Segmenter


class SegmentedDataset:
    """`inner` with the masks that `segmenter` gives for its images; in all else `inner` itself.

    A frame's timings hold the milliseconds that its masks took, as "segment".
    """

    masks: Path | None = None  # they lie nowhere

    def __init__(self, inner: Dataset, segmenter: Segmenter):
        self.inner, self.segmenter = inner, segmenter
        self.name: str = inner.name
        self.path: Path = inner.path
        self.rig: Rig = inner.rig
        self.stamps: Sequence[str] = inner.stamps

    def __getattr__(self, name: str) -> Any:
        if name == "inner":  # not there yet: copying and unpickling ask before __init__ has run
            raise AttributeError(name)
        return getattr(self.inner, name)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(stamp) for stamp in self.stamps)

    def frame(self, stamp: str) -> Frame:
        """Decode one instant and segment it. Raises DatasetError, ModelError, and InputError for masks that do not
        fit the images."""
        frame = self.inner.frame(stamp)
        start = time.perf_counter()
        masks = list(self.segmenter(frame.images))
        try:
            _, checked = check_frame(self.rig, frame.images, masks)
        except InputError as error:
            raise InputError(f"{self.name}, frame {stamp}, from the segmenter: {error}") from error
        timings = {**frame.timings, "segment": 1e3 * (time.perf_counter() - start)}
        return replace(frame, masks=tuple(checked), timings=timings)
