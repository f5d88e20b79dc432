"""Every export read back by another reader than the one that wrote it: pixels, times, geometry, and interruptions."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from seepast import cli
from seepast.errors import DatasetError, MissingExtraError, OptionsError, OutputError
from seepast.export import FolderWriter, Run
from seepast.export.atomic import write_bytes, write_pfm
from seepast.export.exporters import EXPORT_FILE, EXPORTERS, export
from seepast.export.protocol import Exporter, ExportOptions
from seepast.export.reading import RunFolder
from seepast.export.times import frame_rate, guessed_unit, seconds, timeline
from seepast.geometry import ArrayGeometry
from seepast.options import Options
from seepast.result import Result

STAMPS = ("1403636579763555584", "1403636579813555456", "1403636579863555584")
TIMES = tuple(int(stamp) for stamp in STAMPS)
WIDTH, HEIGHT = 48, 35
NORMAL, DISTANCE = np.array([0.2, -0.3, 1.0]), 4.0  # the static scene is the plane NORMAL . X = DISTANCE
FORMATS = tuple(EXPORTERS)
BAGS = ("mcap", "rosbag2", "rosbag1")


def geometry(reference: int = 0) -> ArrayGeometry:
    positions = np.array([[0, 0, 0], [0.1, 0, 0], [0.3, 0, 0.0]])
    return ArrayGeometry((50.0, 52.0), (22.3, 18.6), (WIDTH, HEIGHT), positions - positions[reference], reference)


@dataclass
class Truth:
    """What went into a run; depth with the guesses taken out."""

    folder: Path
    geometry: ArrayGeometry
    results: dict[str, Result]

    def depth(self, stamp: str, min_coverage: int = 1) -> np.ndarray:
        result = self.results[stamp]
        return np.where(result.coverage >= min_coverage, result.depth, 0)


def plane_depth(shape: ArrayGeometry) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(x - shape.center[0]) / shape.focal[0], (y - shape.center[1]) / shape.focal[1], np.ones(x.shape)])
    return DISTANCE / np.tensordot(NORMAL, rays, axes=1)


def result(shape: ArrayGeometry, seed: int, grey: bool) -> Result:
    rng = np.random.default_rng(seed)
    disparity = (shape.focal_baseline / plane_depth(shape)).astype(np.float32)
    disparity[:3] = 0
    coverage = rng.integers(0, 4, (HEIGHT, WIDTH), np.uint8)
    return Result(
        background=rng.integers(0, 256, (HEIGHT, WIDTH) if grey else (HEIGHT, WIDTH, 3), np.uint8),
        disparity=disparity,
        depth=shape.depth(disparity),
        confidence=np.full((HEIGHT, WIDTH), 0.5, np.float32),
        coverage=coverage,
        labels=np.zeros((HEIGHT, WIDTH), np.uint16),
        masks=tuple(rng.integers(0, 256, (HEIGHT + 1, WIDTH + k), np.uint8) for k in range(3)),
        geometry=shape,
        timings={"rectify": 1.0},
        rounds=1,
        options=Options.preset("paper"),
        backend="cpu",
    )


def write_run(
    folder: Path, *, stamps: tuple[str, ...] = STAMPS, reference: int = 0, grey: bool = False, confidence: bool = False
) -> Truth:
    shape, cameras = geometry(reference), ("cam0", "cam1", "cam2")
    run = Run("0.1.0", "/data/rec", "none", "0123", cameras[reference], "cpu", False, {})
    results = {stamp: result(shape, seed, grey) for seed, stamp in enumerate(stamps)}
    with FolderWriter(folder, run, cameras) as writer:
        for stamp, frame in results.items():
            writer.write(stamp, frame, 1.0)
            (folder / "confidence" / f"{stamp}.png").unlink()  # as runs of before there was any
            if confidence:
                write_pfm(folder / "confidence" / f"{stamp}.pfm", frame.coverage.astype(np.float32) / 4)
    return Truth(folder, shape, results)


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    return write_run(tmp_path / "out")


def exported(truth: Truth, to: str, path: Path | None = None, **options: Any) -> Path:
    return export(RunFolder(truth.folder), to, path, ExportOptions(**options)).path


def off_plane(depth: np.ndarray, matrix: np.ndarray) -> float:
    """How far, in metres, the farthest point of known depth lies off the plane, by camera and depth alone."""
    y, x = np.nonzero(np.nan_to_num(depth) > 0)
    points = np.linalg.inv(matrix) @ np.stack([x, y, np.ones(len(x))]) * depth[y, x]
    assert points.shape[1] > 500
    return float(np.abs(NORMAL @ points - DISTANCE).max() / np.linalg.norm(NORMAL))


# --- bags ------------------------------------------------------------------------------------------------------------


def read_mcap(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        for schema, channel, message, ros in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema is not None and channel.message_encoding == "cdr"
            yield channel.topic, schema.name, message.log_time, ros


def read_rosbags(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            yield connection.topic, connection.msgtype, time, reader.deserialize(data, connection.msgtype)


def read_bag(path: Path) -> dict[str, list[Any]]:
    """topic -> its messages in order; each with .kind and .time (ns) beside the message itself."""
    topics: dict[str, list[Any]] = {}
    for topic, kind, time, message in (read_mcap if path.suffix == ".mcap" else read_rosbags)(path):
        topics.setdefault(topic, []).append(SimpleNamespace(kind=kind, time=time, message=message))
    return topics


def pixels(message: Any) -> np.ndarray:
    types = {"mono8": "u1", "bgr8": "u1", "16UC1": "<u2", "32FC1": "<f4"}
    assert not message.is_bigendian
    values = np.frombuffer(bytes(message.data), types[message.encoding])
    values = values.reshape(message.height, message.step // values.itemsize)
    return values.reshape(message.height, message.width, 3) if message.encoding == "bgr8" else values


def field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def nanoseconds(header: Any) -> int:
    stamp = header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@pytest.mark.parametrize("to", BAGS)
def test_a_bag_holds_every_picture_under_one_stamp(truth: Truth, to: str) -> None:
    topics = read_bag(exported(truth, to))
    infos = {f"/seepast/{name}/camera_info" for name in ("background", "depth", "farthest")}
    images = {f"/seepast/{name}/image_rect" for name in ("background", "depth", "coverage")}
    masks = {f"/seepast/masks/cam{k}/image" for k in range(3)}
    assert set(topics) == infos | images | masks | {"/seepast/disparity"}
    for topic, messages in topics.items():
        kind = "CameraInfo" if topic in infos else "Image"
        kind = "stereo_msgs/msg/DisparityImage" if topic == "/seepast/disparity" else f"sensor_msgs/msg/{kind}"
        assert [m.kind for m in messages] == 3 * [kind]
        assert tuple(m.time for m in messages) == tuple(nanoseconds(m.message.header) for m in messages) == TIMES
        expected = topic.split("/")[3] if topic in masks else "cam0_rect"
        assert {m.message.header.frame_id for m in messages} == {expected}
    for i, stamp in enumerate(STAMPS):
        frame = truth.results[stamp]
        for name, values in (("background", frame.background), ("coverage", frame.coverage)):
            np.testing.assert_array_equal(pixels(topics[f"/seepast/{name}/image_rect"][i].message), values)
        for k, mask in enumerate(frame.masks):
            np.testing.assert_array_equal(pixels(topics[f"/seepast/masks/cam{k}/image"][i].message), mask)
    encodings = {topics[topic][0].message.encoding for topic in masks | {"/seepast/coverage/image_rect"}}
    assert encodings == {"mono8"}


@pytest.mark.parametrize("to", BAGS)
def test_depth_in_a_bag_is_rep_118_and_fits_its_camera_info(truth: Truth, to: str) -> None:
    topics = read_bag(exported(truth, to))
    for i, stamp in enumerate(STAMPS):
        message, expected = topics["/seepast/depth/image_rect"][i].message, truth.depth(stamp)
        assert message.encoding == "32FC1"
        depth = pixels(message)
        np.testing.assert_array_equal(np.isnan(depth), expected == 0)
        np.testing.assert_allclose(np.nan_to_num(depth), expected, rtol=1e-6)
        info = topics["/seepast/depth/camera_info"][i].message
        assert (info.width, info.height, info.distortion_model) == (WIDTH, HEIGHT, "plumb_bob")
        assert list(field(info, "d")) == [0.0] * 5 and list(field(info, "r")) == list(np.eye(3).ravel())
        K, P = np.reshape(field(info, "k"), (3, 3)), np.reshape(field(info, "p"), (3, 4))
        assert off_plane(depth, K) < 1e-5
        np.testing.assert_array_equal(P, np.column_stack([K, np.zeros(3)]))


@pytest.mark.parametrize("to", BAGS)
@pytest.mark.parametrize(("reference", "side"), [(0, 1), (2, -1)])
def test_the_baseline_is_in_the_disparity_and_in_the_other_camera(
    tmp_path: Path, to: str, reference: int, side: int
) -> None:
    truth = write_run(tmp_path / "out", reference=reference)
    topics = read_bag(exported(truth, to))
    disparity = topics["/seepast/disparity"][1].message
    values, expected = pixels(disparity.image), truth.depth(STAMPS[1])
    known = values >= disparity.min_disparity
    np.testing.assert_array_equal(known, expected > 0)
    np.testing.assert_allclose(disparity.f * field(disparity, "t") / values[known], expected[known], rtol=1e-6)
    assert disparity.max_disparity == values.max() and nanoseconds(disparity.image.header) == TIMES[1]
    assert (disparity.valid_window.width, disparity.valid_window.height) == (WIDTH, HEIGHT)
    K = np.reshape(field(topics["/seepast/depth/camera_info"][1].message, "k"), (3, 3))
    P = np.reshape(field(topics["/seepast/farthest/camera_info"][1].message, "p"), (3, 4))
    y, x = np.nonzero(known)
    points = np.linalg.inv(K) @ np.stack([x, y, np.ones(len(x))]) * expected[known]
    u, v, w = P @ np.vstack([points, np.ones(len(x))])
    np.testing.assert_allclose(x - u / w, side * values[known], atol=1e-4)
    np.testing.assert_allclose(v / w, y, atol=1e-4)


@pytest.mark.parametrize("to", BAGS)
def test_bags_of_grey_runs_in_millimetres_with_confidence(tmp_path: Path, to: str) -> None:
    truth = write_run(tmp_path / "out", grey=True, confidence=True)
    topics = read_bag(exported(truth, to, depth="16UC1"))
    assert "/seepast/depth/image_rect" not in topics
    depth = topics["/seepast/depth/image_rect_raw"][2].message
    assert depth.encoding == "16UC1"
    np.testing.assert_allclose(pixels(depth), 1000 * truth.depth(STAMPS[2]), atol=0.51)
    assert ((pixels(depth) == 0) == (truth.depth(STAMPS[2]) == 0)).all()
    background = topics["/seepast/background/image_rect"][2].message
    assert background.encoding == "mono8"
    frame = truth.results[STAMPS[2]]
    np.testing.assert_array_equal(pixels(background), frame.background)
    np.testing.assert_array_equal(pixels(topics["/seepast/confidence/image_rect"][2].message), frame.coverage / 4)


def test_a_frame_without_any_depth_has_no_valid_disparity(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "out", stamps=STAMPS[:1])
    write_pfm(truth.folder / "disparity" / f"{STAMPS[0]}.pfm", np.zeros((HEIGHT, WIDTH), np.float32))
    message = read_bag(exported(truth, "mcap"))["/seepast/disparity"][0].message
    assert (pixels(message.image) < message.min_disparity).all() and message.max_disparity >= message.min_disparity


# --- tum -------------------------------------------------------------------------------------------------------------


def read_associations(folder: Path) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """What ORB-SLAM's rgbd_tum reads: every line is "t rgb t depth", files relative to the folder."""
    frames = []
    for line in (folder / "associations.txt").read_text().splitlines():
        time, rgb, depth_time, depth = line.split()
        assert time == depth_time and float(time) == float(Path(rgb).stem) == float(Path(depth).stem)
        frames.append((time, read(folder / rgb), read(folder / depth)))
    return frames


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def settings(path: Path) -> dict[str, Any]:
    """All top-level numbers and strings, through OpenCV's FileStorage as ORB-SLAM reads them."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = {key: storage.getNode(key) for key in storage.root().keys()}  # noqa: SIM118
    return {key: node.string() if node.isString() else node.real() for key, node in nodes.items() if not node.isMap()}


def intrinsics(values: dict[str, Any], camera: str) -> np.ndarray:
    fx, fy, cx, cy = (values[f"{camera}.{name}"] for name in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def test_tum_folders_hold_the_frames_and_cameras_that_slam_reads(truth: Truth) -> None:
    folder = exported(truth, "tum")
    frames = read_associations(folder)
    assert [time for time, *_ in frames] == ["1403636579.763555584", "1403636579.813555456", "1403636579.863555584"]
    orb2, orb3 = settings(folder / "orbslam2.yaml"), settings(folder / "orbslam3.yaml")
    for (_, rgb, depth), stamp in zip(frames, STAMPS, strict=True):
        np.testing.assert_array_equal(rgb, truth.results[stamp].background)
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 5000, truth.depth(stamp), atol=0.51 / 5000)
        assert off_plane(depth / orb2["DepthMapFactor"], intrinsics(orb2, "Camera")) < 2e-4
        assert off_plane(depth / orb3["RGBD.DepthMapFactor"], intrinsics(orb3, "Camera1")) < 2e-4
        mask = read(folder / "mask" / f"{seconds(int(stamp))}.png")
        np.testing.assert_array_equal(mask, truth.results[stamp].coverage >= 1)
    assert orb2["Camera.bf"] == pytest.approx(50 * 0.3) and orb3["Stereo.b"] == pytest.approx(0.3)
    assert orb2["ThDepth"] == orb3["Stereo.ThDepth"] == 40
    assert (orb3["Camera.width"], orb3["Camera.height"], orb3["Camera.fps"]) == (WIDTH, HEIGHT, 20)
    assert (orb3["File.version"], orb3["Camera.type"], orb3["Camera.RGB"]) == ("1.0", "PinHole", 0)
    for kind in ("rgb", "depth"):
        lines = (folder / f"{kind}.txt").read_text().splitlines()
        assert [line.split()[1] for line in lines if not line.startswith("#")] == [
            f"{kind}/{seconds(time)}.png" for time in TIMES
        ]


def test_orbslam3_finds_whole_numbers_where_it_insists_on_them(truth: Truth) -> None:
    storage = cv2.FileStorage(str(exported(truth, "tum") / "orbslam3.yaml"), cv2.FILE_STORAGE_READ)
    orb = [f"ORBextractor.{name}" for name in ("nFeatures", "nLevels", "iniThFAST", "minThFAST")]
    for name in ("Camera.width", "Camera.height", "Camera.fps", "Camera.RGB", *orb):
        assert storage.getNode(name).isInt(), name
    for name in ("Camera1.fx", "Stereo.b", "Stereo.ThDepth", "RGBD.DepthMapFactor", "ORBextractor.scaleFactor"):
        assert storage.getNode(name).isReal(), name


def test_rtabmap_finds_its_folders_and_its_calibration(truth: Truth) -> None:
    folder = exported(truth, "tum")
    assert {p.name for p in (folder / "rgb_sync").iterdir()} == {f"{seconds(time)}.png" for time in TIMES}
    assert (folder / "depth_sync").is_dir()
    storage = cv2.FileStorage(str(folder / "rtabmap_calib.yaml"), cv2.FILE_STORAGE_READ)
    for name, shape in (("camera_matrix", (3, 3)), ("distortion_coefficients", (1, 5)), ("projection_matrix", (3, 4))):
        node = storage.getNode(name)
        assert (node.getNode("rows").real(), node.getNode("cols").real()) == shape
        data = node.getNode("data")
        values = np.reshape([data.at(i).real() for i in range(data.size())], shape)
        if name == "camera_matrix":
            assert off_plane(read(folder / "depth" / f"{seconds(TIMES[0])}.png") / 5000, values) < 2e-4
    assert storage.getNode("image_width").real() == WIDTH


def test_tum_depth_beyond_16_bits_is_unknown_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = write_run(tmp_path / "out", stamps=STAMPS[:1])
    disparity = truth.results[STAMPS[0]].disparity.copy()
    disparity[20:, :] = truth.geometry.focal_baseline / 13.2
    write_pfm(truth.folder / "disparity" / f"{STAMPS[0]}.pfm", disparity)
    with caplog.at_level(logging.WARNING, "seepast"):
        ((_, _, depth),) = read_associations(exported(truth, "tum"))
    assert (depth[20:] == 0).all() and (depth[3:20] > 0).any() and "13.1 m" in caplog.text
    caplog.clear()
    ((_, _, depth),) = read_associations(exported(truth, "tum", tmp_path / "far", depth_factor=1000.0))
    seen = truth.results[STAMPS[0]].coverage[20:] > 0
    assert (depth[20:][seen] == 13200).all() and not caplog.text
    assert settings(tmp_path / "far" / "orbslam2.yaml")["DepthMapFactor"] == 1000


# --- ply, exr --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("min_coverage", [0, 1, 2])
def test_ply_points_lie_on_the_plane_and_keep_their_colours(tmp_path: Path, grey: bool, min_coverage: int) -> None:
    from plyfile import PlyData

    truth = write_run(tmp_path / "out", grey=grey, confidence=grey)
    folder = exported(truth, "ply", min_coverage=min_coverage)
    assert {p.name for p in folder.iterdir()} == {f"{stamp}.ply" for stamp in STAMPS} | {EXPORT_FILE}
    for stamp in STAMPS:
        data = PlyData.read(str(folder / f"{stamp}.ply"))
        assert not data.text and data.byte_order == "<"
        vertex, frame = data["vertex"], truth.results[stamp]
        types = {p.name: p.val_dtype for p in vertex.properties}
        assert types == {**dict.fromkeys("xyz", "f4"), **dict.fromkeys(("red", "green", "blue", "coverage"), "u1")} | (
            {"confidence": "f4"} if grey else {}
        )
        points = np.stack([vertex[c] for c in "xyz"])
        np.testing.assert_allclose(NORMAL @ points, DISTANCE, atol=1e-5)
        (fx, fy), (cx, cy) = truth.geometry.focal, truth.geometry.center
        at = np.rint([fx * points[0] / points[2] + cx, fy * points[1] / points[2] + cy]).astype(int)
        known = truth.depth(stamp, min_coverage) > 0
        np.testing.assert_array_equal(at[::-1], np.nonzero(known))
        np.testing.assert_array_equal(vertex["coverage"], frame.coverage[known])
        for i, name in enumerate(("blue", "green", "red")):
            np.testing.assert_array_equal(vertex[name], (frame.background if grey else frame.background[..., i])[known])
        if grey:
            np.testing.assert_array_equal(vertex["confidence"], frame.coverage[known] / np.float32(4))


@pytest.mark.parametrize("grey", [False, True])
def test_exr_channels_are_the_frame_in_floats(tmp_path: Path, grey: bool) -> None:
    import OpenEXR

    truth = write_run(tmp_path / "out", grey=grey, confidence=grey)
    folder = exported(truth, "exr")
    for stamp in STAMPS:
        with OpenEXR.File(str(folder / f"{stamp}.exr"), separate_channels=True) as file:
            header, planes = dict(file.header()), {name: c.pixels for name, c in file.channels().items()}
        frame, depth = truth.results[stamp], truth.depth(stamp)
        assert set(planes) == {"Z", "disparity", "coverage"} | ({"Y", "confidence"} if grey else set("RGB"))
        stored = planes["Y"] if grey else np.stack([planes[c] for c in "BGR"], axis=-1)
        assert stored.dtype == np.float16 and planes["Z"].dtype == planes["disparity"].dtype == np.float32
        np.testing.assert_array_equal(np.rint(stored.astype(float) * 255), frame.background)
        np.testing.assert_array_equal(planes["coverage"], frame.coverage)
        np.testing.assert_array_equal(np.isinf(planes["Z"]), depth == 0)
        np.testing.assert_array_equal(planes["disparity"] == 0, depth == 0)
        known = depth > 0
        np.testing.assert_allclose(header["focalBaseline"] / planes["disparity"][known], planes["Z"][known], rtol=1e-6)
        K = np.array([[header["fx"], 0, header["cx"]], [0, header["fy"], header["cy"]], [0, 0, 1]])
        assert off_plane(np.where(known, planes["Z"], 0), K) < 1e-5
        assert (header["stamp"], header["seconds"], header["camera"]) == (stamp, seconds(int(stamp)), "cam0")
        if grey:
            np.testing.assert_array_equal(planes["confidence"], frame.coverage / np.float32(4))


# --- times -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (STAMPS, "ns"),
        (("0000000012300000000",), "ns"),
        (("1403636579763555",), "us"),
        (("1403636579763",), "ms"),
        (("1403636579",), "s"),
        (("1305031102.175304", "9.5"), "s"),
        (("000000", "000001"), "index"),
        (("0000000000", "0000000001"), "index"),
        (("1403636579763555584", "x"), "index"),
        (("1403636579763555584", "1403636579"), "index"),
    ],
)
def test_names_are_times_by_their_looks(stamps: tuple[str, ...], unit: str) -> None:
    assert guessed_unit(stamps) == unit


def test_times_are_exact_and_in_order() -> None:
    assert timeline(["10.5", "9.123456789"]) == [(9123456789, "9.123456789"), (10500000000, "10.5")]
    assert timeline(["1305031102.175304"])[0][0] == 1305031102175304000
    assert timeline(["33", "66"], "ms") == [(33000000, "33"), (66000000, "66")]
    assert timeline(["a", "b", "c"], rate=3) == [(10**9, "a"), (1333333333, "b"), (1666666667, "c")]
    assert seconds(10**9 + 5) == "1.000000005" and frame_rate([0, 5 * 10**7], 1) == 20 and frame_rate([7], 12) == 12


@pytest.mark.parametrize(
    ("stamps", "unit", "rate", "says"),
    [
        (["a"], "hours", 10, "--stamps hours"),
        (["a"], "auto", 0, "--rate 0"),
        (["a"], "auto", float("nan"), "--rate nan"),
        (["a"], "ns", 10, "frame a is not named by a number"),
        (["1.50", "1.5"], "auto", 10, "of one time"),
        (["1403636579763"], "s", 10, "2038"),
    ],
)
def test_times_that_cannot_be(stamps: list[str], unit: str, rate: float, says: str) -> None:
    with pytest.raises((OptionsError, DatasetError), match=says):
        timeline(stamps, unit, rate)


# --- whole or not at all ---------------------------------------------------------------------------------------------


def entries(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("to", FORMATS)
@pytest.mark.parametrize("before", [False, True])
def test_an_export_that_fails_or_is_interrupted_leaves_things_as_they_were(
    truth: Truth, to: str, before: bool, tmp_path: Path
) -> None:
    target = tmp_path / "exports" / f"x{EXPORTERS[to].suffix}"
    target.parent.mkdir()
    if before:
        exported(truth, to, target)
    there = entries(target.parent)
    frames = []

    def interrupt() -> None:
        frames.append(1)
        if len(frames) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(RunFolder(truth.folder), to, target, overwrite=before, on_frame=interrupt)
    assert entries(target.parent) == there
    damaged = truth.folder / "disparity" / f"{STAMPS[1]}.pfm"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"0813555456\.pfm|813555456\.pfm"):
        export(RunFolder(truth.folder), to, target, overwrite=before)
    assert entries(target.parent) == there and bool(there) == before


@pytest.mark.parametrize("to", FORMATS)
def test_an_export_is_replaced_on_request_only(truth: Truth, to: str, tmp_path: Path) -> None:
    target = tmp_path / f"x{EXPORTERS[to].suffix}"
    exported(truth, to, target)
    with pytest.raises(OutputError, match="--overwrite"):
        exported(truth, to, target)
    stale = target / "stale" if target.is_dir() else target
    stale.write_bytes(b"stale")
    done = export(RunFolder(truth.folder), to, target, overwrite=True)
    assert (done.path, done.frames) == (target, 3)
    assert not any(data == b"stale" for data in entries(tmp_path).values())
    assert {p.name for p in tmp_path.iterdir()} == {"out", target.name}, "nothing hidden is left"
    if target.is_dir():
        described = json.loads((target / EXPORT_FILE).read_text())
        assert (described["to"], described["frames"], described["options"]["min_coverage"]) == (to, 3, 1)


def test_folders_of_something_else_are_never_replaced(truth: Truth, tmp_path: Path) -> None:
    run = RunFolder(truth.folder)
    for target in (truth.folder, tmp_path):
        with pytest.raises(OutputError, match="something else"):
            export(run, "ply", target, overwrite=True)
    with pytest.raises(OutputError, match="is a folder"):
        export(run, "mcap", tmp_path, overwrite=True)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        export(run, "tum", tmp_path / "file", overwrite=True)
    with pytest.raises(OutputError, match="cannot be written"):
        export(run, "tum", tmp_path / "file" / "below")
    (tmp_path / "empty").mkdir()
    assert export(run, "exr", tmp_path / "empty").path == tmp_path / "empty"
    assert (tmp_path / "file").read_text() == "mine"


def test_leftovers_of_a_killed_export_go_away(truth: Truth, tmp_path: Path) -> None:
    part = truth.folder / ".ply.part"
    write_bytes(part / "ply" / "old.ply", b"half")
    export(RunFolder(truth.folder), "ply", truth.folder / "ply")
    assert not part.exists() and not (truth.folder / "ply" / "old.ply").exists()
    write_bytes(part / "ply" / "old.ply", b"half")
    write_run(truth.folder, stamps=STAMPS[:1])
    assert not part.exists(), "the next run clears up too"


@pytest.mark.skipif(sys.platform == "win32", reason="no limits there")
@pytest.mark.parametrize("to", FORMATS)
def test_a_full_disk_is_told_in_one_line_and_leaves_nothing(truth: Truth, to: str) -> None:
    code = (
        "import resource, signal, sys; from seepast.cli import main\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", code, "export", str(truth.folder), "--to", to]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "cannot be written" in done.stderr and str(truth.folder.parent) in done.stderr
    assert {p.name for p in truth.folder.parent.iterdir()} == {"out"}


# --- what is read, and who may write ---------------------------------------------------------------------------------


def test_unfinished_frames_are_left_out_and_counted(truth: Truth, caplog: pytest.LogCaptureFixture) -> None:
    (truth.folder / "coverage" / f"{STAMPS[1]}.png").unlink()
    assert RunFolder(truth.folder).stamps == (STAMPS[0], STAMPS[2])
    assert "leaving out 1 of 3 frames" in caplog.text
    for stamp in (STAMPS[0], STAMPS[2]):
        (truth.folder / "coverage" / f"{stamp}.png").unlink()
    with pytest.raises(DatasetError, match="no finished frame"):
        RunFolder(truth.folder)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("run.json", "[]", "not the JSON of a run"),
        ("run.json", "{", "not the JSON of a run"),
        ("camera.yaml", "camera: cam0", "'intrinsics'"),
        ("camera.yaml", "camera: [", "not the camera.yaml"),
        ("disparity/{}.pfm", "PF\n2 2\n-1\n", "not a grey PFM"),
        ("disparity/{}.pfm", "Pf\n1 1\n-1\n1234", "is 1x1"),
        ("background/{}.png", "", "empty"),
    ],
)
def test_damaged_runs_are_named(truth: Truth, name: str, text: str, says: str) -> None:
    (truth.folder / name.format(STAMPS[0])).write_text(text)
    with pytest.raises(DatasetError, match=says) as caught:
        RunFolder(truth.folder).frame(STAMPS[0])
    assert str(truth.folder) in str(caught.value)


def test_a_folder_of_several_runs_names_them(truth: Truth) -> None:
    with pytest.raises(DatasetError, match=r"name one of them \(out\)"):
        RunFolder(truth.folder.parent)
    with pytest.raises(DatasetError, match=r"no run\.json"):
        RunFolder(truth.folder / "masks")


@pytest.mark.parametrize("to", [*BAGS, "exr"])
def test_a_missing_package_names_the_extra(truth: Truth, to: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("rosbags.typesys", "OpenEXR"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        MissingExtraError, match=rf"--to {to} needs .* 'seepast\[{'exr' if to == 'exr' else 'rosbag'}\]'"
    ):
        exported(truth, to)
    assert {p.name for p in truth.folder.parent.iterdir()} == {"out"}


def test_a_format_of_ones_own_is_one_function(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    def write_times(view: Any, frames: Any, path: Path, options: ExportOptions) -> None:
        path.write_text(" ".join(f"{view.camera}:{time}" for time, _ in frames))

    monkeypatch.setitem(EXPORTERS, "times", Exporter(write_times, ".txt"))
    assert exported(truth, "times").read_text() == " ".join(f"cam0:{time}" for time in TIMES)


@pytest.mark.parametrize("options", [{"min_coverage": -1}, {"depth": "8UC1"}, {"depth_factor": 0.0}])
def test_options_out_of_range(options: dict[str, Any]) -> None:
    with pytest.raises(OptionsError, match="--" + next(iter(options)).replace("_", "-")):
        ExportOptions(**options)


# --- the command -----------------------------------------------------------------------------------------------------


def test_the_command_exports_beside_the_run(truth: Truth, capsys: pytest.CaptureFixture[str]) -> None:
    for to in FORMATS:
        assert cli.main(["export", str(truth.folder), "--to", to]) == 0
    printed = capsys.readouterr()
    beside = {"tum": "out_tum", "mcap": "out.mcap", "rosbag1": "out.bag"}
    for line, to in zip(printed.out.splitlines(), FORMATS, strict=True):
        assert line == f"out: 3 frames as {to}, {truth.folder.with_name(beside.get(to, f'out_{to}'))}"
    assert printed.err == ""
    assert cli.main(["export", str(truth.folder), "--to", "mcap"]) == 2
    assert cli.main(["export", str(truth.folder), "--to", "obj"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert "--overwrite" in errors[0] and "tum, mcap, rosbag2, rosbag1, ply, exr" in errors[1] and len(errors) == 2


def test_the_command_takes_every_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = write_run(tmp_path / "out", stamps=("000000", "000001"))
    said = ["--json", "--to", "exr", "--out", str(tmp_path / "exr")]
    assert cli.main(["export", str(truth.folder), *said]) == 0
    line = {"name": "out", "to": "exr", "path": str(tmp_path / "exr"), "frames": 2}
    assert json.loads(capsys.readouterr().out) == line
    words = ["--to", "tum", "--rate", "4", "--min-coverage", "3", "--depth-factor", "1000", "--out", tmp_path / "slam"]
    assert cli.main(["export", str(truth.folder), *map(str, words)]) == 0
    (first, _, depth), (second, *_) = read_associations(tmp_path / "slam")
    assert (first, second) == ("1.000000000", "1.250000000")
    np.testing.assert_allclose(depth / 1000, truth.depth("000000", 3), atol=0.51e-3)
    bag = ["--to", "mcap", "--depth", "16UC1", "--stamps", "ms", "--out", tmp_path / "x.mcap"]
    assert cli.main(["export", str(truth.folder), *map(str, bag)]) == 0
    assert [m.time for m in read_bag(tmp_path / "x.mcap")["/seepast/depth/image_rect_raw"]] == [0, 10**6]


def test_names_sort_by_time_whatever_their_length(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "out", stamps=("9.5", "10.5"))
    folder = exported(truth, "tum")
    assert sorted(p.name for p in (folder / "rgb").iterdir()) == [
        "0000000009.500000000.png",
        "0000000010.500000000.png",
    ]
    times = [m.time for m in read_bag(exported(truth, "rosbag1"))["/seepast/disparity"]]
    assert times == [9500000000, 10500000000]
