"""What both benchmarks share: the machine in words, markdown tables, and the marked sections of RESULTS.md."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import cv2
import numpy as np

import seepast
from seepast.options import PRESETS


def machine() -> str:
    """CPU, cores, versions and the load that the run had to live with, in one line."""
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__}"
    load = f"; load average before the run {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{_cpu_model()}, {_cores()} cores; seepast {seepast.__version__}, {versions}{load}; {date.today()}"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table, columns padded so that the plain text is readable too; the first is left-aligned."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    rule = ["-" * widths[0]] + ["-" * (w - 1) + ":" for w in widths[1:]]
    lines = [_padded(header, widths), _padded(rule, widths), *(_padded(row, widths) for row in rows)]
    return "\n".join(lines)


def _padded(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = zip(cells, widths, strict=True)
    return "| " + " | ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]) + " |"


def replace_section(path: Path, name: str, text: str) -> None:
    """Put `text` between the lines <!-- name:begin --> and <!-- name:end --> of `path`."""
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
    head, found, rest = path.read_text(encoding="utf-8").partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise SystemExit(f"{path}: lacks the lines {begin.strip()} and {end.strip()}; put them where the tables go")
    path.write_text(f"{head}{begin}\n{text.strip()}\n\n{end}{tail}", encoding="utf-8")


def preset_names(text: str) -> list[str]:
    """An argparse type: comma-separated names out of PRESETS; nothing means all of them."""
    names = [name for name in text.split(",") if name] or list(PRESETS)
    unknown = [name for name in names if name not in PRESETS]
    if unknown:
        raise argparse.ArgumentTypeError(f"no preset {', '.join(unknown)}; there is {', '.join(PRESETS)}")
    return names
