"""Sampling of images and masks: the core's and OpenCV's, which specifies it, give the same bits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from seepast import sampling
from seepast.backends import core
from seepast.pixel_maps import fixed_point

ROWS = slice(3, 40)
SIZES = ((37, 150), (2, 2), (2, 200), (64, 3))  # height, width

pytestmark = pytest.mark.skipif(core() is None, reason="the core was not built")


def places(size: tuple[int, int], shape: tuple[int, int], seed: int) -> sampling.FixedPoint:
    """Everywhere on the image, on its edges and beyond them, whole pixels among them."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-3, n + 2, shape) for n in size[::-1])
    whole = rng.random(shape) < 0.2
    x, y = np.where(whole, np.rint(x), x), np.where(whole, np.rint(y), y)
    return fixed_point(np.stack([x, y]).astype(np.float32), size[::-1])


def as_opencv(image: np.ndarray, at: sampling.FixedPoint, rows: slice) -> np.ndarray:
    return cv2.remap(image, at[0][rows], at[1][rows], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [(), (3,)])
def test_the_same_as_opencv(size, channels):
    image = np.random.default_rng(1).integers(0, 256, (*size, *channels), np.uint8)
    at = places(size, (50, 333), 2)
    out = np.full((50, 333, *channels), 7, np.uint8)
    assert sampling.sampled(image, at, "linear", ROWS, out[ROWS]).base is out
    np.testing.assert_array_equal(out[ROWS], as_opencv(image, at, ROWS))
    assert (out[:3] == 7).all() and (out[40:] == 7).all()
    np.testing.assert_array_equal(sampling.sampled(image, at, "linear", slice(None)), as_opencv(image, at, slice(None)))


@pytest.mark.parametrize("share", [0.0, 0.001, 1.0])
def test_the_mask_that_is_sampled_with_the_image_is_the_same(share):
    rng = np.random.default_rng(3)
    image, at = rng.integers(0, 256, (37, 150, 3), np.uint8), places((37, 150), (50, 333), 4)
    mask = np.where(rng.random((37, 150)) < share, rng.integers(1, 256, (37, 150)), 0).astype(np.uint8)
    colour, dynamic = np.full((50, 333, 3), 7, np.uint8), np.full((50, 333), 7, np.uint8)
    sampling.sampled_together(image, mask, at, ROWS, colour[ROWS], dynamic[ROWS])
    np.testing.assert_array_equal(colour[ROWS], as_opencv(image, at, ROWS))
    np.testing.assert_array_equal(dynamic[ROWS], as_opencv(mask, at, ROWS))
    for out in (colour, dynamic):
        assert (out[:3] == 7).all() and (out[40:] == 7).all()


def test_every_fraction_and_difference_is_rounded_alike():
    """All pairs of steps between pixels, and all 32 x 32 places between them."""
    at = np.zeros((1, 1024, 2), np.int16), np.arange(1024, dtype=np.uint16)[None]
    rng = np.random.default_rng(5)
    for corners in [*rng.integers(0, 256, (200, 2, 2), np.uint8), *rng.choice([0, 255], (16, 2, 2)).astype(np.uint8)]:
        np.testing.assert_array_equal(
            sampling.sampled(corners, at, "linear", slice(None)), as_opencv(corners, at, slice(None))
        )


def test_opencv_takes_what_the_core_does_not(monkeypatch):
    rng = np.random.default_rng(6)
    thin, at = rng.integers(0, 256, (1, 40), np.uint8), places((1, 40), (20, 30), 7)
    np.testing.assert_array_equal(sampling.sampled(thin, at, "linear", ROWS), as_opencv(thin, at, ROWS))
    image, mask, at = (
        rng.integers(0, 256, (30, 40, 3), np.uint8),
        rng.integers(0, 256, (30, 40), np.uint8),
        places((30, 40), (50, 60), 8),
    )
    monkeypatch.setattr(sampling, "core", lambda: None)
    colour, dynamic = np.empty((37, 60, 3), np.uint8), np.empty((37, 60), np.uint8)
    sampling.sampled_together(image, mask, at, ROWS, colour, dynamic)
    np.testing.assert_array_equal(colour, as_opencv(image, at, ROWS))
    np.testing.assert_array_equal(dynamic, as_opencv(mask, at, ROWS))
