"""One stage's next item while another stage works on the item before."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Generator, Iterable
from types import GeneratorType
from typing import TypeVar

log = logging.getLogger("seepast")

T = TypeVar("T")

PATIENCE_S = 5.0  # for a source that waits for its next item, when nobody wants it any more


class _Failure:
    """Instead of an item: what its making raised."""

    def __init__(self, error: BaseException):
        self.error = error


def ahead(items: Iterable[T], depth: int = 1) -> Generator[T, None, None]:
    """The same items in the same order, made by a thread of their own: one in the making and `depth` waiting.

    What `items` raises is raised here, after the items before it. Closing this generator ends the thread, after
    the item it is making, and closes `items` if that is a generator; one that hangs is left behind.
    """
    waiting: queue.Queue[list[T] | _Failure | None] = queue.Queue(depth)
    stop = threading.Event()
    thread = threading.Thread(target=_make, args=(items, waiting, stop), name="seepast ahead", daemon=True)
    thread.start()
    try:
        while (entry := waiting.get()) is not None:
            if isinstance(entry, _Failure):
                raise entry.error
            yield entry.pop()  # so that nobody but the caller holds it
    finally:
        stop.set()
        with contextlib.suppress(queue.Empty):  # the thread may be waiting to hand over one more
            while True:
                waiting.get_nowait()
        thread.join(PATIENCE_S)
        if thread.is_alive():
            log.debug("the source of frames has not answered for %g s and is left behind", PATIENCE_S)


def _make(items: Iterable[T], waiting: queue.Queue[list[T] | _Failure | None], stop: threading.Event) -> None:
    """Put every item, boxed, then None; or the failure. Each `put` follows a look at `stop`, so that after it at
    most one is still put, for which there is room once the queue has been emptied."""
    last: _Failure | None = None
    try:
        iterator = iter(items)
        for item in iterator:
            if stop.is_set():
                break
            box = [item]
            del item  # while `put` waits, the box alone holds it
            waiting.put(box)
        if isinstance(iterator, GeneratorType):
            iterator.close()
    except BaseException as error:
        last = _Failure(error)
    if not stop.is_set():
        waiting.put(last)
