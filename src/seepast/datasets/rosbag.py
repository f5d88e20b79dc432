"""ROS bags in: one image topic per camera, frames put together by the time stamps of the headers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from .bag import Bag, TopicIndex
from .bag_file import Entry
from .bag_video import VideoTopic
from .grouping import grouped, log_dropped, nanoseconds
from .protocol import Dropped, OpenOptions, said_bits
from .recording import MaskFolder, Recording, find_rig, mask_path
from .ros_images import decode_message
from .topics import image_topics, mask_topics

AT_ONCE = 32  # frames of video that are kept while a decoder catches up


@dataclass(frozen=True, eq=False)
class _Stream:
    """One topic: `index` of its messages, and which of them belongs to each frame, members int64[N]."""

    index: TopicIndex
    members: np.ndarray

    @property
    def times(self) -> np.ndarray:
        """int64[N] ns."""
        return self.index.stamps[self.members]

    def entry(self, frame: int) -> Entry:
        return self.index.entries[self.members[frame]]

    def at(self, frames: np.ndarray) -> _Stream:
        return _Stream(self.index, self.members[frames])


class RosbagDataset(Recording):
    """A ROS 1 bag, or a ROS 2 bag in sqlite3 or MCAP; see OpenOptions for rig, topics, tolerance and masks.

    stamps   ns of cam0's header, 19 digits
    times    int64[N, K] ns of all headers
    dropped  which images belong to no frame, and why
    masks    the folder they are in, or the bag's path, "#" and the topics

    The bag is read once on opening for its time stamps; images are decoded frame by frame, in any order. Masks in a
    folder are <masks>/<camera>/<stamp>.png by the frame's stamp or by the camera's own. Raises RigError, DatasetError.
    """

    def __init__(self, path: str | Path, options: OpenOptions | None = None):
        path, options = Path(path), options or OpenOptions()
        rig, rig_file = find_rig(path, options)
        tolerance = nanoseconds(options.tolerance)
        names = [camera.name for camera in rig.cameras]
        self._bag = Bag(path)
        topics = image_topics(self._bag, rig.cameras, options.topics, rig_file)
        of_masks = mask_topics(self._bag, rig.cameras, options.masks)
        index = self._bag.index([*topics, *of_masks])
        _check_filled(path, index)
        self._streams, dropped = _frames(path, names, topics, [index[topic] for topic in topics], tolerance)
        self._videos = {
            k: VideoTopic(*zip(*index[topic].recorded, strict=True))
            for k, topic in enumerate(topics)
            if index[topic].recorded
        }
        self._mask_streams: list[_Stream] = []
        if of_masks:
            masks = [index[topic] for topic in of_masks]
            self._streams, self._mask_streams, lost = _with_masks(path, names, self._streams, masks, tolerance)
            dropped += lost
        where = Path(f"{path}#{','.join(of_masks)}") if of_masks else mask_path(path, options.masks)
        stamps = [_stamp_name(time) for time in self._streams[0].times]
        super().__init__(path, rig, rig_file, stamps, where, options.bits)
        self.times = np.stack([stream.times for stream in self._streams], axis=1)
        self.dropped = dropped
        reader = "rosbag-split" if self._bag.parts > 1 else "rosbag"
        self.reading = {"reader": reader, "topics": topics, "tolerance": tolerance / 1e9, **said_bits(options)}
        if where is not None and not of_masks:
            own = [[_stamp_name(time) for time in stream.times] for stream in self._streams]
            self._folder = MaskFolder(where, names, [list(zip(stamps, mine, strict=True)) for mine in own])
        log_dropped(path, dropped, sum(len(index[t].stamps) + index[t].repeated + index[t].early for t in topics))

    def _images(self, index: int) -> Sequence[np.ndarray]:
        streams = self._streams + self._mask_streams  # at one go, which reads forward only
        entries = [stream.entry(index) for stream in streams]
        self._catch_up(entries)
        messages = self._bag.fetch(entries)
        self._mask_messages = messages[len(self._streams) :]
        return [self._image(k, index, message) for k, message in enumerate(messages[: len(self._streams)])]

    def _catch_up(self, entries: Sequence[Entry]) -> None:
        """Take the decoders of video to just before the frame of `entries`."""
        waiting = {k: list(video.missing(entries[k])[:-1]) for k, video in self._videos.items()}
        while any(waiting.values()):
            now = {k: own[:AT_ONCE] for k, own in waiting.items()}
            waiting = {k: own[AT_ONCE:] for k, own in waiting.items()}
            fetched = iter(self._bag.fetch([entry for own in now.values() for entry in own]))
            for k, own in now.items():
                for entry in own:
                    self._videos[k].feed(self._place(entry), next(fetched))

    def _image(self, camera: int, index: int, message: Any) -> np.ndarray:
        where, video = self._where(camera, index), self._videos.get(camera)
        if video is None:
            return decode_message(where, message, self._deep)
        if video.missing(self._streams[camera].entry(index)):
            video.feed(where, message)
        return video.image(where)

    def _masks(self, index: int) -> Sequence[np.ndarray]:
        if not self._mask_streams:
            return [self._folder.read(k, index) for k in range(len(self.rig))]
        messages = enumerate(self._mask_messages)
        masks = [decode_message(f"{self._where(k, index)}, its mask", message) for k, message in messages]
        for k, mask in enumerate(masks):
            if mask.ndim != 2:
                raise DatasetError(f"{self._where(k, index)}, its mask: in colour; a mask is mono8, 255 * P(dynamic)")
        return masks

    def _where(self, camera: int, index: int) -> str:
        return self._place(self._streams[camera].entry(index))

    def _place(self, entry: Entry) -> str:
        return f"{self.path}: {entry.topic} at {_stamp_name(entry.stamp)}"


def _stamp_name(nanoseconds: int) -> str:
    return f"{nanoseconds:019d}"  # one length, so that names sort by time


def _check_filled(path: Path, index: dict[str, TopicIndex]) -> None:
    for topic, own in index.items():
        if not len(own.stamps):
            raise DatasetError(f"{path}: {topic} has no messages; was the camera on? record again, or name another")


def _frames(
    path: Path, names: Sequence[str], topics: Sequence[str], images: Sequence[TopicIndex], tolerance: int
) -> tuple[list[_Stream], tuple[Dropped, ...]]:
    """The images of each frame, and what was left out."""
    members, dropped = grouped(path, names, [index.stamps for index in images], tolerance)
    repeated = tuple(
        Dropped(index.repeated, f"{topic} has another image with the same time stamp")
        for index, topic in zip(images, topics, strict=True)
        if index.repeated
    ) + tuple(
        Dropped(index.early, f"{topic} has them before its first key frame")
        for index, topic in zip(images, topics, strict=True)
        if index.early
    )
    return [_Stream(index, members[:, k]) for k, index in enumerate(images)], repeated + dropped


def _with_masks(
    path: Path, names: Sequence[str], images: Sequence[_Stream], masks: Sequence[TopicIndex], tolerance: int
) -> tuple[list[_Stream], list[_Stream], tuple[Dropped, ...]]:
    """The frames that have a mask of every camera within `tolerance` ns of its image; their images and masks."""
    nearest = [_Stream(mask, _nearest(mask.stamps, image.times)) for image, mask in zip(images, masks, strict=True)]
    lacks = np.stack([abs(m.times - i.times) > tolerance for i, m in zip(images, nearest, strict=True)], axis=1)
    whole = np.flatnonzero(~lacks.any(axis=1))
    within = f"within {tolerance / 1e6:g} ms"
    if not len(whole):
        raise DatasetError(f"{path}: no frame has masks {within} of its images; allow more with --tolerance SECONDS")
    lost: tuple[Dropped, ...] = ()
    if len(whole) < len(lacks):
        without = ", ".join(name for k, name in enumerate(names) if lacks[:, k].any())
        incomplete = len(lacks) - len(whole)
        lost = (Dropped(incomplete * len(names), f"{incomplete} frames lack a mask of {without} {within}"),)
    return [image.at(whole) for image in images], [mask.at(whole) for mask in nearest], lost


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """For each of `wanted` the index of the nearest of ascending `times`."""
    return np.searchsorted(times[:-1] + np.diff(times) // 2, wanted)
