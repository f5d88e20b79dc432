"""What readers other than the folder reader share: calibration, masks by stamp, checks of every frame."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, RigError
from ..rig import Rig
from .eight_bits import EightBits
from .png import read_png8
from .protocol import NO_MASKS, Dropped, Frame, OpenOptions

RIG_FILE = "rig.yaml"
DEFAULT_MASKS = "masks"


def find_rig(path: Path, options: OpenOptions) -> tuple[Rig, Path]:
    """The calibration of a recording and the file it is from: --rig, or rig.yaml in it or beside it.

    Raises RigError, naming the mend, where there is none.
    """
    if options.rig is not None:
        return Rig.from_kalibr(options.rig), options.rig
    for folder in (path, path.parent):
        if (folder / RIG_FILE).is_file():
            return Rig.from_kalibr(folder / RIG_FILE), folder / RIG_FILE
    raise RigError(
        f"{path}: no calibration; put the Kalibr camchain of its cameras beside it as {RIG_FILE}, or say --rig FILE"
    )


class MaskFolder:
    """Masks as <path>/<camera>/<stamp>.png, 8-bit grey, 255 * P(dynamic).

    stamps[k][i] are the names that the mask of camera k in frame i may have, the first of them first. Raises
    DatasetError on opening if one is missing.
    """

    def __init__(self, path: Path, names: Sequence[str], stamps: Sequence[Sequence[Sequence[str]]]):
        self._files = [_mask_files(path / name, wanted) for name, wanted in zip(names, stamps, strict=True)]

    def read(self, camera: int, index: int) -> np.ndarray:
        """uint8 [h, w]. Raises DatasetError."""
        mask = read_png8(self._files[camera][index])
        if mask.ndim != 2:
            raise DatasetError(
                f"{self._files[camera][index]}: in colour; convert it: a mask is 8-bit grey, 255 * P(dynamic)"
            )
        return mask


def _mask_files(folder: Path, stamps: Sequence[Sequence[str]]) -> list[Path]:
    if not folder.is_dir():
        raise DatasetError(f"{folder}: missing; every camera needs masks, black where nothing is dynamic")
    there = {path.stem for path in folder.glob("*.png")}
    names = [next((stamp for stamp in choice if stamp in there), None) for choice in stamps]
    if None in names:
        raise DatasetError(
            f"{folder / stamps[names.index(None)][0]}.png: missing, as are the masks of {names.count(None)} of "
            f"{len(names)} frames of {folder.name}; add them, black where nothing is dynamic"
        )
    return [folder / f"{name}.png" for name in names]


def mask_path(path: Path, masks: str | None) -> Path | None:
    """The folder of masks of a recording, in it or beside it; None for "none". Raises DatasetError."""
    if masks == NO_MASKS:
        return None
    places = [path, path.parent] if path.is_dir() else [path.parent]
    folder = next((f for place in places if (f := place / (masks or DEFAULT_MASKS)).is_dir()), None)
    if folder is None:
        raise DatasetError(
            f"{places[0] / (masks or DEFAULT_MASKS)}: no such folder of masks; name one with --masks FOLDER, or say "
            "--masks none, and nothing is taken for dynamic"
        )
    return folder


class Recording(ABC):
    """A Dataset (see protocol.py) whose images are decoded by `_images`; one frame at a time, from any thread."""

    times: np.ndarray | None = None
    dropped: tuple[Dropped, ...] = ()
    reading: Mapping[str, Any] | None = None

    def __init__(
        self,
        path: Path,
        rig: Rig,
        rig_file: Path,
        stamps: Sequence[str],
        masks: Path | None,
        bits: int | None = None,
    ):
        self.path = path
        resolved = path.resolve()
        self.name = resolved.name if path.is_dir() else resolved.stem
        self.rig = rig
        self.stamps = stamps
        self.masks = masks
        self._rig_file = rig_file
        self._deep = EightBits(bits)
        self._index = {stamp: index for index, stamp in enumerate(stamps)}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(stamp) for stamp in self.stamps)

    def frame(self, stamp: str) -> Frame:
        """Decode one instant. Raises DatasetError naming the image that cannot be used, and why."""
        if stamp not in self._index:
            raise DatasetError(f"{self.path}: has no frame {stamp}; it goes from {self.stamps[0]} to {self.stamps[-1]}")
        index = self._index[stamp]
        with self._lock:
            images = tuple(self._images(index))
            masks = None if self.masks is None else tuple(self._masks(index))
        for k, image in enumerate(images):
            self._check_size(self._where(k, index), k, image)
        for k, mask in enumerate(masks or ()):
            self._check_size(f"{self._where(k, index)}, its mask", k, mask)
        self._check_all_grey_or_all_color(stamp, images)
        return Frame(stamp, images, masks)

    @abstractmethod
    def _images(self, index: int) -> Sequence[np.ndarray]:
        """K uint8 images of frame `index`, [h, w] or [h, w, 3] BGR."""

    @abstractmethod
    def _masks(self, index: int) -> Sequence[np.ndarray]:
        """K uint8 [h, w] masks of frame `index`; asked for after its images, and only if `masks` is not None."""

    @abstractmethod
    def _where(self, camera: int, index: int) -> str:
        """The name of one image in an error."""

    def _check_size(self, where: str, camera: int, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        expected = self.rig.cameras[camera]
        if (width, height) != tuple(expected.resolution):
            raise DatasetError(
                f"{where}: is {width}x{height}, but {self._rig_file} says {expected.resolution[0]}x"
                f"{expected.resolution[1]} for {expected.name}; use the size the rig was calibrated at, or calibrate "
                "at this one"
            )

    def _check_all_grey_or_all_color(self, stamp: str, images: Sequence[np.ndarray]) -> None:
        names = [camera.name for camera in self.rig.cameras]
        grey = [name for name, image in zip(names, images, strict=True) if image.ndim == 2]
        if grey and len(grey) < len(names):
            color = [name for name in names if name not in grey]
            raise DatasetError(
                f"{self.path}: frame {stamp} is grey in {', '.join(grey)} and colour in {', '.join(color)}; convert "
                "all to one"
            )
