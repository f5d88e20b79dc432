"""What every exporter looks like to the rest of seepast."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ..errors import OptionsError
from .reading import View, Written

METRES, MILLIMETRES = "32FC1", "16UC1"  # REP 118


@dataclass(frozen=True)
class ExportOptions:
    """What a user may choose about an export.

    stamps        what the frames' names are, times.timeline
    rate          Hz of frames whose names are no times
    min_coverage  depth and disparity where fewer cameras saw the pixel count as unknown; 0 keeps guesses
    depth         "32FC1" (metres, NaN unknown) or "16UC1" (millimetres, 0 unknown): depth images of ROS, REP 118
    depth_factor  units per metre of the depth PNGs of tum; 5000 as TUM's own have

    Raises OptionsError for a value out of range.
    """

    stamps: str = "auto"
    rate: float = 10.0
    min_coverage: int = 1
    depth: str = METRES
    depth_factor: float = 5000.0

    def __post_init__(self) -> None:
        if self.min_coverage < 0:
            raise OptionsError(f"--min-coverage {self.min_coverage}: give a number of cameras, 0 or more")
        if self.depth not in (METRES, MILLIMETRES):
            raise OptionsError(f"--depth {self.depth}: take {METRES} (metres) or {MILLIMETRES} (millimetres)")
        if not (math.isfinite(self.depth_factor) and self.depth_factor > 0):
            raise OptionsError(f"--depth-factor {self.depth_factor}: give units per metre, above 0")


class Write(Protocol):
    """Writes all frames of one run to `path`, a file or a folder that is not there yet.

    view    the camera that the frames live in
    frames  (nanoseconds, frame) in order of time; to be gone through once, each is decoded when it is asked for

    Whatever it leaves takes its final place only when it returns.
    """

    def __call__(
        self, view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions
    ) -> None: ...


@dataclass(frozen=True)
class Exporter:
    """A format: how it is written, and the suffix of its single file, "" for a folder."""

    write: Write
    suffix: str = ""
