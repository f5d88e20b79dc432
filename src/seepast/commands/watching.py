"""A run in the rerun viewer while it goes on: `seepast run --view`."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..errors import OptionsError, SeepastError

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..view_server import ViewServer

log = logging.getLogger("seepast")

Optional = Parameter(negative=(), show_default=False)
OnFrame = Callable[[], None]


@dataclass(frozen=True)
class Watch:
    """Where runs are shown: on the page of `server`, or in the file `save`, or nowhere."""

    server: ViewServer | None = None
    save: Path | None = None
    overwrite: bool = False

    @contextlib.contextmanager
    def run(self, name: str, out: Path, again: Callable[[], Dataset], advance: OnFrame) -> Iterator[OnFrame]:
        """Yields what is to be called after every frame of the run that writes to `out`; it calls `advance`, too.

        again  opens its recording once more: the viewer reads beside the run
        """
        if self.server is None and self.save is None:
            yield advance
            return
        from ..view_server import connected
        from ..viewing import RunLogger, recording_stream, saved

        stream = recording_stream(name)
        with contextlib.ExitStack() as stack:
            if self.save is not None:
                stack.enter_context(saved(stream, self.save, self.overwrite))
            else:
                assert self.server is not None
                stack.enter_context(connected(stream, self.server))
            logger = RunLogger(out, stream, again())

            def on_frame() -> None:
                _unharmed(logger.log_new)
                advance()

            yield on_frame
            _unharmed(logger.log_new)  # the last stage times

    def wait(self) -> None:
        """Until Ctrl-C, where a page is served."""
        if self.server is not None:
            with contextlib.suppress(KeyboardInterrupt):
                print(f"still shown at {self.server.page} ; Ctrl-C ends it", file=sys.stderr, flush=True)
                self.server.wait()


def _unharmed(log_new: Callable[[], int]) -> None:
    """A frame that cannot be shown is no reason to end the run."""
    try:
        log_new()
    except SeepastError as error:
        log.warning("not shown: %s", error)


@Parameter(name="*")
@dataclass(frozen=True)
class Viewing:
    """Options of `run` that show it.

    Parameters
    ----------
    view
        Show the run while it goes on: rerun's web viewer, pip install 'seepast[view]', on this machine only.
    save
        Write what --view shows to this .rrd file instead; no screen needed.
    port
        Of the viewer's page; 0: any free one.
    """

    view: Annotated[bool, Optional] = False
    save: Annotated[Path | None, Optional] = None
    port: int = 9090

    @contextlib.contextmanager
    def watch(self, recordings: int, overwrite: bool) -> Iterator[Watch]:
        """The Watch that these ask for. Raises OptionsError, OutputError or MissingExtraError."""
        if self.save is not None:
            if recordings > 1:
                raise OptionsError(f"--save {self.save}: holds one recording, not {recordings}; run one, or say --view")
            yield Watch(save=self.save, overwrite=overwrite)
        elif self.view:
            from ..view_server import view_server

            with view_server(self.port) as server:
                print(f"shown at {server.page}", file=sys.stderr, flush=True)
                yield Watch(server)
        else:
            yield Watch()


UNSEEN = Viewing()
