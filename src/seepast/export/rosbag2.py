"""Bags of ROS 2 (a folder with an SQLite3 database) and single MCAP files, through rosbags. Topics: ros.py."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..extras import require
from .protocol import ExportOptions
from .reading import View, Written
from .ros import Messages, record, typestore

VERSION = 8  # of metadata.yaml; Humble cannot read the next one


def write_rosbag2(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write: a folder with metadata.yaml and a .db3, which every ROS 2 reads.

    Raises MissingExtraError without the package rosbags.
    """
    _write(view, frames, path, options, "SQLITE3", "seepast export --to rosbag2")


def write_mcap(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write: one .mcap file of CDR messages with their ROS 2 definitions, for Foxglove and ROS 2.

    Raises MissingExtraError without the package rosbags.
    """
    bag = path.with_name("bag")
    _write(view, frames, bag, options, "MCAP", "seepast export --to mcap")
    (file,) = bag.glob("*.mcap")
    file.replace(path)


def _write(
    view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions, storage: str, purpose: str
) -> None:
    import sqlite3

    store = typestore("ROS2_HUMBLE", purpose)
    rosbag2 = require("rosbags.rosbag2", "rosbag", purpose)
    try:
        with rosbag2.Writer(path, version=VERSION, storage_plugin=rosbag2.StoragePlugin[storage]) as bag:
            record(bag, store.serialize_cdr, Messages(store, ros1=False), view, frames, options)
    except sqlite3.Error as error:  # how a full disk shows
        raise OSError(f"the bag's database says: {error}") from error
