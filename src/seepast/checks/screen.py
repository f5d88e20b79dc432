"""The report on the screen."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..check import Report

STYLES = {"good": "green", "unknown": "cyan", "doubtful": "yellow", "bad": "bold red"}
FILE_WIDTH = 140  # columns where the output is no terminal


def heading(report: Report) -> str:
    """Two lines: what lies there, and what the array makes of it."""
    geometry = report.geometry
    share = report.line("masks").figures.get("share")
    frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
    return (
        f"{report.name}: {len(report.cameras)} cameras, {frames}, "
        + ("no masks" if share is None else f"{100 * share:.1f} % dynamic")
        + f"\nview: {geometry.size[0]}x{geometry.size[1]}, f {geometry.focal[0]:.1f} px, baseline "
        f"{geometry.baseline:.3f} m: 5 m away is {geometry.focal_baseline / 5:.1f} px of disparity"
    )


def show(report: Report) -> None:
    """Print the heading and a table with one row per check to stdout, coloured where that is a terminal."""
    print(heading(report), flush=True)
    table = Table("check", "verdict", "value", "remedy", show_lines=True, highlight=False)
    for line in report.lines:
        table.add_row(line.name, Text(line.verdict, STYLES[line.verdict]), Text(line.value), Text(line.remedy))
    console = Console(width=None if sys.stdout.isatty() else FILE_WIDTH)
    console.print(table)
    console.print(Text(f"in all: {report.verdict}", STYLES[report.verdict]))
