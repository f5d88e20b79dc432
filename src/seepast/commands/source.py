"""How the commands that read recordings are told what to read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from ..datasets import Dataset

Optional = Parameter(negative=(), show_default=False)


@Parameter(name="*")
@dataclass(frozen=True)
class Source:
    """Options of their own in each command that has a parameter of this class.

    Parameters
    ----------
    reader
        folder, rosbag, rosbag-split (all bags of a folder as one), video, middlebury, euroc, or MODULE:NAME of a
        Reader of your own; if not given, guessed.
    rig
        Kalibr camchain file; if not given, the recording's own: rig.yaml in it or beside it.
    topics
        Image topics of a ROS bag, in the order of the rig's cameras: A,B,C, or one with {} for the camera's name; if
        not given, the rostopic of each camera in the rig.
    tolerance
        Seconds that images of one instant may be apart (ROS bags, EuRoC); 0.005 if not given.
    bits
        How many of their bits images of 16 fill, 12 for example: they are made 8 by one factor; 16 if not given.
    """

    reader: Annotated[str | None, Optional] = None
    rig: Annotated[Path | None, Optional] = None
    topics: Annotated[str | None, Optional] = None
    tolerance: Annotated[float | None, Optional] = None
    bits: Annotated[int | None, Optional] = None

    def find(self, path: Path) -> list[Path]:
        """See `datasets.find_datasets`."""
        from ..datasets import find_datasets

        return find_datasets(path, reader=self.reader)

    def open(self, path: Path, masks: str | None) -> Dataset:
        """See `datasets.open_dataset`."""
        from ..datasets import open_dataset

        return open_dataset(
            path,
            masks=masks,
            reader=self.reader,
            rig=self.rig,
            topics=self.topics,
            tolerance=self.tolerance,
            bits=self.bits,
        )


GUESSED = Source()
