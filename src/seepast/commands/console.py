"""What the commands share in talking to people."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

from cyclopts import Parameter

EXIT_ERROR = 2
Json = Annotated[
    bool, Parameter(name="--json", negative=(), show_default=False, help="Print one line of JSON instead of text.")
]


@contextlib.contextmanager
def progress(name: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on stderr, nothing where that is no terminal; yields the function that advances it."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda: bar.advance(task)


def count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def say(text: str, values: Mapping[str, Any], as_json: bool) -> None:
    """A result on stdout: `text` for people, or `values` as one line of JSON."""
    print(json.dumps(values) if as_json else text, flush=True)


def say_error(error: object) -> None:
    """One line on stderr."""
    print("seepast: error: " + " ".join(str(error).split()), file=sys.stderr, flush=True)
