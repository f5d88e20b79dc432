"""What every recording looks like to the rest of seepast."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from ..rig import Rig

NO_MASKS = "none"  # the masks argument that says: nothing in these images is dynamic


@dataclass(frozen=True, eq=False)
class Frame:
    """One instant of the array.

    stamp   the name shared by the K files of this instant
    images  K uint8 arrays, [h, w] grey or [h, w, 3] BGR, in camera order of the rig
    masks   K uint8 [h, w] of 255 * P(dynamic), or None where nothing is dynamic
    timings milliseconds of what had to be computed for it, such as its masks ("segment"); reading does not count
    """

    stamp: str
    images: tuple[np.ndarray, ...]
    masks: tuple[np.ndarray, ...] | None
    timings: Mapping[str, float] = field(default_factory=dict)


class Dataset(Protocol):
    """A recording of one rig. Frames are decoded one at a time, when they are asked for.

    name    for people; path   where it lies; masks   where its masks lie, None where nothing is dynamic
    rig     its cameras, in the order of the images
    stamps  names of its frames in time order
    """

    name: str
    path: Path
    masks: Path | None
    rig: Rig
    stamps: Sequence[str]

    def frame(self, stamp: str) -> Frame: ...

    def __iter__(self) -> Iterator[Frame]: ...
