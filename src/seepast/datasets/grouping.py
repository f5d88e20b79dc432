"""Which images of separately stamped cameras were taken at one instant?"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import DatasetError, OptionsError
from .protocol import DEFAULT_TOLERANCE, Dropped

log = logging.getLogger("seepast")

ENDLESS = 2**62  # ns


def nanoseconds(tolerance: float | None) -> int:
    """A tolerance in seconds (None: the default) as ns. Raises OptionsError unless it is finite and >= 0."""
    seconds = DEFAULT_TOLERANCE if tolerance is None else tolerance
    if not (math.isfinite(seconds) and 0 <= seconds < 1e6):
        raise OptionsError(f"--tolerance {seconds}: give seconds, 0 or more, for instance {DEFAULT_TOLERANCE}")
    return round(seconds * 1e9)


def group(times: Sequence[np.ndarray], tolerance: int) -> np.ndarray:
    """Indices int64[N, K] of the images that make up each of N instants, in time order.

    times: per camera ascending int64 ns, none twice. An instant has one image of every camera, all within
    `tolerance` ns, and none of its images is nearer to the next one of the others. No image is used twice.
    """
    heads, found = [0] * len(times), []
    while all(head < len(own) for head, own in zip(heads, times, strict=True)):
        now = [int(own[head]) for head, own in zip(heads, times, strict=True)]
        first = int(np.argmin(now))
        spread = max(now) - now[first]
        if spread > tolerance or _spread_without(now, first, times[first], heads[first]) < spread:
            heads[first] += 1
        else:
            found.append(tuple(heads))
            heads = [head + 1 for head in heads]
    return np.array(found, np.int64).reshape(-1, len(times))


def _spread_without(now: list[int], first: int, own: np.ndarray, head: int) -> int:
    """The spread of `now` in ns if the earliest image were left out for the next one of its camera."""
    if head + 1 >= len(own):
        return ENDLESS
    instead = [*now[:first], int(own[head + 1]), *now[first + 1 :]]
    return max(instead) - min(instead)


def grouped(
    path: Path, names: Sequence[str], times: Sequence[np.ndarray], tolerance: int
) -> tuple[np.ndarray, tuple[Dropped, ...]]:
    """`group`, what it left out, and why. Raises DatasetError, naming `path`, if there is no instant at all."""
    members = group(times, tolerance)
    if not len(members):
        raise DatasetError(f"{path}: {_no_instant(names, times, tolerance)}")
    return members, _left_out(names, times, members, tolerance)


def log_dropped(path: Path, dropped: Sequence[Dropped], images: int) -> None:
    """One warning that tells how many of `images` were dropped, and why."""
    if dropped:
        left_out = sum(d.images for d in dropped)
        log.warning("%s: dropping %d of %d images (%s)", path, left_out, images, "; ".join(map(str, dropped)))


def _left_out(
    names: Sequence[str], times: Sequence[np.ndarray], members: np.ndarray, tolerance: int
) -> tuple[Dropped, ...]:
    reasons: Counter[str] = Counter()
    for k, own in enumerate(times):
        for time in np.delete(own, members[:, k]):
            missing = [name for name, other in zip(names, times, strict=True) if _gap(other, time) > tolerance]
            reasons[_reason(missing, tolerance)] += 1
    return tuple(Dropped(images, reason) for reason, images in reasons.most_common())


def _reason(missing: Sequence[str], tolerance: int) -> str:
    within = f"within {tolerance / 1e6:g} ms"
    if missing:
        return f"{', '.join(missing)} {'have' if len(missing) > 1 else 'has'} no image {within}"
    return f"others {within} are not all {within} of each other, or nearer to another image"


def _gap(times: np.ndarray, time: int) -> int:
    """ns from `time` to the nearest of `times`."""
    at = int(np.searchsorted(times, time))
    return min(abs(int(near) - int(time)) for near in times[max(at - 1, 0) : at + 1])


def _no_instant(names: Sequence[str], times: Sequence[np.ndarray], tolerance: int) -> str:
    nearest = group(times, ENDLESS)
    stamps = np.stack([own[nearest[:, k]] for k, own in enumerate(times)], axis=1)
    apart = float(np.median(np.ptp(stamps, axis=1))) / 1e9
    return (
        f"at no instant do all of {', '.join(names)} have an image within {tolerance / 1e6:g} ms; nearest images "
        f"are {apart:.3g} s apart: trigger the cameras together and set one clock, or, if nothing moves fast, "
        f"allow more with --tolerance SECONDS"
    )
