"""One stage's next item while another stage works on the item before: `ahead` for those that make items, `Behind`
for those that use them up."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from types import GeneratorType
from typing import Any, TypeVar

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
            box = [item]
            del item  # while `put` waits, the box alone holds it
            if not stop.is_set():
                waiting.put(box)
            if stop.is_set():
                break
        if isinstance(iterator, GeneratorType):
            iterator.close()
    except BaseException as error:
        last = _Failure(error)
    if not stop.is_set():
        waiting.put(last)


class Behind:
    """Calls `function` in a thread of its own, in order, while the caller goes on: one in work and `depth` waiting.

    What `function` raises is raised by a later call, or at the end of the with statement, which waits for all that
    was asked for; but an exception that ends the with statement has precedence.
    """

    def __init__(self, function: Callable[..., object], depth: int = 1):
        self._function, self._depth = function, depth
        self._waiting: deque[Future[object]] = deque()
        self._thread = ThreadPoolExecutor(1, "seepast behind")

    def __call__(self, *arguments: Any) -> None:
        while len(self._waiting) > self._depth:
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._function, *arguments))

    def __enter__(self) -> Behind:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._thread.shutdown()
        while kind is None and self._waiting:
            self._waiting.popleft().result()
