"""Stage "balance": cameras that are brighter or darker than the wanted one, or tinted, are matched to it.

Exposures differ by some per cent even where nobody meant them to, and every step of a picture that is made of several
cameras shows. The surfaces that views agree on (surfaces.py) are compared pixel by pixel: per camera and channel, the
gain is the median of the ratios. What the wanted camera shows itself stays as it is. (`seepast check`, which has no
surfaces, measures gains from sparse matches: checks/images.py.)
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np

from . import backends
from .frames import Frame
from .many import UNITS
from .surfaces import Surfaces

SAMPLE = 4  # every so many-th pixel of the look says enough
DARK, BRIGHT = 20, 235  # grey levels whose ratio can be trusted
FEWEST = 64  # ratios that make a median
MOST = 4.0  # times brighter, or darker: what differs by more is no exposure


def balanced(frame: Frame, seen: Surfaces, least: float, backend: ModuleType) -> Frame:
    """The frame with the cameras matched whose gains differ by more than `least` from 1; the same one if none does."""
    gains = brightness(seen)
    off = np.abs(gains - 1).max(1) > least
    if not off.any():
        return frame
    channels = frame.colour.shape[-1]
    levels = np.arange(256) * np.where(off[:, None], gains, 1)[:, :channels, None]
    return replace(frame, colour=backend.mapped(frame.colour, np.rint(levels).clip(0, 255).astype(np.uint8)))


def brightness(seen: Surfaces) -> np.ndarray:
    """What makes every camera's B, G, R as bright as the wanted one's: float64 [K, 3], 1 where too little is seen."""
    geometry = seen.level.geometry
    r, (width, height) = geometry.reference, geometry.size
    colour, found, agree = (backends.on_host(v) for v in (seen.level.colour, seen.disparity[r], seen.agree[r]))
    y, x = SAMPLE * np.array(np.nonzero(agree[::SAMPLE, ::SAMPLE]))
    d, own = found[y, x].astype(np.float32) / np.float32(UNITS), colour[r, y, x]
    gains = np.ones((geometry.cameras, 3))
    for k in range(geometry.cameras):
        if k != r:
            u, v = (np.rint(p).astype(np.int64) for p in geometry.warp(k, x, y, d))
            there = np.flatnonzero((u >= 0) & (u < width) & (v >= 0) & (v < height))
            gains[k] = ratios(own[there], colour[k, v[there], u[there]])
    return gains


def ratios(wanted: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Median of wanted / other in every channel, uint8 [n, 3] of the same points: float64 [3]; 1 where too few are
    neither dark nor bright."""
    sure = (np.minimum(wanted, other) >= DARK) & (np.maximum(wanted, other) <= BRIGHT)
    count = np.count_nonzero(sure, axis=0)
    found = np.sort(np.where(sure, wanted / np.maximum(other, 1), np.inf), axis=0)  # the others come last
    gains = np.append(found, np.ones((1, 3)), axis=0)[np.where(count >= FEWEST, count // 2, -1), range(3)]
    return gains.clip(1 / MOST, MOST)
