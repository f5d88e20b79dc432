"""Which messages of separately stamped topics belong to one instant, told as they come."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from ..datasets.grouping import group
from .messages import CompressedImage, Image

AnyImage = Image | CompressedImage

WAITING = 16  # messages of one topic that wait for those of the others
BACK = 10**9  # ns: stamps that go back by more come from a clock that was set, or a bag played again

NO_STAMP = "no time stamp in the header"
CLOCK = "waited for others when the clock was set back"
LATE = "came after their instant had gone, or twice"


class Grouper:
    """Sorts messages into instants, by header stamp, as `datasets.grouping.group` does for recordings.

    names      of the topics' streams, for reasons
    tolerance  ns that the messages of an instant may be apart
    dropped    reason -> number of messages that belong to no instant

    At most WAITING messages of every stream are held. Not for several threads at a time.
    """

    def __init__(self, names: Sequence[str], tolerance: int):
        self.names, self.tolerance = tuple(names), tolerance
        self.dropped: Counter[str] = Counter()
        self._waiting: list[deque[AnyImage]] = [deque() for _ in names]
        self._last = [0] * len(self.names)  # stamps of the last instant

    def add(self, stream: int, message: AnyImage) -> list[tuple[AnyImage, ...]]:
        """Take a message of that stream; the instants, in time order, that are complete with it."""
        if message.stamp <= 0:
            self.dropped[NO_STAMP] += 1
            return []
        if message.stamp < self._last[stream] - BACK:
            self._start_again()
        waiting = self._waiting[stream]
        if message.stamp <= self._last[stream] or any(other.stamp == message.stamp for other in waiting):
            self.dropped[LATE] += 1
            return []
        behind = len(waiting)
        while behind and waiting[behind - 1].stamp > message.stamp:
            behind -= 1
        waiting.insert(behind, message)
        complete = self._complete()
        if len(waiting) > WAITING:
            self._forget([waiting[0].stamp + self.tolerance + 1] * len(self.names))
        return complete

    def _complete(self) -> list[tuple[AnyImage, ...]]:
        if not all(self._waiting):
            return []
        times = [np.array([message.stamp for message in own]) for own in self._waiting]
        return [
            self._take([int(own[i]) for own, i in zip(times, row, strict=True)]) for row in group(times, self.tolerance)
        ]

    def _take(self, stamps: list[int]) -> tuple[AnyImage, ...]:
        """The messages with these stamps, one of every stream; what is older has missed its partners."""
        self._forget(stamps)
        self._last = stamps
        return tuple(own.popleft() for own in self._waiting)

    def _forget(self, limits: list[int]) -> None:
        """Drop what is older than its stream's limit, after telling why for all of it."""
        missed = [m.stamp for own, limit in zip(self._waiting, limits, strict=True) for m in own if m.stamp < limit]
        self.dropped.update([self._reason(stamp) for stamp in missed])
        for own, limit in zip(self._waiting, limits, strict=True):
            while own and own[0].stamp < limit:
                own.popleft()

    def _reason(self, stamp: int) -> str:
        lacking = [
            name
            for name, own in zip(self.names, self._waiting, strict=True)
            if not any(abs(message.stamp - stamp) <= self.tolerance for message in own)
        ]
        within = f"within {self.tolerance / 1e6:g} ms of them"
        if not lacking:
            return f"others {within} were nearer to another image"
        return f"{lacking[0] if len(lacking) == 1 else 'several topics'} had nothing {within}"

    def _start_again(self) -> None:
        self.dropped[CLOCK] += sum(map(len, self._waiting))
        self._last = [0] * len(self.names)
        for own in self._waiting:
            own.clear()
