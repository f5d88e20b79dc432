"""ROS 2 messages over CycloneDDS without any of seepast's own code: types declared here, bytes made by rosbags.

As a program it is the cameras of an array, in a process of their own:

    python tests/ros_wire.py RECORDING --hz 20 --seconds 3 --lose cam1:4 --masks masks
"""

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from cyclonedds.core import Policy
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore

STORE: Any = get_typestore(Stores.ROS2_HUMBLE)
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)
os.environ["CYCLONEDDS_URI"] = LOOPBACK  # read with the first participant, here and in processes that are started
DOMAIN = 100 + os.getpid() % 100  # that two test runs on one machine do not meet
SKEW = 1_000_000  # ns between the stamps of neighbouring cameras


class _Bytes:
    """Samples hold the bytes that rosbags made, and received ones become what rosbags reads in theirs."""

    def __init__(self, kind: str):
        self.kind = kind

    def __call__(self, cls: Any) -> Any:
        cls.serialize = lambda self, *_, **__: self.cdr
        cls.deserialize = staticmethod(lambda data, *_, **__: _Received(STORE.deserialize_cdr(data, self.kind)))
        cls.deserialize_key = staticmethod(lambda *_, **__: None)
        TYPES[self.kind] = cls
        return cls


@dataclass
class _Received:
    message: Any


TYPES: dict[str, Any] = {}


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Region(IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"):
    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@_Bytes(IMAGE)
@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@_Bytes(COMPRESSED)
@dataclass
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    header: Header
    format: str
    data: sequence[uint8]


@_Bytes(INFO)
@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"):
    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: array[float64, 9]
    r: array[float64, 9]
    p: array[float64, 12]
    binning_x: uint32
    binning_y: uint32
    roi: Region


def header(stamp: int, frame_id: str) -> Any:
    time_type, header_type = (STORE.types[f"{name}"] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    return header_type(stamp=time_type(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame_id)


def image(stamp: int, frame_id: str, pixels: np.ndarray, encoding: str) -> Any:
    return STORE.types[IMAGE](
        header=header(stamp, frame_id), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
        is_bigendian=0, step=pixels.strides[0], data=pixels.reshape(-1).view(np.uint8),
    )  # fmt: skip


def compressed(stamp: int, frame_id: str, pixels: np.ndarray) -> Any:
    data = cv2.imencode(".png", pixels)[1].ravel()
    return STORE.types[COMPRESSED](header=header(stamp, frame_id), format="bgr8; png compressed", data=data)


def pixels_of(message: Any) -> np.ndarray:
    kind, channels = {"bgr8": (np.uint8, 3), "mono8": (np.uint8, 1), "32FC1": (np.float32, 1)}[message.encoding]
    shape = (message.height, message.width, 3)[: 2 + (channels == 3)]
    return message.data.view(kind).reshape(shape)


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Ros:
    """A participant as a ROS 2 node would be one."""

    def __init__(self, domain: int):
        self._participant = DomainParticipant(domain)
        self._quality = Qos(
            Policy.Reliability.Reliable(10**8),
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )

    def writer(self, topic: str, kind: str) -> Any:
        writer = DataWriter(self._participant, self._topic(topic, kind), self._quality)

        def write(message: Any) -> None:
            sample = TYPES[kind].__new__(TYPES[kind])
            sample.cdr = bytes(STORE.serialize_cdr(message, kind))
            writer.write(sample)

        return SimpleNamespace(write=write, matched=lambda: len(writer.get_matched_subscriptions()))

    def reader(self, topic: str, kind: str) -> Any:
        reader = DataReader(self._participant, self._topic(topic, kind), self._quality)
        return lambda: [sample.message for sample in reader.take(100) if isinstance(sample, _Received)]

    def _topic(self, topic: str, kind: str) -> Any:
        return Topic(self._participant, f"rt{topic}", TYPES[kind])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--hz", type=float, default=20)
    parser.add_argument("--seconds", type=float, default=3)
    parser.add_argument("--masks", help="folder of masks, published as /<camera>/mask")
    parser.add_argument("--compressed", action="store_true")
    parser.add_argument("--lose", help="cam1:4 loses every fourth image of cam1")
    arguments = parser.parse_args()
    ros, writers = Ros(int(os.environ.get("ROS_DOMAIN_ID", "0"))), []
    loser, _, every = (arguments.lose or ":0").partition(":")
    for k, folder in enumerate(sorted(arguments.recording.glob("cam*"))):
        picture = cv2.imread(str(next(folder.glob("*.png"))), cv2.IMREAD_UNCHANGED)
        writers.append((k, folder.name, *_writer(ros, folder.name, picture, arguments.compressed)))
        if arguments.masks:
            mask = cv2.imread(str(next((arguments.recording / arguments.masks / folder.name).glob("*.png"))), 0)
            topic = f"/{folder.name}/mask"
            writers.append(
                (k, folder.name + " mask", ros.writer(topic, IMAGE), lambda s, f, m=mask: image(s, f, m, "mono8"))
            )
    while not all(writer.matched() for _, _, writer, _ in writers):
        time.sleep(0.02)
    start = time.monotonic()
    for tick in range(round(arguments.hz * arguments.seconds)):
        time.sleep(max(0.0, start + tick / arguments.hz - time.monotonic()))
        stamp = time.time_ns()
        for k, name, writer, make in writers:
            if not (name == loser and tick % int(every) == int(every) - 1):
                writer.write(make(stamp + k * SKEW, f"{name.split()[0]}_optical"))
    print(f"{tick + 1} ticks in {time.monotonic() - start:.1f} s", flush=True)
    time.sleep(0.5)  # what is on its way is sent again if it was lost


def _writer(ros: Ros, name: str, picture: np.ndarray, as_png: bool) -> tuple[Any, Any]:
    if as_png:
        return ros.writer(f"/{name}/image_raw/compressed", COMPRESSED), lambda s, f: compressed(s, f, picture)
    encoding = "bgr8" if picture.ndim == 3 else "mono8"
    return ros.writer(f"/{name}/image_raw", IMAGE), lambda s, f: image(s, f, picture, encoding)


if __name__ == "__main__":
    main()
