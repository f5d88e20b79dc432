"""Coarse to fine: levels of the array, and what a coarser one tells the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arrays import SPACING, make_scene
from seepast import Options, Rig, multiview, reconstruct
from seepast.backends import cpu_multiview as cpu
from seepast.backends import reference_multiview as reference
from seepast.candidates import CHUNK, DisparityGrid
from seepast.frames import Frame
from seepast.levels import MOST_CHUNKS, Level, Pictures, Views, level_grid, of_half_rows, reduced, scales
from seepast.many import UNITS
from seepast.options import MultiviewOptions
from seepast.pipeline import Clock

SCENE = make_scene(4, (75, 33), reference=1, residual=True, masks="soft", colour=True)


def test_level_averages_colours_and_is_static_where_all_its_pixels_are():
    static = SCENE.dynamic <= 127
    level = Level.of(SCENE.colour, static, SCENE.geometry, 2, cpu)
    assert level.colour.shape == (4, 16, 37, 3) and level.static.shape == (4, 16, 37)
    block = SCENE.colour[2, 6:8, 10:12].astype(int).sum((0, 1)) / 4
    assert np.abs(level.colour[2, 3, 5] - block).max() <= 0.5
    assert np.array_equal(level.static, static[:, :32, :74].reshape(4, 16, 2, 37, 2).all((2, 4)))
    assert level.static.any() and not level.static.all()


def test_full_size_level_is_the_views_themselves():
    static = SCENE.dynamic <= 127
    level = Level.of(SCENE.colour, static, SCENE.geometry, 1, cpu)
    assert level.colour is SCENE.colour and level.static is static and level.geometry is SCENE.geometry


@pytest.mark.parametrize("scale", (2, 4))
def test_reduced_array_warps_the_same_points(scale):
    small = reduced(SCENE.geometry, scale)
    x, y, d = np.array([20.0, 50.5]), np.array([11.0, 25.0]), np.array([8.0, 3.0])
    for k in range(4):
        there = np.array(SCENE.geometry.warp(k, x, y, d))
        low = np.array(small.warp(k, *((v - (scale - 1) / 2) / scale for v in (x, y)), d / scale))
        assert np.allclose(low * scale + (scale - 1) / 2, there, atol=1e-4)


def test_array_of_half_rows_warps_the_same_points():
    small = of_half_rows(SCENE.geometry)
    x, y, d = np.array([20.0, 50.5]), np.array([11.0, 25.0]), np.array([8.0, 3.0])
    for k in range(4):
        u, v = SCENE.geometry.warp(k, x, y, d)
        low_u, low_v = small.warp(k, x, (y - 0.5) / 2, d)
        assert np.allclose(low_u, u, atol=1e-4) and np.allclose(2 * low_v + 0.5, v, atol=1e-4)


def test_scales_halve_down_to_full_size_and_never_get_too_narrow():
    wide = replace(SCENE.geometry, size=(720, 540))
    assert scales(wide, MultiviewOptions(coarsest=4)) == [4, 2, 1]
    assert scales(wide, MultiviewOptions(coarsest=4, finer=4)) == [4, 1]
    assert scales(wide, MultiviewOptions(coarsest=16, finer=3)) == [9, 3, 1]
    assert scales(wide, MultiviewOptions(coarsest=3)) == [2, 1]
    assert scales(wide, MultiviewOptions(coarsest=1)) == [1]
    assert scales(replace(wide, size=(130, 90)), MultiviewOptions(coarsest=16)) == [2, 1]
    assert scales(replace(wide, size=(1, 9)), MultiviewOptions(coarsest=16)) == [1]


@pytest.mark.parametrize(
    ("span", "scale", "step"), (((3.0, 40.0), 1, 0.5), ((0.0, 63.2), 2, 0.5), ((7.0, 7.5), 4, 1.0))
)
def test_grid_of_a_level_holds_the_span_in_whole_chunks(span, scale, step):
    grid = level_grid(span, scale, step)
    assert grid.count % CHUNK == 0 and grid.step == 8 * step
    assert grid.values[0] * scale <= span[0] and grid.values[-1] * scale >= span[1]
    assert span[0] - grid.values[0] * scale <= scale / 8


def test_grid_of_a_huge_span_still_fits_the_masks():
    grid = level_grid((0.0, 4000.0), 1, 0.125)
    assert grid.count <= MOST_CHUNKS * CHUNK and grid.values[-1] >= 4000


def test_enlarged_repeats_pixels_and_continues_edges():
    views = np.arange(6, dtype=np.uint16).reshape(1, 2, 3)
    assert np.array_equal(cpu.enlarged(views, 2, (5, 7))[0, :, 4:], [[2, 2, 2]] * 2 + [[5, 5, 5]] * 3)
    assert cpu.enlarged(views, 1, (2, 3)) is views


def test_pictures_are_reduced_once():
    colour, static = cpu.three_channels(SCENE.colour), SCENE.dynamic <= 127
    pictures = Pictures(colour, static, SCENE.geometry, cpu)
    halved = cpu.half_rows(colour, static)
    for half_rows, geometry, given in (
        (False, SCENE.geometry, (colour, static)),
        (True, of_half_rows(SCENE.geometry), halved),
    ):
        level, expected = pictures.level(2, half_rows), Level.of(*given, geometry, 2, cpu)
        assert np.array_equal(level.colour, expected.colour) and np.array_equal(level.static, expected.static)
        assert level.geometry.size == expected.geometry.size
        assert pictures.level(2, half_rows) is level


def test_views_at_a_finer_level_keep_their_depth():
    static = SCENE.dynamic <= 127
    levels = [Level.of(SCENE.colour, static, SCENE.geometry, scale, cpu) for scale in (2, 1)]
    shape = levels[0].static.shape
    coarse = Views(levels[0], np.full(shape, 5 * UNITS, np.uint16), np.full(shape, 20, np.uint8))
    assert np.array_equal(coarse.at(levels[1], cpu), np.full(static.shape, 10 * UNITS))


@pytest.mark.parametrize("seed", range(40))
def test_windows_of_cpu_and_reference_are_the_same(seed):
    rng = np.random.default_rng(seed)
    ratio = int(rng.choice([1, 2, 4]))
    h, w = rng.integers(1, 30, 2)
    shape = tuple(int(n * ratio + rng.integers(0, ratio)) for n in (h, w))
    grid = DisparityGrid(
        int(rng.integers(0, 99)), int(rng.integers(1, 9)), CHUNK * int(rng.integers(1, MOST_CHUNKS + 1))
    )
    disparity = rng.integers(0, 65535 if seed % 2 else 3000, (h, w)).astype(np.uint16)
    where = rng.random((h, w)) < 0.7
    arguments = disparity, where, ratio, grid, int(rng.integers(1, 300)), int(rng.integers(0, 6)), shape
    found, expected = cpu.windows(*arguments), reference.windows(*arguments)
    assert np.array_equal(found.active, expected.active) and np.array_equal(found.start, expected.start)
    assert np.array_equal(found.active > 0, cpu.enlarged(where[None], ratio, shape)[0])
    within = rng.random(shape) < 0.7
    kept, expected = cpu.windows(*arguments, within), reference.windows(*arguments, within)
    assert np.array_equal(kept.active, expected.active) and np.array_equal(kept.start, expected.start)
    assert np.array_equal(kept.active, np.where(within, found.active, 0))


def test_windows_are_limited_in_all_views_but_one():
    rng = np.random.default_rng(0)
    disparity, where = rng.integers(0, 900, (3, 7, 9), np.uint16), np.ones((3, 7, 9), bool)
    given = disparity, where, 2, DisparityGrid(0, 4, 4 * CHUNK), 2 * UNITS, 1, (14, 18), rng.random((3, 14, 18)) < 0.5
    for whole in (-1, 1):
        both = cpu.windows_of_views(*given, whole), reference.windows_of_views(*given, whole)
        for found, expected in zip(*both, strict=True):
            assert np.array_equal(found.active, expected.active) and np.array_equal(found.start, expected.start)
    assert not (found.active > 0).all() and (cpu.windows_of_views(*given, 1)[1].active > 0).all()


def test_windows_hold_what_the_coarser_level_found():
    grid = DisparityGrid(0, 4, 20 * CHUNK)
    disparity = np.full((8, 8), 12 * UNITS, np.uint16)
    disparity[:, 5:] = 60 * UNITS
    active = cpu.windows(disparity, disparity > 0, 2, grid, 4 * UNITS, 1, (16, 16))
    values = [grid.values[pixel] for pixel in active.mask[3]]
    assert all(v.min() <= 20 and v.max() >= 28 for v in values[:10]), "24 px and 4 px either way"
    assert all(v.max() < 100 for v in values[:8]) and all(v.max() >= 124 for v in values[8:]), "one coarse pixel across"


def test_too_many_candidates_are_refused():
    with pytest.raises(ValueError, match="candidates"):
        cpu.windows(
            np.zeros((2, 2), np.uint16), np.ones((2, 2), bool), 1, DisparityGrid(0, 4, 65 * CHUNK), 32, 1, (2, 2)
        )


@pytest.mark.parametrize("coarsest", (1, 2, 4))
@pytest.mark.parametrize("fine_views", (True, False))
def test_levels_find_the_surface(coarsest, fine_views):
    scene = make_scene(5, (300, 60), surface="step", noise=2, colour=True)
    changes = {"multiview.coarsest": coarsest, "multiview.fine_views": fine_views, "people.enabled": False}
    options = Options.preset("accurate").updated({"range.max_disparity": 60, **changes})
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    found, _ = multiview.see_past(frame, scene.geometry, options, cpu, False, Clock())
    bad = np.abs(found["disparity"] - scene.disparity)[:, 20:-20] > 1
    assert bad.mean() < 0.1


@pytest.mark.parametrize("preset", ["fast", "accurate"])
def test_a_few_rows_are_enough(preset):
    """As narrow a strip as one likes: no level is reduced until nothing is left."""
    for rows in (1, 3):
        scene = make_scene(3, (300, rows), surface="plane", colour=True)
        rig = Rig.linear(3, focal=scene.geometry.focal[0], spacing=SPACING, size=scene.geometry.size)
        result = reconstruct(list(scene.views), None, rig, options=Options.preset(preset))
        assert result.disparity.shape == (rows, 300)
