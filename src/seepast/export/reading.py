"""What a run wrote, read back: the view of camera.yaml and its frames."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from ..datasets.png import read_png8
from ..errors import DatasetError
from .folder import CAMERA_FILE, RUN_FILE

log = logging.getLogger("seepast")


@dataclass(frozen=True, eq=False)
class View:
    """The rectified reference view that a run's pictures live in: a pinhole without distortion.

    camera          name of the reference camera
    focal, center   (fx, fy) and (cx, cy) px, pixel centres at integer coordinates
    size            (width, height) px
    baseline        B in metres, from the reference to the farthest camera; focal_baseline = fx * B in px * m
    cameras         names of the K cameras of the array
    positions       float64 [K, 3] metres, their centres in this view's axes (x right, y down, z forward)
    """

    camera: str
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]
    baseline: float
    focal_baseline: float
    cameras: tuple[str, ...]
    positions: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """float64 [3, 3]: K."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def farthest(self) -> int:
        """The camera that the baseline reaches to."""
        return int(np.argmax(np.linalg.norm(self.positions, axis=1)))

    def depth(self, disparity: np.ndarray) -> np.ndarray:
        """float32 [H, W] metres from px over the array; 0 where the disparity is 0 (unknown)."""
        known = disparity > 0
        return np.where(known, self.focal_baseline / np.where(known, disparity, 1), 0).astype(np.float32)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """float32 [H, W, 3] metres, x right, y down, z forward, from depth float32 [H, W] in metres."""
        y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
        (fx, fy), (cx, cy) = self.focal, self.center
        return np.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Written:
    """One frame of a run; H x W pixels of the View.

    background  uint8 [H, W, 3] BGR, or [H, W] grey
    disparity   float32 [H, W] px over the array; depth  float32 [H, W] metres; 0 = unknown in both
    coverage    uint8 [H, W]: how many cameras the pixel rests on; 0 = a guess
    confidence  float32 [H, W] in 0..1, None where the run wrote none
    masks       camera name -> uint8 [h, w] of 255 * P(dynamic), in that camera's own pixels
    """

    stamp: str
    background: np.ndarray
    disparity: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    confidence: np.ndarray | None
    masks: Mapping[str, np.ndarray]

    def seen_by(self, cameras: int) -> Written:
        """The same frame, its disparity and depth unknown where fewer than that many cameras saw the pixel."""
        seen = self.coverage >= cameras
        return replace(self, disparity=np.where(seen, self.disparity, 0), depth=np.where(seen, self.depth, 0))


class RunFolder:
    """The output folder of one run. Files are listed on opening and decoded one frame at a time.

    path      the folder
    view      View of camera.yaml
    settings  run.json as it is
    stamps    names of the finished frames, sorted; unfinished ones are left out with one warning

    Raises DatasetError where the folder is no output of a run or holds no finished frame.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.settings = _read_settings(self.path)
        self.view = read_view(self.path / CAMERA_FILE)
        self.stamps = self._finished()

    def frame(self, stamp: str) -> Written:
        """Decode one frame. Raises DatasetError naming the file that cannot be used, and why."""
        disparity = read_pfm(self.path / "disparity" / f"{stamp}.pfm")
        masks = {name: read_png8(self.path / "masks" / name / f"{stamp}.png") for name in self.view.cameras}
        frame = Written(
            stamp,
            read_png8(self.path / "background" / f"{stamp}.png"),
            disparity,
            self.view.depth(disparity),
            read_png8(self.path / "coverage" / f"{stamp}.png"),
            self._confidence(stamp),
            masks,
        )
        self._check_sizes(frame)
        return frame

    def _files(self, stamp: str) -> list[Path]:
        singles = [f"background/{stamp}.png", f"disparity/{stamp}.pfm", f"coverage/{stamp}.png"]
        return [self.path / name for name in singles + [f"masks/{c}/{stamp}.png" for c in self.view.cameras]]

    def _finished(self) -> tuple[str, ...]:
        begun = sorted(p.stem for p in self.path.glob("background/*.png") if not p.name.startswith("."))
        finished = tuple(stamp for stamp in begun if all(path.is_file() for path in self._files(stamp)))
        if not finished:
            raise DatasetError(f"{self.path}: holds no finished frame; let `seepast run` finish one first")
        if len(finished) < len(begun):
            log.warning(
                "%s: leaving out %d of %d frames that are not finished; the same `seepast run` goes on with them",
                self.path, len(begun) - len(finished), len(begun),
            )  # fmt: skip
        return finished

    def _confidence(self, stamp: str) -> np.ndarray | None:
        folder = self.path / "confidence"
        if (folder / f"{stamp}.pfm").is_file():
            return read_pfm(folder / f"{stamp}.pfm")
        if (folder / f"{stamp}.png").is_file():
            return read_png8(folder / f"{stamp}.png").astype(np.float32) / 255
        return None

    def _check_sizes(self, frame: Written) -> None:
        width, height = self.view.size
        for name in ("background", "disparity", "coverage", "confidence"):
            values = getattr(frame, name)
            if values is not None and values.shape[:2] != (height, width):
                raise DatasetError(
                    f"{self.path / name}: frame {frame.stamp} is {values.shape[1]}x{values.shape[0]}, but "
                    f"{CAMERA_FILE} says {width}x{height}; run again with --overwrite"
                )


def read_view(path: Path) -> View:
    """camera.yaml as `seepast run` writes it. Raises DatasetError naming what is missing or wrong."""
    try:
        camera = yaml.safe_load(path.read_text())
        view = View(
            str(camera["camera"]),
            (float(camera["intrinsics"][0]), float(camera["intrinsics"][1])),
            (float(camera["intrinsics"][2]), float(camera["intrinsics"][3])),
            (int(camera["resolution"][0]), int(camera["resolution"][1])),
            float(camera["baseline"]),
            float(camera["focal_baseline"]),
            tuple(str(name) for name in camera["cameras"]),
            np.array(camera["positions"], np.float64).reshape(-1, 3),
        )
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error}); run `seepast run` again") from None
    except (yaml.YAMLError, KeyError, IndexError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: not the {CAMERA_FILE} of a run ({error}); run `seepast run` again") from None
    if len(view.positions) != len(view.cameras):
        raise DatasetError(
            f"{path}: lists {len(view.cameras)} cameras at {len(view.positions)} positions; run `seepast run` again"
        )
    return view


def read_pfm(path: Path) -> np.ndarray:
    """float32 [H, W] from a whole grey PFM of either byte order. Raises DatasetError."""
    try:
        kind, size, scale, data = path.read_bytes().split(b"\n", 3)
        width, height = (int(word) for word in size.split())
        values = np.frombuffer(data, "<f4" if float(scale) < 0 else ">f4")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error}); restore the file") from None
    except ValueError:
        raise DatasetError(f"{path}: not a grey PFM file; run `seepast run` again") from None
    if kind.strip() != b"Pf" or values.size != width * height:
        raise DatasetError(f"{path}: truncated, or not a grey PFM file; run `seepast run` again")
    return values.reshape(height, width)[::-1].astype(np.float32)


def colour(image: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] BGR of a grey or colour image."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        settings = json.loads((path / RUN_FILE).read_text())
        if isinstance(settings, dict):
            return settings
    except ValueError:
        pass
    except OSError:
        inside = sorted(p.parent.name for p in path.glob(f"*/{RUN_FILE}"))
        if inside:
            raise DatasetError(
                f"{path}: holds the outputs of {len(inside)} runs; name one of them ({', '.join(inside)})"
            ) from None
        raise DatasetError(f"{path}: no {RUN_FILE}; name a folder that `seepast run` wrote") from None
    raise DatasetError(f"{path / RUN_FILE}: not the JSON of a run; run `seepast run` again")
