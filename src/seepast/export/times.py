"""Times of frames from their names."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

from ..errors import DatasetError, OptionsError

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
UNITS = ("auto", *NANOSECONDS, "index")
FIRST = 10**9  # ns; 0 means "no time" in ROS, and RTAB-Map refuses it
LATEST = 2**31 * 10**9  # ns; the seconds of ROS 2 are an int32
_WRITTEN_SO = {"s": r"\d+\.\d+|[1-9]\d{9}", "ms": r"[1-9]\d{12}", "us": r"[1-9]\d{15}", "ns": r"\d{19}"}


def timeline(stamps: Sequence[str], unit: str = "auto", rate: float = 10.0) -> list[tuple[int, str]]:
    """(nanoseconds, name) of every frame in order of time.

    unit  what the names are: "s", "ms", "us" or "ns" (decimals allowed), or "index": no times at all, then frame i in
          the order given is at 1 s + i / rate. "auto" is `guessed_unit`
    rate  Hz

    Raises OptionsError for an unknown unit, a rate that is not above 0, or names that are no numbers in a forced
    unit; DatasetError for two frames of one time, or a time that ROS cannot hold.
    """
    if unit not in UNITS:
        raise OptionsError(f"--stamps {unit}: unknown; take one of {', '.join(UNITS)}")
    if not (math.isfinite(rate) and rate > 0):
        raise OptionsError(f"--rate {rate}: give frames per second, above 0")
    if unit == "auto":
        unit = guessed_unit(stamps)
    if unit == "index":
        return [(FIRST + round(i * 10**9 / Fraction(rate)), stamp) for i, stamp in enumerate(stamps)]
    line = sorted((_nanoseconds(stamp, unit), stamp) for stamp in stamps)
    _check(line)
    return line


def guessed_unit(stamps: Sequence[str]) -> str:
    """What names are by their looks: "s", "ms", "us", "ns", or "index" for all else.

    Names with a decimal point are seconds. Whole numbers are times since 1970: of 19 digits nanoseconds (EuRoC; they
    may begin with zeros, as times of a simulation do), of 16 micro-, of 13 milliseconds, of 10 seconds.
    """
    for unit, form in _WRITTEN_SO.items():
        if all(re.fullmatch(form, stamp) for stamp in stamps):
            return unit
    return "index"


def seconds(time: int) -> str:
    """Nanoseconds as seconds with all nine decimals, exact: "1403636579.763555584"."""
    return f"{time // 10**9}.{time % 10**9:09d}"


def frame_rate(times: Sequence[int], otherwise: float) -> float:
    """Hz, from the median distance of frames; `otherwise` where there is only one."""
    steps = sorted(b - a for a, b in pairwise(times))
    return 1e9 / steps[len(steps) // 2] if steps else otherwise


def _nanoseconds(stamp: str, unit: str) -> int:
    if not re.fullmatch(r"\d+(\.\d+)?", stamp):
        raise OptionsError(f"--stamps {unit}: frame {stamp} is not named by a number; say --stamps index")
    return round(Fraction(stamp) * NANOSECONDS[unit])


def _check(line: Sequence[tuple[int, str]]) -> None:
    latest, name = line[-1]
    if latest >= LATEST:
        raise DatasetError(f"frame {name}: later than 2038, which ROS 2 cannot write; name the unit with --stamps")
    for (before, first), (time, second) in pairwise(line):
        if time == before:
            raise DatasetError(f"frames {first} and {second}: of one time; rename one, or say --stamps index")
