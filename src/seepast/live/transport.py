"""What a middleware must do for `seepast serve`, and which one is there."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable
from typing import Any, Protocol

from ..errors import OptionsError, TransportError
from ..extras import require
from .messages import Message

log = logging.getLogger("seepast")

DEPTH = 8  # messages of one topic that wait for the thread that takes them

Deliver = Callable[[Any], None]
Publish = Callable[[Message], bool]


class Transport(Protocol):
    """A connection to a running ROS 2 system. Topics are ROS names: "/cam0/image_raw".

    name       for people
    subscribe  `deliver` is called, from a thread of the transport, with every message of `kind` (a class of
               messages.py) on the topic. Quality of service: volatile, keep last DEPTH, and best effort, which gets on
               with every publisher, or reliable
    advertise  returns what publishes a message of `kind`: True, or False where it was not taken in time. Reliable,
               volatile, keep last 1: gets on with every subscriber
    start      deliver from now on; close   end, deliver nothing any more

    Raise TransportError.
    """

    name: str

    def subscribe(self, topic: str, kind: type, deliver: Deliver) -> None: ...

    def advertise(self, topic: str, kind: type) -> Publish: ...

    def start(self) -> None: ...

    def close(self) -> None: ...


def open_transport(name: str = "auto", *, reliable: bool = False) -> Transport:
    """The transport "rclpy" or "dds"; "auto": rclpy where a ROS 2 of this Python is there, else dds.

    Both live in the ROS domain of the environment, ROS_DOMAIN_ID. Raises TransportError, OptionsError, and
    MissingExtraError where neither ROS 2 nor the package cyclonedds is there.
    """
    missing = _missing_ros() if name in ("auto", "rclpy") else None
    if name == "rclpy" and missing is not None:
        raise TransportError(
            f"--transport rclpy: ROS 2 cannot be imported ({missing}): source its setup.bash, with the Python that "
            "this ROS 2 is built for; or leave the option out and pip install 'seepast[dds]'"
        )
    if name != "dds" and missing is None:
        from .ros import RosTransport

        return RosTransport(reliable)
    if name == "auto":
        log.debug("no rclpy (%s): CycloneDDS speaks for itself", missing)
    require("cyclonedds.domain", "dds", "seepast serve without ROS 2")
    from .dds import DdsTransport

    return DdsTransport(domain_of_environment(), reliable)


def domain_of_environment() -> int:
    """ROS_DOMAIN_ID, 0 if not set. Raises OptionsError."""
    word = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not word.isdecimal() or int(word) > 232:  # DDSI-RTPS: with more, port numbers run out
        raise OptionsError(f"ROS_DOMAIN_ID={word}: set it to a number from 0 to 232, the same on all machines")
    return int(word)


def _missing_ros() -> Exception | None:
    """Why ROS 2 cannot be used; None: it can."""
    try:
        importlib.import_module("rclpy")
        importlib.import_module("sensor_msgs.msg")
    except Exception as error:  # a ROS 2 of another Python fails in ways of its own
        return error
    return None
