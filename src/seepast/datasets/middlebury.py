"""Middlebury multi-view folders in: view0 ... view6 (2005, 2006) or im0 ... im8 (2001, 2003), .png or .ppm.

The cameras are equally spaced and the views rectified (D. Scharstein, vision.middlebury.edu/stereo/data). The truth is
disp1, disp5 or disp2, disp6: the disparity between these two views, times a scale, 0 = unknown. The views of 2005 and
2006 are cropped, which makes all their disparities dmin smaller; dmin.txt tells it in px of the full size.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ..errors import DatasetError
from ..rig import Camera, Rig
from .eight_bits import FULL, EightBits
from .png import read_png8
from .protocol import OpenOptions, said_bits
from .recording import DEFAULT_MASKS, RIG_FILE, MaskFolder, Recording, find_rig, mask_path

STAMP = "000000"
FOCAL, SPACING, FULL_HEIGHT = 3740.0, 0.04, 1110  # px, metres, px: the rig of 2005 and 2006 at full size
NOMINAL_FOCAL = 2.8  # image widths, about that of the same rig, where nothing is known
TRUTH_STEPS = 4  # spacings between the two views with truth
_SCALES_2003 = {1800: 1, 900: 2, 450: 4}  # by image width
_SCALE_2001 = 8
_VIEW = re.compile(r"(view|im)(\d)\.(png|ppm)")


def is_middlebury_dataset(path: Path) -> bool:
    if not path.is_dir() or (path / "cam0").is_dir() or (path / "calib.txt").is_file():  # 2014: two views, calibrated
        return False
    return len(_views(path)) >= 2


def _views(path: Path) -> dict[int, Path]:
    """Position in the array -> image; "view" before "im", .png before .ppm, if there are both."""
    found = [(match, file) for file in path.iterdir() if (match := _VIEW.fullmatch(file.name))]
    found.sort(key=lambda pair: (pair[0][1] != "view", pair[0][3]), reverse=True)
    kind = found[-1][0][1] if found else ""
    return dict(sorted((int(match[2]), file) for match, file in found if match[1] == kind))


class MiddleburyDataset(Recording):
    """One instant, "000000", of the views in a folder; their first is cam0.

    Without a rig file (--rig, or rig.yaml in the folder) the rig is linear. For view0 ... in one of the published sizes
    focal length, spacing and, by dmin.txt, principal points are the true ones, so depth is in metres; otherwise they
    are nominal, and depth is right up to a factor only (with cropped views not even that). Nothing is dynamic unless
    there is a folder of masks. Raises RigError, DatasetError.

    truth  names of the cameras whose disparity is known
    """

    def __init__(self, path: str | Path, options: OpenOptions | None = None):
        path, options = Path(path), options or OpenOptions()
        views = _views(path)
        if len(views) < 2:
            raise DatasetError(f"{path}: no Middlebury views; name a folder with view0.png ... or im0.ppm ...")
        self._files = list(views.values())
        self._positions = list(views)
        self._offset = _crop(path, _size(self._files[0])[0])
        rig, rig_file = self._rig(path, options)
        masks = None
        if options.masks is not None or (path / DEFAULT_MASKS).is_dir():
            masks = mask_path(path, options.masks)
        super().__init__(path, rig, rig_file, [STAMP], masks, options.bits)
        self.reading = {"reader": "middlebury", **said_bits(options)} if said_bits(options) else None
        self.truth = tuple(rig.cameras[k].name for k in range(len(rig)) if self._truth_file(k))
        if masks is not None:
            self._folder = MaskFolder(masks, [camera.name for camera in rig.cameras], [[(STAMP,)]] * len(rig))

    def true_disparity(self, camera: str) -> np.ndarray:
        """float32[h, w] px over the full array of a camera in `truth`, as a run from it would find; 0 = unknown.

        Raises DatasetError where there is none, or its scale is unknown (an image size that was not published).
        """
        k = self.rig.index(camera)
        file = self._truth_file(k)
        if file is None:
            raise DatasetError(f"{self.path}: no true disparity of {camera}, only of {', '.join(self.truth) or 'none'}")
        coded = _read(file)
        if coded.ndim != 2:
            raise DatasetError(f"{file}: in colour; the published disparities are grey: copy it again")
        per_step = (coded.astype(np.float32) / _scale(file, self._files[k], coded) + self._offset) / TRUTH_STEPS
        here = self._positions[k]
        steps = max(abs(position - here) for position in self._positions)
        return np.where(coded > 0, per_step * steps, 0).astype(np.float32)

    def _rig(self, path: Path, options: OpenOptions) -> tuple[Rig, Path]:
        if options.rig is None and not (path / RIG_FILE).is_file():
            return _linear(self._files, self._positions, self._offset), self._files[0]
        rig, rig_file = find_rig(path, options)
        if len(rig) != len(self._files):
            raise DatasetError(f"{rig_file}: has {len(rig)} cameras, but {path} {len(self._files)} views; name another")
        return rig, rig_file

    def _truth_file(self, camera: int) -> Path | None:
        position, kind = self._positions[camera], self._files[camera].stem.rstrip("0123456789")
        if position not in ((1, 5) if kind == "view" else (2, 6)):
            return None
        folders = [self.path, *list(self.path.parents)[:2]] if kind == "view" else [self.path]  # above Illum1/Exp1/
        names = [folder / f"disp{position}.{suffix}" for folder in folders for suffix in ("png", "pgm")]
        return next((name for name in names if name.is_file()), None)

    def _images(self, index: int) -> Sequence[np.ndarray]:
        return [_read(file, self._deep) for file in self._files]

    def _masks(self, index: int) -> Sequence[np.ndarray]:
        return [self._folder.read(k, index) for k in range(len(self.rig))]

    def _where(self, camera: int, index: int) -> str:
        return str(self._files[camera])


def _read(file: Path, deep: EightBits | None = None) -> np.ndarray:
    if file.suffix == ".png":
        return read_png8(file, deep)
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if image is not None and image.dtype == np.uint16 and deep is not None:
        return deep(file, image)
    if image is None or image.dtype != np.uint8:
        raise DatasetError(f"{file}: cannot be decoded as an image of 8 or 16 bits; copy it again")
    return image


def _size(file: Path) -> tuple[int, int]:
    """Height and width."""
    height, width = _read(file, EightBits(FULL)).shape[:2]
    return height, width


def _shrunk(height: int) -> int | None:
    """1, 2, 3 for the full, half and third size of 2005 and 2006; None for others."""
    return {FULL_HEIGHT: 1, FULL_HEIGHT // 2: 2, FULL_HEIGHT // 3: 3}.get(height)


def _crop(path: Path, height: int) -> float:
    """px by which the disparity between the views with truth was made smaller; 0 where dmin.txt is not there."""
    file = next((f for folder in (path, *list(path.parents)[:2]) if (f := folder / "dmin.txt").is_file()), None)
    shrunk = _shrunk(height)
    if file is None or shrunk is None:
        return 0.0
    try:
        return float(file.read_text().split()[0]) / shrunk
    except (OSError, ValueError, IndexError):
        raise DatasetError(f"{file}: holds no number; copy it again, or remove it") from None


def _linear(files: Sequence[Path], positions: Sequence[int], offset: float) -> Rig:
    """The array: camera k at its position * SPACING, its principal point moved by what was cropped off its view."""
    height, width = _size(files[0])
    shrunk = _shrunk(height) if files[0].name.startswith("view") else None
    focal = FOCAL / shrunk if shrunk else NOMINAL_FOCAL * width
    first = positions[0]
    full = Rig.linear(positions[-1] - first + 1, focal=focal, spacing=SPACING, size=(width, height))
    chosen = [_moved(full.cameras[p - first], (p - first) * offset / TRUTH_STEPS) for p in positions]
    return Rig(tuple(replace(camera, name=f"cam{k}") for k, camera in enumerate(chosen)))


def _moved(camera: Camera, shift: float) -> Camera:
    fx, fy, cx, cy = camera.intrinsics
    return replace(camera, intrinsics=(fx, fy, cx + shift, cy))


def _scale(file: Path, view: Path, coded: np.ndarray) -> int:
    """Grey levels per px of disparity in a truth image."""
    height, width = coded.shape
    if view.name.startswith("im"):
        return _SCALES_2003.get(width, _SCALE_2001)
    shrunk = _shrunk(height)
    if shrunk is None:
        raise DatasetError(
            f"{file}: is {height} rows high, its scale is known for {FULL_HEIGHT}, {FULL_HEIGHT // 2} and "
            f"{FULL_HEIGHT // 3} only; use a published size"
        )
    return shrunk
