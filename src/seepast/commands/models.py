"""seepast models: public segmentation networks, and the one way in which seepast ever downloads anything."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from .console import Json, say

USAGE = """Usage: seepast models [get NAME]

  seepast models                       what there is, its licence, address and SHA-256
  seepast models get pphumanseg        fetch it once; prints where it lies
  seepast run recording --out out --segmenter onnx:pphumanseg
"""

models = App(
    name="models",
    usage=USAGE,
    help="List and fetch public segmentation networks.\n\nNothing is ever fetched but by `seepast models get`.",
    help_format="plaintext",
)


@models.default
def list_models(*, json_: Json = False) -> int:
    """List the networks that are known to do."""
    from ..segment.models import MODELS, models_folder

    if json_:
        print(json.dumps({name: asdict(model) for name, model in MODELS.items()}))
        return 0
    for name, model in MODELS.items():
        there = (models_folder() / f"{name}.onnx").is_file()
        print(f"{name}: {model.about}{' (fetched)' if there else ''}")
        print(f"  licence {model.licence}, {model.bytes} bytes, sha256 {model.sha256}")
        print(f"  {model.address}")
    return 0


@models.command
def get(name: str, /, *, to: Annotated[Path | None, Parameter(show_default=False)] = None, json_: Json = False) -> int:
    """Fetch a network, verify its SHA-256 and print where it lies; a fetch that broke off goes on.

    Parameters
    ----------
    name
        One of those that `seepast models` lists.
    to
        Folder (default: $SEEPAST_MODELS, or seepast/models in the user's cache; only there is it found by its name).
    """
    from ..segment.fetch import fetch
    from ..segment.models import known_model, models_folder

    model = known_model(name)
    path = (to or models_folder()) / f"{name}.onnx"
    with _progress(name, model.bytes) as on_bytes:
        fetched = fetch(model, path, on_bytes)
    text = f"{path}: {model.bytes} bytes, sha256 as expected{'' if fetched else ', was there already'}"
    say(text, {"name": name, "path": str(path), "bytes": model.bytes, "fetched": fetched}, json_)
    return 0


@contextlib.contextmanager
def _progress(name: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar of bytes on stderr, nothing where that is no terminal; yields the function told how many there are."""
    if not sys.stderr.isatty():
        yield lambda there: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda there: bar.update(task, completed=there)
