"""Cameras and arrays of them, and the Kalibr camchain files that describe them.

Poses are 4x4 matrices named target_from_source: `cam_from_rig` maps a point of the rig frame, which is cam0's
frame (x right, y down, z forward, metres), into the camera's. Kalibr's T_cn_cnm1 of camera n is
cam_n_from_cam_(n-1), T_cam_imu is cam_from_imu, and T_imu_cam its inverse.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .camera_models import check_model, project, unproject
from .errors import OutputError, RigError
from .geometry import MAX_CAMERAS

log = logging.getLogger("seepast")

MAX_ROTATION_ERROR = 5e-3  # of max |R R^T - I|: matrices typed with three decimals still pass
MIN_BASELINE = 1e-6  # metres

_CAMERA_KEY = re.compile(r"cam(?:era)?_?(\d+)")
_ALIASES = {"plumb_bob": "radtan", "radial-tangential": "radtan", "equi": "equidistant", "": "none"}


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    name               "cam0", "cam1", ...: also the name of its folder in a dataset
    model, distortion  "pinhole" | "omni" | "ds", "radtan" | "equidistant" | "none": see camera_models.py
    intrinsics         px, in Kalibr's order for the model
    distortion_coeffs  in Kalibr's order for the distortion
    resolution         (width, height) px
    cam_from_rig       float64[4, 4]; a nearly orthonormal rotation becomes the nearest proper one
    topic              ROS topic, if the file names one

    Raises RigError, naming the camera, when a value cannot be used.
    """

    name: str
    model: str
    distortion: str
    intrinsics: tuple[float, ...]
    distortion_coeffs: tuple[float, ...]
    resolution: tuple[int, int]
    cam_from_rig: np.ndarray
    topic: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "intrinsics", tuple(float(v) for v in self.intrinsics))
        object.__setattr__(self, "distortion_coeffs", tuple(float(v) for v in self.distortion_coeffs))
        object.__setattr__(self, "resolution", _resolution(self.name, self.resolution))
        object.__setattr__(self, "cam_from_rig", proper_pose(self.cam_from_rig, f"{self.name}: cam_from_rig"))
        check_model(self.name, self.model, self.distortion, self.intrinsics, self.distortion_coeffs)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in this camera's frame -> pixels (..., 2) float64; NaN where unseen."""
        return project(self.model, self.distortion, self.intrinsics, self.distortion_coeffs, points)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) -> unit rays (..., 3) float64 in this camera's frame; NaN where no ray reaches."""
        return unproject(self.model, self.distortion, self.intrinsics, self.distortion_coeffs, pixels)

    @property
    def undistorted(self) -> bool:
        """True for an ideal pinhole camera: straight lines are straight in its image."""
        return self.model == "pinhole" and (
            self.distortion == "none" or (self.distortion == "radtan" and not any(self.distortion_coeffs))
        )

    @property
    def rotation(self) -> np.ndarray:
        """float64[3, 3] cam_from_rig rotation."""
        return self.cam_from_rig[:3, :3]

    @property
    def center(self) -> np.ndarray:
        """float64[3] camera centre in the rig frame, metres."""
        return -self.rotation.T @ self.cam_from_rig[:3, 3]


@dataclass(frozen=True, eq=False)
class Rig:
    """2 to 16 rigidly mounted cameras in the order cam0, cam1, ...; poses are re-expressed in cam0's frame.

    Raises RigError for a wrong number of cameras, two of one name, or two in the same place.
    """

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        cameras = tuple(self.cameras)
        if not 2 <= len(cameras) <= MAX_CAMERAS:
            raise RigError(f"an array has 2 to {MAX_CAMERAS} cameras, this one has {len(cameras)}")
        names = [camera.name for camera in cameras]
        for name in names:
            if names.count(name) > 1:
                raise RigError(f"{names.count(name)} cameras are named '{name}'; give every camera its own name")
        if not np.array_equal(cameras[0].cam_from_rig, np.eye(4)):
            old_rig_from_rig = inverse_pose(cameras[0].cam_from_rig)
            cameras = tuple(
                replace(c, cam_from_rig=c.cam_from_rig @ old_rig_from_rig if i else np.eye(4))
                for i, c in enumerate(cameras)
            )
        object.__setattr__(self, "cameras", cameras)
        _check_places(cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def centers(self) -> np.ndarray:
        """float64[K, 3] camera centres in cam0's frame, metres."""
        return np.stack([camera.center for camera in self.cameras])

    def index(self, camera: int | str) -> int:
        """The index of a camera given by name or index ("cam0" or 0); RigError for one that is not there."""
        names = [c.name for c in self.cameras]
        if isinstance(camera, str):
            if camera in names:
                return names.index(camera)
            if camera.isdecimal() and int(camera) < len(names):
                return int(camera)
        elif not isinstance(camera, bool) and 0 <= camera < len(names):
            return int(camera)
        raise RigError(f"the rig has no camera {camera!r}; it has {', '.join(names)}")

    @classmethod
    def linear(
        cls,
        cameras: int,
        *,
        focal: float,
        spacing: float,
        size: tuple[int, int],
        center: tuple[float, float] | None = None,
    ) -> Rig:
        """An ideal, already rectified array: camera k at x = k * spacing metres, all with the same pinhole.

        focal px, size (width, height) px, center the principal point in px (default: the image's middle).
        """
        cx, cy = center if center is not None else ((size[0] - 1) / 2, (size[1] - 1) / 2)
        made = []
        for k in range(cameras):
            cam_from_rig = np.eye(4)
            cam_from_rig[0, 3] = -k * spacing
            made.append(Camera(f"cam{k}", "pinhole", "none", (focal, focal, cx, cy), (), size, cam_from_rig))
        return cls(tuple(made))

    @classmethod
    def from_kalibr(cls, path: str | Path) -> Rig:
        """Read a Kalibr camchain file; cameras come out as cam0 ... camK-1 (`camera_0` keys are renamed so).

        Extrinsics: T_cn_cnm1 where a camera has it, else T_cam_imu or its inverse T_imu_cam of it and
        the camera before; nested rows or 16 numbers in a row. Raises RigError naming the file, the camera and
        the mend.
        """
        try:
            entries = _camera_entries(load_yaml(Path(path)))
            cam_from_rig = np.eye(4)
            cameras = []
            for n, entry in enumerate(entries):
                if n:
                    cam_from_rig = _step(f"cam{n}", entry, entries[n - 1]) @ cam_from_rig
                cameras.append(_camera(f"cam{n}", entry, cam_from_rig))
            return cls(tuple(cameras))
        except RigError as error:
            raise RigError(f"{path}: {error}") from error

    def to_kalibr(self, path: str | Path) -> None:
        """Write a Kalibr camchain file with T_cn_cnm1 that `from_kalibr` reads back as the same rig.

        Cameras are written as cam0 ... camK-1, whatever their names. Raises OutputError when that fails.
        """
        entries: dict[str, dict[str, Any]] = {}
        for n, camera in enumerate(self.cameras):
            entry: dict[str, Any] = {
                "cam_overlaps": [i for i in range(len(self.cameras)) if i != n],
                "camera_model": camera.model,
                "distortion_coeffs": list(camera.distortion_coeffs),
                "distortion_model": camera.distortion,
                "intrinsics": list(camera.intrinsics),
                "resolution": list(camera.resolution),
                "rostopic": camera.topic or f"/cam{n}/image_raw",
            }
            if n:
                step = camera.cam_from_rig @ inverse_pose(self.cameras[n - 1].cam_from_rig)
                entry["T_cn_cnm1"] = step.tolist()
            entries[f"cam{n}"] = entry
        try:
            Path(path).write_text(yaml.safe_dump(entries, default_flow_style=None, width=110), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{path}: cannot write the rig: {error.strerror or error}") from error


def inverse_pose(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rigid 4x4 pose."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def proper_pose(pose: np.ndarray, what: str) -> np.ndarray:
    """float64[4, 4] with the nearest proper rotation (SVD); RigError, naming `what`, if none is close."""
    pose = np.array(pose, np.float64)
    if pose.shape != (4, 4):
        raise RigError(f"{what} must be a 4x4 matrix, not {' x '.join(map(str, pose.shape))}")
    if not np.isfinite(pose).all():
        raise RigError(f"{what} holds NaN or infinity: the calibration did not converge; repeat it")
    if abs(pose[3] - [0, 0, 0, 1]).max() > 1e-9:
        hint = "; it looks transposed" if not pose[:3, 3].any() else ""
        raise RigError(f"the last row of {what} is {pose[3].tolist()}, not [0, 0, 0, 1]{hint}")
    rotation = pose[:3, :3]
    error = float(abs(rotation @ rotation.T - np.eye(3)).max())
    if error > MAX_ROTATION_ERROR:
        raise RigError(
            f"the rotation of {what} is not orthonormal: max |R R^T - I| is {error:.3g}, at most "
            f"{MAX_ROTATION_ERROR:g} can be mended; look for a mistyped or missing number"
        )
    u, _, vt = np.linalg.svd(rotation)
    if np.linalg.det(u @ vt) < 0:
        raise RigError(f"the rotation of {what} is a mirror image (determinant -1); look for a lost sign")
    if error > 1e-12:  # cleaner ones keep their bits, so that a file written and read again is the same
        pose[:3, :3] = u @ vt
    if error > 1e-3:
        log.warning("%s: the rotation was orthonormal only to %.1g; using the nearest one", what, error)
    return pose


def _check_places(cameras: Sequence[Camera]) -> None:
    centers = [camera.center for camera in cameras]
    for j in range(len(cameras)):
        for i in range(j):
            distance = float(np.linalg.norm(centers[i] - centers[j]))
            if distance < MIN_BASELINE:
                raise RigError(
                    f"{cameras[i].name} and {cameras[j].name} are in the same place ({distance:.1g} m "
                    "apart); without a baseline there is no disparity: check the translations (in metres)"
                )


def _resolution(name: str, value: Any) -> tuple[int, int]:
    numbers = _numbers(value, f"{name}: resolution", 2)
    if not all(v > 0 and v.is_integer() for v in numbers):
        raise RigError(f"{name}: resolution {list(numbers)} must be two positive whole numbers: [width, height]")
    return int(numbers[0]), int(numbers[1])


class _UniqueKeysLoader(yaml.SafeLoader):
    """yaml.safe_load, except that a key given twice is an error instead of the last one winning."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if str(key.value) in seen:
                line = key.start_mark.line + 1
                raise RigError(f"'{key.value}' is given twice (again in line {line}); keep one of them")
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def load_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a calibration file; also OpenCV's dialect of YAML. Raises RigError that does not name the file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise RigError("there is no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RigError(f"cannot be read as text: {error}") from error
    try:
        content = yaml.load(_mended(text), _UniqueKeysLoader)
    except yaml.YAMLError as error:
        raise RigError(f"is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise RigError("is not a Kalibr camchain: it holds no 'cam0:', 'cam1:', ... entries")
    return content


def _mended(text: str) -> str:
    """OpenCV's and hand-edited YAML made plain; line numbers stay as they are."""
    text = re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(---|\.\.\.)\s*$", "", text, flags=re.MULTILINE)
    text = text.replace("\t", "    ").replace("!!opencv-matrix", "")
    return re.sub(r"^([ -]*[A-Za-z_]\w*)[ ]*:(?=\S)", r"\1: ", text, flags=re.MULTILINE)


def _camera_entries(content: dict[str, Any]) -> list[dict[str, Any]]:
    numbered: dict[int, dict[str, Any]] = {}
    for key, entry in content.items():
        match = _CAMERA_KEY.fullmatch(str(key))
        if not match:
            continue
        if int(match[1]) in numbered:
            raise RigError(f"'{key}' is a second camera {match[1]}; give every camera its own number")
        if not isinstance(entry, dict):
            raise RigError(f"'{key}' holds no parameters")
        numbered[int(match[1])] = entry
    if not numbered:
        keys = ", ".join(map(str, list(content)[:8]))
        raise RigError(f"is not a Kalibr camchain: it holds no 'cam0:', 'cam1:', ... entries but {keys}")
    if sorted(numbered) != list(range(len(numbered))):
        there = ", ".join(f"cam{n}" for n in sorted(numbered))
        raise RigError(f"cameras must be numbered cam0, cam1, ... without gaps, not {there}")
    if len(numbered) > 1 and not any(key in e for e in numbered.values() for key in _EXTRINSICS):
        raise RigError(
            f"has no extrinsics (none of {', '.join(_EXTRINSICS)}): the {len(numbered)} cameras were "
            "calibrated one by one; calibrate them together"
        )
    return [numbered[n] for n in range(len(numbered))]


_EXTRINSICS = ("T_cn_cnm1", "T_cam_imu", "T_imu_cam")


def _step(name: str, entry: dict[str, Any], previous: dict[str, Any]) -> np.ndarray:
    """The 4x4 pose cam_n_from_cam_(n-1)."""
    if "T_cn_cnm1" in entry:
        return _pose(entry["T_cn_cnm1"], f"{name}: T_cn_cnm1")
    this_from_imu = _cam_from_imu(name, entry)
    previous_from_imu = _cam_from_imu(f"the camera before {name}", previous)
    if this_from_imu is None or previous_from_imu is None:
        raise RigError(
            f"{name} has no extrinsics: it needs T_cn_cnm1, or T_cam_imu (or T_imu_cam) in it and in the camera before"
        )
    return this_from_imu @ inverse_pose(previous_from_imu)


def _cam_from_imu(name: str, entry: dict[str, Any]) -> np.ndarray | None:
    if "T_cam_imu" in entry:
        return _pose(entry["T_cam_imu"], f"{name}: T_cam_imu")
    if "T_imu_cam" in entry:
        return inverse_pose(_pose(entry["T_imu_cam"], f"{name}: T_imu_cam"))
    return None


def _camera(name: str, entry: dict[str, Any], cam_from_rig: np.ndarray) -> Camera:
    for key in ("camera_model", "intrinsics", "resolution"):
        if entry.get(key) is None:
            raise RigError(f"{name}: '{key}' is missing")
    coefficients = _numbers(entry.get("distortion_coeffs") or [], f"{name}: distortion_coeffs")
    distortion = str(entry.get("distortion_model") or "").lower()
    if not distortion and coefficients:
        raise RigError(f"{name}: 'distortion_model' is missing, yet there are distortion_coeffs")
    return Camera(
        name=name,
        model=str(entry["camera_model"]).lower(),
        distortion=_ALIASES.get(distortion, distortion),
        intrinsics=_numbers(entry["intrinsics"], f"{name}: intrinsics"),
        distortion_coeffs=coefficients,
        resolution=_resolution(name, entry["resolution"]),
        cam_from_rig=cam_from_rig,
        topic=str(entry["rostopic"]) if entry.get("rostopic") else None,
    )


def _pose(value: Any, what: str) -> np.ndarray:
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    numbers = _numbers(value, what)
    if len(numbers) == 12:
        numbers = (*numbers, 0.0, 0.0, 0.0, 1.0)
    if len(numbers) != 16:
        raise RigError(f"{what} must be 16 numbers (4 rows of 4), not {len(numbers)}")
    return proper_pose(np.reshape(numbers, (4, 4)), what)


def _numbers(value: Any, what: str, count: int | None = None) -> tuple[float, ...]:
    """A list of numbers, nested or not, flattened; "1e-3", which YAML takes for text, counts as a number."""
    numbers: list[float] = []
    pending = [value]
    while pending:
        item = pending.pop(0)
        if isinstance(item, (list, tuple, np.ndarray)):
            pending = [*item, *pending]
            continue
        try:
            if isinstance(item, (bool, np.bool_)):
                raise ValueError
            numbers.append(float(item))
        except (TypeError, ValueError):
            raise RigError(f"{what}: {item!r} is not a number") from None
    if not isinstance(value, (list, tuple, np.ndarray)):
        raise RigError(f"{what} must be a list of numbers, not {value!r}")
    if count is not None and len(numbers) != count:
        raise RigError(f"{what} must be {count} numbers, not {len(numbers)}")
    return tuple(numbers)
