"""Bags of ROS 1 (format 2.0), through rosbags. Topics and frames: ros.py."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..extras import require
from .protocol import ExportOptions
from .reading import View, Written
from .ros import Messages, record, typestore


def write_rosbag1(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write: one .bag file. Raises MissingExtraError without the package rosbags."""
    purpose = "seepast export --to rosbag1"
    store = typestore("ROS1_NOETIC", purpose)
    writer = require("rosbags.rosbag1", "rosbag", purpose).Writer
    with writer(path) as bag:
        record(bag, store.serialize_ros1, Messages(store, ros1=True), view, frames, options)
