"""seepast view: a run in the rerun viewer."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from .console import Json, count, progress, say
from .segmenting import Classes, SegmenterName, opened_recording, opened_segmenter
from .source import GUESSED, Source

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..export.reading import RunFolder
    from ..segment import Segmenter

log = logging.getLogger("seepast")

Optional = Parameter(negative=(), show_default=False)


def view(
    out: Path,
    /,
    *,
    dataset: Annotated[Path | None, Optional] = None,
    masks: Annotated[str | None, Optional] = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    save: Annotated[Path | None, Optional] = None,
    port: int = 9090,
    overwrite: Annotated[bool, Optional] = False,
    json_: Json = False,
    source: Source = GUESSED,
) -> int:
    """Look at what `run` made in the rerun viewer.

    For example

      seepast view out                       a web page at http://127.0.0.1:9090, until Ctrl-C
      seepast view out --save out.rrd        a file for the rerun viewer, no screen needed
      seepast view out --dataset moved/rec   the recording lies elsewhere now

    It shows inputs, masks before and after, the scene, 3-D points and milliseconds
    per stage.

    The viewer is rerun's, pip install 'seepast[view]', and listens on this machine only.

    Parameters
    ----------
    out
        Folder that `run` wrote.
    dataset
        The recording that was run (default: where it lay then).
    masks
        Folder of its masks (default: those of the run, by its network if it had one); 'none': leave them out.
    save
        Write this .rrd file instead of serving a page.
    port
        Of the page; 0: any free one.
    overwrite
        Replace the file if it is there.
    """
    from ..export.reading import RunFolder
    from ..view_server import connected, view_server
    from ..viewing import RunLogger, recording_stream, saved

    run = RunFolder(out)
    given = _Masks(masks, segmenter, classes)
    stream = recording_stream(run.path.resolve().name)
    logger = RunLogger(out, stream, _recording(run, dataset, given, source))
    if save is not None:
        with saved(stream, save, overwrite), progress(out.name, len(run.stamps)) as advance:
            frames = logger.log_new(advance)
        say(f"{out}: {count(frames, 'frame')}, {save}", {"name": str(out), "frames": frames, "path": str(save)}, json_)
        return 0
    with view_server(port) as server, connected(stream, server):
        values = {"name": str(out), "frames": len(run.stamps), "page": server.page}
        say(f"{out}: {count(len(run.stamps), 'frame')} at {server.page} ; Ctrl-C ends it", values, json_)
        with progress(out.name, len(run.stamps)) as advance:
            logger.log_new(advance)
        server.wait()
    return 0


@dataclass(frozen=True)
class _Masks:
    """What the command line says about masks."""

    masks: str | None = None
    segmenter: str | None = None
    classes: str | None = None


def _recording(run: RunFolder, dataset: Path | None, given: _Masks, source: Source) -> Dataset | None:
    """What was run, as it was opened then, as far as it is still there: without it the inputs are left out, told."""
    from ..errors import SeepastError

    path = dataset or Path(str(run.settings.get("dataset", "")))
    said = dict(run.settings.get("settings") or {})
    try:
        masks, network = _masks_of(run, path, given, said)
        return opened_recording(_as_then(source, said), path, masks, network)
    except SeepastError as error:
        if dataset is not None or given.segmenter is not None or given.classes is not None:
            raise
        log.warning("the inputs are left out (%s); name the recording with --dataset", error)
        return None


def _masks_of(run: RunFolder, path: Path, given: _Masks, said: Mapping[str, Any]) -> tuple[str, Segmenter | None]:
    """Folder of masks and segmenter: those that are given, else those of the run as far as they are still there."""
    from ..datasets import NO_MASKS
    from ..datasets.topics import MASK_TOPICS
    from ..errors import SeepastError

    if given != _Masks():
        return given.masks or NO_MASKS, opened_segmenter(given.segmenter, given.classes, given.masks)
    try:
        network = opened_segmenter(said.get("segmenter"), said.get("classes"), None)
    except SeepastError as error:
        log.warning("the masks before are left out (%s); name their network with --segmenter", error)
        network = None
    folder, name = Path(str(run.settings.get("masks", NO_MASKS))), str(said.get("masks", NO_MASKS))
    if folder.is_dir():
        return str(folder), network
    return (name if name.startswith(MASK_TOPICS) or (path / name).is_dir() else NO_MASKS), network


def _as_then(source: Source, said: Mapping[str, Any]) -> Source:
    """`source` with the run's own words where nothing is said."""
    found = {name: said.get(name) if value is None else value for name, value in vars(source).items()}
    found["rig"] = None if found["rig"] is None else Path(found["rig"])
    if isinstance(found["topics"], list):
        found["topics"] = ",".join(found["topics"])
    return Source(**found)
