"""ROS 1 and ROS 2 bags behind one face: which topics there are, when their images were taken, and single images.

An index of time stamps is all of a bag that is kept in memory.
"""

from __future__ import annotations

import contextlib
import logging
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..extras import require
from .bag_file import VIDEO_TYPES, BagFile, Entry
from .bag_video import is_key
from .forward import Forward
from .recording import RIG_FILE

log = logging.getLogger("seepast")

STILL_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMAGE_TYPES = (*STILL_TYPES, *VIDEO_TYPES)
BAG_SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"


@dataclass(frozen=True, eq=False)
class TopicIndex:
    """The images of one topic by the time they were taken.

    stamps    int64[N] ns of the headers, ascending, none twice
    entries   where each is found again
    repeated  how many images were left out since another one has the same stamp
    early     how many were left out since video begins with a key frame only
    recorded  all messages in the order of recording, and whether each is a key frame; of video only
    """

    stamps: np.ndarray
    entries: Sequence[Entry]
    repeated: int
    early: int = 0
    recorded: Sequence[tuple[Entry, bool]] = ()


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
        paths = [path] if _is_one_bag(path) else bags_in(path)
        if not paths:
            raise DatasetError(f"{path}: no bag here; name a .bag, .mcap or .db3 file or a ROS 2 bag folder")
        self._open = contextlib.ExitStack()
        self.close = weakref.finalize(self, self._open.close)
        self._files: list[BagFile] = []
        for part, file in enumerate(paths):
            self._files.append(self._open.enter_context(contextlib.closing(BagFile(file, part))))
        self._forward: list[Forward] = []
        self.parts = len(paths)
        self.topics = {topic: kind for file in self._files for topic, kind in file.topics.items()}

    def index(self, topics: Sequence[str]) -> dict[str, TopicIndex]:
        """Read through the bag once for the time stamps of all images of `topics`; `fetch` gets these."""
        found: dict[str, list[Entry]] = {topic: [] for topic in topics}
        keys: dict[str, list[bool]] = {topic: [] for topic in topics if self.topics[topic] in VIDEO_TYPES}
        for file in self._files:
            for entry, message in file.messages(topics):
                found[entry.topic].append(entry)
                if entry.topic in keys:
                    keys[entry.topic].append(is_key(message))
        if any(own and not any(entry.stamp for entry in own) for own in found.values()):
            log.warning("%s: headers have no time stamps; taking the times at which images were recorded", self.path)
            for file in self._files:
                file.stamped = False
            found = {topic: [entry._replace(stamp=entry.logged) for entry in own] for topic, own in found.items()}
        self._forward = [self._open.enter_context(contextlib.closing(Forward(f, topics))) for f in self._files]
        return {topic: _video(own, keys[topic]) if topic in keys else _sorted(own) for topic, own in found.items()}

    def fetch(self, wanted: Sequence[Entry]) -> list[Any]:
        """The messages of `wanted`, in this order; quick if later than those before. Raises DatasetError."""
        found: dict[Entry, Any] = {}
        for part in {entry.part for entry in wanted}:
            found |= self._forward[part].fetch([entry for entry in wanted if entry.part == part])
        if len(found) < len(set(wanted)):
            raise DatasetError(f"{self.path}: has changed since it was opened; let the recording end first")
        return [found[entry] for entry in wanted]


def _video(entries: Sequence[Entry], keys: Sequence[bool]) -> TopicIndex:
    """Likewise of video, from its first key frame on, or from its beginning where none is known."""
    first = keys.index(True) if any(keys) else 0
    index = _sorted(entries[first:])
    return replace(index, early=first, recorded=list(zip(entries, keys, strict=True))[first:])


def _sorted(entries: Sequence[Entry]) -> TopicIndex:
    stamps, first = np.unique(np.array([entry.stamp for entry in entries], np.int64), return_index=True)
    return TopicIndex(stamps, [entries[i] for i in first], len(entries) - len(stamps))
