"""Epipolar-plane images: one row of all cameras, stacked by where the cameras stand (Bolles, Baker, Marimont 1987).

A point at disparity d moves along a straight line: by -d px from the reference to a camera B away from it, whatever
the cameras' spacing. Static points thus draw lines whose slope is their disparity, nearer ones cut across
farther ones, and a person is a band that hides other lines in some cameras and not in others: those who see past.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from .backends.reference import bilinear, inside, neighbours, quarter_positions, ray_offsets
from .errors import OptionsError
from .focal import DYNAMIC
from .geometry import ArrayGeometry
from .rectify import NO_RAY

Fill = Literal["nearest", "linear"]

ROW_HEIGHT = 40  # px of the picture per camera unless a height is given
STRIP = 90  # px of the reference view shown around the row
LEGEND = 52  # px for the names of the cameras
STRIPE = 6  # px between stripes over dynamic rays
INK, PAPER, UNSEEN = (40, 40, 40), (255, 255, 255), (120, 120, 120)  # BGR
STRUCK, MARK = (50, 50, 230), (0, 200, 240)


@dataclass(frozen=True, eq=False)
class EpipolarImage:
    """The rays of one row of the reference view, camera by camera along the line.

    colours  uint8 [K, W, C]; dynamic: bool [K, W], what the masks strike out; seen: bool [K, W], inside the view
    places   float64[K], ascending: camera positions along the line in units of B, the reference at 0
    cameras  their indices
    """

    colours: np.ndarray
    dynamic: np.ndarray
    seen: np.ndarray
    places: np.ndarray
    cameras: tuple[int, ...]


def epipolar_image(
    views: Sequence[np.ndarray],
    geometry: ArrayGeometry,
    row: int,
    dynamic: np.ndarray | None = None,
    shear: float = 0.0,
) -> EpipolarImage:
    """The epipolar-plane image of reference row `row`.

    views    K rectified views, uint8 [H, W] or [H, W, 3]
    dynamic  uint8 [K, H, W], Rectification.dynamic; None: nothing is
    shear    px over the full array: points of that disparity stand vertical; 0: infinitely far ones do

    Camera k's line holds its colours at W_k(x, shear), bilinearly, for every reference column x; so offsets of a camera
    off the array's line are carried for the sheared disparity, and a point at d stands at x - (d - shear) place.
    Raises OptionsError for a row outside the view, or a shear that is none.
    """
    width, height = geometry.size
    if not 0 <= row < height:
        raise OptionsError(f"--row {row}: the rectified view has rows 0 .. {height - 1}")
    if not (math.isfinite(shear) and shear >= 0):
        raise OptionsError(f"--shear {shear:g}: give a disparity in px over the full array, 0 or more")
    x = np.arange(width)[None]
    y, d = np.full_like(x, row), np.full(x.shape, np.float32(shear))
    places = geometry.positions[:, 0] / geometry.baseline
    order = [int(k) for k in np.argsort(places)]
    colours, struck, seen = [], [], []
    for k in order:
        value = bilinear(np.atleast_3d(views[k]), x, y, *ray_offsets(geometry, k, x, y, d))
        colours.append(np.floor(value + np.float32(0.5)).astype(np.uint8)[0])
        xq, at = quarter_positions(geometry, k, x, y, d)
        inner = inside(xq, at, (height, width))[0]
        p = np.zeros((2, width), np.uint8)
        if dynamic is not None:
            at, *both = neighbours(xq, at, (height, width))
            p = np.concatenate([dynamic[k, at, column] for column in both])
        seen.append(inner & (p != NO_RAY).all(axis=0))
        struck.append(seen[-1] & (p >= DYNAMIC).any(axis=0))
    return EpipolarImage(np.stack(colours), np.stack(struck), np.stack(seen), places[order], tuple(order))


def spread(epi: EpipolarImage, height: int, fill: Fill = "nearest") -> np.ndarray:
    """The picture: uint8 [height, W, 3] BGR, the first camera in the first line, the last in the last.

    Lines in between lie where a camera at that place would be. fill "nearest": they repeat the nearest camera, so that
    every colour is one that was seen, and lines look like stairs; "linear": they mix the two cameras around, which
    is smooth and right only for points that move less than a pixel between them. Dynamic rays are striped in red,
    of the nearest camera in either case; what lies outside a view is grey.
    """
    at = np.linspace(epi.places[0], epi.places[-1], height)
    nearest = abs(at[:, None] - epi.places[None]).argmin(axis=1)
    colours = np.broadcast_to(epi.colours, (*epi.colours.shape[:2], 3))
    if fill == "linear":
        after = np.clip(np.searchsorted(epi.places, at), 1, len(epi.places) - 1)
        weight = (at - epi.places[after - 1]) / (epi.places[after] - epi.places[after - 1])
        weight = weight[:, None, None].astype(np.float32)
        picture = np.rint(colours[after - 1] * (1 - weight) + colours[after] * weight).astype(np.uint8)
    else:
        picture = colours[nearest].copy()
    picture[~epi.seen[nearest]] = UNSEEN
    y, x = np.mgrid[:height, : picture.shape[1]]
    stripes = epi.dynamic[nearest] & ((x + y) % STRIPE < STRIPE // 2)
    picture[stripes] = STRUCK
    return picture


def draw(
    epi: EpipolarImage, reference: np.ndarray, row: int, names: Sequence[str], height: int, fill: Fill = "nearest"
) -> np.ndarray:
    """uint8 [*, LEGEND + W, 3]: the reference around the marked row, and below it, column for column, `spread`.

    reference  uint8 [H, W] or [H, W, 3], the rectified reference view; names: of all cameras
    """
    top = int(np.clip(row - STRIP // 2, 0, max(0, reference.shape[0] - STRIP)))
    strip = reference[top : top + STRIP]
    strip = cv2.cvtColor(strip, cv2.COLOR_GRAY2BGR) if strip.ndim == 2 else strip.copy()
    cv2.line(strip, (0, row - top), (strip.shape[1], row - top), MARK, 1)
    body = spread(epi, height, fill)
    legend = np.full((height, LEGEND, 3), PAPER, np.uint8)
    for place, k in zip(epi.places, epi.cameras, strict=True):
        at = (place - epi.places[0]) / (epi.places[-1] - epi.places[0]) * (height - 1)
        _write(legend, names[k], int(np.clip(at + 4, 11, height - 3)))
        cv2.line(legend, (LEGEND - 5, round(at)), (LEGEND, round(at)), INK, 1)
    beside = np.full((len(strip), LEGEND, 3), PAPER, np.uint8)
    _write(beside, f"y {row}", int(np.clip(row - top + 4, 11, len(strip) - 3)))
    gap = np.full((6, LEGEND + strip.shape[1], 3), PAPER, np.uint8)
    return np.vstack([np.hstack([beside, strip]), gap, np.hstack([legend, body])])


def _write(image: np.ndarray, text: str, baseline: int) -> None:
    cv2.putText(image, text, (2, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.38, INK, 1, cv2.LINE_AA)
