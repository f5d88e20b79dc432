"""Kernels behind the many views' matching, run on the CPU (cuda_on_cpu), against the specification, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cuda_on_cpu import EmulatedDevice
from seepast.backends import cuda_votes as cuda
from seepast.backends import reference_multiview as reference
from seepast.candidates import CHUNK, DisparityGrid
from seepast.gpu import device
from seepast.many import UNITS, VoteWeights
from test_multiview import KINDS, SCENES, VOTED, WEIGHTS, assert_same, case, every_scene, some_candidates


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


@every_scene
@pytest.mark.parametrize("skip", [-1, 1])
def test_witnesses_and_labels(name, skip):
    c = case(name)
    for k in c.some_views:
        d = c.disparities[k]
        assert_same(*(b.witnesses(d, c.disparities, c.static, c.views[k], skip, UNITS) for b in (reference, cuda)))
        assert_same(*(b.labels(d, c.disparities, c.static, c.views[k], 48) for b in (reference, cuda)))


@every_scene
def test_confidence(name):
    c = case(name)
    agree, farther = reference.witnesses(c.disparities[0], c.disparities, c.static, c.views[0], 1, UNITS)
    assert_same(*(b.confidence_of(agree, farther, c.static[0], 14, 3) for b in (reference, cuda)))


@every_scene
def test_confirmed_does_all_views_at_once(name):
    c = case(name)
    confidence, trusted, wanted = cuda.confirmed(c.disparities, c.static, c.views, UNITS, 14, 3)
    for k, view in enumerate(c.views):
        agree, farther = reference.witnesses(c.disparities[k], c.disparities, c.static, view, k, UNITS)
        assert_same(confidence[k], reference.confidence_of(agree, farther, c.static[k], 14, 3))
        assert_same(trusted[k], (agree > 0) & c.static[k])
        assert_same(wanted[k], agree == 0)


@every_scene
@pytest.mark.parametrize("grid", VOTED, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_votes(name, grid, kind):
    c = case(name)
    candidates = some_candidates(grid, c.static.shape[1:], kind)
    costs = np.random.default_rng(1).integers(0, 256, (candidates.start[-1], CHUNK), np.uint8)
    rough = np.random.default_rng(2).integers(0, grid.values[-1] * UNITS, c.static.shape).astype(np.uint16)
    for k, skip in ((0, 0), (c.geometry.reference, -1)):
        for d, weights in ((c.disparities, WEIGHTS), (rough, replace(VoteWeights(7680, 3, 6, 128), visible=False))):
            given = d, c.confidence, c.static[k], c.views[k], candidates, skip, weights
            assert_same(reference.votes(costs, *given), cuda.votes(costs, *given))


@pytest.mark.parametrize("name", ["5, step", "noise"])
def test_votes_in_place_on_all_views_at_once(name):
    c = case(name)
    every = [some_candidates(VOTED[1], c.static.shape[1:], kind) for kind in (KINDS * 2)[: len(c.views)]]
    rng, own = np.random.default_rng(1), range(len(c.views))
    costs = [rng.integers(0, 256, (one.start[-1], CHUNK), np.uint8) for one in every]
    expected = [
        reference.votes(costs[k], c.disparities, c.confidence, c.static[k], c.views[k], every[k], k, WEIGHTS)
        for k in own
    ]
    found = cuda.votes_of_views(costs, c.disparities, c.confidence, c.static, c.views, every, own, WEIGHTS, costs)
    assert_same(tuple(expected), tuple(costs))
    assert all(a is b for a, b in zip(found, costs, strict=True))


def test_votes_where_candidates_are_left_out():
    """Rows of pixels that are not polled keep their costs (Candidates.where)."""
    c, grid = case("5, step"), DisparityGrid(0, 4, 64)
    candidates = some_candidates(grid, c.static.shape[1:], "random")
    costs = np.random.default_rng(1).integers(0, 256, (candidates.start[-1], CHUNK), np.uint8)
    given = c.disparities, c.confidence, c.static[0], c.views[0], candidates.where(c.choice[0]), 0, WEIGHTS
    assert_same(reference.votes(costs, *given), cuda.votes(costs, *given))


def test_the_scenes_are_those_of_the_cpu_backend():
    assert {len(case(name).views) for name in SCENES} >= {2, 3, 5, 9, 16}
