"""Sphinx configuration; pictures and the command reference are made first, by the code itself."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import os
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
os.environ["COLUMNS"] = "88"  # of the help that is shown

import pictures  # noqa: E402

import seepast  # noqa: E402
from seepast import cli  # noqa: E402
from seepast.options import PRESETS, Options  # noqa: E402

project, author, version = "seepast", "the seepast authors", seepast.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme, html_title = "furo", f"seepast {version}"
exclude_patterns = ["made/*.md"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
MADE = HERE / "made"
logging.getLogger("seepast").setLevel(logging.WARNING)


def commands_page() -> str:
    """Every command with the help that it gives, as Markdown."""
    parts = []
    for words in ([], *([name] for name in cli.app if not name.startswith("-"))):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            cli.main([*words, "--help"])
        parts.append(f"## seepast {' '.join(words)}".rstrip() + f"\n\n```text\n{printed.getvalue().strip()}\n```\n")
    return "\n".join(parts)


def options_page() -> str:
    """Every option with unit, range and meaning, a table for each stage, as Markdown."""
    parts = []
    for stage in dataclasses.fields(Options):
        group = getattr(Options(), stage.name)
        parts.append(f"## {stage.name}\n\n{group.__doc__}\n")
        parts.append("| option | default | unit | range | |\n|---|---|---|---|---|")
        parts.append("\n".join(_option_row(stage.name, field) for field in dataclasses.fields(group)) + "\n")
    return "\n".join(parts)


def _option_row(stage: str, field: dataclasses.Field[Any]) -> str:
    about = field.metadata
    defaults = {name: preset.flat()[f"{stage}.{field.name}"] for name, preset in PRESETS.items()}
    alike = len(set(defaults.values())) == 1
    default = f"{field.default}" if alike else ", ".join(f"{name}: {value}" for name, value in defaults.items())
    limits = (
        f"{about['low']:g} to {about['high']:g}" if about["low"] is not None else ", ".join(about.get("choices", ()))
    )
    doc = about["doc"].replace("|", "\\|")
    return f"| `{stage}.{field.name}` | {default} | {about['unit']} | {limits} | {doc} |"


def make_generated(app: Any) -> None:
    """Write docs/made/."""
    MADE.mkdir(exist_ok=True)
    (MADE / "commands.md").write_text(commands_page())
    (MADE / "options.md").write_text(options_page())
    pictures.make(MADE)


def as_written(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with aligned columns: the summary stays text, the rest is shown as it is written."""
    text = "\n".join(lines).strip()
    summary, _, rest = text.partition("\n\n")
    lines[:] = _escaped(" ".join(summary.split())).splitlines()
    if rest.strip():
        lines += ["", "::", "", *(f"   {line}".rstrip() for line in rest.splitlines()), ""]


def _escaped(text: str) -> str:
    quoted = re.sub(r"`([^`]+)`", r"``\1``", text)
    pieces = re.split(r"(``.+?``)", quoted)
    return "".join(piece if piece.startswith("``") else re.sub(r"([\\*|]|_(?!\w))", r"\\\1", piece) for piece in pieces)


def setup(app: Any) -> None:
    app.connect("builder-inited", make_generated)
    app.connect("autodoc-process-docstring", as_written)
