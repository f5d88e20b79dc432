"""Bags whose topics carry H.264 and H.265, made by PyAV and rosbags."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("rosbags")

import av
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bags import KINDS, START, _writer
from seepast import cli
from seepast.datasets import open_dataset
from seepast.errors import DatasetError, MissingExtraError
from seepast.rig import Rig

SIZE = (96, 64)
FRAMES, PERIOD, KEY_EVERY = 10, 50_000_000, 4
TYPE, PACKET = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
FIELDS = {
    TYPE: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    PACKET: "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
    "bool is_bigendian\nuint8[] data\n",
}
STAMPS = [str(START + n * PERIOD) for n in range(FRAMES)]


def picture(camera: int, frame: int) -> np.ndarray:
    """A bright bar that moves, so that every frame differs, before something smooth."""
    ramp = np.linspace(40, 120, SIZE[0])[None, :, None] + 20 * np.arange(3) + 5 * camera
    image = np.broadcast_to(ramp, (SIZE[1], SIZE[0], 3)).astype(np.uint8).copy()
    image[:, 8 * frame : 8 * frame + 6] = 230
    return image


def encoded(camera: int, codec: str = "libx264") -> list[bytes]:
    """One packet per frame, a key frame every KEY_EVERY, no B-frames."""
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = *SIZE, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 20), Fraction(20)
    kind = "x264-params" if codec == "libx264" else "x265-params"
    parameters = f"keyint={KEY_EVERY}:min-keyint={KEY_EVERY}:scenecut=0:bframes=0:repeat-headers=1:log-level=none"
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "10", kind: parameters}
    packets = []
    for n in range(FRAMES):
        frame = av.VideoFrame.from_ndarray(picture(camera, n), format="bgr24")
        frame.pts = n
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    assert len(packets) == FRAMES
    return [bytes(packet) for packet in packets]


def make(
    folder: Path, kind: str, streams: Sequence[Sequence[bytes | None]], form: str = "h264", of: str = TYPE
) -> Path:
    """A bag of one topic per camera; None: that message was lost."""
    folder.mkdir(exist_ok=True)
    Rig.linear(len(streams), focal=96.0, spacing=0.1, size=SIZE).to_kalibr(folder / "rig.yaml")
    store: Any = get_typestore(Stores.ROS1_NOETIC if kind == "rosbag1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(FIELDS[of], of))
    path = folder / ("walk.bag" if kind == "rosbag1" else "walk")
    with _writer(path, kind, "") as writer:
        serialize = store.serialize_ros1 if kind == "rosbag1" else store.serialize_cdr
        names = [f"/cam{k}/image_raw/{of.partition('_')[0]}" for k in range(len(streams))]
        topics = [writer.add_connection(name, of, typestore=store) for name in names]
        for n in range(FRAMES):
            for k, packets in enumerate(streams):
                if packets[n] is None:
                    continue
                stamp = START + n * PERIOD + k * 1_000_000
                time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
                data = np.frombuffer(packets[n], np.uint8)
                if of == TYPE:
                    message = store.types[of](timestamp=time, frame_id="camera", data=data, format=form)
                else:
                    number = {"seq": 0} if kind == "rosbag1" else {}
                    header = store.types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **number)
                    message = store.types[of](header, *SIZE, form, n, 0, False, data)
                writer.write(topics[k], stamp + 2_000_000, serialize(message, of))
    return path


def check(image: np.ndarray, camera: int, frame: int) -> None:
    error = abs(image.astype(int) - picture(camera, frame)).mean()
    others = [abs(image.astype(int) - picture(camera, n)).mean() for n in range(FRAMES) if n != frame]
    assert image.shape == (SIZE[1], SIZE[0], 3) and error < 4 and error < 0.5 * min(others)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_decoded_in_order_and_out_of_order(kind: str, tmp_path: Path) -> None:
    dataset = open_dataset(make(tmp_path / "r", kind, [encoded(k) for k in range(3)]), masks="none")
    assert list(dataset.stamps) == STAMPS and not dataset.dropped
    forward = {frame.stamp: frame.images for frame in dataset}
    for n, stamp in enumerate(STAMPS):
        for k in range(3):
            check(forward[stamp][k], k, n)
    for n in (9, 2, 3, 3, 0, 6):
        for k, image in enumerate(dataset.frame(STAMPS[n]).images):
            np.testing.assert_array_equal(image, forward[STAMPS[n]][k])


def test_h265(tmp_path: Path) -> None:
    dataset = open_dataset(
        make(tmp_path / "r", "mcap", [encoded(k, "libx265") for k in range(2)], "h265"), masks="none"
    )
    for n in (7, 1):
        check(dataset.frame(STAMPS[n]).images[1], 1, n)


@pytest.mark.parametrize("encoding", ["libx264", "h264;yuv420p;bgr8;bgr8"])
@pytest.mark.parametrize("kind", KINDS[::2])
def test_packets_of_ffmpeg_image_transport(kind: str, encoding: str, tmp_path: Path) -> None:
    bag = make(tmp_path / "r", kind, [encoded(k) for k in range(2)], encoding, PACKET)
    dataset = open_dataset(bag, masks="none")
    assert list(dataset.stamps) == STAMPS
    for n in (6, 7, 2):
        check(dataset.frame(STAMPS[n]).images[1], 1, n)


def test_what_lies_before_a_key_frame_is_dropped_and_counted(tmp_path: Path) -> None:
    streams = [encoded(k) for k in range(2)]
    streams[1] = [None, *streams[1][1:]]  # type: ignore[list-item]
    dataset = open_dataset(make(tmp_path / "r", "mcap", streams), masks="none")
    assert list(dataset.stamps) == STAMPS[KEY_EVERY:]
    reasons = {str(dropped) for dropped in dataset.dropped}
    assert "3 images: /cam1/image_raw/foxglove has them before its first key frame" in reasons
    check(dataset.frame(STAMPS[KEY_EVERY]).images[1], 1, KEY_EVERY)


def test_frames_that_other_cameras_lack_are_still_decoded(tmp_path: Path) -> None:
    streams: list[list[bytes | None]] = [list(encoded(k)) for k in range(2)]
    streams[0][5] = streams[0][6] = streams[0][7] = None  # to its next key frame
    dataset = open_dataset(make(tmp_path / "r", "sqlite3", streams), masks="none")
    assert list(dataset.stamps) == STAMPS[:5] + STAMPS[8:]
    for stamp in dataset.stamps:
        check(dataset.frame(stamp).images[1], 1, STAMPS.index(stamp))


def test_a_run_on_video_topics(tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "mcap", [encoded(k) for k in range(3)])
    words = ["--masks", "none", "--preset", "paper", "--set", "range.max_disparity=12"]
    assert cli.main(["run", str(bag), "--out", str(tmp_path / "out"), *words]) == 0
    assert len(list((tmp_path / "out" / "background").glob("*.png"))) == FRAMES
    check(cv2.imread(str(tmp_path / "out" / "background" / f"{STAMPS[4]}.png")), 0, 4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: [p[0], b"\0\0\0\1\x65nonsense", *p[2:]], "cannot be decoded|no whole picture"),
        (lambda p: [p[0], b"", *p[2:]], "no whole picture"),
    ],
)
def test_what_cannot_be_decoded_is_named(change: Any, words: str, tmp_path: Path) -> None:
    bag = make(tmp_path / "r", "mcap", [change(encoded(0)), encoded(1)])
    with pytest.raises(DatasetError, match=rf"/cam0/image_raw/foxglove at {STAMPS[1]}: .*({words})"):
        open_dataset(bag, masks="none").frame(STAMPS[1])


def test_other_formats_and_a_missing_extra_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = make(tmp_path / "r", "mcap", [encoded(k) for k in range(2)], "theora")
    with pytest.raises(DatasetError, match="video format 'theora' is not known; record H"):
        open_dataset(bag, masks="none").frame(STAMPS[0])
    with pytest.raises(DatasetError, match=r"--masks names /cam0/image_raw.* is of type foxglove_msgs/msg/Compressed"):
        open_dataset(bag, masks="topics:/{}/image_raw/foxglove")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"seepast\[h264\]"):
        open_dataset(bag, masks="none")
