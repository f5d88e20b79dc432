"""What a run is in ROS: topics, frames and messages, the same in bags of ROS 1 and ROS 2.

All messages of one instant carry the same stamp. Topics, with the encoding of their images:

    /seepast/background/image_rect     bgr8 or mono8          frame <reference>_rect
    /seepast/background/camera_info    K, P of that view, R identity, D zero
    /seepast/depth/image_rect          32FC1 metres, NaN unknown (REP 118); or
    /seepast/depth/image_rect_raw      16UC1 millimetres, 0 unknown
    /seepast/depth/camera_info         the same CameraInfo
    /seepast/disparity                 stereo_msgs/DisparityImage: px over the array, 0 unknown; f, and T the baseline
    /seepast/farthest/camera_info      the camera the baseline reaches to: P = K [I | -position], as a right camera's
    /seepast/coverage/image_rect       mono8, how many cameras saw the pixel; 0 = a guess
    /seepast/confidence/image_rect     32FC1 in 0..1, where the run wrote one
    /seepast/masks/<camera>/image      mono8, 255 * P(dynamic)     frame <camera>, its own pixels, not rectified

<reference>_rect has the axes of REP 103's optical frames: x right, y down, z forward. Where the view needed no rotation
it is the reference camera's own optical frame; otherwise rectified_from_cam in camera.yaml turns one into the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ..extras import require
from .folder import depth_millimetres
from .protocol import METRES, ExportOptions
from .reading import View, Written

NAMESPACE = "/seepast"


def record(
    bag: Any,
    serialize: Callable[[Any, str], Any],
    messages: Messages,
    view: View,
    frames: Iterable[tuple[int, Written]],
    options: ExportOptions,
) -> None:
    """Write all frames to an open rosbags Writer; a message's time in the bag is its stamp."""
    connections: dict[str, Any] = {}
    for time, frame in frames:
        for topic, message in messages.of(view, time, frame, options):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=messages.store)
            bag.write(connections[topic], time, serialize(message, kind))


class Messages:
    """Makes the messages of a frame from the message types of one ROS, a typestore of rosbags.

    ros1  ROS 1 spells some fields in capitals and numbers its headers
    """

    def __init__(self, store: Any, *, ros1: bool):
        self.store = store
        self._ros1 = ros1
        self._sequence = 0

    def of(self, view: View, time: int, frame: Written, options: ExportOptions) -> Iterator[tuple[str, Any]]:
        """(topic, message) of everything that a frame holds."""
        header = self.header(time, f"{view.camera}_rect")
        info = self.camera_info(header, view, np.zeros(3))
        depth, name = frame.depth, "image_rect"
        depth = np.where(depth > 0, depth, np.float32(np.nan))
        if options.depth != METRES:
            depth, name = depth_millimetres(frame.depth), "image_rect_raw"
        yield f"{NAMESPACE}/background/image_rect", self.image(header, frame.background)
        yield f"{NAMESPACE}/background/camera_info", info
        yield f"{NAMESPACE}/depth/{name}", self.image(header, depth)
        yield f"{NAMESPACE}/depth/camera_info", info
        yield f"{NAMESPACE}/disparity", self.disparity(header, view, frame.disparity)
        yield f"{NAMESPACE}/farthest/camera_info", self.camera_info(header, view, view.positions[view.farthest])
        yield f"{NAMESPACE}/coverage/image_rect", self.image(header, frame.coverage)
        if frame.confidence is not None:
            yield f"{NAMESPACE}/confidence/image_rect", self.image(header, frame.confidence)
        for camera, mask in frame.masks.items():
            yield f"{NAMESPACE}/masks/{camera}/image", self.image(self.header(time, camera), mask)
        self._sequence += 1

    def header(self, time: int, frame_id: str) -> Any:
        """std_msgs/Header; time in nanoseconds."""
        stamp = self._make("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
        sequence = {"seq": self._sequence} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **sequence)

    def image(self, header: Any, pixels: np.ndarray) -> Any:
        """sensor_msgs/Image of uint8 [H, W, 3] BGR, or [H, W] of uint8, uint16 or float32."""
        encoding = {"u1": "mono8", "u2": "16UC1", "f4": "32FC1"}[pixels.dtype.str[1:]]
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False))
        return self._make(
            "sensor_msgs/msg/Image",
            header=header,
            height=height,
            width=width,
            encoding="bgr8" if pixels.ndim == 3 else encoding,
            is_bigendian=0,
            step=data.strides[0],
            data=data.reshape(-1).view(np.uint8),
        )

    def camera_info(self, header: Any, view: View, position: np.ndarray) -> Any:
        """sensor_msgs/CameraInfo of a pinhole with the view's axes and K, at `position` (metres) in it.

        P = K [I | -position] projects points of the view's frame, as the message's definition asks of the right
        camera of a stereo pair; for the view itself the last column is 0.
        """
        projection = view.matrix @ np.column_stack([np.eye(3), -position])
        matrices = {"d": np.zeros(5), "k": view.matrix.ravel(), "r": np.eye(3).ravel(), "p": projection.ravel()}
        if self._ros1:
            matrices = {name.upper(): values for name, values in matrices.items()}
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=view.size[1],
            width=view.size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self._region(0, 0),
            **matrices,
        )

    def disparity(self, header: Any, view: View, disparity: np.ndarray) -> Any:
        """stereo_msgs/DisparityImage: Z = f T / d; 0 = unknown lies below min_disparity, so it has no depth."""
        known = disparity[disparity > 0]
        smallest, largest = (known.min(), known.max()) if known.size else (1, 1)
        return self._make(
            "stereo_msgs/msg/DisparityImage",
            header=header,
            image=self.image(header, disparity),
            f=view.focal[0],
            **{"T" if self._ros1 else "t": view.baseline},
            valid_window=self._region(*view.size),
            min_disparity=float(smallest),
            max_disparity=float(largest),
            delta_d=0.0,
        )

    def _region(self, width: int, height: int) -> Any:
        kind = "sensor_msgs/msg/RegionOfInterest"
        return self._make(kind, x_offset=0, y_offset=0, height=height, width=width, do_rectify=False)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)


def typestore(name: str, purpose: str) -> Any:
    """A typestore of rosbags, "ROS1_NOETIC" or "ROS2_HUMBLE". Raises MissingExtraError without the package rosbags."""
    typesys = require("rosbags.typesys", "rosbag", purpose)
    return typesys.get_typestore(typesys.Stores[name])
