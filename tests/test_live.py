"""The parts of the live path, without a network: bytes, instants, the queue, the server over a transport in memory."""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recordings import SIZE, write_recording
from seepast import cli
from seepast.errors import OptionsError, TransportError
from seepast.live import cdr, messages, transport
from seepast.live.figures import STALE, UNUSABLE
from seepast.live.grouper import CLOCK, LATE, NO_STAMP, WAITING, Grouper
from seepast.live.latest import Latest
from seepast.live.server import Inputs, Server
from seepast.options import Options
from seepast.rig import Rig
from seepast.sequence import Settings

MS = 1_000_000  # ns
START = 1_700_000_000 * 10**9
TOPICS = ("/a", "/b", "/c")


def image(stamp: int, value: int = 0, size: tuple[int, int] = SIZE, frame_id: str = "lens") -> messages.Image:
    return messages.image_message(stamp, frame_id, np.full((size[1], size[0], 3), value, np.uint8))


# ---------------------------------------------------------------- bytes


@pytest.fixture(scope="module")
def store() -> Any:
    typesys = pytest.importorskip("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def ros(store: Any, name: str, message: Any, **fields: Any) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=message.stamp // 10**9, nanosec=message.stamp % 10**9)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=message.frame_id)
    return store.types[f"sensor_msgs/msg/{name}"](header=header, **fields)


@pytest.mark.parametrize("frame_id", ["", "cam0", "cam0_optical"])
@pytest.mark.parametrize("pixels", [np.arange(30, dtype=np.uint8).reshape(2, 5, 3), np.float32([[1, np.nan, 3]])])
def test_images_have_the_bytes_that_ros_gives_them(store: Any, frame_id: str, pixels: np.ndarray) -> None:
    ours = messages.image_message(START + 7, frame_id, pixels)
    assert (ours.encoding, ours.step) == (("bgr8", 15) if pixels.ndim == 3 else ("32FC1", 12))
    fields = ("height", "width", "encoding", "is_bigendian", "step", "data")
    theirs = ros(store, "Image", ours, **{name: getattr(ours, name) for name in fields})
    expected = bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/Image"))
    assert cdr.encode(ours) == expected
    back = cdr.decode(messages.Image, expected)
    assert {**vars(back), "data": back.data.tobytes()} == {**vars(ours), "data": ours.data.tobytes()}


def test_big_endian_and_other_messages_are_read(store: Any) -> None:
    ours = messages.CompressedImage(START, "cam1", "jpeg", np.arange(9, dtype=np.uint8))
    theirs = ros(store, "CompressedImage", ours, format="jpeg", data=ours.data)
    for little in (True, False):
        data = bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/CompressedImage", little_endian=little))
        back = cdr.decode(messages.CompressedImage, data)
        assert (back.stamp, back.frame_id, back.format, back.data.tolist()) == (START, "cam1", "jpeg", list(range(9)))
    assert cdr.encode(ours) == bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/CompressedImage"))


@pytest.mark.parametrize("coefficients", [(), (0.1, 0.2, 0.0, 0.0, 0.5)])
def test_camera_info_has_the_bytes_that_ros_gives_it(store: Any, coefficients: tuple[float, ...]) -> None:
    ours = messages.CameraInfo(START, "cam0_rect", 36, 48, range(9), range(12), range(1, 10), coefficients)
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    matrices = {name: np.array(getattr(ours, name), np.float64) for name in "dkrp"}
    theirs = ros(
        store, "CameraInfo", ours, height=36, width=48, distortion_model="plumb_bob", binning_x=0, binning_y=0,
        roi=roi, **matrices,
    )  # fmt: skip
    assert cdr.encode(ours) == bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/CameraInfo"))
    back = cdr.decode(messages.CameraInfo, cdr.encode(ours))
    assert [list(getattr(back, name)) for name in "dkrp"] == [list(getattr(ours, name)) for name in "dkrp"]


# ---------------------------------------------------------------- instants


def fed(grouper: Grouper, *arrivals: tuple[int, int]) -> list[tuple[int, ...]]:
    """Stamps in ms of the instants that (stream, ms) arrivals complete."""
    found = [instant for stream, ms in arrivals for instant in grouper.add(stream, image(START + ms * MS))]
    return [tuple((message.stamp - START) // MS for message in instant) for instant in found]


def test_an_instant_is_complete_with_its_last_message_in_whatever_order() -> None:
    grouper = Grouper(TOPICS, 5 * MS)
    assert fed(grouper, (2, 1), (0, 0)) == []
    assert fed(grouper, (1, 2)) == [(0, 2, 1)]
    assert fed(grouper, (0, 50), (0, 100), (1, 100), (2, 100), (1, 50), (2, 50)) == [(100, 100, 100)]
    assert not grouper.dropped.keys() - {LATE, "several topics had nothing within 5 ms of them"}


def test_what_misses_its_partner_is_dropped_and_named() -> None:
    grouper = Grouper(TOPICS, 5 * MS)
    arrivals = [(k, 50 * tick) for tick in range(10) for k in range(3) if not (k == 1 and tick % 5 == 4)]
    assert [stamps[0] for stamps in fed(grouper, *arrivals)] == [0, 50, 100, 150, 250, 300, 350, 400]
    assert grouper.dropped == {"/b had nothing within 5 ms of them": 2}, "the last instant still waits"


def test_a_camera_that_is_off_costs_bounded_memory() -> None:
    grouper = Grouper(TOPICS, 5 * MS)
    assert fed(grouper, *((k, 50 * tick) for tick in range(100) for k in (0, 2))) == []
    assert grouper.dropped == {"/b had nothing within 5 ms of them": 2 * (100 - WAITING)}
    assert fed(grouper, (1, 99 * 50)) == [(99 * 50,) * 3]
    assert grouper.dropped == {"/b had nothing within 5 ms of them": 2 * 99}


def test_repeated_late_and_unstamped_messages_are_told_apart() -> None:
    grouper = Grouper(TOPICS, 5 * MS)
    assert fed(grouper, (0, 0), (0, 0), (1, 0), (2, 0), (2, 0), (1, -20)) == [(0, 0, 0)]
    assert grouper.add(0, image(0)) == [] and grouper.dropped == {LATE: 3, NO_STAMP: 1}


def test_a_clock_that_is_set_back_starts_again() -> None:
    grouper = Grouper(TOPICS, 5 * MS)
    assert fed(grouper, (0, 90_000), (1, 90_000), (2, 90_000), (0, 90_050)) == [(90_000,) * 3]
    assert fed(grouper, (0, 10), (1, 10), (2, 10)) == [(10,) * 3]
    assert grouper.dropped == {CLOCK: 1}


def test_the_newer_displaces_the_older() -> None:
    queue: Latest[int] = Latest(2)
    for item in range(5):
        queue.put(item)
    assert [queue.get(0), queue.get(0), queue.get(0.01)] == [3, 4, None] and queue.displaced == 3


# ---------------------------------------------------------------- the server


class Memory:
    """A transport whose other side is the test."""

    name = "memory"

    def __init__(self) -> None:
        self.deliver: dict[str, Callable[[Any], None]] = {}
        self.kinds: dict[str, type] = {}
        self.sent: list[tuple[str, Any]] = []
        self.takes = True
        self.on_start: Callable[[], None] = lambda: None

    def subscribe(self, topic: str, kind: type, deliver: Callable[[Any], None]) -> None:
        self.deliver[topic], self.kinds[topic] = deliver, kind

    def advertise(self, topic: str, kind: type) -> Callable[[Any], bool]:
        def publish(message: Any) -> bool:
            assert isinstance(message, kind)
            self.sent.append((topic, message))
            return self.takes

        return publish

    def start(self) -> None:
        self.on_start()

    def close(self) -> None: ...


RIG = Rig.linear(3, focal=float(SIZE[0]), spacing=0.1, size=SIZE)
PAPER = Settings(Options.preset("paper").updated({"range.max_disparity": 12}), threads=1)
IMAGES = ("/cam0/image_raw", "/cam1/image_raw", "/cam2/image_raw")


def instants(memory: Memory, count: int, make: Callable[[int], Any] = image, pause: float = 0.0) -> None:
    for tick in range(count):
        stamp = START + 50 * tick * MS
        for topic in IMAGES:
            memory.deliver[topic](make(stamp))
        time.sleep(pause)


def run_once(server: Server, seconds: float = 0.5, **words: Any) -> Any:
    return server.run(threading.Event(), seconds=seconds, **words)


def test_stale_instants_are_dropped_and_counted_never_queued() -> None:
    memory = Memory()
    seen: list[int] = []

    def slow(images: Any) -> Any:
        seen.append(int(images[0][0, 0, 0]))
        time.sleep(0.05)
        return [np.zeros(view.shape[:2], np.uint8) for view in images]

    server = Server(RIG, PAPER, memory, Inputs(IMAGES), segmenter=slow)  # type: ignore[arg-type]
    feeder = threading.Thread(target=instants, args=(memory, 60, lambda s: image(s, (s - START) // (50 * MS)), 0.01))
    reports: list[Any] = []
    memory.on_start = feeder.start
    report = run_once(server, 2.0, every=0.4, on_report=reports.append)
    assert report.images == 180 and report.frames == 60
    assert report.frames_dropped[STALE] + report.published == 60 and report.frames_dropped[STALE] > 20
    assert seen == sorted(seen) and seen[-1] == 59, "the newest is always next, and the last is not lost"
    assert report.latency_ms is not None and 50 <= report.latency_ms[0] < 700, "one instant waits at most"
    assert len(reports) >= 3 and sum(r.frames for r in reports) <= 60
    assert sum(r.frames_dropped.get(STALE, 0) for r in reports) <= report.frames_dropped[STALE]


def resident() -> float:
    """MB of this process."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs Linux's /proc")
def test_memory_does_not_grow_with_the_instants() -> None:
    """Each instant brings half a MB, so that one kept of every ten of them would show."""
    size = (240, 180)
    memory, told = Memory(), list[float]()
    server = Server(
        Rig.linear(3, focal=240.0, spacing=0.1, size=size), PAPER, memory, Inputs(IMAGES), namespace="seepast"
    )
    stop = threading.Event()

    def feed() -> None:
        for tick in range(460):
            for topic in IMAGES:
                memory.deliver[topic](image(START + 50 * tick * MS, size=size))
            end = time.monotonic() + 5
            while len(memory.sent) < 5 + len(IMAGES) and time.monotonic() < end:
                time.sleep(0.001)
            memory.sent.clear()
            if tick in (60, 459):
                told.append(resident())
        stop.set()

    memory.on_start = threading.Thread(target=feed).start
    report = server.run(stop, seconds=120)
    assert report.published >= 400 and len(told) == 2
    assert told[1] - told[0] < 12, f"{told[0]:.0f} MB after 60 instants, {told[1]:.0f} MB after 460"


def test_what_cannot_be_used_is_counted_and_told_once(caplog: pytest.LogCaptureFixture) -> None:
    memory = Memory()
    server = Server(RIG, PAPER, memory, Inputs(IMAGES), room=9)
    instants(memory, 3, lambda stamp: image(stamp, size=(SIZE[0], SIZE[1] - 2)))
    memory.deliver[IMAGES[0]](image(START + 10**9))
    memory.deliver[IMAGES[1]](image(START + 10**9))
    bad = image(START + 10**9)
    bad.encoding = "bayer_rggb32"
    memory.deliver[IMAGES[2]](bad)
    with caplog.at_level(logging.WARNING):
        report = run_once(server)
    assert report.frames_dropped == {UNUSABLE: 4} and report.published == 0 and not memory.sent
    told = [record.message for record in caplog.records]
    assert len(told) == 2 and "cam0 is 48x34, the rig says 48x36" in told[0] and "cam2: encoding bayer" in told[1]


def test_masks_of_topics_reach_the_method_and_come_back_refined() -> None:
    memory = Memory()
    masks = tuple(f"/cam{k}/mask" for k in range(3))
    server = Server(RIG, PAPER, memory, Inputs(IMAGES, masks), namespace="x/")
    for k, topic in enumerate(masks):
        dynamic = np.full((SIZE[1], SIZE[0]), 255 * (k == 1), np.uint8)
        memory.deliver[topic](messages.image_message(START, "", dynamic))
    instants(memory, 1)
    memory.takes = False
    report = run_once(server)
    sent = dict(memory.sent)
    assert report.published == 1 and report.unsent == len(memory.sent) == 8
    assert set(sent) >= {"/x/background/image_rect", "/x/depth/camera_info", "/x/masks/cam2/image"}
    assert sent["/x/coverage/image_rect"].data.max() <= 2, "no ray of cam1"
    assert not sent["/x/masks/cam0/image"].data.any() and sent["/x/masks/cam1/image"].data.any()


def crooked() -> Rig:
    """The cameras' line falls to the right, so that every rectified view is turned."""
    cameras = list(RIG.cameras)
    for k, camera in enumerate(cameras):
        pose = camera.cam_from_rig.copy()
        pose[1, 3] = -0.02 * k
        cameras[k] = replace(camera, cam_from_rig=pose)
    return Rig(tuple(cameras))


@pytest.mark.parametrize(
    ("rig", "given", "expected"),
    [(RIG, "lens", "lens"), (RIG, "", "cam0"), (crooked(), "lens", "lens_rect"), (crooked(), "", "cam0_rect")],
)
def test_a_view_that_is_turned_has_a_frame_of_its_own(rig: Rig, given: str, expected: str) -> None:
    memory = Memory()
    server = Server(rig, PAPER, memory, Inputs(IMAGES))
    instants(memory, 1, lambda stamp: image(stamp, frame_id=given))
    run_once(server, 0.3)
    sent = dict(memory.sent)
    assert {sent[f"/seepast/{name}/image_rect"].frame_id for name in ("background", "depth", "coverage")} == {expected}
    assert sent["/seepast/depth/camera_info"].frame_id == expected
    assert sent["/seepast/masks/cam0/image"].frame_id == (given or "cam0")


def test_grey_cameras_give_a_grey_scene() -> None:
    memory = Memory()
    server = Server(RIG, PAPER, memory, Inputs(IMAGES))
    instants(memory, 1, lambda s: messages.image_message(s, "", np.full(SIZE[::-1], 7, np.uint8)))
    run_once(server, 0.3)
    background = dict(memory.sent)["/seepast/background/image_rect"]
    assert background.encoding == "mono8" and set(background.data.tolist()) == {7}


def test_silence_is_told(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("seepast.live.server.QUIET", 0.1)
    memory = Memory()
    server = Server(RIG, PAPER, memory, Inputs(IMAGES))
    memory.deliver[IMAGES[1]](image(START))
    run_once(server, 0.6)
    told = [record.message for record in caplog.records]
    assert len(told) == 1 and "/cam0/image_raw, /cam2/image_raw" in told[0] and "ROS_DOMAIN_ID" in told[0]


def test_it_stops_when_it_is_told_to() -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    report = Server(RIG, PAPER, Memory(), Inputs(IMAGES)).run(stop)
    assert report.seconds < 2 and "0 frames" in str(report) and report.as_dict()["latency_ms"] is None


@pytest.mark.parametrize("words", [{"room": 0}, {"every": 0.0}])
def test_numbers_that_make_no_sense(words: dict[str, Any]) -> None:
    with pytest.raises(OptionsError, match="--queue 0" if "room" in words else "--every 0"):
        server = Server(RIG, PAPER, Memory(), Inputs(IMAGES), room=words.get("room", 1))
        server.run(threading.Event(), **words)


# ---------------------------------------------------------------- the command


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = write_recording(tmp_path / "rec") / "rig.yaml"
    path.write_text("".join(line for line in path.open() if "rostopic" not in line))
    return path


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--topics", "/{}/x"], "say where the masks come from"),
        (["--topics", "/{}/x", "--masks", "masks"], "live masks are messages"),
        (["--masks", "none"], "names no rostopic for cam0"),
        (["--topics", "/a,/b", "--masks", "none"], "give 3 different topics"),
        (["--topics", "/{}/x", "--masks", "topics:/m"], "--masks topics:: give 3 different topics"),
        (["--topics", "/{}/x", "--masks", "none", "--tolerance", "-1"], "--tolerance -1"),
        (["--topics", "/{}/x", "--masks", "none", "--set", "a.b=1"], "option 'a.b' does not exist"),
        (["--topics", "/{}/x", "--masks", "none", "--transport", "rclpy"], "source its setup.bash"),
    ],
)
def test_what_is_wrong_is_told_in_a_line(
    words: list[str],
    expected: str,
    rig_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert cli.main(["serve", "--rig", str(rig_file), "--seconds", "1", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and expected in error


def test_without_either_transport_the_extra_is_named(
    rig_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    assert cli.main(["serve", "--rig", str(rig_file), "--topics", "/{}/x", "--masks", "none"]) == 2
    assert "pip install 'seepast[dds]'" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["x", "-1", "233"])
def test_a_domain_that_is_none(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", word)
    with pytest.raises(OptionsError, match=f"ROS_DOMAIN_ID={word}"):
        transport.domain_of_environment()


# ---------------------------------------------------------------- rclpy, as far as its documentation tells


class Fields:
    """A ROS message: what is set, is kept; sequences of numbers must be what rclpy takes."""

    def __init__(self, **fields: Any):
        self.__dict__.update(fields)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name != "data" or (isinstance(value, array) and value.typecode == "B"), "slow in rclpy"
        assert name not in "dkrp" or isinstance(value, list)
        self.__dict__[name] = value


@pytest.fixture
def fake_ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """Modules with the names that the transport imports; a node that keeps what it is asked for."""
    ros = SimpleNamespace(subscribed={}, published=[], spinning=threading.Event(), calls=[])
    stop = threading.Event()

    class Node:
        def create_subscription(self, kind: type, topic: str, callback: Any, quality: Any) -> None:
            ros.subscribed[topic] = (kind, callback, quality)

        def create_publisher(self, kind: type, topic: str, quality: Any) -> Any:
            return SimpleNamespace(publish=lambda message: ros.published.append((topic, quality, message)))

        def destroy_node(self) -> None:
            ros.calls.append("destroy_node")

    class Executor:
        def add_node(self, node: Any) -> None:
            ros.calls.append("add_node")

        def spin(self) -> None:
            ros.spinning.set()
            stop.wait(10)
            raise Shutdown

        def shutdown(self) -> None:
            stop.set()

    class Shutdown(Exception):  # noqa: N818
        pass

    kinds = {name: type(name, (Fields,), {}) for name in ("Image", "CompressedImage", "CameraInfo")}
    policy = SimpleNamespace(BEST_EFFORT="best effort", RELIABLE="reliable", KEEP_LAST="keep last", VOLATILE="volatile")
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda **words: ros.calls.append(words),
            "create_node": lambda name: Node(),
            "try_shutdown": lambda: ros.calls.append("try_shutdown"),
        },
        "rclpy.executors": {"ExternalShutdownException": Shutdown, "SingleThreadedExecutor": Executor},
        "rclpy.qos": {
            "DurabilityPolicy": policy, "HistoryPolicy": policy, "ReliabilityPolicy": policy, "QoSProfile": dict
        },
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="no")},
        "sensor_msgs": {},
        "sensor_msgs.msg": kinds,
        "std_msgs": {},
        "std_msgs.msg": {"Header": Fields},
        "builtin_interfaces": {},
        "builtin_interfaces.msg": {"Time": Fields},
    }  # fmt: skip
    for name, content in contents.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    monkeypatch.delitem(sys.modules, "seepast.live.ros", raising=False)
    yield ros
    sys.modules.pop("seepast.live.ros", None)


def test_with_ros_there_it_is_a_node(fake_ros: SimpleNamespace) -> None:
    node = transport.open_transport("auto")
    assert node.name == "rclpy" and fake_ros.calls[0] == {"args": [], "signal_handler_options": "no"}
    received: list[Any] = []
    node.subscribe("/cam0/image_raw", messages.Image, received.append)
    node.subscribe("/cam1/image_raw/compressed", messages.CompressedImage, received.append)
    publish = [node.advertise("/x", kind) for kind in (messages.Image, messages.CameraInfo)]
    node.start()
    assert fake_ros.spinning.wait(5)
    header = Fields(stamp=Fields(sec=5, nanosec=7), frame_id="lens")
    fields = {"height": 1, "width": 2, "encoding": "mono8", "is_bigendian": 0, "step": 2}
    fake_ros.subscribed["/cam0/image_raw"][1](Fields(header=header, **fields, **{"data": array("B", [3, 4])}))
    fake_ros.subscribed["/cam1/image_raw/compressed"][1](Fields(header=header, format="png", data=array("B", [9])))
    assert (received[0].stamp, received[0].frame_id, received[0].data.tolist()) == (5 * 10**9 + 7, "lens", [3, 4])
    assert received[1].format == "png" and received[1].data.tolist() == [9]
    assert fake_ros.subscribed["/cam0/image_raw"][2]["reliability"] == "best effort"

    assert publish[0](image(START + 3)) and publish[1](messages.camera_info(START, "r", server_geometry()))
    (_, quality, sent), (_, _, info) = fake_ros.published
    assert quality == {"reliability": "reliable", "history": "keep last", "depth": 1, "durability": "volatile"}
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec, sent.width) == (START // 10**9, 3, SIZE[0])
    assert len(sent.data) == 3 * SIZE[0] * SIZE[1] and info.k[0] == info.p[0] == SIZE[0] and len(info.r) == 9
    node.close()
    assert fake_ros.calls[-2:] == ["destroy_node", "try_shutdown"]


def server_geometry() -> Any:
    from seepast.rectify import rectify

    return rectify(RIG, 0).geometry


def test_a_ros_of_another_python_is_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(TransportError, match=r"--transport rclpy: ROS 2 cannot be imported .* setup\.bash"):
        transport.open_transport("rclpy")
