"""Every format that a run can be exported to, and the one way to do it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from .. import __version__
from ..errors import OptionsError, OutputError
from . import atomic
from .exr import write_exr
from .ply import write_ply
from .protocol import Exporter, ExportOptions
from .reading import RunFolder, Written
from .rosbag1 import write_rosbag1
from .rosbag2 import write_mcap, write_rosbag2
from .times import timeline
from .tum import write_tum

EXPORTERS: dict[str, Exporter] = {
    "tum": Exporter(write_tum),
    "mcap": Exporter(write_mcap, ".mcap"),
    "rosbag2": Exporter(write_rosbag2),
    "rosbag1": Exporter(write_rosbag1, ".bag"),
    "ply": Exporter(write_ply),
    "exr": Exporter(write_exr),
}
"""A format of your own: a function like protocol.Write, entered here under the name that --to takes."""

EXPORT_FILE = "export.json"  # in every folder that was exported: what it is, and that it may be overwritten


@dataclass(frozen=True)
class Exported:
    """What `export` left where."""

    path: Path
    frames: int


def exporter_of(name: str) -> Exporter:
    """Raises OptionsError for a format that is not registered."""
    if name not in EXPORTERS:
        raise OptionsError(f"--to {name}: unknown format; take one of {', '.join(EXPORTERS)}")
    return EXPORTERS[name]


def export(
    run: RunFolder,
    to: str,
    path: str | Path | None = None,
    options: ExportOptions | None = None,
    *,
    overwrite: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> Exported:
    """Write a run in another format to `path`, whole or not at all.

    to    a name in EXPORTERS
    path  file or folder; None: beside the run's folder, <its name>_<to> or <its name>.<suffix>

    `on_frame` is called after every frame. Raises OptionsError, DatasetError, MissingExtraError, or OutputError where
    `path` is there already; `overwrite` replaces a file, or a folder that an export made.
    """
    exporter, options = exporter_of(to), options or ExportOptions()
    path = _default(run, to, exporter) if path is None else Path(path)
    line = timeline(run.stamps, options.stamps, options.rate)
    _check_free(path, exporter, overwrite)
    with atomic.replacing(path) as made:
        exporter.write(run.view, _frames(run, line, options.min_coverage, on_frame), made, options)
        if not exporter.suffix:
            described = {"seepast": __version__, "to": to, "run": str(run.path.resolve()), "frames": len(line)}
            atomic.write_json(made / EXPORT_FILE, {**described, "options": asdict(options)})
    return Exported(path, len(line))


def _frames(
    run: RunFolder, line: Sequence[tuple[int, str]], min_coverage: int, on_frame: Callable[[], None]
) -> Iterator[tuple[int, Written]]:
    for time, stamp in line:
        yield time, run.frame(stamp).seen_by(min_coverage)
        on_frame()


def _default(run: RunFolder, to: str, exporter: Exporter) -> Path:
    folder = run.path.resolve()
    return folder.with_name(f"{folder.name}{exporter.suffix or '_' + to}")


def _check_free(path: Path, exporter: Exporter, overwrite: bool) -> None:
    if path.is_dir() and not any(path.iterdir()):
        return
    if not path.exists() and not path.is_symlink():
        return
    if path.is_dir() == bool(exporter.suffix):
        is_, wanted = ("a folder", "a file") if exporter.suffix else ("a file", "a folder")
        raise OutputError(f"{path}: is {is_}, but this format is {wanted}; give another --out")
    if path.is_dir() and not (path / EXPORT_FILE).is_file():
        raise OutputError(f"{path}: holds something else than an export; give another --out")
    if not overwrite:
        raise OutputError(f"{path}: is there already; add --overwrite to replace it, or give another --out")
