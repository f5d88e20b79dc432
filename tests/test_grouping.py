"""Which images were taken at one instant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from seepast.datasets.grouping import group, grouped, nanoseconds
from seepast.errors import DatasetError, OptionsError

MS = 1_000_000


def times(*cameras: list[float]) -> list[np.ndarray]:
    return [np.array([round(t * MS) for t in own], np.int64) for own in cameras]


def test_jittered_times_are_grouped_and_gaps_left_out() -> None:
    own = times([0, 50, 100, 150], [1, 101.5, 151], [2.5, 49, 99, 152])
    assert group(own, 5 * MS).tolist() == [[0, 0, 0], [2, 1, 2], [3, 2, 3]]


def test_the_tolerance_is_met_exactly() -> None:
    assert len(group(times([0], [5]), 5 * MS)) == 1
    assert len(group(times([0], [5.000001]), 5 * MS)) == 0


def test_a_wide_tolerance_still_takes_the_nearest_images() -> None:
    own = times([0, 50, 100], [50.1, 100.1])
    assert group(own, 80 * MS).tolist() == [[1, 0], [2, 1]]
    fast = times([0, 10, 20, 30, 40], [19, 39])
    assert group(fast, 30 * MS).tolist() == [[2, 0], [4, 1]]


def test_random_jitter_and_losses_are_undone() -> None:
    rng = np.random.default_rng(3)
    period, frames, cameras = 50 * MS, 200, 5
    jitter = rng.integers(-2 * MS, 2 * MS, (cameras, frames))
    kept = rng.random((cameras, frames)) > 0.1
    instants = np.arange(frames) * period
    own = [(instants + jitter[k])[kept[k]] for k in range(cameras)]
    members = group(own, 5 * MS)
    found = np.stack([own[k][members[:, k]] for k in range(cameras)], axis=1)
    whole = kept.all(axis=0)
    np.testing.assert_array_equal(found, (instants + jitter).T[whole])


def test_what_is_left_out_is_counted_with_its_reason() -> None:
    own = times([0, 50, 100], [0, 100], [0, 50, 100, 150])
    members, dropped = grouped(Path("x.bag"), ("cam0", "cam1", "cam2"), own, 5 * MS)
    assert len(members) == 2
    reasons = {d.reason: d.images for d in dropped}
    assert reasons == {"cam1 has no image within 5 ms": 2, "cam0, cam1 have no image within 5 ms": 1}
    assert str(dropped[0]) == "2 images: cam1 has no image within 5 ms"


def test_images_spread_too_far_are_told_apart_from_missing_ones() -> None:
    own = times([0, 100], [4, 100], [8, 100])  # each has a neighbour within 5 ms, all three have not
    _, dropped = grouped(Path("x.bag"), ("cam0", "cam1", "cam2"), own, 5 * MS)
    reasons = {d.reason.split(" has")[0].split(" are")[0]: d.images for d in dropped}
    assert reasons == {"cam2": 1, "others within 5 ms": 1, "cam0": 1}


def test_no_common_instant_says_how_far_apart_the_images_are() -> None:
    with pytest.raises(DatasetError, match=r"x\.bag: at no instant do all of cam0, cam1 .*are 0\.02 s apart"):
        grouped(Path("x.bag"), ("cam0", "cam1"), times([0, 50], [20, 70]), 5 * MS)


@pytest.mark.parametrize("wrong", [-0.001, float("nan"), float("inf")])
def test_a_tolerance_must_be_a_time(wrong: float) -> None:
    with pytest.raises(OptionsError, match="--tolerance"):
        nanoseconds(wrong)
    assert nanoseconds(None) == 5 * MS and nanoseconds(0.02) == 20 * MS
