"""What the presets are measured against: one function per baseline, a Scene in and a Picture out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from seepast.backends.reference import fill_unseen, median3, popcount
from seepast.evaluate import Truth
from seepast.focal import refocus_at
from seepast.geometry import ArrayGeometry

STATIC = 254 * (1 - 0.7)  # a ray is static up to this many 254ths of P(dynamic), as the presets start
TELEA_RADIUS = 5  # px
RANGE = 0.45  # of the width: the disparities searched, as the presets do
BLOCK = 5  # px, the matching window of SGBM
LEAK = 4 * BLOCK + 1  # px, twice as far as a person's disparity spills over the mask's edge


@dataclass(frozen=True, eq=False)
class Scene:
    """One instant: views K x uint8 [H, W(, 3)] and dynamic uint8 [K, H, W] in 254ths, rectified; masks as given."""

    views: list[np.ndarray]
    dynamic: np.ndarray
    geometry: ArrayGeometry
    truth: Truth
    masks: tuple[np.ndarray, ...]

    @property
    def reference(self) -> np.ndarray:
        return self.views[self.geometry.reference]

    @property
    def masked(self) -> np.ndarray:
        """bool [H, W]: reference pixels that the mask calls dynamic."""
        return self.dynamic[self.geometry.reference] > STATIC


@dataclass(frozen=True, eq=False)
class Picture:
    """What is scored: background uint8, disparity float32 px (0 unknown), coverage uint8, masks in input pixels."""

    background: np.ndarray
    disparity: np.ndarray
    coverage: np.ndarray
    masks: tuple[np.ndarray, ...]


def true_disparity(scene: Scene, median: bool = False) -> Picture:
    """The ceiling: true disparity, true labels, mean of cubic samples of all rays that see the point."""
    truth = scene.truth
    seen = [(truth.seen_by >> k & 1).astype(bool) for k in range(scene.geometry.cameras)]
    background = _refocused(scene, truth.disparity, seen, truth.hidden, median)
    return Picture(background, truth.disparity, popcount(truth.seen_by.astype(np.uint16)), scene.masks)


def telea(scene: Scene) -> Picture:
    """What one camera alone can do: inpainting of the reference image (Telea 2004)."""
    background = cv2.inpaint(scene.reference, scene.masked.astype(np.uint8), TELEA_RADIUS, cv2.INPAINT_TELEA)
    return Picture(background, np.zeros(scene.masked.shape, np.float32), _ones(scene), scene.masks)


def averaging(scene: Scene) -> Picture:
    """Plain synthetic aperture: unmasked mean of all rays at the true median disparity of what is hidden."""
    known = scene.truth.disparity[scene.truth.hidden]
    d = float(np.median(known if known.size else scene.truth.disparity))
    return Picture(
        refocus_at(scene.views, scene.geometry, d),
        np.full(scene.masked.shape, d, np.float32),
        _ones(scene),
        scene.masks,
    )


def stereo(scene: Scene) -> Picture:
    """SGBM on the reference and its neighbour, completed behind the mask from the row's background, then the
    mean of the other cameras' static rays."""
    around = cv2.dilate(scene.masked.astype(np.uint8), np.ones((LEAK, LEAK), np.uint8))
    disparity = behind_mask(pair_disparity(scene), around > 0)
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]]
    static = []
    for k in range(scene.geometry.cameras):
        at = scene.geometry.warp(k, x, y, disparity)
        p = cv2.remap(scene.dynamic[k], *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
        static.append((p <= STATIC) & (scene.masked if k != scene.geometry.reference else ~scene.masked))
    background = _refocused(scene, disparity, static, scene.masked, median=True)
    return Picture(background, disparity, np.sum(static, axis=0).astype(np.uint8), scene.masks)


def pair_disparity(scene: Scene) -> np.ndarray:
    """float32 [H, W] px over the full array, 0 unknown: SGBM with all 8 directions on the closest camera pair."""
    geometry = scene.geometry
    along = geometry.offsets[:, 0]
    other = int(np.argsort(abs(along))[1])
    sx, sy = geometry.offsets[other, 3:]
    width, height = geometry.size
    moved = cv2.warpAffine(
        scene.views[other],
        np.array([[1, 0, -sx], [0, 1, -sy]], np.float32),
        (width, height),
        borderMode=cv2.BORDER_REPLICATE,
    )
    count = 16 * int(np.ceil(RANGE * width * abs(along[other]) / 16))
    if along[other] > 0:
        return sgbm(scene.reference, moved, count) / along[other]
    # the neighbour stands on the left, but SGBM wants the left image first
    return cv2.flip(sgbm(cv2.flip(scene.reference, 1), cv2.flip(moved, 1), count), 1) / -along[other]


def sgbm(left: np.ndarray, right: np.ndarray, count: int) -> np.ndarray:
    """float32 px between the two images, 0 where none was found; `count` disparities from 0, a multiple of 16."""
    weight = left[0, 0].size * BLOCK**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=BLOCK, P1=8 * weight, P2=32 * weight, disp12MaxDiff=1,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    # SGBM leaves out the first `count` columns: let these be columns that nobody misses
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    return np.maximum(matcher.compute(*padded)[:, count:], 0).astype(np.float32) / 16


def behind_mask(disparity: np.ndarray, masked: np.ndarray) -> np.ndarray:
    """Masked and unknown pixels take the farther one of the next known disparities left and right in their row."""
    known = np.where(masked | (disparity <= 0), np.inf, disparity)
    left, right = _next_known(known), _next_known(known[:, ::-1])[:, ::-1]
    farther = np.minimum(left, right)
    return np.where(np.isfinite(known), known, np.where(np.isfinite(farther), farther, 0)).astype(np.float32)


def _next_known(values: np.ndarray) -> np.ndarray:
    """Every pixel's nearest finite value to the left, inf where there is none."""
    columns = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(columns, axis=1), axis=1)


def _refocused(
    scene: Scene, disparity: np.ndarray, rays: list[np.ndarray], where: np.ndarray, median: bool
) -> np.ndarray:
    """The reference image with, at `where`, the mean of the `rays` (K x bool [H, W]), then perhaps a 3x3 median."""
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]]
    total = np.zeros(np.atleast_3d(scene.reference).shape, np.float32)
    for view, used, k in zip(scene.views, rays, range(len(rays)), strict=True):
        at = scene.geometry.warp(k, x, y, disparity)
        value = cv2.remap(view.astype(np.float32), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        total += np.where(used[..., None], value.reshape(total.shape), 0)
    coverage = np.sum(rays, axis=0)
    mean = np.clip(np.rint(total / np.maximum(coverage, 1)[..., None]), 0, 255).astype(np.uint8)
    picture = np.where(where[..., None], mean, np.atleast_3d(scene.reference))
    picture = fill_unseen(picture, np.where(where, coverage, 1).astype(np.uint8), disparity)
    if median:
        picture = np.where(where[..., None], median3(picture), picture)
    return picture.reshape(scene.reference.shape)


def _ones(scene: Scene) -> np.ndarray:
    return np.ones(scene.masked.shape, np.uint8)


PICTURE = ("psnr", "psnr 1", "psnr 2+", "ssim")
DEPTH = ("bad1 hid", "bad1 1", "bad1 2+", "bad1 vis")

# name -> the function, and the columns that mean something for it
BASELINES: dict[str, tuple[Callable[[Scene], Picture], tuple[str, ...]]] = {
    "ceiling: true disparity": (true_disparity, PICTURE),
    "ceiling, then 3x3 median": (partial(true_disparity, median=True), PICTURE),
    "SGBM pair + masked warp": (stereo, (*PICTURE, *DEPTH, "flag", "lost")),
    "Telea inpainting": (telea, PICTURE),
    "plain averaging": (averaging, PICTURE),
}
