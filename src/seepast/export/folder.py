"""Folders out: background/, disparity/, depth/, confidence/, coverage/, masks/camK/, camera.yaml and run.json.

Every file appears whole or not at all, and a frame counts as done once its last file is there, so a run that
was interrupted, killed or out of disk space goes on with the next frame when it is started again.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import yaml

from ..errors import OutputError
from . import atomic

if TYPE_CHECKING:
    from ..geometry import ArrayGeometry
    from ..result import Result

RUN_FILE = "run.json"
CAMERA_FILE = "camera.yaml"
RUN_FILE_EVERY = 5.0  # seconds between two versions of run.json while frames come in
MAX_DEPTH_MM = 65535  # 16UC1; what lies farther is written as unknown, never as a wrong distance


@dataclass(frozen=True)
class Run:
    """What determines an output: two runs that agree in all of this may share a folder.

    seepast       version
    dataset       absolute path; masks = the absolute folder of masks, or "none"
    rig           digest of the calibration
    dynamic_only  only pixels that a person hides are synthesised
    options       flat, "stage.field" -> value
    segmenter     what made the masks, as it describes itself (with the SHA-256 of its model); None: files
    reading       what was chosen on opening the recording (reader, topics, tolerance); None: there is no choice
    settings      flags that make the same run again (settings.FLAGS); two runs may differ in how they say it
    """

    seepast: str
    dataset: str
    masks: str
    rig: str
    reference: str
    backend: str
    dynamic_only: bool
    options: Mapping[str, Any]
    segmenter: Mapping[str, Any] | None = None
    reading: Mapping[str, Any] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


class FolderWriter:
    """Writes one sequence into `out`, frame by frame, and picks up where an earlier equal run stopped.

    run      what is about to run; a folder of another run is refused unless `overwrite`
    cameras  names of the K cameras, in the order of Result.masks
    rotation float64[3, 3] rectified_from_cam of the reference camera, for camera.yaml

        with FolderWriter(out, run, cameras) as writer:
            if not writer.done(stamp):
                writer.write(stamp, result)

    Raises OutputError where `out` cannot be written, is not a folder, or holds anything but an equal run.
    """

    def __init__(
        self,
        out: str | Path,
        run: Run,
        cameras: Sequence[str],
        *,
        rotation: np.ndarray | None = None,
        overwrite: bool = False,
    ):
        self.out = Path(out)
        self.cameras = tuple(cameras)
        self._rotation = rotation
        self._run = json.loads(json.dumps(asdict(run)))
        self._milliseconds: list[Mapping[str, float]] = []
        self._run_written = -RUN_FILE_EVERY
        self._covered: list[float] = []
        _make_writable(self.out)
        self._before = _earlier_run(self.out)
        self._take_over(overwrite)
        self._by_frame = dict((self._before or {}).get("frame_milliseconds") or {})
        atomic.remove_parts(self.out)

    def __enter__(self) -> FolderWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def files(self, stamp: str) -> list[Path]:
        """The files of one frame in the order they are written."""
        masks = [self.out / "masks" / name / f"{stamp}.png" for name in self.cameras]
        kinds = ("background/{}.png", "disparity/{}.pfm", "depth/{}.png", "confidence/{}.png")
        last = self.out / "coverage" / f"{stamp}.png"
        return [self.out / kind.format(stamp) for kind in kinds] + masks + [last]

    def done(self, stamp: str) -> bool:
        return all(path.is_file() for path in self.files(stamp))

    def write(self, stamp: str, result: Result, total_ms: float) -> None:
        """Write one frame; its stage times, the time it took in all and its coverage enter run.json."""
        if not (self.out / RUN_FILE).is_file():
            self._write_run()
        if not (self.out / CAMERA_FILE).is_file():
            self._write_camera(result.geometry)
        background, disparity, depth, confidence, *masks, coverage = self.files(stamp)
        coverage.unlink(missing_ok=True)  # a frame that is redone is unfinished until the end
        atomic.write_png(background, result.background)
        atomic.write_pfm(disparity, result.disparity)
        atomic.write_png(depth, depth_millimetres(result.depth))
        atomic.write_png(confidence, np.rint(255 * result.confidence).astype(np.uint8))
        for path, mask in zip(masks, result.masks, strict=True):
            atomic.write_png(path, mask)
        atomic.write_png(coverage, result.coverage)
        self._milliseconds.append({**result.timings, "total": total_ms})
        self._by_frame[stamp] = {stage: round(ms, 3) for stage, ms in self._milliseconds[-1].items()}
        self._covered.append(float((result.coverage > 0).mean()))
        if time.monotonic() - self._run_written >= RUN_FILE_EVERY:
            self._write_run()

    def close(self) -> None:
        """Leave run.json with the figures of this run; one that added no frame keeps the earlier figures."""
        if (self.out / RUN_FILE).is_file():
            self._write_run()

    def summary(self) -> dict[str, Any]:
        """frames, timed_frames, coverage_share (mean share of pixels seen), milliseconds (medians)."""
        if not self._milliseconds and self._before:
            earlier = {key: self._before[key] for key in _figures(0, [], []) if key in self._before}
            return {**_figures(0, [], []), **earlier, "frames": self._finished()}
        return _figures(self._finished(), self._milliseconds, self._covered)

    def _finished(self) -> int:
        return sum(self.done(path.stem) for path in (self.out / "coverage").glob("*.png"))

    def _take_over(self, overwrite: bool) -> None:
        """Make sure that nothing but frames of this very run lies in the folder."""
        if self._before is None:
            return
        different = _differences(self._before, self._run)
        if not different and not overwrite:
            return
        if different and not overwrite and self._finished():
            raise OutputError(
                f"{self.out}: holds the frames of another run ({'; '.join(different)}); add --overwrite to "
                "replace them, or name another folder"
            )
        _remove_results(self.out)
        self._before = None

    def _write_run(self) -> None:
        versions = {"seepast": self._run["seepast"], "python": platform.python_version(), **_libraries()}
        settings = {key: value for key, value in self._run.items() if key not in ("seepast", "options")}
        atomic.write_json(
            self.out / RUN_FILE,
            {
                "versions": versions,
                **settings,
                **self.summary(),
                "options": self._run["options"],
                "frame_milliseconds": self._by_frame,
            },
        )
        self._run_written = time.monotonic()

    def _write_camera(self, geometry: ArrayGeometry) -> None:
        atomic.write_bytes(self.out / CAMERA_FILE, camera_yaml(geometry, self.cameras, self._rotation).encode())


def depth_millimetres(depth: np.ndarray) -> np.ndarray:
    """uint16 [H, W] millimetres (REP 118 16UC1) from metres; 0 where unknown or beyond 65.535 m."""
    millimetres = np.rint(np.nan_to_num(np.asarray(depth, np.float64), nan=0, posinf=0, neginf=0) * 1000)
    return np.where((millimetres > 0) & (millimetres <= MAX_DEPTH_MM), millimetres, 0).astype(np.uint16)


def camera_yaml(geometry: ArrayGeometry, cameras: Sequence[str], rotation: np.ndarray | None = None) -> str:
    """The view that all outputs live in: Kalibr's names for its intrinsics, metres and px for the array.

    rotation: float64[3, 3] rectified_from_cam of the reference camera; None says nothing about it.
    """
    camera: dict[str, Any] = {
        "camera": cameras[geometry.reference],
        "camera_model": "pinhole",
        "distortion_model": "none",
        "intrinsics": [float(v) for v in (*geometry.focal, *geometry.center)],
        "resolution": [int(v) for v in geometry.size],
        "baseline": float(geometry.baseline),
        "focal_baseline": float(geometry.focal_baseline),
        "cameras": list(cameras),
        "positions": [[float(v) for v in position] for position in geometry.positions],
    }
    comment = (
        "# The rectified reference view: intrinsics fx fy cx cy, resolution in px, pixel centres integer.\n"
        "# depth [m] = focal_baseline [px m] / disparity [px]; baseline, positions in metres.\n"
    )
    if rotation is not None:
        camera["rectified_from_cam"] = np.asarray(rotation, np.float64).tolist()
        comment += "# rectified_from_cam: directions of the camera as calibrated -> directions of this view.\n"
    return comment + yaml.safe_dump(camera, sort_keys=False, default_flow_style=None)


def _figures(frames: int, milliseconds: Sequence[Mapping[str, float]], covered: Sequence[float]) -> dict[str, Any]:
    stages = list(dict.fromkeys(stage for frame in milliseconds for stage in frame))
    medians = {s: round(statistics.median(frame.get(s, 0.0) for frame in milliseconds), 3) for s in stages}
    share = round(statistics.fmean(covered), 6) if covered else None
    return {"frames": frames, "timed_frames": len(covered), "coverage_share": share, "milliseconds": medians}


def _make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise OutputError(f"{out}: is a file; name a folder") from None
    except OSError as error:
        raise OutputError(f"{out}: cannot be made ({error.strerror or error}); name another folder") from None
    if not os.access(out, os.W_OK | os.X_OK):
        raise OutputError(f"{out}: may not be written to; change its permissions or name another folder")


def _earlier_run(out: Path) -> dict[str, Any] | None:
    """run.json of an earlier run, None for an empty folder. Raises OutputError if something else is there."""
    entries = [p.name for p in out.iterdir() if not p.name.endswith(atomic.PART_SUFFIX)]
    if not entries:
        return None
    with contextlib.suppress(OSError, ValueError):
        run = json.loads((out / RUN_FILE).read_text())
        if isinstance(run, dict) and "seepast" in run.get("versions", {}):
            return run
    raise OutputError(
        f"{out}: exists and holds something else than a seepast run ({min(entries)}, no {RUN_FILE} of ours); "
        "name another folder, or empty this one yourself"
    )


def changes_since(before: Mapping[str, Any], run: Run, *, segmenter: bool = True) -> list[str]:
    """In words, in what a repetition of the run of run.json `before` cannot be equal, whatever its settings say.

    segmenter  whether the segmenter is to be the same one; the calibration is, where the recording is.
    """
    now = json.loads(json.dumps(asdict(run)))
    fixed = {"seepast", *(["rig"] if before.get("dataset") == now["dataset"] else [])}
    told = _differences(before, now)
    changes = [text for text in told if text.partition(":")[0] in fixed or (segmenter and text.startswith("segmenter"))]
    old = before.get("versions", {})
    return changes + [f"{n}: {old[n]} there, {v} now" for n, v in _libraries().items() if n in old and old[n] != v]


def _libraries() -> dict[str, str]:
    return {"numpy": np.__version__, "opencv": cv2.__version__}


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """In words, what two runs do not agree in."""

    def flat(run: Mapping[str, Any]) -> dict[str, Any]:
        settings = {key: run.get(key) for key in now if key not in ("options", "seepast", "segmenter", "settings")}
        version = run.get("seepast", run.get("versions", {}).get("seepast"))
        return {"seepast": version, **settings, **segmenter(run), **(run.get("options") or {})}

    def segmenter(run: Mapping[str, Any]) -> dict[str, Any]:
        said = run.get("segmenter") or {"kind": "files"}
        if not (before.get("segmenter") and now.get("segmenter")):
            return {"segmenter": said["kind"]}
        return {f"segmenter.{key}": value for key, value in said.items()}

    old, new = flat(before), flat(now)
    keys = [key for key in dict.fromkeys([*new, *old]) if old.get(key) != new.get(key)]
    return [f"{key}: {old.get(key)} there, {new.get(key)} now" for key in keys]


def _remove_results(out: Path) -> None:
    """Remove what a run writes, run.json last, and nothing else."""
    kinds = ("coverage/*.png", "background/*.png", "disparity/*.pfm", "depth/*.png", "confidence/*.png")
    try:
        for pattern in (*kinds, "masks/cam*/*.png", CAMERA_FILE, RUN_FILE):
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be removed ({error.strerror}); do it by hand") from None
