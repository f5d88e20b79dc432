"""Cameras of other exposures: their gains are found, made up for, and nothing is done where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arrays import Scene, make_scene
from cuda_on_cpu import EmulatedDevice
from seepast import balance, multiview
from seepast.backends import cpu_multiview, cuda_levels, host
from seepast.frames import Frame
from seepast.gpu import device
from seepast.levels import Pictures
from seepast.options import Options
from seepast.pipeline import Clock
from seepast.surfaces import Surfaces, looks, surfaces

OPTIONS = Options.preset("accurate").updated({"range.max_disparity": 60})
GAINS = np.array([[0.8, 1, 1.2], [1, 1, 1], [1.1, 0.9, 0.95], [1, 1.003, 1], [0.7, 0.7, 0.7]])


def exposed(scene: Scene, gains: np.ndarray) -> Scene:
    """The same scene by cameras with these gains of B, G, R; less contrast, so that none is overexposed."""
    views = (60 + scene.views * 0.5) / gains[:, None, None]
    still = np.rint(60 + scene.background * 0.5).astype(np.uint8)
    return replace(scene, views=np.rint(views).clip(0, 255).astype(np.uint8), background=still)


def seen_in(scene: Scene) -> Surfaces:
    pictures = Pictures(cpu_multiview.three_channels(scene.colour), scene.dynamic <= 127, scene.geometry, cpu_multiview)
    return surfaces(pictures, scene.geometry, looks(scene.geometry, OPTIONS)[-1], OPTIONS, cpu_multiview)


def background_of(scene: Scene, least: float) -> np.ndarray:
    frame, options = Frame(scene.colour, scene.grey, scene.dynamic), OPTIONS.updated({"multiview.balance": least})
    return multiview.see_past(frame, scene.geometry, options, cpu_multiview, False, Clock())[0]["background"]


def test_gains_are_found() -> None:
    scene = exposed(make_scene(5, (180, 120), reference=1, colour=True, noise=2), GAINS)
    assert np.abs(balance.brightness(seen_in(scene)) - GAINS).max() < 0.01


def test_pictures_are_as_good_as_of_equal_cameras() -> None:
    scenes = [exposed(make_scene(5, (180, 120), reference=1, colour=True), gains) for gains in (GAINS, GAINS * 0 + 1)]
    hidden = scenes[0].person[1] & (scenes[0].seen_by() > 0)
    wrong = [
        np.abs(background_of(scene, least).astype(int) - scene.background)[hidden].mean()
        for scene, least in ((scenes[0], 0.01), (scenes[1], 0.01), (scenes[0], 10.0))
    ]
    assert wrong[1] <= wrong[0] < 0.5 and wrong[2] > 5


def test_equal_cameras_are_left_alone() -> None:
    scene = make_scene(5, (180, 120), colour=True, noise=2)
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    assert balance.balanced(frame, seen_in(scene), 0.01, cpu_multiview) is frame


def test_a_camera_that_shows_too_little_is_left_alone() -> None:
    dark, grey = np.full((1000, 3), 5, np.uint8), np.full((1000, 3), 100, np.uint8)
    for wanted, other in ((grey, dark), (grey[:9], 2 * grey[:9]), (grey[:0], grey[:0])):
        assert (balance.ratios(wanted, other) == 1).all()
    tinted = grey // np.array([2, 1, 25], np.uint8)
    assert np.array_equal(balance.ratios(grey, tinted), [2, 1, 1])
    seen = seen_in(make_scene(3, (90, 60), masks="none"))
    blind = replace(seen, agree=np.zeros_like(seen.agree))
    assert (balance.brightness(blind) == 1).all()


@pytest.mark.parametrize("channels", [1, 3])
def test_backends_map_alike(channels: int) -> None:
    rng = np.random.default_rng(channels)
    colour = rng.integers(0, 256, (3, 35, 61, channels), np.uint8)
    tables = rng.integers(0, 256, (3, channels, 256), np.uint8)
    expected = np.stack([np.stack([tables[k, c][colour[k, ..., c]] for c in range(channels)], -1) for k in range(3)])
    assert np.array_equal(host.mapped(colour, tables), expected)
    assert np.array_equal(cpu_multiview.mapped(colour, tables), expected)
    with device.use(EmulatedDevice()):
        assert np.array_equal(cuda_levels.mapped(colour, tables), expected)
