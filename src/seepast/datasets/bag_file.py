"""One bag file of ROS 1 or ROS 2, read by rosbags.

Messages of sensor_msgs are the same in every release of ROS 2, so the definitions in the bag, which old bags lack, are
not needed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import DatasetError, SeepastError

VIDEO_TYPES = {  # not among those that rosbags knows by itself
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
}


class Entry(NamedTuple):
    """One message: its topic, which file of the bag it is in, when it was recorded and when taken (ns)."""

    topic: str
    part: int
    logged: int
    stamp: int


class BagFile:
    """An open file, or ROS 2 bag folder; `part` is its number in the bag. Raises DatasetError.

    topics   message type of each
    stamped  False: headers without time stamps, the time of recording counts as the time taken
    """

    def __init__(self, path: Path, part: int):
        self.path, self.part, self.stamped = path, part, True
        ros1 = path.is_file() and path.suffix == ".bag"  # folders of ROS 2 may have any name
        self._deserialize = _deserializer(ros1)
        with self._reading():
            self._reader = _reader(path, ros1)
            self._reader.open()
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in self._reader.connections}

    def close(self) -> None:
        self._reader.close()

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Entry, Any]]:
        """What was recorded from `start` on and before `stop` (ns; None: the ends), by the time of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:  # no filter at all, to rosbags
            return
        with self._reading():
            for connection, logged, raw in self._reader.messages(connections, start, stop):
                message = self._deserialize(raw, connection.msgtype)
                time = int(logged)  # a damaged database may hold anything
                taken = _stamp(message) if self.stamped else time
                yield Entry(connection.topic, self.part, time, taken), message

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (SeepastError, MemoryError):
            raise
        except Exception as error:  # rosbags meets damaged files with a dozen kinds of error
            text = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(
                f"{self.path}: cannot be read as a bag, it is damaged, cut off or still being written ({text}); mend "
                "it with rosbag reindex, ros2 bag reindex or mcap recover, or copy it again"
            ) from error


def _reader(path: Path, ros1: bool) -> Any:
    from rosbags import rosbag1, rosbag2

    return rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)


def _deserializer(ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, definition in VIDEO_TYPES.items():
        store.register(get_types_from_msg(definition, name))
    return store.deserialize_ros1 if ros1 else store.deserialize_cdr


def _stamp(message: Any) -> int:
    stamp = message.header.stamp if hasattr(message, "header") else message.timestamp  # CompressedVideo has no header
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)
