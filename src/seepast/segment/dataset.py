"""A recording whose masks a segmenter makes, frame by frame, in place of those in files."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets import Dataset, Frame
from ..errors import InputError
from ..frames import check_frame
from ..rig import Rig
from .protocol import Segmenter

KEPT = 12  # frames: more than are on their way through a run at once


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
        self._making = threading.Lock()
        self._kept: dict[str, tuple[np.ndarray, ...]] | None = None

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
        with self._making:
            masks = self._masks(stamp, frame.images)
        timings = {**frame.timings, "segment": 1e3 * (time.perf_counter() - start)}
        return replace(frame, masks=masks, timings=timings)

    def beside(self, inner: Dataset) -> SegmentedDataset:
        """The recording opened once more, for who reads beside: masks that were just made are not made again."""
        twin = SegmentedDataset(inner, self.segmenter)
        self._kept = twin._kept = {} if self._kept is None else self._kept
        twin._making = self._making
        return twin

    def _masks(self, stamp: str, images: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        if self._kept is not None and stamp in self._kept:
            return self._kept[stamp]
        try:
            _, checked = check_frame(self.rig, images, list(self.segmenter(images)))
        except InputError as error:
            raise InputError(f"{self.name}, frame {stamp}, from the segmenter: {error}") from error
        if self._kept is not None:
            self._kept[stamp] = tuple(checked)
            if len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]
        return tuple(checked)
