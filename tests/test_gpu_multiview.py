"""Kernels behind the many views' matching, run on the CPU (cuda_on_cpu), against the specification, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cuda_on_cpu import EmulatedDevice
from seepast.backends import cuda_levels as levels
from seepast.backends import cuda_picture as picture
from seepast.backends import cuda_votes as cuda
from seepast.backends import host
from seepast.backends import reference_multiview as reference
from seepast.candidates import CHUNK, DisparityGrid
from seepast.confidence import VIEWS
from seepast.gpu import device
from seepast.many import UNITS, VoteWeights
from seepast.picture import camera_weights
from test_multiview import KINDS, OPTIONS, SCENES, VOTED, WEIGHTS, assert_same, case, every_scene, some_candidates


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
        for wanted in (None, c.choice[0]):
            assert_same(*(b.labels(d, c.disparities, c.static, c.views[k], 48, wanted) for b in (reference, cuda)))


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


@every_scene
def test_all_views_are_graded_at_once(name):
    c = case(name)
    given = c.disparities, c.static, c.views, UNITS, 14, 3
    grid = DisparityGrid(0, 8, 2 * CHUNK)
    some = [some_candidates(grid, c.static.shape[1:], "holes") if k % 3 else None for k in range(len(c.views))]
    for candidates in (None, some):
        expected = reference.graded_of_views(*given, candidates)
        assert_same(expected, cuda.graded_of_views(*given, candidates))


@every_scene
def test_planes(name):
    c = case(name)
    smooth = (c.disparities[0] // 8 + 300).astype(np.uint16)
    for d in (smooth, c.disparities[0]):
        given = d, c.choice[0], c.choice[1], c.colour[0], c.static[0]
        assert_same(reference.planes(*given), picture.planes(*given))
    few = np.zeros_like(c.choice[1])
    few[::7, ::11] = True
    given = smooth, c.choice[0], few, c.colour[0], c.static[0]
    assert_same(reference.planes(*given), picture.planes(*given))
    given = smooth, c.choice[0], np.zeros_like(few), c.colour[0], c.static[0]
    assert_same(smooth, picture.planes(*given))


@pytest.mark.parametrize("name", ["5, step", "noise of 7"])
def test_planes_of_all_views_at_once(name):
    c = case(name)
    found = c.disparities // 8 + 300
    sure = np.random.default_rng(3).random(found.shape) < 0.7
    expected = [reference.planes(found[k], sure[k] & c.static[k], ~sure[k], c.colour[k], c.static[k]) for k in (0, 1)]
    assert_same(np.stack(expected), picture.planes_of_views(found, sure, c.colour, c.static)[:2])


@every_scene
def test_blend(name):
    c = case(name)
    rays = np.random.default_rng(2).integers(0, 1 << len(c.static), c.choice[0].shape).astype(np.uint16)
    clear = host.clear_of_masks(c.static)
    for k in c.some_views:
        near = camera_weights(c.views[k], OPTIONS.multiview)
        given = rays, clear, near, 0.3, c.views[k], c.disparities[k], c.choice[0]
        assert_same(*(b.blend(c.colour, *given) for b in (reference, picture)))


@every_scene
def test_evidence(name):
    c = case(name)
    r = c.geometry.reference
    flat = (c.disparities // 40 * 40)[r]
    for d in (c.disparities[r], flat, np.full_like(flat, 400)):
        shown, _, close = reference.labels(d, c.disparities, c.static, c.geometry, 48)
        given = d, c.static[r], close, shown
        assert_same(reference.evidence(*given), picture.evidence(*given))
        for keep in (None, c.static[r]):
            told = (b.told(d, reference.evidence(*given), VIEWS.table, shown, keep) for b in (host, picture))
            for expected, found in zip(*told, strict=True):
                assert_same(expected, found)


# --------------------------------------------------------------------------------------------- between the stages


@pytest.mark.parametrize("scale", [2, 3, 4, 5, 8])
@pytest.mark.parametrize("shape", [(64, 96), (65, 43), (8, 131)])
def test_averaged(scale, shape):
    rng = np.random.default_rng(scale)
    colour, static = rng.integers(0, 256, (3, *shape, 3), np.uint8), rng.random((3, *shape)) < 0.97
    given = colour, static, (shape[1] // scale, shape[0] // scale), scale
    assert_same(host.averaged(*given), levels.averaged(*given))


@pytest.mark.parametrize("ratio", [1, 2, 4])
@pytest.mark.parametrize("kind", [bool, np.uint16])
def test_enlarged(ratio, kind):
    views = np.random.default_rng(ratio).integers(0, 9, (3, 13, 21)).astype(kind)
    for more in (0, ratio - 1):
        shape = 13 * ratio + more, 21 * ratio + more
        assert_same(host.enlarged(views, ratio, shape), levels.enlarged(views, ratio, shape))
        if kind == np.uint16:
            assert_same(host.enlarged(views, ratio, shape, 3), levels.enlarged(views, ratio, shape, 3))


@every_scene
def test_landings_and_beside(name):
    c = case(name)
    d = c.disparities[c.geometry.reference] / np.float32(UNITS)
    hidden = ~c.static[c.geometry.reference]
    for high in (d + np.float32(0.75), d[::-1, ::-1].copy(), d):
        found = host.landings(hidden, d, high, c.geometry)
        assert_same(found, levels.landings(hidden, d, high, c.geometry))
    for reach in ((3, 3), (4, 2), (2, 17)):
        assert_same(host.beside(found, *reach), levels.beside(found, *reach))


@every_scene
def test_witnessed(name):
    c, k = case(name), case(name).geometry.reference
    for most, tolerance in ((15, UNITS), (2, UNITS), (1, 20 * UNITS)):
        given = ~c.static[k], c.disparities, c.static, c.geometry, most, tolerance
        assert_same(host.witnessed(*given), levels.witnessed(*given))


@every_scene
def test_clear_of_masks(name):
    static = case(name).static
    assert_same(host.clear_of_masks(static), levels.clear_of_masks(static))


@pytest.mark.parametrize("height", [2, 3, 20, 21])
def test_half_rows_and_back(height):
    rng = np.random.default_rng(height)
    given = rng.integers(0, 256, (2, height, 37, 3), np.uint8), rng.random((2, height, 37)) < 0.8
    assert_same(host.half_rows(*given), levels.half_rows(*given))
    views = rng.integers(0, 9000, (2, height // 2, 37), np.uint16)
    assert_same(host.double_rows(views, height), levels.double_rows(views, height))


@pytest.mark.parametrize("radius", [0, 1, 4, 15, 17])
def test_masks_grown_by_discs(radius):
    masks = np.random.default_rng(radius).random((2, 45, 70)) < (0.01 if radius else 0.5)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    views = masks.view(np.uint8)
    assert_same(np.stack([cv2.dilate(v, disc) for v in views]) > 0, levels.grown(masks, disc))
    assert_same(np.stack([cv2.erode(1 - v, disc) for v in views]) > 0, levels.grown(~masks, disc, erode=True))


@pytest.mark.parametrize("share", [0, 0.001, 0.3, 1])
def test_inner_span(share):
    rng = np.random.default_rng(1)
    disparity = rng.integers(0, 3000, (3, 33, 47)).astype(np.uint16)
    disparity[0, 0, :2] = 0, 65535
    static, agree = rng.random((3, 70, 99)) < 0.995, rng.random(disparity.shape) < share
    for percentiles in ((0.3, 99.7), (0, 100), (50, 50.01, 7)):
        given = disparity, agree, static, 2, 1, percentiles
        expected, found = host.inner_span(*given), levels.inner_span(*given)
        assert (found is None) == (expected is None) == (not share)
        if share:
            assert np.array_equal(expected, found)


def test_three_channels():
    grey = np.random.default_rng(0).integers(0, 256, (2, 5, 7, 1), np.uint8)
    assert_same(host.three_channels(grey), levels.three_channels(grey))
    colour = host.three_channels(grey)
    assert levels.three_channels(colour) is colour
