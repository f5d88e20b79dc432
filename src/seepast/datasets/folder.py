"""Folders in: rig.yaml, camK/<stamp>.png and <masks>/camK/<stamp>.png."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..rig import Rig
from .eight_bits import EightBits
from .png import read_png8
from .protocol import NO_MASKS, Frame

log = logging.getLogger("seepast")

RIG_FILE = "rig.yaml"
DEFAULT_MASKS = "masks"


def is_folder_dataset(path: Path) -> bool:
    return (path / RIG_FILE).is_file()


class FolderDataset:
    """A recording in folders.

    name    the folder's own name
    path    the folder
    rig     cameras of rig.yaml; images come in this order
    stamps  names of the instants that every camera has, sorted
    masks   the folder the masks are read from, None where nothing is dynamic
    reading what was said about bits (OpenOptions), None where nothing was

    Files are listed and matched on opening and decoded one frame at a time. Raises RigError or DatasetError.
    """

    def __init__(self, path: str | Path, masks: str | None = None, bits: int | None = None):
        self.path = Path(path)
        self.name = self.path.resolve().name
        self.rig = Rig.from_kalibr(self.path / RIG_FILE)
        self._names = tuple(camera.name for camera in self.rig.cameras)
        _check_cameras(self.path, self._names)
        self.stamps: Sequence[str] = _common_stamps(self.path, self._names)
        self.masks = _masks_folder(self.path, masks)
        if self.masks is not None:
            _check_masks_present(self.masks, self._names, self.stamps)
        self._warned_about_binary_masks = False
        self._deep = EightBits(bits)
        self.reading = None if bits is None else {"reader": "folder", "bits": bits}

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(stamp) for stamp in self.stamps)

    def frame(self, stamp: str) -> Frame:
        """Decode one instant. Raises DatasetError naming the file that cannot be used, and why."""
        images = tuple(self._image(k, stamp) for k in range(len(self._names)))
        _check_all_grey_or_all_color(self.path, self._names, stamp, images)
        masks = None if self.masks is None else tuple(self._mask(k, stamp) for k in range(len(self._names)))
        return Frame(stamp, images, masks)

    def _image(self, camera: int, stamp: str) -> np.ndarray:
        path = self.path / self._names[camera] / f"{stamp}.png"
        image = read_png8(path, self._deep)
        self._check_size(path, camera, image)
        return image

    def _mask(self, camera: int, stamp: str) -> np.ndarray:
        assert self.masks is not None
        path = self.masks / self._names[camera] / f"{stamp}.png"
        mask = read_png8(path)
        if mask.ndim != 2:
            raise DatasetError(f"{path}: in colour; convert it: a mask is 8-bit grey, 255 * P(dynamic)")
        self._check_size(path, camera, mask)
        if not self._warned_about_binary_masks and mask.max() == 1:
            self._warned_about_binary_masks = True
            log.warning("%s: holds only 0 and 1, but 255 means dynamic; multiply such masks by 255", path)
        return mask

    def _check_size(self, path: Path, camera: int, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        expected = tuple(self.rig.cameras[camera].resolution)
        if (width, height) != expected:
            raise DatasetError(
                f"{path}: is {width}x{height}, but {self.path / RIG_FILE} says {expected[0]}x{expected[1]} "
                f"for {self._names[camera]}; use the size the rig was calibrated at, or calibrate at this one"
            )


def _check_cameras(path: Path, names: tuple[str, ...]) -> None:
    rig_file = path / RIG_FILE
    for name in names:
        if not (path / name).is_dir():
            raise DatasetError(f"{path / name}: missing, but {rig_file} lists it; add its images, or drop it there")
    there = {p.name for p in path.iterdir() if p.is_dir() and p.name.startswith("cam") and p.name[3:].isdigit()}
    for name in sorted(there - set(names)):
        raise DatasetError(f"{path / name}: {rig_file} does not list it; calibrate it, or move it away")


def _stamps_in(folder: Path) -> set[str]:
    return {p.stem for p in folder.iterdir() if p.suffix == ".png" and not p.name.startswith(".")}


def _common_stamps(path: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    """The stamps that every camera has; the others are skipped with one warning that counts them."""
    per_camera = {name: _stamps_in(path / name) for name in names}
    for name, stamps in per_camera.items():
        if not stamps:
            kinds = sorted({p.suffix for p in (path / name).iterdir() if p.suffix})
            found = f" (there is {', '.join(kinds)}: convert it)" if kinds else ""
            raise DatasetError(f"{path / name}: no <stamp>.png in it{found}; every camera needs its images")
    everywhere = set.intersection(*per_camera.values())
    partial = set.union(*per_camera.values()) - everywhere
    if not everywhere:
        raise DatasetError(
            f"{path}: no stamp is there for all of {', '.join(names)}; the images of one instant must share one name"
        )
    if partial:
        first = min(partial)
        missing = [name for name in names if first not in per_camera[name]]
        log.warning(
            "%s: skipping %d of %d stamps that some camera lacks (%s is missing in %s)",
            path, len(partial), len(partial) + len(everywhere), first, ", ".join(missing),
        )  # fmt: skip
    return tuple(sorted(everywhere))


def _masks_folder(path: Path, masks: str | None) -> Path | None:
    if masks == NO_MASKS:
        return None
    folder = path / (masks or DEFAULT_MASKS)
    if folder.is_dir():
        return folder
    others = sorted(p.name for p in path.iterdir() if p.is_dir() and p.name.startswith(DEFAULT_MASKS))
    known = f" (there is: {', '.join(others)})" if others else ""
    raise DatasetError(
        f"{folder}: no such folder of masks{known}; name one with --masks FOLDER, or say --masks none, "
        "and nothing is taken for dynamic"
    )


def _check_masks_present(folder: Path, names: tuple[str, ...], stamps: Sequence[str]) -> None:
    for name in names:
        if not (folder / name).is_dir():
            raise DatasetError(f"{folder / name}: missing; every camera needs masks, black where nothing is dynamic")
        lacking = sorted(set(stamps) - _stamps_in(folder / name))
        if lacking:
            raise DatasetError(
                f"{folder / name / lacking[0]}.png: missing, as are the masks of "
                f"{len(lacking)} of {len(stamps)} frames of {name}; add them, black where nothing is dynamic"
            )


def _check_all_grey_or_all_color(
    path: Path, names: tuple[str, ...], stamp: str, images: tuple[np.ndarray, ...]
) -> None:
    grey = [name for name, image in zip(names, images, strict=True) if image.ndim == 2]
    if grey and len(grey) < len(names):
        color = [name for name in names if name not in grey]
        raise DatasetError(
            f"{path}: frame {stamp} is grey in {', '.join(grey)} and colour in {', '.join(color)}; convert all to one"
        )
