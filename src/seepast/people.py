"""Masks from all views: a person is one surface that all cameras see; a network errs in each of them differently.

`refine_people` is the whole of it on one screen. Four ideas carry it:

* the cameras' P(dynamic) are pooled over the views that see the same surface, then over whole objects (place and
  depth): an object's share of P survives errors of single pixels and of single views;
* what the other cameras see behind an object is what its gaps show, and a person does not (behind.py);
* how far a level of P can be trusted, by how much people differ from what is behind them, which colours they wear and
  what their edges look like nearby is learnt from this very instant, and added up as log-odds u of every pixel;
* a two-label field whose costs fall with contrast and steps of the surface finds the outline.

Loops over pixels are the backends' (backends/reference_people.py is their specification); what is small is here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import cv2
import numpy as np

from .frames import Frame
from .geometry import ArrayGeometry
from .many import UNITS
from .options import PeopleOptions
from .rectify import NO_RAY
from .surfaces import Surfaces

NO_SAY = 255  # in `saw`: this camera does not see the surface
POOLED = 64  # steps per 254th of a pooled P
UNKNOWN = 65535  # pooled P, or share of P, of a pixel without a ray
SHARE = 4096  # steps of an object's share of P, 0..1
LEVELS = 16  # of P, and of surprise, each with a reliability of its own
COLOURS = 16  # levels of b, g and r
NATS = 256  # steps per nat in the field
# by the step from what is behind, sum |dBGR|: twice its binary logarithm
SURPRISE = np.minimum(np.floor(2 * np.log2(1 + np.arange(766))), LEVELS - 1).astype(np.uint8)
MAX_COST = 11.5  # nats: eight of them and MAX_POTENTIAL stay within an int16
MAX_POTENTIAL = 30.0  # nats
MAX_RATIO = 3.0  # nats that one learnt ratio may say
ALIKE = 1.1  # views' numbers of people's pixels differ by no more if they see the same
SPARSE = 4  # every so many-th pixel says enough on whether masks agree
MOST_OUTLINE = 0.25  # of people's pixels: masks with more of it are torn, and not trusted for that
BLOCK = 8  # lattice pixels per block of colour moments
MOMENTS = 14  # 1, b, g, r, bb, bg, br, gg, gr, rr; and of people's pixels 1, b, g, r


@dataclass(frozen=True)
class Cells:
    """The objects' grid. Axes (disparity, y, x) in the reference view; cell i is centred at low + (i - 1/2) size."""

    low: tuple[float, float, float]
    size: tuple[float, float, float]
    count: tuple[int, int, int]

    @property
    def last(self) -> tuple[float, ...]:
        """The farthest position, short of the last cell so that there is a next one to interpolate with."""
        return tuple(n - 1.01 for n in self.count)


@dataclass(frozen=True, eq=False)
class Terms:
    """What the log-odds of a pixel are made of, nats: sure float32 [3] for static, unsure, person; said, a factor;
    local, per unit of the local linear label; colours float32 [4096]; behind float32 [K, LEVELS], by the surprise."""

    sure: np.ndarray
    said: float
    local: float
    colours: np.ndarray
    behind: np.ndarray


@dataclass(frozen=True, eq=False)
class FieldCosts:
    """contrast int16 [n]: cost of a label change by squared colour step, NATS ths of a nat; across a step of the
    surface by more than depth_step px it counts cut / 256."""

    contrast: np.ndarray
    depth_step: float
    cut: int


def refine_people(
    frame: Frame,
    surfaces: np.ndarray,
    geometry: ArrayGeometry,
    options: PeopleOptions,
    backend: ModuleType,
    surprise_at: Callable[[np.ndarray, int], np.ndarray] | None = None,
) -> np.ndarray:
    """Masks of all cameras from all cameras: 254ths of P(dynamic), uint8 [K, H, W], NO_RAY where frame.dynamic has it.

    frame     rectified views
    surfaces  float32 [K, H, W], D_k >= 0: disparity of the nearest surface in every view, people included, px over
              the array
    backend   reference_people or cpu_people
    surprise_at  called with the objects' region, uint8 [K, h, w] on the lattice, and its stride: how much every pixel
              in and around it differs from what other cameras see behind, uint8 [K, H, W] of LEVELS, NO_SAY where
              nothing is known; None: nothing is
    """
    saw = backend.witnesses(frame.dynamic, surfaces, geometry, options.same_surface)
    stride = max(1, round(geometry.size[0] / options.working_width))
    region = object_region(saw, surfaces, geometry, stride, options, backend)
    if region is None:
        return nobody(frame.dynamic)

    surprise = frame.dynamic | np.uint8(NO_SAY) if surprise_at is None else surprise_at(region, stride)
    person, costs = region, field_costs(frame.colour.shape[-1], options)
    for step in (stride, 1):  # learnt from the objects' region, then once more from the outline that this gave
        levels, colours = backend.histograms(frame.dynamic, frame.colour, person, stride)
        said = backend.log_odds(saw, reliability(levels), step)
        sure = backend.sure_labels(region, said if step == stride else lattice(said, stride), options)
        behind = options.behind * reliability(backend.surprise_counts(surprise, sure, stride))
        linear = local_label(backend.colour_moments(frame.colour, sure, stride, BLOCK), options)
        worn = options.colour * colour_ratio(colours, options)
        terms = Terms(sure_terms(options), options.said, options.local, worn, behind)
        u = backend.potentials(
            said, frame.dynamic, frame.colour, linear, sure, surprise, terms, step, stride // step, BLOCK * stride
        )
        belief = backend.field(u, frame.colour, surfaces, costs, step)
        person = (belief > 0).astype(np.uint8)
    return backend.probability(belief, frame.dynamic, probabilities(options), options.grow)


def lattice(plane: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th pixel of [K, H, W, ...] along both axes: where object-level steps look."""
    return plane[:, stride // 2 :: stride, stride // 2 :: stride]


# --------------------------------------------------------------------------------------- who is there at all


def trusted(dynamic: np.ndarray, seen: Surfaces, options: PeopleOptions, backend: ModuleType) -> bool:
    """Whether the masks are exact, by a look at reduced views: then there is nothing to refine, or to look closer at.

    Exact masks differ between views only where a surface is found wrong, along the outline. So what they differ by is
    compared with how much outline there is: the same for people near and far, in small views and large ones.

    dynamic uint8 [K, H, W] of full-size views. Cameras that were not looked from must have about as many people's
    pixels as the others: a mask that is missing is noticed.
    """
    height, width = seen.disparity.shape[1:]
    there = lattice(seen.rows(dynamic), seen.scale)[:, :height, :width].copy()
    unseen = [k for k in range(len(there)) if k not in seen.cameras]
    if unseen:
        people = [float(share) for share in ((there > 127) & (there != NO_RAY)).mean((1, 2))]
        known = [people[k] for k in seen.cameras]
        if not all(min(known) / ALIKE <= people[k] <= max(known) * ALIKE for k in unseen):
            return False
        for k in unseen:
            there[k] = NO_RAY
    surfaces = seen.disparity.astype(np.float32) / np.float32(UNITS)
    saw = backend.witnesses(there, surfaces, seen.level.geometry, options.same_surface / seen.scale)
    apart = backend.disagreement(saw, max(1, SPARSE // seen.scale))
    return apart <= options.trusted * min(outline_share(there), MOST_OUTLINE)


def outline_share(dynamic: np.ndarray) -> float:
    """Of people's pixels in masks uint8 [K, h, w], how many have a neighbour to the sides or above or below that is
    none; 0 where nobody is there."""
    person = (dynamic > 127) & (dynamic != NO_RAY)
    inner = person[:, 1:-1, 1:-1] & person[:, :-2, 1:-1] & person[:, 2:, 1:-1] & person[:, 1:-1, :-2]
    inside = float((inner & person[:, 1:-1, 2:]).sum())
    count = float(person.sum())
    return 1 - inside / count if count else 0.0


def object_region(saw, surfaces, geometry, stride, options, backend) -> np.ndarray | None:
    """Lattice pixels of objects that are people, roughly: uint8 [K, h, w], 1 = person. None: nobody is there.

    An object is a cell of place and disparity. Its share of P is sum / count of pooled P over all views, normalised
    so that the share of which a fifth of all P lies above is 1: people differ in how well a network knows them.

    The floor is as far away as the feet that stand on it, and much wider: floors, and ceilings, are no part of an
    object, but for what is near one and may be found on the wrong surface.
    """
    nearest, farthest = backend.surface_range(surfaces)
    nearest = max(nearest, 1.0)
    cells = object_cells(geometry, (nearest, farthest), options)
    rows = max(1, round(options.upright_reach * geometry.size[1]))
    floor = backend.sloping(surfaces, options.upright * nearest / geometry.size[1] * rows, rows, stride)
    mean, sums = backend.object_grid(saw, surfaces, geometry, cells, stride, floor)
    share = backend.object_slice(blurred(sums, options.cell_blur), mean, surfaces, geometry, cells, stride)
    upright = share | floor  # UNKNOWN on floors
    top = weighted_percentile(backend.share_histograms(upright, mean, 2), 0.8)  # a sample says enough
    shares = backend.share_histograms(upright, mean, 1)
    one = SHARE * max(top, options.least_share)
    thresholds = np.round(one * np.arange(0.3, 0.905, 0.05)).astype(np.int32)
    counts = backend.border_counts(upright, mean, surfaces, thresholds, options.depth_step, stride)
    best = border_threshold(counts, int(shares[1].sum()))
    level = thresholds[best] if best is not None else one * valley(shares[0], one)
    objects = ((upright != UNKNOWN) & (upright > level)).astype(np.uint8)
    if objects.mean() < options.least_area:
        return None
    near = backend.within(objects, max(1, round(rows / stride)))
    return near * ((share != UNKNOWN) & (share > level))


def object_cells(geometry: ArrayGeometry, disparities: tuple[float, float], options: PeopleOptions) -> Cells:
    """Cells of a share of the view: people are that big. x reaches one view to either side, where others look.

    In disparity a share of the nearest surface's: as thick in depth whatever the array. disparities of surfaces, px:
    nearly the largest, and the largest.
    """
    width, height = geometry.size
    nearest, farthest = disparities
    size = (options.cell_disparity * nearest, options.cell_height * height, options.cell_width * width)
    low = (0.0, 0.0, -1.0 * width)
    reach = (min(farthest, 2 * nearest), height, 3 * width)
    count = tuple(int(r / s) + 3 for r, s in zip(reach, size, strict=True))
    return Cells(low, size, count)  # type: ignore[arg-type]


def blurred(sums: np.ndarray, sigma: float) -> np.ndarray:
    """Sums of pooled P and counts int64 [2, *cells] -> float32, P in 0..1, softened: cells lend to their neighbours."""
    grid = sums.astype(np.float64)
    grid[0] /= POOLED * 254
    reach = math.ceil(4 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-3)) ** 2)
    weights /= weights.sum()
    for axis in (1, 2, 3):
        n = grid.shape[axis]
        padded = np.pad(grid, [(reach, reach) if a == axis else (0, 0) for a in range(4)], "symmetric")
        grid = sum(w * np.take(padded, range(i, i + n), axis) for i, w in enumerate(weights))
    return grid.astype(np.float32)


def weighted_percentile(shares: np.ndarray, q: float) -> float:
    """The share (0..1) below which q of all pooled P lies, by `share_histograms`; 0 without any."""
    counts, weights = shares
    total = weights.cumsum()
    return float(np.searchsorted(total, q * total[-1])) / SHARE if counts.any() else 0.0


def border_threshold(counts: np.ndarray, total: int) -> int | None:
    """Index of the threshold whose region ends where surfaces end; None where none does well enough.

    argmax B recall^(1/2) precision^(1/4): B, the share of its border with the inside clearly nearer; recall, the share
    of all P that lies inside; precision, the mean P inside. A person left out is worse than a table taken along.
    """
    on_steps, border, weight, area = counts.astype(np.float64)
    B = on_steps / np.maximum(border, 1)
    recall, precision = weight / max(total, 1), weight / (POOLED * 254) / np.maximum(area, 1)
    return int(np.argmax(B * recall**0.5 * precision**0.25)) if B.max() > 0.75 else None


def valley(counts: np.ndarray, one: float) -> float:
    """Where few pixels have that share t, near 0.7: argmin log(histogram + 1) + 4 (t - 0.7)^2 over 0.35 .. 0.9.

    counts [SHARE + 1], where t = 1 is at `one`.
    """
    histogram, edges = np.histogram(np.arange(len(counts)) / one, bins=65, range=(0, 1.3), weights=counts)
    smooth = cv2.GaussianBlur(histogram.astype(np.float32)[None], (0, 0), 2)[0]
    middle = (edges[1:] + edges[:-1]) / 2
    score = np.log(smooth + 1) + 4 * (middle - 0.7) ** 2
    return float(middle[np.argmin(np.where((middle > 0.35) & (middle < 0.9), score, np.inf))])


def nobody(dynamic: np.ndarray) -> np.ndarray:
    return np.where(dynamic == NO_RAY, np.uint8(NO_RAY), np.uint8(0))


# ------------------------------------------------------------------------------------------ what a pixel says


def reliability(levels: np.ndarray) -> np.ndarray:
    """log p(level | person) / p(level | static) of every camera's levels of P, or of surprise: float32 [K, LEVELS] from
    counts int64 [K, 2, LEVELS] (static, person), smoothed over neighbouring levels and made to rise."""
    padded = np.pad(levels.astype(np.float64), ((0, 0), (0, 0), (1, 1)), "edge")
    smooth = 0.25 * padded[..., :-2] + 0.5 * padded[..., 1:-1] + 0.25 * padded[..., 2:] + 3
    static, person = np.moveaxis(smooth / smooth.sum(-1, keepdims=True), 1, 0)
    ratio = np.log(person / static)
    rising = np.maximum.accumulate(ratio, 1) + np.minimum.accumulate(ratio[:, ::-1], 1)[:, ::-1]
    return (rising / 2).clip(-MAX_RATIO, MAX_RATIO).astype(np.float32)


def colour_ratio(colours: np.ndarray, options: PeopleOptions) -> np.ndarray:
    """log p(colour | person) / p(colour | static): float32 [4096] from counts int64 [2, 4096] (static, person).

    Every bin is doubted by some pixels of either label, in proportion to all: colours hardly ever seen say nothing.
    """
    bins = colours.reshape(2, COLOURS, COLOURS, COLOURS).astype(np.float64)
    for axis in (1, 2, 3):  # Gaussian, sigma 0.7 bins
        padded = np.pad(bins, [(2, 2) if a == axis else (0, 0) for a in range(4)], "symmetric")
        weights = np.exp(-0.5 * (np.arange(-2, 3) / 0.7) ** 2)
        bins = sum(w / weights.sum() * np.take(padded, range(i, i + COLOURS), axis) for i, w in enumerate(weights))
    share = np.maximum(bins.sum((1, 2, 3)), 1)[:, None] / max(bins.sum(), 1)
    p = (bins.reshape(2, -1) + options.colour_doubt * share) / share
    return np.log(p[1] / p[0]).clip(-MAX_RATIO, MAX_RATIO).astype(np.float32)


def sure_terms(options: PeopleOptions) -> np.ndarray:
    """Nats for static, unsure, person. Outside is the surer: people end where their surface does."""
    return np.array([-3 * options.sure, options.unsure, options.sure], np.float32)


def local_label(moments: np.ndarray, options: PeopleOptions) -> np.ndarray:
    """The label as a linear function of colour, fitted to the sure pixels around: guided filtering with weights.

    a = (Cov(I) + ridge)^-1 cov(I, label) over the window (He, Sun, Tang 2013, eq. 14); b such that the label is 1/2
    midway between the mean colours of both labels (Fisher), so that colours which tell nothing favour neither. Both
    averaged over the windows that a block lies in; 1/2 where only one label is sure.

    moments int32 [K, r, c, MOMENTS] per block. Returns float32 [K, r, c, 4]: label = (b, g, r, 1) . it, colours 0..255.
    """
    S = boxed(moments.astype(np.float64), options.window)
    n = np.maximum(S[..., 0], 1)
    m, label = S[..., 1:4] / n[..., None] / 255, S[..., 10] / n
    c = S[..., 11:14] / n[..., None] / 255 - m * label[..., None]
    ij = [(i, j) for i in range(3) for j in range(i, 3)]
    xx, xy, xz, yy, yz, zz = (
        S[..., 4 + q] / n / 255**2 - m[..., i] * m[..., j] + (options.ridge if i == j else 0)
        for q, (i, j) in enumerate(ij)
    )
    # inverse of the symmetric 3x3 matrix by its cofactors
    cofactors = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz, xx * zz - xz * xz, xy * xz - xx * yz
    A, B, C, E, F = cofactors
    G = xx * yy - xy * xy
    det = xx * A + xy * B + xz * C
    rows = ((A, B, C), (B, E, F), (C, F, G))
    a = np.stack([sum(r * c[..., i] for i, r in enumerate(row)) / det for row in rows], -1)
    people, static = S[..., 10:], S[..., :4] - S[..., 10:]
    middle = sum(of[..., 1:] / np.maximum(of[..., :1], 1) for of in (people, static)) / 2 / 255
    b = 0.5 - (a * middle).sum(-1)
    weight = S[..., :1] * ((people[..., :1] > 0) & (static[..., :1] > 0))
    total = boxed(np.concatenate([a / 255 * weight, b[..., None] * weight, weight], -1), options.window)
    linear = total[..., :4] / np.maximum(total[..., 4:], 1)
    return np.where(total[..., 4:] > 0, linear, (0, 0, 0, 0.5)).astype(np.float32)


def boxed(planes: np.ndarray, window: int) -> np.ndarray:
    """Sums over about window x window lattice pixels, of blocks of BLOCK: float64 [K, r, c, n]."""
    reach = max(1, round((window / BLOCK - 1) / 2))
    for axis in (1, 2):
        n = planes.shape[axis]
        pad = [(reach + 1, reach) if a == axis else (0, 0) for a in range(4)]
        total = np.pad(planes, pad).cumsum(axis)
        planes = np.take(total, range(2 * reach + 1, n + 2 * reach + 1), axis) - np.take(total, range(n), axis)
    return planes


# ------------------------------------------------------------------------------------------------ the outline


def field_costs(channels: int, options: PeopleOptions) -> FieldCosts:
    """w = lam (base + exp(-|dBGR|^2 / (2 sigma^2))), nats: people end at contrast, and where the surface steps."""
    squared = np.arange(min(3 * 255**2, math.ceil(16 * options.contrast**2)) + 1)
    cost = options.field * (options.least_cost + np.exp(-squared / (2 * options.contrast**2)))
    return FieldCosts(
        np.round(NATS * np.minimum(cost, MAX_COST)).astype(np.int16), options.depth_step, round(256 * options.depth_cut)
    )


def probabilities(options: PeopleOptions) -> np.ndarray:
    """P = 1 / (1 + exp(-b / scale)) of beliefs b in quarters of a nat from -128 on, in 254ths: uint8 [256].

    A pixel has that of the largest belief next to it (`grow`): true masks contain the mixed pixels of an outline.
    """
    quarters = np.arange(-128, 128) + 0.5  # the middle of each: P > 1/2 exactly where b > 0
    return np.round(254 / (1 + np.exp(-quarters / 4 / options.belief_scale))).astype(np.uint8)
