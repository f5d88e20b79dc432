"""ROS bags in: one image topic per camera, frames put together by the time stamps of the headers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..rig import Camera
from .bag import IMAGE_TYPES, Bag, TopicIndex
from .grouping import grouped, log_dropped, nanoseconds
from .protocol import Dropped, OpenOptions
from .recording import MaskFolder, Recording, find_rig, mask_path
from .ros_images import decode_message

MASK_TOPICS = "topics:"


@dataclass(frozen=True, eq=False)
class _Stream:
    """One topic, and which of its images belongs to each frame: members int64[N]."""

    index: TopicIndex
    members: np.ndarray


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
        topics = _image_topics(self._bag, rig.cameras, options.topics, rig_file)
        mask_topics = _mask_topics(self._bag, rig.cameras, options.masks)
        indices = self._bag.index([*topics, *mask_topics])
        images = _filled(path, [indices[topic] for topic in topics], topics)
        members, dropped = grouped(path, names, [index.stamps for index in images], tolerance)
        dropped = _repeated(images, topics) + dropped
        self._mask_streams: list[_Stream] = []
        if mask_topics:
            masks = _filled(path, [indices[topic] for topic in mask_topics], mask_topics)
            members, lost = _with_masks(path, names, images, members, masks, tolerance)
            dropped += lost
            self._mask_streams = _mask_streams(images, members, masks)
        self._streams = [_Stream(index, members[:, k]) for k, index in enumerate(images)]
        times = np.stack([stream.index.stamps[stream.members] for stream in self._streams], axis=1)
        where = Path(f"{path}#{','.join(mask_topics)}") if mask_topics else mask_path(path, options.masks)
        super().__init__(path, rig, rig_file, [_stamp_name(time) for time in times[:, 0]], where)
        self.times, self.dropped = times, dropped
        reader = "rosbag-split" if self._bag.parts > 1 else "rosbag"
        self.reading = {"reader": reader, "topics": topics, "tolerance": tolerance / 1e9}
        self._folder = None
        if where is not None and not mask_topics:
            choices = [[(stamp, _stamp_name(t)) for stamp, t in zip(self.stamps, own, strict=True)] for own in times.T]
            self._folder = MaskFolder(where, names, choices)
        log_dropped(path, dropped, sum(len(index.stamps) + index.repeated for index in images))

    def _images(self, index: int) -> Sequence[np.ndarray]:
        messages = self._bag.fetch([stream.index.entries[stream.members[index]] for stream in self._streams])
        return [decode_message(self._where(k, index), message) for k, message in enumerate(messages)]

    def _masks(self, index: int) -> Sequence[np.ndarray]:
        if self._folder is not None:
            return [self._folder.read(k, index) for k in range(len(self.rig))]
        messages = self._bag.fetch([stream.index.entries[stream.members[index]] for stream in self._mask_streams])
        masks = [decode_message(f"{self._where(k, index)}, its mask", m) for k, m in enumerate(messages)]
        for k, mask in enumerate(masks):
            if mask.ndim != 2:
                raise DatasetError(f"{self._where(k, index)}, its mask: in colour; a mask is mono8, 255 * P(dynamic)")
        return masks

    def _where(self, camera: int, index: int) -> str:
        stream = self._streams[camera]
        entry = stream.index.entries[stream.members[index]]
        return f"{self.path}: {entry.topic} at {_stamp_name(entry.stamp)}"


def _stamp_name(nanoseconds: int) -> str:
    return f"{nanoseconds:019d}"  # one length, so that names sort by time


def _image_topics(bag: Bag, cameras: Sequence[Camera], topics: str | None, rig_file: Path) -> list[str]:
    if topics is not None:
        return [_there(bag, topic, "--topics names") for topic in _listed(topics, cameras, "--topics")]
    for camera in cameras:
        if camera.topic is None:
            raise DatasetError(
                f"{rig_file}: names no rostopic for {camera.name}; add it, or say --topics TOPIC,TOPIC,... in the "
                f"order of its cameras; {_image_topics_there(bag)}"
            )
    return [_there(bag, str(camera.topic), f"{rig_file} names") for camera in cameras]


def _mask_topics(bag: Bag, cameras: Sequence[Camera], masks: str | None) -> list[str]:
    if masks is None or not masks.startswith(MASK_TOPICS):
        return []
    listed = _listed(masks.removeprefix(MASK_TOPICS), cameras, f"--masks {MASK_TOPICS}")
    return [_there(bag, topic, "--masks names") for topic in listed]


def _listed(topics: str, cameras: Sequence[Camera], option: str) -> list[str]:
    """One topic per camera from "a,b,c" or "/{}/image"."""
    listed = [topic.strip() for topic in topics.split(",") if topic.strip()]
    if len(listed) == 1 and "{}" in listed[0]:
        return [listed[0].replace("{}", camera.name) for camera in cameras]
    if len(listed) != len(cameras) or len(set(listed)) < len(listed):
        raise DatasetError(
            f"{option}: give {len(cameras)} different topics with commas between them, in the order of the rig's "
            f"cameras, or one with {{}} for the camera's name; not {topics!r}"
        )
    return listed


def _there(bag: Bag, topic: str, who: str) -> str:
    """The bag's name of an image topic: as it is, with a leading slash, or with /compressed behind it."""
    base = "/" + topic.strip("/")
    for name in (topic, base, base[1:], f"{base}/compressed", f"{base[1:]}/compressed"):
        if bag.topics.get(name) in IMAGE_TYPES:
            return name
    kind = bag.topics.get(base) or bag.topics.get(base[1:])
    problem = f"is of type {kind}, not an image" if kind else "is not in the bag"
    raise DatasetError(
        f"{bag.path}: {who} {topic}, which {problem}; {_image_topics_there(bag)}: choose with --topics or --masks "
        f"{MASK_TOPICS}..., or mend rostopic in the rig"
    )


def _image_topics_there(bag: Bag) -> str:
    images = sorted(topic for topic, kind in bag.topics.items() if kind in IMAGE_TYPES)
    if images:
        return f"the bag has the images {', '.join(images)}"
    others = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.topics.items())) or "nothing"
    return f"the bag has no sensor_msgs/Image or CompressedImage, but {others}"


def _filled(path: Path, indices: Sequence[TopicIndex], topics: Sequence[str]) -> list[TopicIndex]:
    for index, topic in zip(indices, topics, strict=True):
        if not len(index.stamps):
            raise DatasetError(f"{path}: {topic} has no messages; was the camera on? record again, or name another")
    return list(indices)


def _repeated(indices: Sequence[TopicIndex], topics: Sequence[str]) -> tuple[Dropped, ...]:
    return tuple(
        Dropped(index.repeated, f"{topic} has another image with the same time stamp")
        for index, topic in zip(indices, topics, strict=True)
        if index.repeated
    )


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """For each of `wanted` the index of the nearest of ascending `times`."""
    return np.searchsorted(times[:-1] + np.diff(times) // 2, wanted)


def _with_masks(
    path: Path,
    names: Sequence[str],
    images: Sequence[TopicIndex],
    members: np.ndarray,
    masks: Sequence[TopicIndex],
    tolerance: int,
) -> tuple[np.ndarray, tuple[Dropped, ...]]:
    """The frames that have a mask of every camera within `tolerance` ns of its image."""
    lacking = np.zeros(members.shape, bool)
    for k, (image, mask) in enumerate(zip(images, masks, strict=True)):
        times = image.stamps[members[:, k]]
        lacking[:, k] = abs(mask.stamps[_nearest(mask.stamps, times)] - times) > tolerance
    whole = ~lacking.any(axis=1)
    if not whole.any():
        raise DatasetError(f"{path}: no frame has masks within {tolerance / 1e6:g} ms of its images; see --tolerance")
    incomplete = int((~whole).sum())
    without = [name for k, name in enumerate(names) if lacking[:, k].any()]
    reason = f"{incomplete} frames lack a mask of {', '.join(without)} within {tolerance / 1e6:g} ms"
    return members[whole], (Dropped(incomplete * len(names), reason),) if incomplete else ()


def _mask_streams(images: Sequence[TopicIndex], members: np.ndarray, masks: Sequence[TopicIndex]) -> list[_Stream]:
    return [
        _Stream(mask, _nearest(mask.stamps, image.stamps[members[:, k]]))
        for k, (image, mask) in enumerate(zip(images, masks, strict=True))
    ]
