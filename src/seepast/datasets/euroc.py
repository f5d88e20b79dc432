"""EuRoC / ASL folders in: mav0/cam0/data.csv, mav0/cam0/data/<ns>.png and mav0/cam0/sensor.yaml."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, RigError
from ..rig import Camera, Rig, inverse_pose, load_yaml
from .grouping import grouped, log_dropped, nanoseconds
from .png import read_png8
from .protocol import Dropped, OpenOptions, said_bits
from .recording import RIG_FILE, MaskFolder, Recording, find_rig, mask_path

SENSOR_FILE = "sensor.yaml"
_DISTORTIONS = {"radial-tangential": "radtan", "radtan": "radtan", "equidistant": "equidistant", "none": "none"}


def is_euroc_dataset(path: Path) -> bool:
    return _mav(path) is not None


def _mav(path: Path) -> Path | None:
    """The folder of cam0/data: the recording's mav0, or the recording itself."""
    return next((folder for folder in (path / "mav0", path) if (folder / "cam0" / "data").is_dir()), None)


class EurocDataset(Recording):
    """An EuRoC / ASL folder (the one that holds mav0, or mav0 itself).

    stamps   ns of cam0, 19 digits
    times    int64[N, K] ns of all images
    dropped  which images belong to no frame, and why

    The rig is --rig, or rig.yaml in the folder or in mav0, or made of the sensor.yaml files (T_BS is
    body_from_sensor; T. Schneider et al., the ASL dataset format). Masks are <masks>/<camera>/<stamp>.png by the
    frame's stamp or by the camera's own. Raises RigError, DatasetError.
    """

    def __init__(self, path: str | Path, options: OpenOptions | None = None):
        path, options = Path(path), options or OpenOptions()
        mav = _mav(path)
        if mav is None:
            raise DatasetError(f"{path}: no EuRoC folder; name the one that holds mav0/cam0/data/")
        rig, rig_file = _find_rig(path, mav, options)
        tolerance = nanoseconds(options.tolerance)
        names = [camera.name for camera in rig.cameras]
        listed = [_listed_images(mav / name) for name in names]
        there = [{time: file for time, file in own.items() if file.is_file()} for own in listed]
        for name, own in zip(names, there, strict=True):
            if not own:
                raise DatasetError(f"{mav / name / 'data'}: no image of data.csv is there; copy the images")
        stamps = [np.array(sorted(own), np.int64) for own in there]
        members, dropped = grouped(path, names, stamps, tolerance)
        times = np.stack([own[members[:, k]] for k, own in enumerate(stamps)], axis=1)
        self._files = [[there[k][time] for time in times[:, k].tolist()] for k in range(len(names))]
        masks = mask_path(path, options.masks)
        super().__init__(path, rig, rig_file, [f"{time:019d}" for time in times[:, 0]], masks, options.bits)
        self.times, self.dropped = times, _absent(names, listed, there) + dropped
        self.reading = {"reader": "euroc", "tolerance": tolerance / 1e9, **said_bits(options)}
        if masks is not None:
            choices = [[(s, file.stem) for s, file in zip(self.stamps, own, strict=True)] for own in self._files]
            self._folder = MaskFolder(masks, names, choices)
        log_dropped(path, self.dropped, sum(map(len, listed)))

    def _images(self, index: int) -> Sequence[np.ndarray]:
        return [read_png8(files[index], self._deep) for files in self._files]

    def _masks(self, index: int) -> Sequence[np.ndarray]:
        return [self._folder.read(k, index) for k in range(len(self.rig))]

    def _where(self, camera: int, index: int) -> str:
        return str(self._files[camera][index])


def _listed_images(camera: Path) -> dict[int, Path]:
    """Time in ns -> image file, from data.csv, or from the files' names where there is none. Raises DatasetError."""
    data, table = camera / "data", camera / "data.csv"
    if not data.is_dir():
        raise DatasetError(f"{data}: missing, but the rig lists {camera.name}; add its images, or name another --rig")
    if not table.is_file():
        return {int(file.stem): file for file in data.glob("*.png") if file.stem.isdecimal()}
    images: dict[int, Path] = {}
    try:
        for row in csv.reader(table.read_text(encoding="utf-8-sig").splitlines()):
            if row and not row[0].lstrip().startswith("#"):
                images[int(row[0])] = data / row[1].strip()
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise DatasetError(f"{table}: each line must be 'ns,file.png' ({error}); copy the file again") from None
    return images


def _absent(
    names: Sequence[str], listed: Sequence[dict[int, Path]], there: Sequence[dict[int, Path]]
) -> tuple[Dropped, ...]:
    return tuple(
        Dropped(len(every) - len(own), f"{name}/data.csv lists it, but there is no such file")
        for name, every, own in zip(names, listed, there, strict=True)
        if len(every) > len(own)
    )


def _find_rig(path: Path, mav: Path, options: OpenOptions) -> tuple[Rig, Path]:
    if options.rig is not None or (path / RIG_FILE).is_file():
        return find_rig(path, options)
    if (mav / RIG_FILE).is_file():
        return find_rig(mav, options)
    files = sorted(mav.glob(f"cam*/{SENSOR_FILE}"), key=lambda file: (len(file.parent.name), file.parent.name))
    if not files:
        raise RigError(
            f"{mav}: no calibration, neither {RIG_FILE} nor cam0/{SENSOR_FILE}; add one, or name it: --rig FILE"
        )
    return Rig(tuple(_camera(file) for file in files)), mav / f"cam*/{SENSOR_FILE}"


def _camera(file: Path) -> Camera:
    """A camera from its sensor.yaml; the rig frame is the body's. Raises RigError naming the file."""
    try:
        entry = load_yaml(file)
        for key in ("T_BS", "camera_model", "intrinsics", "resolution"):
            if entry.get(key) is None:
                raise RigError(f"'{key}' is missing; complete it, or put a Kalibr {RIG_FILE} beside mav0")
        return Camera(
            name=file.parent.name,
            model=str(entry["camera_model"]).lower(),
            distortion=_distortion(entry),
            intrinsics=tuple(entry["intrinsics"]),
            distortion_coeffs=tuple(entry.get("distortion_coefficients") or ()),
            resolution=tuple(entry["resolution"]),
            cam_from_rig=inverse_pose(_matrix(entry["T_BS"])),
        )
    except RigError as error:
        raise RigError(f"{file}: {error}") from error
    except (TypeError, ValueError) as error:
        raise RigError(f"{file}: a value is not a number or a list of numbers ({error}); mend it") from error


def _distortion(entry: dict[str, Any]) -> str:
    name = str(entry.get("distortion_model") or "none").lower()
    return _DISTORTIONS.get(name, name)


def _matrix(value: Any) -> np.ndarray:
    numbers = np.array(value["data"] if isinstance(value, dict) else value, np.float64)
    if numbers.size != 16:
        raise RigError(f"T_BS must be 16 numbers (4 rows of 4), not {numbers.size}")
    return numbers.reshape(4, 4)
