"""What comes in: array recordings behind one small protocol, and the readers that are known.

for frame in open_dataset("recording"):
    result = reconstructor(frame.images, frame.masks)

A reader of your own is one file, mymodule.py, with a class that is a Dataset (protocol.py) and

READER = Reader(lambda path: path.suffix == ".mine", lambda path, options: MyDataset(path, options.masks))

`--reader mymodule:READER` uses it from the command line; `READERS["mine"] = READER` makes it known in Python.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from ..errors import DatasetError, OptionsError
from .bag import is_bag
from .euroc import EurocDataset, is_euroc_dataset
from .folder import FolderDataset, is_folder_dataset
from .middlebury import MiddleburyDataset, is_middlebury_dataset
from .protocol import NO_MASKS, Dataset, Dropped, Frame, OpenOptions
from .rosbag import RosbagDataset
from .video import VideoDataset, is_video_dataset

__all__ = [
    "NO_MASKS",
    "READERS",
    "Dataset",
    "Dropped",
    "Frame",
    "OpenOptions",
    "Reader",
    "find_datasets",
    "find_reader",
    "guess_reader",
    "open_dataset",
]

_CAMERA = re.compile(r"cam\d+")


@dataclass(frozen=True)
class Reader:
    """One kind of recording.

    recognises  whether it reads what lies at a path; may look at names, not into images
    open        makes the Dataset
    takes       which fields of OpenOptions it heeds; another one that is given is an error
    """

    recognises: Callable[[Path], bool]
    open: Callable[[Path, OpenOptions], Dataset]
    takes: frozenset[str] = frozenset(field.name for field in fields(OpenOptions))


def _open_folder(path: Path, options: OpenOptions) -> Dataset:
    return FolderDataset(path, options.masks, options.bits)


# The last one is asked first, so readers that users add go before these, and plain folders come last.
READERS: dict[str, Reader] = {
    "folder": Reader(is_folder_dataset, _open_folder, frozenset({"masks", "bits"})),
    "rosbag-split": Reader(lambda path: False, RosbagDataset),  # all bags in a folder as one: must be asked for
    "rosbag": Reader(lambda path: is_bag(path) and not (path / "cam0").is_dir(), RosbagDataset),
    "video": Reader(is_video_dataset, VideoDataset, frozenset({"masks", "rig"})),
    "middlebury": Reader(is_middlebury_dataset, MiddleburyDataset, frozenset({"masks", "rig", "bits"})),
    "euroc": Reader(is_euroc_dataset, EurocDataset, frozenset({"masks", "rig", "tolerance", "bits"})),
}


def open_dataset(
    path: str | Path,
    *,
    masks: str | None = None,
    reader: str | None = None,
    rig: str | Path | None = None,
    topics: str | None = None,
    tolerance: float | None = None,
    bits: int | None = None,
) -> Dataset:
    """Open one recording, or the only one in a folder.

    reader: a name in READERS, or "module:NAME" of a Reader; None = the one that recognises the recording. The others
    are those of OpenOptions. Raises DatasetError (no reader, missing or contradictory files), RigError (unusable
    calibration), OptionsError (an unknown reader, or an option that it does not take) or MissingExtraError.
    """
    found = find_datasets(path, reader=reader)
    if len(found) > 1:
        raise DatasetError(f"{path}: holds {len(found)} recordings; name one of {', '.join(p.name for p in found)}")
    options = OpenOptions(masks, None if rig is None else Path(rig), topics, tolerance, bits)
    name = reader or guess_reader(found[0])
    assert name is not None
    chosen = find_reader(name)
    _check_taken(name, chosen, options)
    return chosen.open(found[0], options)


def find_datasets(path: str | Path, *, reader: str | None = None) -> list[Path]:
    """[path] where it is a recording itself, otherwise the recordings directly below it, by name.

    With a `reader`, those that it recognises, else [path], for the reader to tell what is missing. Raises
    DatasetError, OptionsError.
    """
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder; name one of the recordings in `seepast run --help`")
    if reader is not None:
        chosen = find_reader(reader)
        here = _recognises(chosen, path)
        return [path] if here else [p for p in _below(path) if _recognises(chosen, p)] or [path]
    guess = guess_reader(path)
    if guess is None or (guess == "folder" and not (path / "cam0").is_dir()):  # perhaps one rig.yaml for many bags
        below = [p for p in _below(path) if guess_reader(p)]
        if below:
            return below
    if guess is None:
        raise _unknown(path)
    return [path]


def find_reader(name: str) -> Reader:
    """The reader of a name in READERS, or of "module:NAME"; modules are looked for in the current folder, too.

    Raises OptionsError where there is none.
    """
    module, colon, attribute = name.partition(":")
    if name in READERS or not colon:
        if name not in READERS:
            raise OptionsError(f"--reader {name}: there is {', '.join(READERS)}; one of your own is module:NAME")
        return READERS[name]
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise OptionsError(f"--reader {name}: cannot be imported ({error}); name MODULE:NAME of a Reader") from error
    if not isinstance(found, Reader):
        raise OptionsError(f"--reader {name}: is a {type(found).__name__}, not a seepast.datasets.Reader; make it one")
    return found


def guess_reader(path: Path) -> str | None:
    """The name in READERS of the one that recognises `path`; None where none does."""
    return next((name for name, reader in reversed(READERS.items()) if _recognises(reader, path)), None)


def _recognises(reader: Reader, path: Path) -> bool:
    try:
        return reader.recognises(path)
    except OSError:  # a folder that may not be listed
        return False


def _below(path: Path) -> list[Path]:
    """What may be recordings in a folder: not the cameras' own folders, whose files may have any name."""
    return sorted(p for p in path.iterdir() if not _CAMERA.fullmatch(p.name)) if path.is_dir() else []


def _check_taken(name: str, reader: Reader, options: OpenOptions) -> None:
    for field in fields(options):
        if field.name not in reader.takes and getattr(options, field.name) is not None:
            takes = ", ".join(f"--{option}" for option in sorted(reader.takes))
            raise OptionsError(f"--{field.name}: the reader '{name}' does not take it, but {takes}; leave it out")


def _unknown(path: Path) -> DatasetError:
    return DatasetError(
        f"{path}: no recording here, nor in its sub-folders; a dataset is a folder with a Kalibr rig.yaml and "
        "cam0/<stamp>.png, cam1/<stamp>.png ..., or with videos cam0.mp4 ..., a ROS bag, an EuRoC or a Middlebury "
        "folder; --reader NAME forces one"
    )
