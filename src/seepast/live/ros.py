"""The transport of a ROS 2 installation: an rclpy node named seepast."""

from __future__ import annotations

import array
import threading
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
import sensor_msgs.msg
from builtin_interfaces.msg import Time
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Header

from .messages import CameraInfo, CompressedImage, Image, Message
from .transport import DEPTH, Deliver, Publish

SECOND = 10**9  # ns

_TYPES = {
    Image: sensor_msgs.msg.Image,
    CompressedImage: sensor_msgs.msg.CompressedImage,
    CameraInfo: sensor_msgs.msg.CameraInfo,
}


class RosTransport:
    """See Transport. The domain and the middleware are those of the environment (ROS_DOMAIN_ID, RMW_IMPLEMENTATION)."""

    name = "rclpy"

    def __init__(self, reliable: bool = False):
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)  # signals are the command's
        self._node = rclpy.create_node("seepast")
        self._reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="seepast ros", daemon=True)

    def subscribe(self, topic: str, kind: type, deliver: Deliver) -> None:
        quality = _quality(self._reliability, DEPTH)
        self._node.create_subscription(_TYPES[kind], topic, lambda given: deliver(_received(kind, given)), quality)

    def advertise(self, topic: str, kind: type) -> Publish:
        publisher = self._node.create_publisher(_TYPES[kind], topic, _quality(ReliabilityPolicy.RELIABLE, 1))

        def publish(message: Message) -> bool:
            publisher.publish(_sent(message))
            return True

        return publish

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._executor.shutdown()
        with suppress(RuntimeError):  # never started
            self._thread.join()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()


def _quality(reliability: Any, depth: int) -> Any:
    return QoSProfile(
        reliability=reliability,
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        durability=DurabilityPolicy.VOLATILE,
    )


def _received(kind: type, given: Any) -> Image | CompressedImage:
    """A received ROS message of images as ours; its data is an array.array, of which this is a view."""
    stamp, frame_id = given.header.stamp.sec * SECOND + given.header.stamp.nanosec, given.header.frame_id
    data = np.frombuffer(given.data, np.uint8)
    if kind is CompressedImage:
        return CompressedImage(stamp, frame_id, given.format, data)
    return Image(stamp, frame_id, given.height, given.width, given.encoding, given.step, data, int(given.is_bigendian))


def _sent(message: Message) -> Any:
    """Ours as a ROS message. Anything but an array.array would be checked number by number."""
    sent = _TYPES[type(message)]()
    stamp = Time(sec=message.stamp // SECOND, nanosec=message.stamp % SECOND)
    sent.header = Header(stamp=stamp, frame_id=message.frame_id)
    for name, value in vars(message).items():
        if name in ("stamp", "frame_id"):
            continue
        if name == "data":
            pixels: np.ndarray = value
            value = array.array("B")
            value.frombytes(pixels.data)
        setattr(sent, name, list(value) if isinstance(value, tuple) else value)
    return sent
