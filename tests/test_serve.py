"""seepast serve between processes: cameras in one, the server in another, the listener here, over loopback only."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("cyclonedds.domain")
pytest.importorskip("rosbags.typesys")

import ros_wire as wire
from recordings import write_recording
from seepast import cli
from seepast.live import dds_types, messages
from seepast.live.dds import DdsTransport
from seepast.options import Options
from seepast.pipeline import Reconstructor
from seepast.result import Result
from seepast.rig import Rig

CAMERAS, HZ, SECONDS = 5, 20, 3
QUICK = ["--preset", "paper", "--set", "range.max_disparity=12", "--threads", "1"]
SCENE = {"background/image_rect": wire.IMAGE, "depth/image_rect": wire.IMAGE, "coverage/image_rect": wire.IMAGE}
INFOS = {"background/camera_info": wire.INFO, "depth/camera_info": wire.INFO}
MASKS = {f"masks/cam{k}/image": wire.IMAGE for k in range(CAMERAS)}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "rec", cameras=CAMERAS, size=(64, 48))


@pytest.fixture
def environment() -> dict[str, str]:
    return {**os.environ, "ROS_DOMAIN_ID": str(wire.DOMAIN)}


@pytest.fixture
def children() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for child in started:
        if child.poll() is None:
            child.kill()
        child.wait()


def served(recording: Path, environment: dict[str, str], children: list[Any], *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "seepast.cli", "serve", "--rig", str(recording / "rig.yaml"), "--transport", "dds"]
    server = subprocess.Popen(
        [*command, *QUICK, "--json", *words], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    children.append(server)
    assert server.stderr is not None
    line = server.stderr.readline()
    assert "CycloneDDS: waiting for /cam0/" in line, line + server.stderr.read()
    return server


def published(recording: Path, environment: dict[str, str], children: list[Any], *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(Path(wire.__file__)), str(recording), "--hz", str(HZ), "--seconds", str(SECONDS)]
    children.append(subprocess.Popen([*command, *words], env=environment, text=True, stdout=subprocess.PIPE))
    return children[-1]


def listen(readers: dict[str, Any], cameras: subprocess.Popen[str]) -> dict[str, list[Any]]:
    """All that comes while the cameras run, and half a second longer."""
    heard: dict[str, list[Any]] = {name: [] for name in readers}
    end = time.monotonic() + 60
    while time.monotonic() < end:
        for name, take in readers.items():
            heard[name] += take()
        if cameras.poll() is not None:
            end = min(end, time.monotonic() + 0.5)
        time.sleep(0.02)
    assert cameras.returncode == 0
    return heard


def truth(recording: Path, masked: bool) -> Result:
    rig = Rig.from_kalibr(recording / "rig.yaml")
    images = [cv2.imread(str(recording / f"{c.name}/000000.png"), -1) for c in rig.cameras]
    masks = [cv2.imread(str(recording / f"masks/{c.name}/000000.png"), 0) for c in rig.cameras] if masked else None
    options = Options.preset("paper").updated({"range.max_disparity": 12})
    return Reconstructor(rig, options=options)(images, masks)


KINDS = {"boolean": 1, "int32": 4, "uint32": 7, "float64": 10, "uint8": 13}  # TypeKind, XTypes 1.3, 7.3.4


def announced(carrier: Any) -> dict[str, Any]:
    """Type name -> complete struct type, of all that DDS announces for an IDL type."""
    from cyclonedds.idl._xt_builder import XTBuilder

    pairs = XTBuilder.process_type(carrier)[1].identifier_object_pair_complete
    structs = [pair.type_object.value.value for pair in pairs]
    return {struct.header.detail.type_name: struct for struct in structs}


def described(identifier: Any) -> Any:
    """A member's type in the words of a .msg file."""
    if identifier.discriminator == 112:
        return "string", identifier.value.bound
    if identifier.discriminator == 128:
        return "sequence", identifier.value.element_identifier.discriminator, identifier.value.bound
    if identifier.discriminator == 144:
        return "array", identifier.value.element_identifier.discriminator, tuple(identifier.value.array_bound_seq)
    return "struct" if identifier.discriminator == 242 else identifier.discriminator


def expected(field: Any) -> Any:
    kind, detail = field
    if kind.name == "BASE":
        return ("string", 0) if detail[0] == "string" else KINDS[{"bool": "boolean"}.get(detail[0], detail[0])]
    if kind.name == "NAME":
        return "struct"
    (_, (element, _)), length = detail
    sort = "array" if kind.name == "ARRAY" else "sequence"
    return sort, KINDS[element], (length,) if sort == "array" else length


@pytest.mark.parametrize("carrier", dds_types.TYPES.values())
def test_types_are_announced_as_ros_announces_them(carrier: Any) -> None:
    """As rmw_cyclonedds does it: name mangled, final, ids in order, fields of the .msg with their plain names."""
    found = announced(carrier)
    name = carrier.__idl_typename__.replace("/", "::")
    assert name in found and len(found) >= 3
    for mangled, struct in found.items():
        package, message = re.fullmatch(r"(\w+)::msg::dds_::(\w+)_", mangled).groups()  # type: ignore[union-attr]
        fields = wire.STORE.fielddefs[f"{package}/msg/{message}"][1]
        flags = struct.struct_flags
        assert flags.IS_FINAL and not (flags.IS_APPENDABLE or flags.IS_MUTABLE or flags.IS_AUTOID_HASH)
        members = struct.member_seq
        assert [member.common.member_id for member in members] == list(range(len(fields)))
        assert [member.detail.name for member in members] == [field[0] for field in fields]
        for member, (_, field) in zip(members, fields, strict=True):
            assert described(member.common.member_type_id) == expected(field), (mangled, member.detail.name)
            assert not (member.common.member_flags.IS_OPTIONAL or member.common.member_flags.IS_KEY)


def test_topics_and_quality_of_service_match_those_of_ros() -> None:
    """By DDS's rules of request and offer they get on with rmw's profiles: default, sensor data, rviz's."""
    from cyclonedds.core import Policy
    from cyclonedds.qos import Qos

    transport = DdsTransport(wire.DOMAIN)
    try:
        transport.subscribe("/cam0/image_raw", messages.Image, lambda message: None)
        transport.advertise("/seepast/depth/image_rect", messages.Image)
        (reader, _), writer_qos = transport._readers[0], transport._out
        assert reader.topic.name == "rt/cam0/image_raw"
        assert reader.topic.typename == "sensor_msgs::msg::dds_::Image_"
        assert reader.get_qos()[Policy.Reliability] == Policy.Reliability.BestEffort, "gets on with every publisher"
        for qos in (reader.get_qos(), writer_qos):
            assert qos[Policy.Durability] == Policy.Durability.Volatile
            assert qos[Policy.DataRepresentation] == Policy.DataRepresentation(use_cdrv0_representation=True)
        assert isinstance(writer_qos[Policy.Reliability], Policy.Reliability.Reliable), (
            "serves both kinds of subscriber"
        )
        assert Policy.Deadline not in Qos(*writer_qos) and Policy.Partition not in Qos(*writer_qos)
    finally:
        transport.close()


def test_cameras_of_another_process_are_seen_through(
    recording: Path, environment: dict[str, str], children: list[Any]
) -> None:
    ros = wire.Ros(wire.DOMAIN)
    readers = {name: ros.reader(f"/seepast/{name}", kind) for name, kind in {**SCENE, **INFOS, **MASKS}.items()}
    words = ("--topics", "/{}/image_raw", "--masks", "topics:/{}/mask", "--every", "1")
    server = served(recording, environment, children, *words)
    heard = listen(readers, published(recording, environment, children, "--masks", "masks", "--lose", "cam3:4"))
    server.send_signal(signal.SIGTERM)
    out, err = server.communicate(timeout=20)
    assert server.returncode == 0, err
    report = json.loads(out)

    ticks = HZ * SECONDS
    # best effort: a machine that is busy with other things may lose some before anybody here sees them
    heard_ticks = report["images"] / (2 * CAMERAS)
    assert ticks * 0.5 <= heard_ticks <= ticks
    assert report["frames"] <= ticks * 3 // 4, "frames without the lost images of cam3"
    lost = report["images_dropped"]["/cam3/image_raw had nothing within 5 ms of them"]
    assert 0.5 * (2 * CAMERAS - 1) * heard_ticks / 4 <= lost <= (2 * CAMERAS - 1) * ticks / 4
    assert report["published"] + sum(report["frames_dropped"].values()) + 1 >= report["frames"]
    assert report["published"] >= 5 and 0 < report["latency_ms"][0] <= report["latency_ms"][1]
    assert report["latency_ms"][0] <= report["age_ms"][0] + 1, "stamps are older than what has arrived"
    assert "latency" in err and "out (" in err, "figures every second"
    check_heard(heard, truth(recording, masked=True), report["published"])


def check_heard(heard: dict[str, list[Any]], expected: Result, published: int) -> None:
    backgrounds = heard["background/image_rect"]
    assert published * 0.8 <= len(backgrounds) <= published
    last = backgrounds[-1]
    assert last.encoding == "bgr8" and last.header.frame_id == "cam0_optical"
    assert np.array_equal(wire.pixels_of(last), expected.background)
    stamp = wire.stamp_of(last)
    by_stamp = {name: {wire.stamp_of(m): m for m in messages} for name, messages in heard.items()}
    depth = by_stamp["depth/image_rect"][stamp]
    unknown = (expected.depth == 0) | (expected.coverage == 0)
    assert depth.encoding == "32FC1" and unknown.any() and not unknown.all()
    assert np.array_equal(wire.pixels_of(depth), np.where(unknown, np.nan, expected.depth), equal_nan=True)
    assert np.array_equal(wire.pixels_of(by_stamp["coverage/image_rect"][stamp]), expected.coverage)
    for name in INFOS:
        info = by_stamp[name][stamp]
        assert info.header.frame_id == "cam0_optical" and (info.width, info.height) == (64, 48)
        (fx, fy), (cx, cy) = expected.geometry.focal, expected.geometry.center
        assert np.allclose(info.k, [fx, 0, cx, 0, fy, cy, 0, 0, 1]) and np.allclose(info.r, np.eye(3).ravel())
        assert np.allclose(info.p.reshape(3, 4)[:, :3].ravel(), info.k) and not info.p.reshape(3, 4)[:, 3].any()
    for k in range(CAMERAS):
        mask = by_stamp[f"masks/cam{k}/image"][stamp + k * wire.SKEW]
        assert mask.encoding == "mono8" and mask.header.frame_id == f"cam{k}_optical"
        assert np.array_equal(wire.pixels_of(mask), expected.masks[k])


def test_compressed_images_without_masks_and_ctrl_c(
    recording: Path, environment: dict[str, str], children: list[Any]
) -> None:
    ros = wire.Ros(wire.DOMAIN)
    readers = {"background": ros.reader("/robot/static/background/image_rect", wire.IMAGE)}
    words = (
        "--topics",
        "/{}/image_raw/compressed",
        "--masks",
        "none",
        "--namespace",
        "robot/static",
        "--qos",
        "reliable",
    )
    server = served(recording, environment, children, *words)
    heard = listen(readers, published(recording, environment, children, "--compressed", "--seconds", "1"))
    server.send_signal(signal.SIGINT)
    out, err = server.communicate(timeout=20)
    assert server.returncode == 0, err
    assert json.loads(out)["images_dropped"] == {}
    assert np.array_equal(wire.pixels_of(heard["background"][-1]), truth(recording, masked=False).background)


README = Path(__file__).parents[1] / "README.md"
COMMANDS = re.findall(r"^    ((?:\w+=\w+ )?seepast serve .+?)(?: {2,}.*)?$", README.read_text(), re.MULTILINE)


def test_the_readme_shows_where_masks_come_from() -> None:
    assert len(COMMANDS) >= 4
    assert all(any(words in command for command in COMMANDS) for words in ("topics:", "onnx:", "--masks none"))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_of_the_readme_start_and_end(
    command: str, recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "onnx:" in command:
        pytest.importorskip("onnxruntime")
        import onnx_nets

        onnx_nets.logits(recording / "net.onnx", np.eye(19, 3), (64, 64))
    monkeypatch.chdir(recording)
    before, _, words = command.rpartition("seepast ")
    for name, value in (("ROS_DOMAIN_ID", str(wire.DOMAIN)), *(pair.split("=") for pair in before.split())):
        monkeypatch.setenv(name, value)
    assert cli.main([*shlex.split(words), "--seconds", "0.5", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["frames"] == 0 and "waiting for /cam0/image_raw" in err and err.count("\n") == 1
