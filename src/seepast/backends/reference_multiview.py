"""The many-view method in NumPy, written to be read: THE specification of every stage, slow on purpose.

`cpu_multiview` has these functions with these names, arguments and results, bit for bit; multiview.py calls them
in order. One view at a time is "the view": geometry is the array as seen from it (geometry.seen_from), and
x^k = W_k(x, d) is where its pixel x lies in camera k at disparity d. Nothing but the blend and the planes uses
floating point; where they do, the order of the operations is part of the specification.

Common shapes:  colour uint8 [K, H, W, 3] (grey views repeat their channel);  static bool [K, H, W];  a view's
disparity uint16 [H, W] in 32nds of a pixel over the array;  volumes uint8 [n, CHUNK], costs of the chunks of
Candidates;  confidence uint8 in 20ths.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import cv2
import numpy as np

from ..candidates import CHUNK, EIGHTHS, Candidates, DisparityGrid
from ..confidence import CLOSE
from ..confidence import of_views as evidence
from ..geometry import ArrayGeometry
from ..many import (
    CONFIDENT,
    CUBIC,
    FULL_VOTE,
    LIGHT,
    LUMA,
    NO_PAIR,
    PLANE,
    REACH,
    UNITS,
    PairCosts,
    Penalties,
    VoteWeights,
    camera_pairs,
    cubic_weights,
)
from .host import (
    averaged,
    beside,
    clear_of_masks,
    copied,
    double_rows,
    enlarged,
    half_rows,
    inner_span,
    landings,
    mapped,
    three_channels,
    told,
    witnessed,
)
from .one_by_one import OneByOne
from .reference import fill_unseen, half_positions, ray_offsets

__all__ = [
    "aggregate",
    "aggregates",
    "averaged",
    "beside",
    "blend",
    "clear_of_masks",
    "confidence_of",
    "copied",
    "describe",
    "double_rows",
    "enlarged",
    "everything",
    "evidence",
    "fill_unseen",
    "graded",
    "graded_of_views",
    "half_rows",
    "inner_span",
    "labels",
    "landings",
    "mapped",
    "planes",
    "planes_of_views",
    "three_channels",
    "told",
    "volume",
    "volumes",
    "votes",
    "votes_of_views",
    "windows",
    "windows_of_views",
    "witnessed",
    "witnesses",
]

_views = OneByOne(sys.modules[__name__])
windows_of_views, volumes, aggregates = _views.windows_of_views, _views.volumes, _views.aggregates
votes_of_views, graded_of_views = _views.votes_of_views, _views.graded_of_views
planes_of_views = _views.planes_of_views
everything = Candidates.all


# ---------------------------------------------------------------------------------------------- describe


@dataclass(frozen=True, eq=False)
class Features:
    """Every view at its pixels and half way between them, phases p = 0, 1: sample (p, x) lies at x + p / 2.

    colour  uint8 [K, 2, H, W, 3]
    census  uint32 [K, 2, H, W]: bit per neighbour (REACH), set where it is darker than the sample
    valid   uint32 [K, 2, H, W]: bit per neighbour, set where it is static, and the sample itself
    static  bool [K, 2, H, W]: both pixels that the sample lies between are static; at phase 0 the pixel itself
    """

    colour: np.ndarray
    census: np.ndarray
    valid: np.ndarray
    static: np.ndarray


def describe(colour: np.ndarray, static: np.ndarray) -> Features:
    """Pixels and cubic samples (Keys 1981, A = -1/2) half way between them, and their census (Zabih & Woodfill 1994).

    The census compares 16-bit luma of samples that were never rounded to 8 bits: the faint texture of plain walls is
    evidence. Neighbours that are not static, or not in the image, have no valid bit.
    """
    K, height, width, _ = colour.shape
    phases = np.empty((K, 2, height, width, 3), np.uint8)
    census = np.zeros((K, 2, height, width), np.uint32)
    valid, usable = np.zeros_like(census), np.empty(census.shape, bool)
    padded = np.pad(colour.astype(np.int32), ((0, 0), (0, 0), (1, 2), (0, 0)), mode="edge")
    around = [padded[:, :, i : i + width] for i in range(4)]
    beside = np.pad(static[..., 1:], ((0, 0), (0, 0), (0, 1)))
    for p, value in enumerate((128 * around[1], np.tensordot(CUBIC, around, 1))):  # 128 x the sample
        phases[:, p] = ((value + 64) >> 7).clip(0, 255)
        luma = (((value * LUMA).sum(-1) + 64) >> 7).clip(0, 65535)
        usable[:, p] = static & beside if p else static
        for bit, (dy, dx) in enumerate(REACH):
            census[:, p] |= (moved(luma, dy, dx) < luma).astype(np.uint32) << np.uint32(bit)
            valid[:, p] |= (usable[:, p] & moved(usable[:, p], dy, dx)).astype(np.uint32) << np.uint32(bit)
    return Features(phases, census, valid, usable)


def moved(planes: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """planes[..., y + dy, x + dx], 0 outside."""
    height, width = planes.shape[-2:]
    padded = np.pad(planes, ((0, 0), (abs(dy), abs(dy)), (abs(dx), abs(dx))))
    return padded[:, abs(dy) + dy :, abs(dx) + dx :][:, :height, :width]


# --------------------------------------------------------------------------------------------- candidates


def windows(
    disparity: np.ndarray,
    where: np.ndarray,
    ratio: int,
    grid: DisparityGrid,
    reach: int,
    spread: int,
    shape: tuple[int, ...],
    within: np.ndarray | None = None,
) -> Candidates:
    """Chunks of the grid within `reach` (32nds of a pixel) of a coarser level's disparity, none where `where`, or
    `within`, does not hold.

    disparity uint16, where bool [h, w] of views that are `ratio` times smaller than shape = (H, W); disparity in
    32nds of their pixels. within bool [H, W], None: everywhere. A pixel takes the chunks of all coarse pixels within
    `spread` of its own: what is thin may have been missed there, and surfaces end anywhere in between.
    """
    centre = disparity.astype(np.int64) * ratio - UNITS // EIGHTHS * grid.first
    spacing, last = UNITS // EIGHTHS * grid.step, grid.count - 1
    low = ((centre - reach) // spacing).clip(0, last) // CHUNK
    high = (-(-(centre + reach) // spacing)).clip(0, last) // CHUNK
    bits = (np.uint64(2**64 - 1) >> (63 - (high - low)).astype(np.uint64)) << low.astype(np.uint64)
    h, w = bits.shape
    padded, side = np.pad(bits, spread), range(2 * spread + 1)
    bits = np.where(where, np.bitwise_or.reduce([padded[i : i + h, j : j + w] for i in side for j in side]), 0)
    y, x = ((np.arange(n) // ratio).clip(0, limit - 1) for n, limit in zip(shape, (h, w), strict=True))
    bits = bits[y[:, None], x]
    return Candidates.of(grid, bits if within is None else np.where(within, bits, 0))


# ------------------------------------------------------------------------------------------------- volume


def volume(features: Features, geometry: ArrayGeometry, candidates: Candidates, costs: PairCosts) -> np.ndarray:
    """Matching costs of the view's pixels at their candidates: uint8 [n, CHUNK].

    cost of a pair of static rays = 96 hamming / n over the n neighbours valid in both (costs.few where there are
    fewer than FEW) + min(mean |dBGR|, colour_cap). The mean of the smaller half (rounded up) of the pairs tolerates
    rays that a static nearer thing stops. Pairs are those with the view's own ray where that is static, else all
    others' (camera_pairs). No pair: costs.lone with one static ray, costs.unseen with none.
    """
    grid = candidates.grid
    r = geometry.reference
    K, _, height, width = features.static.shape
    with_own, others = camera_pairs(K, r, costs.apart_of(K, r))
    own = features.static[r, 0]
    out = np.empty((height, width, grid.count), np.uint8)
    for i, d in enumerate(grid.values):
        rays = [ray_samples(features, geometry, k, d) for k in range(K)]
        mine, theirs = (
            smaller_half([pair_cost(rays[j], rays[k], costs) for j, k in pairs]) for pairs in (with_own, others)
        )
        cost = np.where(own, mine, theirs)
        any_ray = np.logical_or.reduce([ray[3] for ray in rays])
        out[..., i] = np.where(cost == NO_PAIR, np.where(any_ray, costs.lone, costs.unseen), cost)
    return out[candidates.mask].reshape(-1, CHUNK)


def ray_samples(features: Features, geometry: ArrayGeometry, k: int, d: float):
    """(census, valid, colour, static) of camera k at x^k for every pixel of the view."""
    height, width = features.static.shape[-2:]
    y, x = np.mgrid[:height, :width]
    xh, row = half_positions(geometry, k, x, y, d)
    column = xh >> 1
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = k, xh & 1, row.clip(0, height - 1), column.clip(0, width - 1)
    valid = np.where(there, features.valid[at], 0).astype(np.uint32)
    return features.census[at], valid, features.colour[at].astype(np.int32), there & features.static[at]


def pair_cost(a, b, costs: PairCosts) -> np.ndarray:
    """int32 [H, W], NO_PAIR where no neighbour of both rays is valid. Nothing in it needs more than bytes."""
    valid = a[1] & b[1]
    hamming, n = popcount((a[0] ^ b[0]) & valid), popcount(valid)
    scale = costs.census_scale[n].astype(np.int32)
    census = np.where(scale > 0, (hamming * scale + 4) >> 3, costs.few)
    blue, green, red = np.moveaxis(np.abs(a[2] - b[2]), -1, 0)
    step = (((blue + red + 1) >> 1) + green + 1) >> 1
    return np.where(n > 0, census + np.minimum(step, costs.colour_cap), NO_PAIR)


BITS = np.array([bin(byte).count("1") for byte in range(256)], np.int32)


def popcount(words: np.ndarray) -> np.ndarray:
    return BITS[words[..., None].view(np.uint8)].sum(-1).astype(np.int32)


def smaller_half(costs: list[np.ndarray]) -> np.ndarray:
    """Mean of the smaller half, rounded up, of the costs that exist; NO_PAIR where none does."""
    if not costs:
        return np.int32(NO_PAIR)
    ordered = np.sort(np.stack(costs), axis=0)
    half = ((ordered != NO_PAIR).sum(0) + 1) // 2
    total = sum(np.where(q < half, cost, 0) for q, cost in enumerate(ordered))
    return np.where(half > 0, (total + half // 2) // np.maximum(half, 1), NO_PAIR)


# ---------------------------------------------------------------------------------------------- aggregate


INACTIVE = 1 << 20  # cost of a candidate that a pixel is not matched at: more than any path's


def aggregate(
    costs: np.ndarray,
    image: np.ndarray,
    static: np.ndarray,
    candidates: Candidates,
    penalties: Penalties,
    paths: int = 8,
    otherwise: np.ndarray | None = None,
) -> np.ndarray:
    """Semi-global matching along 8 paths, or 4: left, right, up, down (Hirschmueller 2008), then a 5x5 median.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + P1, min L(q) + P2) - min L(q), with q the pixel before p on the
    path; candidates that are not active at a pixel cost more than any path. costs uint8 [n, CHUNK]; image uint8
    [H, W, 3]: P2 falls with the colour step between p and q; static bool [H, W]. Pixels that are not matched
    at all keep what `otherwise` has, and paths begin anew behind them. uint16 [H, W] in 32nds of a pixel.
    """
    active = candidates.mask
    dense = np.full(active.shape, INACTIVE, np.int32)
    dense[active] = costs[candidates.rows].reshape(-1)
    total = np.zeros(active.shape, np.int32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if 0 < dy * dy + dx * dx <= paths // 4:  # 4: no diagonals
                total += path_costs(dense, image, static, penalties, dy, dx)
    found = winner(total, active, candidates.grid)
    if otherwise is None:
        return cv2.medianBlur(found, 5)
    matched = active.any(-1)
    return np.where(matched, cv2.medianBlur(np.where(matched, found, otherwise), 5), otherwise)


def path_costs(costs, image, static, penalties: Penalties, dy: int, dx: int) -> np.ndarray:
    """L of the path that comes from pixel (y - dy, x - dx), line of pixels by line of pixels."""
    if dy == 0:  # along rows: columns are the lines
        swapped = path_costs(costs.swapaxes(0, 1), image.swapaxes(0, 1), static.T, penalties, dx, 0)
        return swapped.swapaxes(0, 1)
    height, width, count = costs.shape
    out = costs.copy()
    rows = range(1, height) if dy > 0 else range(height - 2, -1, -1)
    to = slice(max(dx, 0), width + min(dx, 0))  # pixels whose predecessor lies in the image
    at = slice(max(-dx, 0), width + min(-dx, 0))
    for y in rows:
        before = out[y - dy, at]
        lowest = before.min(-1, keepdims=True)
        step = np.abs(image[y, to].astype(np.int32) - image[y - dy, at]).sum(-1)
        large = np.where(static[y, to] & static[y - dy, at], penalties.large[step].astype(np.int32), penalties.dynamic)
        near = np.full((before.shape[0], count + 2), INACTIVE)
        near[:, 1:-1] = before
        near = np.minimum(near[:, :-2], near[:, 2:]) + penalties.small
        way = np.minimum(np.minimum(before, near), lowest + large[:, None]) - lowest
        out[y, to] += np.where(out[y, to] < INACTIVE, way, 0)
    return out


def winner(total: np.ndarray, active: np.ndarray, grid: DisparityGrid) -> np.ndarray:
    """First lowest candidate, moved to the vertex of the parabola through it and its neighbours if both are active."""
    best = total.argmin(-1)
    at = lambda a, i: np.take_along_axis(a, i.clip(0, grid.count - 1)[..., None], -1)[..., 0]  # noqa: E731
    lowest, left, right = at(total, best), at(total, best - 1), at(total, best + 1)
    bend = left + right - 2 * lowest
    half = UNITS // 16 * grid.step  # of the spacing of candidates
    # floor(half (left - right) / bend + 1/2), kept positive for integer division
    moved_by = (2 * half * (left - right + bend) + bend) // np.maximum(2 * bend, 1) - half
    inner = (best > 0) & (best < grid.count - 1) & at(active, best - 1) & at(active, best + 1) & (bend > 0)
    place = UNITS // 8 * (grid.first + grid.step * best) + np.where(inner, moved_by, 0)
    return place.astype(np.uint16)


# ---------------------------------------------------------------------------------- agreement of the views


def landing(geometry: ArrayGeometry, k: int, disparity: np.ndarray):
    """Rays at the pixels' own disparities: (there bool, row, column int32, the disparity expected there int32).

    A camera further forward sees the same point at disparity d / (1 - d az) (geometry.seen_from).
    """
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width].astype(np.int32)
    d = disparity.astype(np.float32) / np.float32(UNITS)
    dx, dy = ray_offsets(geometry, k, x, y, d)
    half = np.float32(0.5)
    column, row = x + np.floor(dx + half).astype(np.int32), y + np.floor(dy + half).astype(np.int32)
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    expected = np.floor(disparity.astype(np.float32) * seen_scale(geometry, k, d) + half).astype(np.int32)
    return there, row.clip(0, height - 1), column.clip(0, width - 1), expected


def seen_scale(geometry: ArrayGeometry, k: int, d) -> np.ndarray:
    """Disparity in camera k of a point that the view has at d, divided by d: 1 / (1 - d az)."""
    one = np.float32(1)
    zoom = one / (one - np.asarray(d, np.float32) * geometry.offsets[k, 2]) - one
    return zoom + one


def witnesses(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    skip: int,
    tolerance: int,
) -> tuple[np.ndarray, np.ndarray]:
    """How many views but `skip` are static at x^k and see there what the view sees: uint8 [H, W]; and whether one
    sees farther: bool [H, W]. tolerance in 32nds of a pixel."""
    agree = np.zeros(disparity.shape, np.uint8)
    farther = np.zeros(disparity.shape, bool)
    for k in range(geometry.cameras):
        if k == skip:
            continue
        there, row, column, expected = landing(geometry, k, disparity)
        there &= static[k, row, column]
        e = disparities[k, row, column].astype(np.int32) - expected
        agree += there & (np.abs(e) <= tolerance)
        farther |= there & (e < -tolerance)
    return agree, farther


def labels(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    tolerance: int,
    wanted: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which rays show the surface, and which make the picture: uint16 [H, W] both, bit k = ray k; and how many of the
    other views confirm the disparity within CLOSE: uint8 [H, W].

    Ray k shows it where it is static and |D_k(x^k) - d| <= tolerance (32nds of a pixel): a static thing in front has
    another disparity and must not lend its colour. The view's own ray does wherever it is static. The picture is made
    of the rays that show the surface or, where there are none, of all static ones. Pixels that are not `wanted`, bool
    [H, W] if given, have their own ray alone.
    """
    shown, open_rays = np.zeros(disparity.shape, np.uint16), np.zeros(disparity.shape, np.uint16)
    close = np.zeros(disparity.shape, np.uint8)
    for k in range(geometry.cameras):
        own = k == geometry.reference
        there, row, column, expected = landing(geometry, k, disparity)
        there &= static[k, row, column] & (True if wanted is None else wanted)
        e = np.abs(disparities[k, row, column].astype(np.int32) - expected)
        bit = np.uint16(1 << k)
        open_rays |= np.where(there, bit, np.uint16(0))
        shown |= np.where(there & ((e <= tolerance) | own), bit, np.uint16(0))
        close += there & (e <= CLOSE) & (not own)
    if wanted is not None:
        shown[~wanted] = open_rays[~wanted] = 1 << geometry.reference
    return shown, np.where(shown, shown, open_rays), close


def votes(
    costs: np.ndarray,
    disparities: np.ndarray,
    confidence: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    candidates: Candidates,
    skip: int,
    weights: VoteWeights,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Energies of the view's candidates from what all cameras but `skip` see there: uint8 [n, CHUNK].

    With e = D_k(x^k) - d in pixels and c the confidence of D_k there (0 where k is not static): support
    s = sum c max(0, 1 - |e|); k sees farther, so the candidate would stand in its line of sight: violation
    v = sum c min(1, (|e| - 1) / 2) over e < 0. A supported candidate hides those behind it, where the view itself
    does not see: o(d) = max over the pixel's candidates d' >= d + 2 of max(0, s(d') - v(d')).
    E = max(0, base - gain min(s, 2) + gain min(v, 2) + hide min(o, 1)) + volume_weight * costs.
    Without weights.visible, what the view sees itself keeps its costs, as rows of no candidate do.

    static bool [H, W] of the view. s, v and o are counted in units of 1 / FULL_VOTE, E in 128ths. `out`, where the
    energies go, may be `costs`.
    """
    height, width = static.shape
    grid, asked = candidates.grid, candidates.mask
    y, x = np.mgrid[:height, :width].astype(np.int32)
    lag = -(-2 * 8 // grid.step)
    hide = np.where(static, 0, weights.hide)
    margins: list[np.ndarray] = []  # max(0, s - v) of the candidates from the nearest on
    nearer = np.zeros((height, width), np.int32)
    energies = np.empty(asked.shape, np.int32)
    for i in reversed(range(grid.count)):
        s, v = np.zeros((height, width), np.int32), np.zeros((height, width), np.int32)
        for k in range(geometry.cameras):
            if k == skip:
                continue
            e, c = vote_of(disparities[k], confidence[k], geometry, k, x, y, grid.values[i])
            s += c * 2 * np.maximum(0, UNITS - np.abs(e))
            v += c * np.minimum(2 * UNITS, np.maximum(0, -e - UNITS))
        margins.append(np.where(asked[..., i], np.maximum(0, s - v), 0))
        if len(margins) > lag:
            nearer = np.maximum(nearer, margins[-1 - lag])
        energy = weights.base + weights.gain * (np.minimum(v, 2 * FULL_VOTE) - np.minimum(s, 2 * FULL_VOTE))
        energy = (np.maximum(0, energy + hide * np.minimum(nearer, FULL_VOTE)) + 64) >> 7
        energies[..., i] = np.minimum(255, energy)
    parts = (costs[candidates.rows].astype(np.int32) * weights.volume + 64) >> 7
    found = np.minimum(255, energies[asked].reshape(-1, CHUNK) + parts)
    polled = asked[..., ::CHUNK] & (~static | weights.visible)[..., None]
    out = costs.copy() if out is None else out
    out[candidates.rows[polled[asked[..., ::CHUNK]]]] = found[polled[asked[..., ::CHUNK]]]
    return out


def vote_of(disparity, confidence, geometry, k, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """e in 32nds of a pixel, cut at +-4 px, and c in 20ths, of camera k on the candidate d of every pixel."""
    height, width = disparity.shape
    dx, dy = ray_offsets(geometry, k, x, y, d)
    half = np.float32(0.5)
    column, row = x + np.floor(dx + half).astype(np.int32), y + np.floor(dy + half).astype(np.int32)
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    row, column = row.clip(0, height - 1), column.clip(0, width - 1)
    expected = np.floor(d * np.float32(UNITS) * seen_scale(geometry, k, d) + half).astype(np.int32)
    e = (disparity[row, column].astype(np.int32) - expected).clip(-4 * UNITS, 4 * UNITS)
    return e, np.where(there, confidence[row, column], 0).astype(np.int32)


def confidence_of(agree: np.ndarray, farther: np.ndarray, static: np.ndarray, lone: int, doubtful: int) -> np.ndarray:
    """c of a view's disparities in 20ths: CONFIDENT where another view agrees, else doubtful where one sees farther,
    else lone; 0 where not static. uint8, any shape."""
    c = np.where(agree > 0, CONFIDENT, np.where(farther, doubtful, lone))
    return np.where(static, c, 0).astype(np.uint8)


def graded(
    disparity: np.ndarray,
    disparities: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Candidates | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What `witnesses` and `confidence_of` say of the view's disparities: c in 20ths, uint8 [H, W]; and whether
    another view agrees, bool [H, W]. At once, since then a pixel that one view confirms needs no other.

    With candidates only of the pixels that have some: 0 and False elsewhere.
    """
    k = geometry.reference
    agree, farther = witnesses(disparity, disparities, static, geometry, k, tolerance)
    confidence, sure = confidence_of(agree, farther, static[k], lone, doubtful), agree > 0
    if candidates is not None:
        asked = candidates.active != 0
        confidence, sure = np.where(asked, confidence, np.uint8(0)), sure & asked
    return confidence, sure


# ------------------------------------------------------------------------------------------------- planes


def planes(
    disparity: np.ndarray, trusted: np.ndarray, wanted: np.ndarray, image: np.ndarray, static: np.ndarray
) -> np.ndarray:
    """Reads `wanted` pixels from the plane through the trusted ones around them: uint16 [H, W] in 32nds of a pixel.

    Smoothness alone is fronto-parallel; where no second view confirms a disparity it is off by a few pixels on a
    slanted wall. The plane is the weighted least-squares fit to D(x') - D(x) over the trusted x' on every second
    pixel within PLANE.radius, |D(x') - D(x)| <= PLANE.gate, with weight
    colour(sum |dBGR|) / (1 + 4 rho^2 / radius^2), colour ~ exp(-g / 32), left out where x is not static. A ridge keeps
    weak slopes flat. Pixels with too little weight, or that would move by more than the gate, stay.
    trusted, wanted, static bool [H, W]; image uint8 [H, W, 3].
    """
    height, width = disparity.shape
    sums = {name: np.zeros((height, width), np.float32) for name in ("w", "x", "y", "xx", "xy", "yy", "e", "ex", "ey")}
    d, bgr = disparity.astype(np.int32), image.astype(np.int32)
    f = np.float32
    for j in PLANE.taps:
        line = {name: np.zeros((height, width), np.float32) for name in ("w", "x", "xx", "e", "ex")}
        for i in PLANE.taps:
            e = moved(d[None], j, i)[0] - d
            step = np.abs(np.stack([moved(c[None], j, i)[0] for c in np.moveaxis(bgr, -1, 0)], -1) - bgr).sum(-1)
            usable = moved(trusted[None], j, i)[0] & (np.abs(e) <= PLANE.gate)
            w = np.where(static, colour_likeness(step), f(1)) * PLANE.nearness(j, i)
            w = np.where(usable, w, f(0))
            we, wi = w * e.astype(np.float32), w * f(i)
            line["w"] += w
            line["x"] += wi
            line["xx"] += wi * f(i)
            line["e"] += we
            line["ex"] += we * f(i)
        sums["w"] += line["w"]
        sums["x"] += line["x"]
        sums["xx"] += line["xx"]
        sums["e"] += line["e"]
        sums["ex"] += line["ex"]
        sums["y"] += line["w"] * f(j)
        sums["yy"] += line["w"] * f(j * j)
        sums["xy"] += line["x"] * f(j)
        sums["ey"] += line["e"] * f(j)
    height_here, enough = plane_height(sums)
    moved_by = np.floor(height_here + 0.5)
    accepted = wanted & enough & (np.abs(moved_by) <= PLANE.gate)
    return np.where(accepted, np.maximum(0, d + np.where(accepted, moved_by, 0)), d).astype(np.uint16)


def colour_likeness(step: np.ndarray) -> np.ndarray:
    """(1 - g / 256)^8, float32: exp(-g / 32) for small steps g, without a call to exp."""
    t = np.float32(1) - np.minimum(step, 256).astype(np.float32) * np.float32(1 / 256)
    t = t * t
    t = t * t
    return t * t


def plane_height(sums: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The fitted plane at the pixel itself, float64 in 32nds of a pixel, and whether enough weight bears it."""
    enough = sums["w"] >= np.float32(PLANE.need)
    s = {name: value.astype(np.float64) for name, value in sums.items()}
    one = 1.0 / np.where(enough, s["w"], 1.0)
    mx, my, me = s["x"] * one, s["y"] * one, s["e"] * one
    a, b, c = s["xx"] * one - mx * mx + PLANE.ridge, s["xy"] * one - mx * my, s["yy"] * one - my * my + PLANE.ridge
    u, v = s["ex"] * one - mx * me, s["ey"] * one - my * me
    det = a * c - b * b
    safe = np.where(enough, det, 1.0)
    return me - (c * u - b * v) / safe * mx - (a * v - b * u) / safe * my, enough


# -------------------------------------------------------------------------------------------------- blend


def blend(
    colour: np.ndarray,
    rays: np.ndarray,
    clear: np.ndarray,
    near: np.ndarray,
    edge: float,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
) -> np.ndarray:
    """Weighted mean of the rays' colours, cubic samples at x^k: uint8 [H, W, 3], the view's own where not wanted.

    rays uint16 [H, W]; clear bool [K, H, W]: pixels of camera k that are not beside a mask: those weigh `edge`; near
    float32 [K]: weight of cameras, which falls with their distance, since blending far views blurs. A ray of a camera
    that weighs less than LIGHT of the heaviest ray of nearer ones is left out. 0 without any ray.
    """
    height, width = rays.shape
    y, x = np.mgrid[:height, :width].astype(np.int32)
    total, weights = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    heaviest = np.zeros_like(weights)
    for k in geometry.nearest_first:
        used = (rays >> k & 1).astype(bool) & (near[k] >= LIGHT * heaviest)
        dx, dy = ray_offsets(geometry, k, x, y, disparity.astype(np.float32) / np.float32(UNITS))
        half = np.float32(0.5)
        column = (x + np.floor(dx + half).astype(np.int32)).clip(0, width - 1)
        row = (y + np.floor(dy + half).astype(np.int32)).clip(0, height - 1)
        w = np.where(clear[k, row, column], np.float32(1), np.float32(edge)) * near[k]
        w = np.where(used, w, np.float32(0))
        total += w[..., None] * bicubic(colour[k], x, y, dx, dy)
        weights += w
        heaviest = np.maximum(heaviest, w)
    mean = total / np.where(weights > 0, weights, np.float32(1))[..., None]
    value = np.floor(mean + np.float32(0.5)).clip(0, 255).astype(np.uint8)
    return np.where(wanted[..., None], value, colour[geometry.reference])


def bicubic(image: np.ndarray, x, y, dx, dy) -> np.ndarray:
    """image uint8 [H, W, C] at (x + dx, y + dy), Keys' cubic, edges continued: float32 [H, W, C]."""
    height, width = image.shape[:2]
    left, top = np.floor(dx), np.floor(dy)
    wx, wy = cubic_weights(dx - left), cubic_weights(dy - top)
    columns = [np.clip(x + left.astype(np.int32) + i - 1, 0, width - 1) for i in range(4)]
    total = np.zeros(image.shape, np.float32)
    for j in range(4):
        row = np.clip(y + top.astype(np.int32) + j - 1, 0, height - 1)
        line = np.zeros(image.shape, np.float32)
        for i in range(4):
            line += wx[i][..., None] * image[row, columns[i]].astype(np.float32)
        total += wy[j][..., None] * line
    return total
