"""Constants and tables of the many-view method that its backends share: all are made here and handed over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .options import MultiviewOptions

UNITS = 32  # disparities of views are uint16 in 32nds of a pixel over the array
NO_PAIR = 255  # in costs: no two static rays
CONFIDENT = 20  # confidence is counted in 20ths
FULL_VOTE = 2 * CONFIDENT * UNITS  # units of one full vote of a confident view

# Keys' cubic (A = -1/2) half way between the second and third of four pixels, in 128ths: exact. C++ and CUDA write
# the rounded sample out, (9 (b + c) - (a + d) + 8) >> 4: the same number.
CUBIC = np.array([-8, 72, 72, -8], np.int32)
LUMA = np.array([29, 150, 77], np.int32)  # of B, G, R in 256ths
# neighbours (dy, dx) of the census: every other pixel of a 7 x 7 window, like a chessboard
REACH = tuple((dy, dx) for dy in range(-3, 4) for dx in range(-3, 4) if (dy + dx) % 2 == 0 and (dy, dx) != (0, 0))
LIGHT = np.float32(1 / 64)  # rays that weigh less, beside the heaviest, are left out of the picture
FEW = 8  # of them, or more, must be static in both rays


def cubic_weights(t: np.ndarray) -> list[np.ndarray]:
    """Keys' cubic (A = -1/2) of four pixels at -1, 0, 1, 2 for the place t in [0, 1): float32."""
    f = np.float32
    near, far = f(1) - t, f(2) - t
    beyond = f(1) + t
    return [
        ((f(-0.5) * beyond + f(2.5)) * beyond - f(4)) * beyond + f(2),
        (f(1.5) * t - f(2.5)) * t * t + f(1),
        (f(1.5) * near - f(2.5)) * near * near + f(1),
        ((f(-0.5) * far + f(2.5)) * far - f(4)) * far + f(2),
    ]


def camera_pairs(cameras: int, view: int, apart: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs that are matched where `view` sees the static scene itself, and where it does not: of the others, in their
    order, those that are at most `apart` places apart."""
    others = [k for k in range(cameras) if k != view]
    return [(view, k) for k in others], [(j, k) for i, j in enumerate(others) for k in others[i + 1 : i + 1 + apart]]


@dataclass(frozen=True, eq=False)
class PairCosts:
    """Matching cost of a pair of rays; numbers below 101, so that costs fit bytes.

    apart, wanted  of camera_pairs: `apart`, but everything for the camera `wanted`; see apart_of
    census_scale  uint8 [32]: cost of one differing neighbour in 8ths, by how many are valid: 4 if all 24 are;
                  0 below FEW
    few           cost of the census there
    colour_cap    the mean colour step costs no more
    lone, unseen  costs with one static ray, with none
    """

    apart: int
    wanted: int
    census_scale: np.ndarray
    few: int
    colour_cap: int
    lone: int
    unseen: int

    def apart_of(self, cameras: int, view: int) -> int:
        """`apart` of camera_pairs. Of many cameras, two at most: their pairs would be too many."""
        apart = cameras if view == self.wanted else self.apart
        return min(apart, 2) if cameras > 6 else apart

    @staticmethod
    @lru_cache(maxsize=64)  # made for every frame anew it takes longer than some stages
    def of(options: MultiviewOptions, wanted: int = -1) -> PairCosts:
        n = np.arange(32)
        scale = np.where(n < FEW, 0, np.round(8 * 4 * len(REACH) / np.maximum(n, FEW))).astype(np.uint8)
        return PairCosts(
            options.apart, wanted, scale, options.few_cost, options.colour_cap, options.lone_cost, options.unseen_cost
        )


@dataclass(frozen=True, eq=False)
class Penalties:
    """Of a path: small (P1) for one candidate's step; large uint16 [766] (P2) for more, by the colour step
    sum |dBGR|; dynamic in place of P2 at pixels that are not static."""

    small: int
    large: np.ndarray
    dynamic: int

    @staticmethod
    @lru_cache(maxsize=64)
    def of(small: int, large: float, least: float, dynamic: int) -> Penalties:
        """P2 = max(least, large / (1 + g / 10)), g the mean step of the channels; never below P1."""
        table = np.maximum(least, large / (1 + np.arange(766) / 30))
        return Penalties(small, np.maximum(table, small).astype(np.uint16), max(dynamic, small))


@dataclass(frozen=True)
class VoteWeights:
    """base and volume in 128ths; gain and hide in 128ths per unit of FULL_VOTE: whole tens of energy. visible: there
    are votes on what the view sees itself; else it keeps its costs."""

    base: int
    gain: int
    hide: int
    volume: int
    visible: bool = True

    @staticmethod
    def of(options: MultiviewOptions) -> VoteWeights:
        return VoteWeights(
            round(128 * options.vote_base),
            round(128 * options.vote_gain / FULL_VOTE),
            round(128 * options.vote_hide / FULL_VOTE),
            round(128 * options.vote_volume),
        )


@dataclass(frozen=True)
class Plane:
    """Fit of `planes`: pixels of radius and stride, gate in 32nds of a pixel, ridge px^2, least sum of weights."""

    radius: int
    stride: int
    gate: int
    ridge: float
    need: float

    @property
    def taps(self) -> range:
        return range(-self.radius, self.radius + 1, self.stride)

    def nearness(self, j: int, i: int) -> np.float32:
        """1 / (1 + 4 rho^2 / radius^2)."""
        return np.float32(1 / (1 + 4 * (i * i + j * j) / self.radius**2))

    @property
    def table(self) -> np.ndarray:
        """float32 [taps, taps] of `nearness`."""
        return np.array([[self.nearness(j, i) for i in self.taps] for j in self.taps], np.float32)


PLANE = Plane(radius=16, stride=2, gate=4 * UNITS, ridge=4.0, need=4.0)
