"""Which topic of a bag shows which camera, or its masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import DatasetError
from ..rig import Camera
from .bag import IMAGE_TYPES, STILL_TYPES, Bag

TRANSPORTS = ("compressed", "foxglove", "ffmpeg")  # what those of image_transport put behind the topic
MASK_TOPICS = "topics:"  # the masks argument begins so where masks are messages, too


def image_topics(bag: Bag, cameras: Sequence[Camera], topics: str | None, rig_file: Path) -> list[str]:
    """The bag's names of the image topics in the order of `cameras`: `topics`, or else the rostopic of each.

    Raises DatasetError, naming the image topics that there are.
    """
    who = "--topics names" if topics is not None else f"{rig_file} names"
    wanted = topics_of(cameras, topics, rig_file, f"; {_image_topics_there(bag)}")
    return [_there(bag, topic, who) for topic in wanted]


def topics_of(cameras: Sequence[Camera], topics: str | None, rig_file: Path, hint: str = "") -> list[str]:
    """The image topics that are wanted, in the order of `cameras`: `topics`, or else the rostopic of each.

    Raises DatasetError, with `hint` at its end, where there are none.
    """
    if topics is not None:
        return listed(topics, cameras, "--topics")
    for camera in cameras:
        if camera.topic is None:
            raise DatasetError(
                f"{rig_file}: names no rostopic for {camera.name}; add it, or say --topics TOPIC,TOPIC,... in the "
                f"order of its cameras{hint}"
            )
    return [str(camera.topic) for camera in cameras]


def mask_topics(bag: Bag, cameras: Sequence[Camera], masks: str | None) -> list[str]:
    """Likewise for masks, "topics:" and the topics; none for masks that lie elsewhere."""
    if masks is None or not masks.startswith(MASK_TOPICS):
        return []
    wanted = listed(masks.removeprefix(MASK_TOPICS), cameras, f"--masks {MASK_TOPICS}")
    return [_there(bag, topic, "--masks names", STILL_TYPES) for topic in wanted]


def listed(topics: str, cameras: Sequence[Camera], option: str) -> list[str]:
    """One topic per camera from "a,b,c" or "/{}/image". Raises DatasetError, naming `option`."""
    names = [topic.strip() for topic in topics.split(",") if topic.strip()]
    if len(names) == 1 and "{}" in names[0]:
        return [names[0].replace("{}", camera.name) for camera in cameras]
    if len(names) != len(cameras) or len(set(names)) < len(names):
        raise DatasetError(
            f"{option}: give {len(cameras)} different topics with commas between them, in the order of the rig's "
            f"cameras, or one with {{}} for the camera's name; not {topics!r}"
        )
    return names


def _there(bag: Bag, topic: str, who: str, kinds: Sequence[str] = IMAGE_TYPES) -> str:
    """The bag's name of an image topic: as it is, with or without its leading slash, with the name of a transport
    behind it."""
    base = "/" + topic.strip("/")
    variants = [base, base[1:], *(f"{b}/{transport}" for transport in TRANSPORTS for b in (base, base[1:]))]
    for name in (topic, *variants):
        if bag.topics.get(name) in kinds:
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
    return f"the bag has no sensor_msgs/Image, CompressedImage or video, but {others}"
