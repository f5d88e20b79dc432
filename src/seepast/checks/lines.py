"""One line of the report: what was looked at, what was found, how good that is and what mends it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["good", "unknown", "doubtful", "bad"]
VERDICTS: tuple[Verdict, ...] = ("good", "unknown", "doubtful", "bad")  # from best to worst


@dataclass(frozen=True)
class Line:
    """One check. `figures` are the numbers behind `value`, for machines; NaN where not known."""

    name: str
    value: str
    verdict: Verdict
    remedy: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)


def verdict_of(value: float, good: float, doubtful: float) -> Verdict:
    """good up to the first limit, doubtful up to the second, bad beyond; unknown for NaN."""
    if math.isnan(value):
        return "unknown"
    return "good" if value <= good else "doubtful" if value <= doubtful else "bad"


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The worst of them; good if there is none."""
    return max(verdicts, key=VERDICTS.index, default="good")


def line(name: str, value: str, verdict: Verdict, remedy: str, **figures: Any) -> Line:
    """A Line whose remedy is kept only where something needs one."""
    return Line(name, value, verdict, "" if verdict == "good" else remedy, figures)
