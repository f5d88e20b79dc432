"""What comes in: array recordings behind one small protocol, and the readers that are known.

for frame in open_dataset("recording"):
    result = reconstructor(frame.images, frame.masks)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..errors import DatasetError
from .folder import FolderDataset, is_folder_dataset
from .protocol import NO_MASKS, Dataset, Frame

__all__ = ["NO_MASKS", "READERS", "Dataset", "Frame", "Reader", "find_datasets", "open_dataset"]


@dataclass(frozen=True)
class Reader:
    """One kind of recording: how to know it and how to open it (path, masks)."""

    recognises: Callable[[Path], bool]
    open: Callable[[Path, str | None], Dataset]


READERS: dict[str, Reader] = {
    "folder": Reader(is_folder_dataset, FolderDataset),
}


def open_dataset(path: str | Path, *, masks: str | None = None) -> Dataset:
    """Open a recording with the first reader that recognises it.

    masks: the folder of masks, relative to the dataset or absolute; None = "masks"; "none" = no masks.
    Raises DatasetError (no reader, missing or contradictory files) or RigError (unusable calibration).
    """
    path = Path(path)
    for reader in READERS.values():
        if reader.recognises(path):
            return reader.open(path, masks)
    raise _unknown(path)


def find_datasets(path: str | Path) -> list[Path]:
    """[path] where it is a recording itself, otherwise the recordings directly below it, by name."""
    path = Path(path)
    if _recognised(path):
        return [path]
    found = sorted(p for p in path.iterdir() if _recognised(p)) if path.is_dir() else []
    if not found:
        raise _unknown(path)
    return found


def _recognised(path: Path) -> bool:
    return any(reader.recognises(path) for reader in READERS.values())


def _unknown(path: Path) -> DatasetError:
    if not path.exists():
        return DatasetError(f"{path}: no such folder; name the one that holds rig.yaml and cam0/, cam1/ ...")
    return DatasetError(
        f"{path}: no recording here (no rig.yaml, and none in its sub-folders); a dataset is a folder "
        "with a Kalibr rig.yaml and cam0/<stamp>.png, cam1/<stamp>.png ..."
    )
