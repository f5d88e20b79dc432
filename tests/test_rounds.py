"""EM rounds that only redo what changed give the very result of rounds that redo everything."""

from types import SimpleNamespace

import numpy as np
import pytest

from seepast import pipeline
from seepast.backends import cpu, reference
from seepast.frames import Frame
from seepast.geometry import ArrayGeometry
from seepast.options import Options


def noisy_frame(seed: int, cameras: int = 4, height: int = 47, width: int = 97) -> tuple[Frame, ArrayGeometry]:
    """Textured views of a plane at 20 px, with blotchy, contradictory masks: labels move in every round."""
    rng = np.random.default_rng(seed)
    positions = np.zeros((cameras, 3))
    positions[:, 0] = 0.1 * np.arange(cameras)
    positions[1:, 1:] = rng.normal(0, 0.002, (cameras - 1, 2))
    geometry = ArrayGeometry((300.0, 300.0), (width / 2, height / 2), (width, height), positions)
    texture = rng.integers(0, 255, (height, width + 80), np.uint8)
    grey = np.stack([texture[:, 40 + round(20 * a) :][:, :width] for a in geometry.offsets[:, 0]])
    grey = (grey // 2 + rng.integers(0, 100, grey.shape)).astype(np.uint8)
    blotches = np.kron(rng.integers(0, 255, (cameras, height // 6 + 1, width // 6 + 1)), np.ones((1, 6, 6)))
    dynamic = blotches[:, :height, :width].astype(np.uint8) // 2 + rng.integers(0, 60, grey.shape).astype(np.uint8)
    return Frame(grey[..., None].copy(), grey, dynamic), geometry


@pytest.mark.parametrize("dynamic_only", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_redoing_only_what_changed_equals_full_rounds(seed, dynamic_only):
    frame, geometry = noisy_frame(seed)
    options = Options.preset("paper").updated(
        {"range.max_disparity": 40, "segmentation.max_rounds": 4, "segmentation.beta": 0.01}
    )
    everything = SimpleNamespace(**vars(cpu))
    everything.affected = lambda changed, geometry, prior, grid, wanted, options: wanted.copy()
    fast, rounds = pipeline.see_past(frame, geometry, options, cpu, dynamic_only, pipeline.Clock())
    full, full_rounds = pipeline.see_past(frame, geometry, options, everything, dynamic_only, pipeline.Clock())
    assert rounds == full_rounds >= 3  # labels did move
    for name in full:
        np.testing.assert_array_equal(fast[name], full[name], err_msg=name)


@pytest.mark.parametrize("seed", range(3))
def test_affected_pixels_agree_with_the_reference(seed):
    frame, geometry = noisy_frame(seed)
    options = Options.preset("paper").updated({"range.max_disparity": 40, "support.texture": 5})
    rng = np.random.default_rng(seed)
    changed = rng.random(frame.dynamic.shape) < 0.002
    wanted = rng.random(changed.shape[1:]) < 0.8
    grid = pipeline.DisparityGrid.of(options.range, geometry.size[0])
    features = reference.describe(frame.grey)
    points = reference.support(features, frame.dynamic <= 76, geometry, grid, options.support)
    prior = reference.prior(points, wanted.shape, grid, options.prior)
    found = cpu.affected(changed, geometry, prior, grid, wanted, options)
    np.testing.assert_array_equal(found, reference.affected(changed, geometry, prior, grid, wanted, options))
    assert 0 < found.sum() < wanted.sum()
    assert not cpu.affected(np.zeros_like(changed), geometry, prior, grid, wanted, options).any()


def test_support_near_what_is_wanted_is_the_whole_support_cut_to_it():
    height, width = 47, 261
    _, geometry = noisy_frame(1, width=width)
    texture = np.random.default_rng(1).integers(0, 255, (height, width + 80), np.uint8)
    grey = np.stack([texture[:, 40 + round(20 * a) :][:, :width] for a in geometry.offsets[:, 0]])
    options = Options.preset("paper").updated({"range.max_disparity": 40, "support.min_agreeing": 0})
    wanted = np.zeros((height, width), bool)
    wanted[20:24, 40:44] = True
    near, static = cpu.neighbourhood(wanted), np.ones(grey.shape, bool)
    assert near[:, : 44 + 64].all() and not near[:, 44 + 64 :].any()
    grid = pipeline.DisparityGrid.of(options.range, width)
    found = [
        backend.support(backend.describe(grey), static, geometry, grid, options.support, near)
        for backend in (cpu, reference)
    ]
    np.testing.assert_array_equal(*found)
    whole = cpu.support(cpu.describe(grey), static, geometry, grid, options.support)
    cut = near[whole[:, 1].astype(int), whole[:, 0].astype(int)]
    assert 0 < cut.sum() < len(whole)
    np.testing.assert_array_equal(found[0], whole[cut])
