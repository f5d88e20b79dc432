"""Memory that is used again, and that which somebody still holds."""

from __future__ import annotations

import gc
import threading

import numpy as np
import pytest

import seepast
from arrays import SPACING, make_scene
from seepast.backends import cpu_multiview, workspace
from seepast.backends.workspace import LEAST, Workspace, rounded

BIG = (2, LEAST)


def memory(array: np.ndarray) -> int:
    return array.ctypes.data


def test_memory_that_nobody_holds_is_used_again():
    here = Workspace()
    first = memory(here.empty(BIG, np.uint8))
    assert memory(here.empty(BIG, np.uint8)) == first
    assert memory(here.empty((LEAST,), np.int16)) == first  # as many bytes
    assert memory(here.zeros((LEAST // 2,), np.float32)) == first


@pytest.mark.parametrize(
    "part",
    [
        lambda a: a[1:],
        lambda a: a[0, ::7],
        lambda a: a.view(np.uint16)[:, 3],
        lambda a: a.T.reshape(-1, 2, order="F")[5],
        lambda a: np.split(a, 2)[1],
        lambda a: memoryview(a)[1:],
        lambda a: np.asarray(memoryview(a)),
        lambda a: iter(a),
        lambda a: (row for row in a),
        lambda a: np.lib.stride_tricks.as_strided(a, (3,), (1,)),
    ],
)
def test_what_is_held_in_part_is_not_written_over(part):
    here = Workspace()
    array = here.empty(BIG, np.uint8)
    place, held = memory(array), part(array)
    del array
    other = here.empty(BIG, np.uint8)
    assert memory(other) != place
    del other, held
    gc.collect()
    assert place in {memory(a) for a in [here.empty(BIG, np.uint8) for _ in range(2)]}


def test_arrays_in_use_never_share_memory():
    here, rng = Workspace(), np.random.default_rng(2)
    held: list[tuple[np.ndarray, int]] = []
    for i in range(300):
        array = here.empty((int(rng.integers(LEAST // 2, 8 * LEAST)),), np.uint8)
        array.fill(i % 251)
        held.append((array, i % 251))
        del array
        for _ in range(int(rng.integers(0, 3))):
            if held:
                held.pop(int(rng.integers(len(held))))
        assert all((kept == value).all() for kept, value in held)


def test_zeros_are_zeros():
    here = Workspace()
    here.empty(BIG, np.uint8).fill(7)
    assert not here.zeros(BIG, bool).any()
    assert not here.zeros((3,), np.uint8).any()


def test_what_others_made_is_not_written_over_on_another_thread():
    """Images go from thread to thread, and are let go on any of them."""
    here, places, held = Workspace(), [], []

    def make() -> None:
        array = here.empty(BIG, np.uint8)
        array.fill(9)
        held.append(array[1])
        places.append(memory(array))
        del array
        places.append(memory(here.empty(BIG, np.uint8)))

    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
    mine = here.empty(BIG, np.uint8)
    mine.fill(1)
    assert places[0] != places[1] and memory(mine) != places[0]
    assert (held[0] == 9).all()  # though that thread is gone


def test_memory_for_growing_arrays_does_not_gather():
    here = Workspace()
    for size in range(LEAST, 20 * LEAST, LEAST // 3):
        here.empty((size,), np.uint8)
    most = 20 * LEAST
    assert sum(m.bytes.size for m in here._pool) <= 2.5 * rounded(most)


def test_what_nobody_asks_for_any_more_is_returned(monkeypatch):
    monkeypatch.setattr(workspace, "FORGOTTEN", 4)
    here = Workspace()
    here.empty((100 * LEAST,), np.uint8)
    for size in (1, 1, 1, 1, 1, 6):
        here.empty((size * LEAST,), np.uint8)
    assert max(m.bytes.size for m in here._pool) < 100 * LEAST


def test_rounding_wastes_little():
    for size in (LEAST, LEAST + 1, 3 * LEAST - 1, 12345678):
        assert size <= rounded(size) <= size * 9 / 8 + 1


@pytest.mark.parametrize("preset", ["fast", "accurate"])
def test_results_that_are_kept_stay_what_they_were(preset, monkeypatch):
    """Whatever came after, on two threads, over all that is free."""
    monkeypatch.setattr(workspace, "LEAST", 16)
    scene = make_scene(3, (96, 64), colour=True)
    size, geometry, masks = scene.geometry.size, scene.geometry, scene.masks
    rig = seepast.Rig.linear(geometry.cameras, focal=geometry.focal[0], spacing=SPACING, size=size)
    given = [np.roll(scene.views, 9 * i, axis=2) for i in range(4)]
    options = seepast.Options.preset(preset)
    found: dict[int, list[seepast.Result]] = {}

    def work(thread: int) -> None:
        see = seepast.Reconstructor(rig, options=options)
        found[thread] = [see(list(views), masks) for views in given]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    work(2)
    assert cpu_multiview.workspace._pool
    held, copies = found[2], [arrays_of(result, copy=True) for result in found[2]]
    work(3)
    for others in (held, *(found[i] for i in (0, 1, 3))):
        for result, was in zip(others, copies, strict=True):
            is_now = arrays_of(result)
            assert is_now.keys() == was.keys() and {"background", "disparity", "labels", "masks 0"} <= was.keys()
            assert [n for n in was if not np.array_equal(was[n], is_now[n], equal_nan=True)] == []


def arrays_of(result: seepast.Result, copy: bool = False) -> dict[str, np.ndarray]:
    names = ("background", "disparity", "depth", "confidence", "coverage", "labels")
    found = {n: getattr(result, n) for n in names} | {f"masks {k}": m for k, m in enumerate(result.masks)}
    return {n: np.array(a) if copy else a for n, a in found.items()}
