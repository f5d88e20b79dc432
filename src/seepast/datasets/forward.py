"""Messages of one bag file, found again by when they were recorded."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator
from typing import Any

from .bag_file import BagFile, Entry

JUMP = 10**9  # ns: what lies between is read on the way to what is no farther, and sought beyond
NEVER, ALWAYS = -(2**62), 2**62  # ns


class Forward:
    """Reads on from where it stopped, as seeking costs a look through the index of the whole file.

    Only what was recorded between the first and the last of the messages fetched last, and one more, is kept in memory.
    """

    def __init__(self, file: BagFile, topics: Collection[str]):
        self._file, self._topics = file, topics
        self._source: Iterator[tuple[Entry, Any]] = iter(())
        self._kept: dict[Entry, Any] = {}
        self._first, self._reached = ALWAYS, NEVER

    def fetch(self, wanted: Collection[Entry]) -> dict[Entry, Any]:
        """Those of `wanted` that are there."""
        times = [entry.logged for entry in wanted]
        first, last = min(times), max(times)
        if not self._first <= first <= self._reached + JUMP:
            self.close()
            self._source, self._reached = self._file.messages(self._topics, first), first
        self._first = first
        self._kept = {entry: message for entry, message in self._kept.items() if entry.logged >= first}
        while self._reached <= last and (item := next(self._source, None)) is not None:
            self._reached = item[0].logged
            if self._reached >= first:
                self._kept.setdefault(*item)
        if all(entry in self._kept for entry in wanted):
            return {entry: self._kept[entry] for entry in wanted}
        self.close()  # storage files of one ROS 2 bag that overlap in time are read one after the other
        return dict(item for item in self._file.messages(self._topics, first, last + 1) if item[0] in wanted)

    def close(self) -> None:
        """Forget where reading stopped; a database must be left before it is closed."""
        if isinstance(self._source, Generator):
            self._source.close()
        self._source, self._kept = iter(()), {}
        self._first, self._reached = ALWAYS, NEVER
