"""The ROS 2 message types that `seepast serve` speaks, as IDL types with the names that ROS 2 gives them in DDS.

Declared so that types match, name and structure; the bytes are cdr.py's. Needs the extra dds.
"""

# mypy: disable-error-code="type-arg,valid-type,misc"

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32

from . import cdr, messages

# No "from __future__ import annotations" here: IdlStruct looks at the annotations.


TYPES: dict[type, Any] = {}  # of messages.py -> the IDL type that carries it


def _carries(kind: type) -> Callable[[type], type]:
    """Makes samples of an IDL type carry a message in their attribute `message`, and received ones be one."""

    def change(carrier: Any) -> Any:
        carrier.serialize = lambda self, *_, **__: cdr.encode(self.message)
        carrier.deserialize = staticmethod(lambda data, *_, **__: cdr.decode(kind, data))
        carrier.deserialize_key = staticmethod(lambda *_, **__: None)  # what says that a publisher has gone
        TYPES[kind] = carrier
        return carrier

    return change


def sample(message: messages.Message) -> Any:
    """What a DataWriter writes."""
    carrier = TYPES[type(message)]
    made = carrier.__new__(carrier)
    made.message = message
    return made


@dataclass
class Time_(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):  # noqa: N801
    sec: int32
    nanosec: uint32


@dataclass
class Header_(IdlStruct, typename="std_msgs::msg::dds_::Header_"):  # noqa: N801
    stamp: Time_
    frame_id: str


@dataclass
class RegionOfInterest_(  # noqa: N801
    IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"
):
    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@_carries(messages.Image)
@dataclass
class Image_(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):  # noqa: N801
    header: Header_
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@_carries(messages.CompressedImage)
@dataclass
class CompressedImage_(  # noqa: N801
    IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"
):
    header: Header_
    format: str
    data: sequence[uint8]


@_carries(messages.CameraInfo)
@dataclass
class CameraInfo_(  # noqa: N801
    IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"
):
    header: Header_
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: array[float64, 9]
    r: array[float64, 9]
    p: array[float64, 12]
    binning_x: uint32
    binning_y: uint32
    roi: RegionOfInterest_
