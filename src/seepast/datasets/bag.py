"""ROS 1 and ROS 2 bags behind one face: which image topics there are, when their images were taken, and one image.

An index of time stamps is all that is kept in memory. Messages of sensor_msgs are the same in every release of ROS 2,
so the definitions in the bag, which old bags lack, are not needed.
"""

from __future__ import annotations

import contextlib
import logging
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import DatasetError, SeepastError
from ..extras import require
from .recording import RIG_FILE

log = logging.getLogger("seepast")

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
BAG_SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"


class Entry(NamedTuple):
    """One message: its topic, which file of the bag it is in, when it was recorded and when taken (ns)."""

    topic: str
    part: int
    logged: int
    stamp: int


@dataclass(frozen=True, eq=False)
class TopicIndex:
    """The images of one topic by the time they were taken.

    stamps    int64[N] ns of the headers, ascending, none twice
    entries   where each is found again
    repeated  how many images were left out since another one has the same stamp
    """

    stamps: np.ndarray
    entries: Sequence[Entry]
    repeated: int


def is_bag(path: Path) -> bool:
    """A bag file, a ROS 2 bag folder, or a folder with just one of these in it beside rig.yaml."""
    return _is_one_bag(path) or ((path / RIG_FILE).is_file() and len(bags_in(path)) == 1)


def bags_in(folder: Path) -> list[Path]:
    """The bags directly in a folder, by name."""
    return sorted(p for p in folder.iterdir() if _is_one_bag(p)) if folder.is_dir() else []


def _is_one_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / METADATA).is_file() and any(p.suffix in BAG_SUFFIXES[1:] for p in path.iterdir())
    return path.suffix in BAG_SUFFIXES and path.is_file()


class Bag:
    """A bag of one or several files, open for reading. Raises DatasetError, MissingExtraError without rosbags.

    topics  message type of every topic; parts  number of its files
    """

    def __init__(self, path: Path):
        require("rosbags", "rosbag", "reading ROS bags")
        self.path = path
        parts = [path] if _is_one_bag(path) else bags_in(path)
        if not parts:
            raise DatasetError(f"{path}: no bag here; name a .bag, .mcap or .db3 file or a ROS 2 bag folder")
        self._readers: list[Any] = []
        stack = contextlib.ExitStack()
        self.close = weakref.finalize(self, stack.close)
        for part in parts:
            with self._reading(part):
                self._readers.append(stack.enter_context(_reader(part)))
        self._deserialize = [_deserializer(part) for part in parts]
        self._parts, self.parts = parts, len(parts)
        self._stamped = True
        self.topics: dict[str, str] = {c.topic: c.msgtype for reader in self._readers for c in reader.connections}

    def index(self, topics: Sequence[str]) -> dict[str, TopicIndex]:
        """Read through the bag once for the time stamps of all images of `topics`."""
        found: dict[str, list[Entry]] = {topic: [] for topic in topics}
        for part in range(len(self._readers)):
            for entry, _ in self._messages(part, topics):
                found[entry.topic].append(entry)
        if self._stamped and any(own and not any(entry.stamp for entry in own) for own in found.values()):
            log.warning("%s: headers have no time stamps; taking the times at which images were recorded", self.path)
            self._stamped = False
            found = {topic: [entry._replace(stamp=entry.logged) for entry in own] for topic, own in found.items()}
        return {topic: _sorted(own) for topic, own in found.items()}

    def fetch(self, wanted: Sequence[Entry]) -> list[Any]:
        """The messages of `wanted`, in this order. Raises DatasetError."""
        found: dict[Entry, Any] = {}
        for part in {entry.part for entry in wanted}:
            ours = [entry for entry in wanted if entry.part == part]
            times = [entry.logged for entry in ours]
            for entry, message in self._messages(part, [e.topic for e in ours], min(times), max(times) + 1):
                if entry in ours:
                    found.setdefault(entry, message)
        if len(found) < len(set(wanted)):
            raise DatasetError(f"{self.path}: has changed since it was opened; let the recording end first")
        return [found[entry] for entry in wanted]

    def _messages(
        self, part: int, topics: Sequence[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Entry, Any]]:
        reader = self._readers[part]
        connections = [c for c in reader.connections if c.topic in topics]
        if not connections:  # no filter at all, to rosbags
            return
        with self._reading(self._parts[part]):
            for connection, logged, raw in reader.messages(connections, start, stop):
                message = self._deserialize[part](raw, connection.msgtype)
                taken = _stamp(message) if self._stamped else logged
                yield Entry(connection.topic, part, logged, taken), message

    @contextlib.contextmanager
    def _reading(self, part: Path) -> Iterator[None]:
        try:
            yield
        except (SeepastError, MemoryError):
            raise
        except Exception as error:  # rosbags meets damaged files with a dozen kinds of error
            text = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(
                f"{part}: cannot be read as a bag, it is damaged, cut off or still being written ({text}); mend it "
                "with rosbag reindex, ros2 bag reindex or mcap recover, or copy it again"
            ) from error


def _reader(part: Path) -> Any:
    from rosbags import rosbag1, rosbag2

    return rosbag1.Reader(part) if part.suffix == ".bag" else rosbag2.Reader(part)


def _deserializer(part: Path) -> Any:
    from rosbags.typesys import Stores, get_typestore

    if part.suffix == ".bag":
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _sorted(entries: Sequence[Entry]) -> TopicIndex:
    stamps, first = np.unique(np.array([entry.stamp for entry in entries], np.int64), return_index=True)
    return TopicIndex(stamps, [entries[i] for i in first], len(entries) - len(stamps))
