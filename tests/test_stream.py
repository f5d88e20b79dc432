"""Streams: the same results as one by one, frames in the making meanwhile, failures in their place, no thread left."""

from __future__ import annotations

import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import seepast
from recordings import write_recording
from seepast import ahead as ahead_module
from seepast import backends
from seepast.ahead import Behind, ahead
from seepast.datasets import open_dataset
from seepast.errors import DatasetError, InputError, OutputError
from seepast.export import FolderWriter
from seepast.options import Options
from seepast.pipeline import Reconstructor
from seepast.rig import Rig
from seepast.sequence import Settings, describe_run, process
from test_rectify import crooked_rig, textured

SOON = 20.0  # seconds after which a test gives up on a thread
Frames = list[tuple[list[np.ndarray], list[np.ndarray] | None]]


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + SOON
    while (left := set(threading.enumerate()) - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left


def some_frames(rig: Rig, count: int) -> Frames:
    frames: Frames = []
    for number in range(count):
        images, _ = textured(rig, seed=number)
        masks = [np.zeros(image.shape[:2], np.uint8) for image in images]
        for mask in masks:
            mask[40:120, 60 + 20 * number : 100 + 20 * number] = 255
        frames.append((images, None if number == 1 else masks))
    return frames


def options(preset: str) -> Options:
    return Options.preset(preset).updated({"range.max_disparity": 24})


def assert_same(a: seepast.Result, b: seepast.Result) -> None:
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y, err_msg=f.name)
    for x, y in zip(a.masks, b.masks, strict=True):
        np.testing.assert_array_equal(x, y)
    assert a.rounds == b.rounds and a.timings.keys() == b.timings.keys()


# --------------------------------------------------------------------------------------------------- results


@pytest.mark.parametrize("preset", ["paper", "accurate"])
def test_a_stream_gives_what_single_calls_give(preset: str) -> None:
    rig = crooked_rig(3)
    frames = some_frames(rig, 4)
    run = Reconstructor(rig, options=options(preset), reference=1)
    single = [run(*frame) for frame in frames]
    for results in (
        list(run.stream(frames)),
        list(seepast.stream(iter(frames), rig, options=options(preset), reference=1, threads=1)),
    ):
        assert len(results) == len(single)
        for one, other in zip(results, single, strict=True):
            assert_same(one, other)
    assert (single[0].background != single[2].background).any()  # or any order would do


def test_memory_of_earlier_frames_is_used_again_but_never_seen() -> None:
    """Colour, grey and colour, masks and none in turn, all results kept: each is that of a Reconstructor of its own."""
    rig = crooked_rig(2)
    frames = some_frames(rig, 5)
    for number in (1, 2):
        images, masks = frames[number]
        frames[number] = ([image[..., 1].copy() for image in images], masks)
    for kind in ("cubic", "linear"):
        chosen = options("paper").updated({"rectify.interpolation": kind, "refocus.median": False})
        run = Reconstructor(rig, options=chosen)
        kept = [run(*frame) for frame in frames] + list(run.stream(frames))
        for frame, *results in zip(frames, kept[:5], kept[5:], strict=True):
            fresh = seepast.reconstruct(*frame, rig, options=chosen)
            for result in results:
                assert_same(result, fresh)


def test_grey_frames_and_no_frames() -> None:
    rig = crooked_rig(2)
    grey = [[image[..., 0].copy() for image in images] for images, _ in some_frames(rig, 2)]
    run = Reconstructor(rig, options=options("paper"))
    for result, images in zip(run.stream((images, None) for images in grey), grey, strict=True):
        assert result.background.ndim == 2
        assert_same(result, run(images, None))
    assert list(run.stream([])) == []


def test_a_bad_frame_is_told_in_its_place() -> None:
    rig = crooked_rig(2)
    frames = some_frames(rig, 4)
    frames[2][0][1] = frames[2][0][1][:-1]
    results = Reconstructor(rig, options=options("paper")).stream(frames)
    next(results), next(results)
    with pytest.raises(InputError, match="image of cam1 is 240x179"):
        next(results)
    assert next(results, None) is None


def test_what_the_source_raises_comes_after_the_frames_before_it() -> None:
    rig = crooked_rig(2)

    def source() -> Iterator[Any]:
        yield from some_frames(rig, 2)
        raise DatasetError("frame 2: the file is damaged")

    seen = 0
    with pytest.raises(DatasetError, match="frame 2"):
        for _ in Reconstructor(rig, options=options("paper")).stream(source()):
            seen += 1
    assert seen == 2


def test_the_next_frames_are_made_while_one_is_reconstructed(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = crooked_rig(2)
    fetched, rectified = threading.Event(), threading.Event()
    really, prepare = Reconstructor._reconstructed, Reconstructor._prepared
    waited: list[bool] = []

    def source() -> Iterator[Any]:
        for number, frame in enumerate(some_frames(rig, 3)):
            if number == 2:
                fetched.set()
            yield frame

    def counted(self: Reconstructor, *arguments: Any) -> Any:
        made = prepare(self, *arguments)
        if arguments[1] is None:  # the second frame
            rectified.set()
        return made

    def slow(self: Reconstructor, prepared: Any) -> seepast.Result:
        if not waited:  # the first frame
            waited.extend([rectified.wait(SOON), fetched.wait(SOON)])
        return really(self, prepared)

    monkeypatch.setattr(Reconstructor, "_prepared", counted)
    monkeypatch.setattr(Reconstructor, "_reconstructed", slow)
    assert len(list(Reconstructor(rig, options=options("paper")).stream(source()))) == 3
    assert waited == [True, True]


def test_a_stream_that_is_left_early_closes_its_source() -> None:
    rig = crooked_rig(2)
    closed = threading.Event()
    made = 0

    def endless() -> Iterator[Any]:
        nonlocal made
        try:
            while True:
                made += 1
                yield some_frames(rig, 1)[0]
        finally:
            closed.set()

    with closing(Reconstructor(rig, options=options("paper")).stream(endless())) as results:
        next(results)
    assert closed.wait(SOON)
    assert made <= 6  # the one that was asked for, and five


@pytest.mark.parametrize("own", [None, "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"])
def test_idle_threads_soon_sleep_unless_the_user_has_said_how_they_wait(
    monkeypatch: pytest.MonkeyPatch, own: str | None
) -> None:
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    if own:
        monkeypatch.setenv(own, "7")
    before = dict(os.environ)
    with backends._idle_threads_soon_sleep():
        assert dict(os.environ) == (before if own else {**before, "GOMP_SPINCOUNT": str(backends.SPINS)})
    assert dict(os.environ) == before


# --------------------------------------------------------------------------------------------------- ahead


def test_ahead_goes_no_farther_than_asked_and_keeps_no_item() -> None:
    class Item:
        pass

    made: list[weakref.ref[Item]] = []
    third = threading.Event()

    def source() -> Iterator[Item]:
        for number in range(9):
            item = Item()
            made.append(weakref.ref(item))
            if number == 3:
                third.set()
            yield item
            del item

    items = ahead(source(), depth=2)
    first = next(items)
    assert third.wait(SOON)  # one handed out, two waiting, and this one that waits for a place
    time.sleep(0.05)
    assert len(made) == 4 and first is made[0]()
    del first
    assert made[0]() is None
    assert len(list(items)) == 8


def test_ctrl_c_while_the_source_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead_module, "PATIENCE_S", 0.05)
    release = threading.Event()

    def hanging() -> Iterator[int]:
        yield 1
        release.wait(SOON)

    items = ahead(hanging())
    assert next(items) == 1
    with alarm_in(0.1), pytest.raises(KeyboardInterrupt):
        next(items)
    release.set()


class alarm_in:  # noqa: N801
    """Raises KeyboardInterrupt in the main thread, as Ctrl-C does, after some seconds."""

    def __init__(self, seconds: float):
        self.seconds = seconds

    def __enter__(self) -> None:
        self.before = signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, self.seconds)

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, self.before)


# --------------------------------------------------------------------------------------------------- behind, run


def test_behind_works_in_order_and_holds_the_caller_back() -> None:
    done: list[int] = []
    gates = [threading.Event() for _ in range(5)]

    def work(number: int) -> None:
        assert gates[number].wait(SOON)
        done.append(number)

    with Behind(work, depth=1) as behind:
        behind(0)
        behind(1)
        late = threading.Thread(target=behind, args=(2,))
        late.start()
        late.join(0.05)
        assert late.is_alive()  # 0 is in work, 1 waits, 2 finds no place
        gates[0].set()
        late.join(SOON)
        assert not late.is_alive() and done == [0]
        for gate in gates:
            gate.set()
    assert done == [0, 1, 2]


def test_behind_tells_failures_but_never_instead_of_the_callers_own() -> None:
    def full(_: int) -> None:
        raise OutputError("disk full")

    with pytest.raises(OutputError, match="disk full"), Behind(full) as behind:
        behind(0)
    with pytest.raises(OutputError, match="disk full"), Behind(full) as behind:
        for number in range(9):
            behind(number)
        raise AssertionError("nobody was told")
    with pytest.raises(DatasetError, match="mine"), Behind(full) as behind:
        behind(0)
        raise DatasetError("mine")


def files(folder: Path) -> dict[str, bytes]:
    kept = ("png", "pfm", "yaml")
    found = (path for path in sorted(folder.rglob("*")) if path.name.endswith(kept))
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def test_a_run_writes_what_frame_by_frame_is_written(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "rec", stamps=("a", "b", "c", "d"))
    dataset, settings = open_dataset(recording), Settings(options("paper"), reference=1)
    summary = process(dataset, tmp_path / "out", settings)
    assert summary.frames == summary.computed == 4
    run = Reconstructor(dataset.rig, options=settings.options, reference=1)
    names = [camera.name for camera in dataset.rig.cameras]
    rotation = run.rectification.rotation_from_cam[1]
    with FolderWriter(tmp_path / "plain", describe_run(dataset, settings), names, rotation=rotation) as writer:
        for frame in dataset:
            writer.write(frame.stamp, run(frame.images, frame.masks), 1.0)
    assert files(tmp_path / "out") == files(tmp_path / "plain") and len(files(tmp_path / "out")) == 4 * 8 + 1


def test_a_run_reconstructs_while_it_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    second = threading.Event()
    really, write = Reconstructor._reconstructed, FolderWriter.write
    waited: list[bool] = []

    def counted(self: Reconstructor, prepared: Any) -> seepast.Result:
        if waited_or_started:
            second.set()
        waited_or_started.append(True)
        return really(self, prepared)

    def slow(self: FolderWriter, *arguments: Any) -> None:
        if not waited:
            waited.append(second.wait(SOON))
        write(self, *arguments)

    waited_or_started: list[bool] = []
    monkeypatch.setattr(Reconstructor, "_reconstructed", counted)
    monkeypatch.setattr(FolderWriter, "write", slow)
    dataset = open_dataset(write_recording(tmp_path / "rec", stamps=("a", "b")))
    assert process(dataset, tmp_path / "out", Settings(options("paper"))).frames == 2
    assert waited == [True]


@pytest.mark.parametrize("bad", ["read", "write"])
def test_what_was_finished_before_a_failure_stays_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    dataset = open_dataset(write_recording(tmp_path / "rec", stamps=("a", "b", "c", "d", "e")))

    def failing(really: Callable[..., Any]) -> Callable[..., Any]:
        def call(self: Any, stamp: str, *arguments: Any) -> Any:
            if stamp == "c":
                raise DatasetError("frame c: gone")
            return really(self, stamp, *arguments)

        return call

    owner, name = (type(dataset), "frame") if bad == "read" else (FolderWriter, "write")
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, failing(getattr(owner, name)))
        with pytest.raises(DatasetError, match="frame c"):
            process(dataset, tmp_path / "out", Settings(options("paper")))
    there = {path.stem for path in (tmp_path / "out" / "coverage").iterdir()}
    assert there >= {"a", "b"} and "c" not in there
    summary = process(dataset, tmp_path / "out", Settings(options("paper")))
    assert summary.frames == 5 and summary.computed == 5 - len(there)
