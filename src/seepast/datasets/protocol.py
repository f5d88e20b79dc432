"""What every recording looks like to the rest of seepast."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from ..rig import Rig

NO_MASKS = "none"  # the masks argument that says: nothing in these images is dynamic
DEFAULT_TOLERANCE = 0.005  # seconds


@dataclass(frozen=True)
class OpenOptions:
    """How a recording is to be opened; None = the reader's own choice.

    masks      folder of masks, relative to the recording or absolute; "none" = no masks; in ROS bags also
               "topics:" and topics as below
    rig        Kalibr camchain file; None = the recording's own
    topics     image topics of a ROS bag in the order of the rig's cameras, separated by commas; or one with {}
               for the camera's name. None = the rostopic of each camera in the rig
    tolerance  seconds that the images of one instant may be apart in time; None = DEFAULT_TOLERANCE
    bits       how many of their bits images of 16 fill, for making them 8 (eight_bits.py); None = 16
    """

    masks: str | None = None
    rig: Path | None = None
    topics: str | None = None
    tolerance: float | None = None
    bits: int | None = None


def said_bits(options: OpenOptions) -> dict[str, int]:
    """What goes into `Dataset.reading` about bits: nothing where nothing was said."""
    return {} if options.bits is None else {"bits": options.bits}


@dataclass(frozen=True)
class Dropped:
    """Images of a recording that belong to no frame, and why."""

    images: int
    reason: str

    def __str__(self) -> str:
        return f"{self.images} image{'s' if self.images > 1 else ''}: {self.reason}"


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

    Readers that put images of separately stamped cameras together also have `dropped`, a tuple of Dropped, and
    `times`, int64[N, K] nanoseconds of each frame's images (None where the recording has no clock). Where frames depend
    on how the recording was opened, `reading` tells it, for run.json.
    """

    name: str
    path: Path
    masks: Path | None
    rig: Rig
    stamps: Sequence[str]

    def frame(self, stamp: str) -> Frame: ...

    def __iter__(self) -> Iterator[Frame]: ...
