"""What a live path has done: counts, reasons for what it dropped, and times."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

KEPT = 10_000  # frames that the quantiles of the end are made of

STALE = "a newer one came before the method was free"
UNUSABLE = "could not be used"


@dataclass(frozen=True)
class Report:
    """What happened in `seconds`.

    images, frames, published  messages that came, instants that were complete, results that went out
    latency_ms  (median, 95 %) from the arrival of a frame's last message until its results were out; None: no result
    age_ms      the same from the reference camera's stamp, by this machine's clock
    frames_dropped, images_dropped  reason -> number
    unsent      messages of results that a subscriber did not take in time
    """

    seconds: float
    images: int
    frames: int
    published: int
    latency_ms: tuple[float, float] | None
    age_ms: tuple[float, float] | None
    frames_dropped: Mapping[str, int]
    images_dropped: Mapping[str, int]
    unsent: int

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def __str__(self) -> str:
        rate = f"{self.frames / self.seconds:.1f} frames/s in, {self.published / self.seconds:.1f} out"
        words = [f"{self.seconds:.1f} s: {self.images} images, {self.frames} frames, {self.published} out ({rate})"]
        if self.latency_ms is not None and self.age_ms is not None:
            words.append(
                f"latency {self.latency_ms[0]:.0f} ms median, {self.latency_ms[1]:.0f} ms 95 % "
                f"(since the stamp: {self.age_ms[0]:.0f}, {self.age_ms[1]:.0f} ms)"
            )
        for what, dropped in (("frames", self.frames_dropped), ("images", self.images_dropped)):
            if dropped:
                reasons = ", ".join(f"{number}: {reason}" for reason, number in dropped.items())
                words.append(f"dropped {sum(dropped.values())} {what} ({reasons})")
        if self.unsent:
            words.append(f"{self.unsent} messages not taken in time by a subscriber")
        return "; ".join(words)


class Figures:
    """Adds up over a period; `report` tells it. What comes is counted in one thread, what goes out in another."""

    def __init__(self) -> None:
        self.since = time.monotonic()
        self.images = self.frames = self.published = 0
        self.unusable = self.unsent = 0
        self._latencies: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def out(self, latency: float, age: float) -> None:
        """One result is out; seconds."""
        self.published += 1
        self._latencies.append((1e3 * latency, 1e3 * age))

    def report(self, displaced: int, images_dropped: Mapping[str, int]) -> Report:
        latency, age = self._quantiles()
        frames = {STALE: displaced, UNUSABLE: self.unusable}
        return Report(
            seconds=max(time.monotonic() - self.since, 1e-9),
            images=self.images,
            frames=self.frames,
            published=self.published,
            latency_ms=latency,
            age_ms=age,
            frames_dropped=_sorted(frames.items()),
            images_dropped=_sorted(images_dropped.items()),
            unsent=self.unsent,
        )

    def _quantiles(self) -> tuple[tuple[float, float], tuple[float, float]] | tuple[None, None]:
        if not self._latencies:
            return None, None
        (latency, age), (latency95, age95) = np.percentile(np.array(self._latencies), (50, 95), axis=0).tolist()
        return (latency, latency95), (age, age95)


def _sorted(reasons: Iterable[tuple[str, int]]) -> dict[str, int]:
    return dict(Counter({reason: number for reason, number in reasons if number > 0}).most_common())
