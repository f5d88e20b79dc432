"""Small ROS bags, made by the writers of rosbags, for the tests of what reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

KINDS = ("rosbag1", "sqlite3", "mcap")
START = 1_700_000_000_000_000_000  # ns


@dataclass(frozen=True)
class Shot:
    """One image message: when it was taken and recorded (ns), its pixels as `encoding` has them.

    encoding "jpeg" or "png" makes a CompressedImage of a BGR or grey image; "text" a std_msgs/String.
    """

    stamp: int
    image: np.ndarray
    encoding: str = "bgr8"
    delay: int = 2_000_000
    padding: int = 0


def write_bag(path: Path, kind: str, topics: Mapping[str, Sequence[Shot]], compression: str = "") -> Path:
    """The bag at `path` (rosbag1: a .bag file; else a folder), messages in the order in which they were recorded.

    compression: "lz4" or "bz2" for rosbag1, "zstd" for the others.
    """
    store = get_typestore(Stores.ROS1_NOETIC if kind == "rosbag1" else Stores.ROS2_HUMBLE)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _writer(path, kind, compression) as writer:
        messages = []
        for topic, shots in topics.items():
            msgtype = _message(store, shots[0], kind).__msgtype__ if shots else "sensor_msgs/msg/Image"
            connection = writer.add_connection(topic, msgtype, typestore=store)
            messages += [(shot.stamp + shot.delay, connection, shot) for shot in shots]
        serialize = store.serialize_ros1 if kind == "rosbag1" else store.serialize_cdr
        for logged, connection, shot in sorted(messages, key=lambda m: m[0]):
            writer.write(connection, logged, serialize(_message(store, shot, kind), connection.msgtype))
    return path


def _writer(path: Path, kind: str, compression: str) -> Any:
    if kind == "rosbag1":
        writer: Any = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        return writer
    plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if compression:
        mode = rosbag2.CompressionMode.STORAGE if kind == "mcap" else rosbag2.CompressionMode.MESSAGE
        writer.set_compression(mode, rosbag2.CompressionFormat[compression.upper()])
    return writer


def _message(store: Any, shot: Shot, kind: str) -> Any:
    types = store.types
    if shot.encoding == "text":
        return types["std_msgs/msg/String"]("no image")
    time = types["builtin_interfaces/msg/Time"](sec=shot.stamp // 10**9, nanosec=shot.stamp % 10**9)
    number = {"seq": 0} if kind == "rosbag1" else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **number)
    if shot.encoding in ("jpeg", "png"):
        data = cv2.imencode(f".{shot.encoding}", shot.image)[1].reshape(-1)
        kind_of_pixels = "mono8" if shot.image.ndim == 2 else "bgr8"
        return types["sensor_msgs/msg/CompressedImage"](
            header=header, format=f"{kind_of_pixels}; {shot.encoding} compressed {kind_of_pixels}", data=data
        )
    height, width = shot.image.shape[:2]
    rows = np.ascontiguousarray(shot.image).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, shot.padding)), constant_values=77)
    return types["sensor_msgs/msg/Image"](
        header=header,
        height=height,
        width=width,
        encoding=shot.encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.reshape(-1),
    )
