"""RGB-D folders in the layout of the TUM benchmark, which ORB-SLAM, DynaSLAM and RTAB-Map read.

    rgb/<seconds>.png     the static scene; depth/<seconds>.png  uint16, depth_factor units per metre, 0 unknown
    mask/<seconds>.png    for DynaSLAM: 1 where enough cameras saw the pixel, 0 where its colour is a guess
    rgb.txt depth.txt associations.txt      "<seconds> <file>" lines; file names are seconds too
    orbslam2.yaml orbslam3.yaml             settings of ORB-SLAM2 (and DynaSLAM) and of ORB-SLAM3
    rtabmap_calib.yaml, rgb_sync, depth_sync    what rtabmap-rgbd_dataset asks for; the latter two are links

Formats: "File Formats" of the TUM RGB-D benchmark (Sturm et al. 2012); the keys are those that ORB_SLAM2's Tracking.cc,
ORB_SLAM3's Settings.cc and RTAB-Map's CameraModel::load ask for.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from .atomic import write_bytes, write_png
from .protocol import ExportOptions
from .reading import View, Written
from .times import frame_rate, seconds

log = logging.getLogger("seepast")

LARGEST = 65535  # of uint16
CLOSE_BASELINES = 40.0  # a point is "close" up to 40 baselines away: Mur-Artal and Tardos 2017, section III-A

_ORB = """\
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def write_tum(view: View, frames: Iterable[tuple[int, Written]], path: Path, options: ExportOptions) -> None:
    """The protocol's Write. Depth beyond 65535 / depth_factor metres (13.1 m for TUM's 5000) becomes unknown."""
    times: list[int] = []
    lost = known = 0
    for time, frame in frames:
        name = file_name(time)
        depth = depth_units(frame.depth, options.depth_factor)
        write_png(path / "rgb" / name, frame.background)
        write_png(path / "depth" / name, depth)
        write_png(path / "mask" / name, (frame.coverage >= options.min_coverage).astype(np.uint8))
        times.append(time)
        known += np.count_nonzero(frame.depth)
        lost += np.count_nonzero(frame.depth) - np.count_nonzero(depth)
    _write_lists(path, times)
    _write_cameras(path, view, options, frame_rate(times, options.rate))
    for name in ("rgb", "depth"):
        with contextlib.suppress(OSError):  # some file systems have no links; RTAB-Map's window reads rgb/ and depth/
            (path / f"{name}_sync").symlink_to(name, target_is_directory=True)
    if lost:
        log.warning(
            "%.2g %% of the depth lies beyond %.1f m, what 16 bits hold at %g units per metre, and is left out; "
            "a smaller --depth-factor reaches farther",
            100 * lost / known, LARGEST / options.depth_factor, options.depth_factor,
        )  # fmt: skip


def file_name(time: int) -> str:
    """Seconds padded with zeros to ten digits, so that the names' order is that of time."""
    return f"{seconds(time):0>20}.png"


def depth_units(depth: np.ndarray, factor: float) -> np.ndarray:
    """uint16 [H, W] of `factor` units per metre from float32 metres; 0 where unknown or beyond 16 bits."""
    units = np.rint(depth.astype(np.float64) * factor)
    return np.where(units <= LARGEST, units, 0).astype(np.uint16)


def _write_lists(path: Path, times: Sequence[int]) -> None:
    named = [(seconds(time), file_name(time)) for time in times]
    for kind, what in (("rgb", "color images"), ("depth", "depth maps")):
        lines = [f"# {what}", f"# frames: {len(times)}", "# timestamp filename"]
        lines += [f"{second} {kind}/{name}" for second, name in named]
        write_bytes(path / f"{kind}.txt", ("\n".join(lines) + "\n").encode())
    pairs = [f"{second} rgb/{name} {second} depth/{name}\n" for second, name in named]
    write_bytes(path / "associations.txt", "".join(pairs).encode())  # ORB-SLAM takes no comments in this one


def _write_cameras(path: Path, view: View, options: ExportOptions, rate: float) -> None:
    for name, text in (
        ("orbslam2.yaml", orbslam2_yaml(view, options.depth_factor, rate)),
        ("orbslam3.yaml", orbslam3_yaml(view, options.depth_factor, rate)),
        ("rtabmap_calib.yaml", rtabmap_yaml(view, "rtabmap_calib")),
    ):
        write_bytes(path / name, text.encode())


def orbslam2_yaml(view: View, depth_factor: float, rate: float) -> str:
    """Settings of ORB-SLAM2 and what was built on it; the baseline is the array's, f * B in px * m."""
    return (
        f'%YAML:1.0\nCamera.type: "PinHole"\n{_pinhole("Camera", view)}'
        f"Camera.bf: {view.focal_baseline!r}\nCamera.fps: {rate!r}\n{_BGR}"
        f"ThDepth: {CLOSE_BASELINES!r}\nDepthMapFactor: {depth_factor!r}\n{_ORB}"
    )


def orbslam3_yaml(view: View, depth_factor: float, rate: float) -> str:
    """Settings of ORB-SLAM3, File.version 1.0, which wants whole frames per second and the baseline in metres."""
    return (
        f'%YAML:1.0\nFile.version: "1.0"\nCamera.type: "PinHole"\n{_pinhole("Camera1", view)}'
        f"Camera.fps: {max(1, round(rate))}\n{_BGR}"
        f"Stereo.b: {view.baseline!r}\nStereo.ThDepth: {CLOSE_BASELINES!r}\n"
        f"RGBD.DepthMapFactor: {depth_factor!r}\n{_ORB}"
    )


def rtabmap_yaml(view: View, name: str) -> str:
    """The calibration format of ROS (camera_calibration_parsers), as OpenCV's FileStorage reads it."""
    projection = np.hstack([view.matrix, np.zeros((3, 1))])
    matrices = (
        ("camera_matrix", view.matrix),
        ("distortion_coefficients", np.zeros((1, 5))),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", projection),
    )
    width, height = view.size
    head = f'%YAML:1.0\n---\ncamera_name: "{name}"\nimage_width: {width}\nimage_height: {height}\n'
    return head + 'distortion_model: "plumb_bob"\n' + "".join(_matrix(*matrix) for matrix in matrices)


_BGR = "Camera.RGB: 0\n"  # these programs read with cv::imread, which gives BGR


def _pinhole(prefix: str, view: View) -> str:
    (fx, fy), (cx, cy), (width, height) = view.focal, view.center, view.size
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    lines = [f"{prefix}.{key}: {value!r}\n" for key, value in values.items()]
    return "".join(lines) + f"Camera.width: {width}\nCamera.height: {height}\n"


def _matrix(name: str, values: np.ndarray) -> str:
    data = ", ".join(repr(float(value)) for value in values.ravel())
    return f"{name}:\n   rows: {values.shape[0]}\n   cols: {values.shape[1]}\n   data: [ {data} ]\n"
