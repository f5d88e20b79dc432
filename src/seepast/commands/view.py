"""seepast view: a run in the rerun viewer."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from .console import Json, count, progress, say
from .source import GUESSED, Source

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..export.reading import RunFolder

log = logging.getLogger("seepast")

Optional = Parameter(negative=(), show_default=False)


def view(
    out: Path,
    /,
    *,
    dataset: Annotated[Path | None, Optional] = None,
    masks: Annotated[str | None, Optional] = None,
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
        Folder of its masks (default: those of the run); 'none': leave them out.
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
    stream = recording_stream(run.path.resolve().name)
    logger = RunLogger(out, stream, _recording(run, dataset, masks, source))
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


def _recording(run: RunFolder, dataset: Path | None, masks: str | None, source: Source) -> Dataset | None:
    """What was run, as far as it is still there: without it the inputs are left out, which is told."""
    from ..datasets import NO_MASKS
    from ..errors import SeepastError

    path = dataset or Path(str(run.settings.get("dataset", "")))
    before = str(run.settings.get("masks", NO_MASKS))
    masks = masks or (before if Path(before).is_dir() else NO_MASKS)
    try:
        return source.open(path, masks)
    except SeepastError as error:
        if dataset is not None:
            raise
        log.warning("the inputs are left out (%s); name the recording with --dataset", error)
        return None
