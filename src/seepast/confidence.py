"""How sure is a disparity? P(|error| <= 1 px over the array) of every pixel, from what a method has at its end.

Two things tell right disparities from wrong ones: how closely other views confirm them, and how flat they are around
the pixel. Both are counted into one byte per pixel, the evidence, and a table of 256 probabilities says what share of
such pixels was right where the truth is known:

    evidence = 128 own + 32 close + 8 loose + flatness        logit P = support[own][close][loose] + flat[flatness]

own       1 where the view itself sees the pixel, no person in front
close     other views that confirm the disparity to 1/4 px (paper: static rays of other cameras), counted to 3
loose     other views that confirm it less closely (paper: 0), counted to 3
flatness  7 where disparities within 4 px of the pixel are equal, less the more they differ (STEPS)

Where no camera sees the pixel (coverage 0) nothing was measured: what stands there is a guess, of confidence 0.

The numbers are fitted by `benchmarks/calibration.py --fit`, which also says how right they are on scenes that they were
not fitted on (benchmarks/RESULTS.md). P never falls with another view that agrees, nor with flatness. Texture was tried
and left out: what it says about synthetic scenes is wrong for real ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from .many import UNITS
from .options import Options

CLOSE = UNITS // 4  # 32nds of a pixel: views that differ by no more confirm closely
REACH = 9  # px, side of the square in which disparities are compared
# in 32nds of a pixel: what the range of disparities in the square must not exceed for flatness 7, 6, .. 1
STEPS = (7, 15, 23, 31, 47, 63, 127)


@dataclass(frozen=True)
class Calibration:
    """Log-odds that a disparity is right: support[own][close][loose] (2 x 4 x 4) plus flat[flatness] (8)."""

    support: tuple[tuple[tuple[float, ...], ...], ...]
    flat: tuple[float, ...]

    @cached_property
    def table(self) -> np.ndarray:
        """float32 [256], P of every evidence byte; 0 where no camera sees the pixel."""
        odds = np.asarray(self.support, np.float64)[..., None] + np.asarray(self.flat, np.float64)
        p = 1 / (1 + np.exp(-odds))
        p[0, 0, 0] = 0
        return p.astype(np.float32).ravel()


def of_views(d: np.ndarray, static: np.ndarray, close: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Evidence of the many-view method: uint8 [H, W].

    d       uint16 [H, W], the wanted view's final disparity in 32nds of a pixel over the array
    static  bool [H, W]: nobody in front, in the wanted view
    close   uint8 [H, W], the other views that confirm it within CLOSE (`labels`)
    shown   uint16 [H, W], which rays show the surface (`labels`): bit k = ray k
    """
    own = static.view(np.uint8)
    return packed(own, close, cv2.subtract(ray_count(shown), cv2.add(own, close)), d)


def of_labels(disparity: np.ndarray, labels: np.ndarray, reference: int) -> np.ndarray:
    """Evidence of the paper's method: uint8 [H, W].

    disparity  float32 [H, W] px over the array, 0 (or less) = unknown
    labels     uint16 [H, W], which rays are static: bit k = ray k
    """
    own = (labels >> np.uint16(reference)).astype(np.uint8) & np.uint8(1)
    others = cv2.subtract(ray_count(labels), own)
    d = (np.maximum(disparity, 0) * np.float32(UNITS)).astype(np.uint16)  # whole: the paper's are eighths
    return packed(own, others, np.zeros_like(own), d)


def packed(own: np.ndarray, close: np.ndarray, loose: np.ndarray, d: np.ndarray) -> np.ndarray:
    """One byte of evidence per pixel from uint8 [H, W] counts and the disparity uint16 [H, W] in 32nds."""
    spread = cv2.morphologyEx(d, cv2.MORPH_GRADIENT, np.ones((REACH, REACH), np.uint8))
    flat = cv2.LUT(np.minimum(spread, 255).astype(np.uint8), _FLATNESS)
    counts = cv2.addWeighted(np.minimum(close, 3), 32, np.minimum(loose, 3), 8, 0)
    return cv2.addWeighted(own, 128, counts, 1, 0) + flat


def ray_count(labels: np.ndarray) -> np.ndarray:
    """Number of rays of every label set: uint8, same shape."""
    low, high = (cv2.LUT((labels >> shift).astype(np.uint8), _BITS) for shift in (np.uint16(0), np.uint16(8)))
    return low + high


def probability(evidence: np.ndarray, calibration: Calibration) -> np.ndarray:
    """P(|disparity error| <= 1 px over the array), float32 [H, W] in 0 .. 1, of `of_views` or `of_labels`."""
    return cv2.LUT(evidence, calibration.table)


_BITS = np.array([bin(i).count("1") for i in range(256)], np.uint8)
_FLATNESS = (7 - np.digitize(np.arange(256), STEPS, right=True)).astype(np.uint8)


# Fitted by benchmarks/calibration.py on the recordings that it names.
VIEWS = Calibration(
    support=(
        (
            (-0.88, -0.32, -0.30, 0.08),
            (-0.61, -0.06, -0.03, 0.34),
            (1.17, 1.72, 1.75, 2.12),
            (1.73, 2.29, 2.32, 2.69),
        ),
        (
            (-0.80, -0.80, -0.80, -0.80),
            (-0.12, -0.12, -0.12, -0.12),
            (0.46, 0.46, 0.46, 0.46),
            (1.62, 1.62, 1.62, 1.62),
        ),
    ),
    flat=(0.0, 0.67, 0.67, 0.80, 1.39, 1.85, 2.46, 2.98),
)
# of views that are coarse but for what is hidden (multiview.fine_views off)
COARSE_VIEWS = Calibration(
    support=(
        (
            (-1.16, -0.78, -0.22, 0.11),
            (-0.45, -0.07, 0.49, 0.82),
            (0.80, 1.18, 1.74, 2.07),
            (1.43, 1.81, 2.37, 2.69),
        ),
        (
            (-0.57, -0.01, 0.21, 0.80),
            (0.08, 0.64, 0.86, 1.44),
            (0.75, 1.31, 1.53, 2.11),
            (1.58, 2.14, 2.37, 2.95),
        ),
    ),
    flat=(0.0, 1.03, 1.48, 1.96, 2.79, 3.40, 3.47, 3.47),
)
PAPER = Calibration(
    support=(
        ((-2.04,) * 4, (-2.04,) * 4, (-0.45,) * 4, (0.14,) * 4),
        ((-1.68,) * 4, (-0.24,) * 4, (0.09,) * 4, (0.09,) * 4),
    ),
    flat=(0.0, 0.88, 1.13, 1.32, 1.32, 1.32, 1.32, 1.32),
)


def calibration(options: Options) -> Calibration:
    """That of the method which the options ask for."""
    if not options.multiview.enabled:
        return PAPER
    return VIEWS if options.multiview.fine_views else COARSE_VIEWS
