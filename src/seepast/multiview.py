"""The many-view method on one screen: every camera is a reference once, then they vote.

What people hide from one camera is plainly visible to another. So the static disparity is estimated in every view,
on its static pixels, and all of them vote on what the wanted view cannot see itself. `see_past` calls one function
per stage, in order, of the backend's many-view module (backends.multiview).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING

import cv2
import numpy as np

from . import backends
from .candidates import CHUNK, EIGHTHS, Candidates, DisparityGrid
from .frames import Frame
from .geometry import ArrayGeometry
from .many import UNITS, PairCosts, Penalties, VoteWeights
from .options import MultiviewOptions, Options
from .people import refine_people

if TYPE_CHECKING:
    from .pipeline import Clock


def see_past(
    frame: Frame,
    geometry: ArrayGeometry,
    options: Options,
    backend: ModuleType,
    dynamic_only: bool,
    clock: Clock,
) -> tuple[dict[str, np.ndarray], int]:
    """One instant of rectified views -> static scene and labels; arguments and results as pipeline.see_past.

    Symbols: x pixel of view r, x^k = W_k(x, d) its ray in camera k, D_k camera k's disparity, c_k its confidence.
    """
    o, K, r = options.multiview, geometry.cameras, geometry.reference
    views = [geometry.seen_from(k) for k in range(K)]
    colour = three_channels(frame.colour)
    first = Penalties.of(o.small_penalty, o.large_penalty, o.least_penalty, o.dynamic_penalty)
    final = Penalties.of(o.final_small_penalty, o.final_large_penalty, o.final_least_penalty, o.final_dynamic_penalty)

    with clock("surfaces"):  # what every camera sees, people included, at a coarse look
        scale = coarseness(geometry, options)
        seen = surfaces(colour, geometry, search_range(geometry, options), scale, o, backend)
    dynamic = frame.dynamic
    if options.people.enabled:
        with clock("people"):  # masks from all views: people as surfaces that all cameras see
            whole = enlarged(seen.disparity.astype(np.float32) * np.float32(scale / UNITS), scale, dynamic.shape)
            dynamic = refine_people(frame, whole, geometry, options.people, backends.people(backend))
    static = dynamic <= 254 * (1 - o.threshold)
    with clock("range"):  # candidates: between what the static surfaces span
        fine = static_range(seen, scale, static, geometry, options)
        grid = thinned(fine, o.view_step)
    with clock("describe"):  # census and colour at quarter-pixel phases
        features = backend.describe(colour, static)
    with clock("volume"):  # C_k(x, d): mean of the smaller half of the static pairs' costs
        costs = [
            backend.volume(features, view, fine if k == r else grid, PairCosts.of(o)) for k, view in enumerate(views)
        ]
        wanted_costs, costs[r] = costs[r], np.ascontiguousarray(costs[r][..., :: o.view_step])
        del features  # a fifth of the memory
    with clock("aggregate"):  # D_k = argmin of C_k smoothed along 8 paths
        found = np.stack([aggregated(backend, costs[k], colour[k], static[k], grid, first) for k in range(K)])
    found, confidence = confirmed(found, colour, static, views, o, backend, clock)

    for _ in range(o.rounds - 1):  # once more, with what the others saw
        better = []
        for k in range(K):
            with clock("votes"):  # E_k(x, d) = base - gain s + gain v + hide o + C_k / 2
                energy = backend.votes(costs[k], found, confidence, static[k], views[k], grid, k, VoteWeights.of(o))
            with clock("aggregate"):
                better.append(aggregated(backend, energy, colour[k], static[k], grid, first))
        found, confidence = confirmed(np.stack(better), colour, static, views, o, backend, clock)

    with clock("votes"):  # the wanted view, its own vote included
        energy = backend.votes(wanted_costs, found, confidence, static[r], geometry, fine, -1, VoteWeights.of(o))
    with clock("aggregate"):
        d = aggregated(backend, energy, colour[r], static[r], fine, final)
    if o.planes:
        with clock("planes"):  # where fewer than two static views agree
            agree, _ = backend.witnesses(d, found, static, geometry, -1, agreement(o))
            d = backend.planes(d, agree >= 2, agree < 2, colour[r], static[r])

    keep = static[r]  # the reference sees these itself
    with clock("labels"):  # S^k: ray k is static and |D_k(x^k) - d| <= label_tolerance
        shown, passing = backend.labels(d, found, static, geometry, round(UNITS * o.label_tolerance))
    with clock("refocus"):  # I* = sum_k w_k S^k I_k(x^k) / sum_k w_k S^k
        kept = keep if options.refocus.keep_reference or dynamic_only else np.zeros_like(keep)
        background = picture(colour, shown, passing, static, geometry, d, kept, options, backend)
    disparity = d.astype(np.float32) / np.float32(UNITS)
    if dynamic_only:  # the rest keeps its own ray, and no disparity
        shown = np.where(keep, np.uint16(1 << r), shown)
        disparity = np.where(keep, np.float32(0), disparity)
    return {
        "background": background[..., : frame.colour.shape[-1]],
        "disparity": disparity,
        "coverage": ray_count(shown),
        "labels": shown,
        "dynamic": dynamic,
    }, o.rounds


def three_channels(colour: np.ndarray) -> np.ndarray:
    """Grey views as BGR: uint8 [K, H, W, C] -> [K, H, W, 3], contiguous."""
    return np.ascontiguousarray(np.broadcast_to(colour, (*colour.shape[:-1], 3)))


def ray_count(labels: np.ndarray) -> np.ndarray:
    """Number of rays of every label set: uint8, same shape."""
    pairs = np.unpackbits(np.ascontiguousarray(labels)[..., None].view(np.uint8), axis=-1)
    return pairs.sum(-1, dtype=np.uint8)


def aggregated(backend, costs, image, static, grid: DisparityGrid, penalties: Penalties) -> np.ndarray:
    """backend.aggregate of dense costs uint8 [H, W, count]."""
    return backend.aggregate(costs.reshape(-1, CHUNK), image, static, Candidates.all(grid, static.shape), penalties)


def agreement(o: MultiviewOptions) -> int:
    """Views whose disparities differ by no more agree: 32nds of a pixel."""
    return round(UNITS * o.tolerance)


def confirmed(found, colour, static, views, o: MultiviewOptions, backend, clock) -> tuple[np.ndarray, np.ndarray]:
    """Every view's disparities with unconfirmed ones put on planes, and their confidence: uint16, uint8 [K, H, W]."""
    confidence, completed = np.empty(found.shape, np.uint8), np.empty_like(found)
    for k, view in enumerate(views):
        with clock("confidence"):  # 1 where another view agrees, little where one sees farther
            agree, farther = backend.witnesses(found[k], found, static, view, k, agreement(o))
            doubtful, lone = round(20 * o.doubtful_confidence), round(20 * o.lone_confidence)
            confidence[k] = backend.confidence_of(agree, farther, static[k], lone, doubtful)
        with clock("planes"):  # least squares through the confirmed pixels around
            sure = agree > 0
            completed[k] = (
                backend.planes(found[k], sure & static[k], ~sure, colour[k], static[k]) if o.planes else found[k]
            )
    return completed, confidence


# --------------------------------------------------------------------------------------------------- range


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What every camera sees, people included: disparity uint16 [K, h, w] in 32nds of a reduced pixel, and bool
    [K, h, w] where another view confirms it."""

    disparity: np.ndarray
    agree: np.ndarray


def coarseness(geometry: ArrayGeometry, options: Options) -> int:
    """How often views are reduced for the coarse look: the masks want more of it than the range does."""
    width, scale = geometry.size[0], 1
    if not options.people.enabled:
        return max(1, min(options.multiview.range_scale, width // 64))
    while width // scale > options.people.surface_width:
        scale *= 2
    return scale


def static_range(
    seen: Surfaces, scale: int, static: np.ndarray, geometry: ArrayGeometry, options: Options
) -> DisparityGrid:
    """The candidates between which the static scene lies.

    The 0.3 and 99.7 percentiles of disparities that another view confirms, clear of people, and a margin.
    """
    o, search = options.multiview, search_range(geometry, options)
    clear = cv2.erode(static.view(np.uint8).transpose(1, 2, 0), np.ones((21, 21), np.uint8), borderValue=1)
    clear = clear.reshape(*static.shape[1:], -1).transpose(2, 0, 1)[:, scale // 2 :: scale, scale // 2 :: scale]
    height, width = (min(a, b) for a, b in zip(clear.shape[1:], seen.disparity.shape[1:], strict=True))
    sure = seen.disparity[:, :height, :width][clear[:, :height, :width].astype(bool) & seen.agree[:, :height, :width]]
    low, high = search.values[0], search.values[-1]
    if len(sure):
        inner = np.percentile(sure, (0.3, 99.7)) * (scale / UNITS)
        margin = max(2.0, 0.04 * (inner[1] - inner[0])) + 3
        low, high = max(low, inner[0] - margin), min(high, inner[1] + margin)
    step = max(1, round(EIGHTHS * options.range.step))
    start = round(EIGHTHS * float(np.floor(low)))
    count = int(np.ceil((EIGHTHS * high - start) / step)) + 1
    whole = LANES * o.view_step
    return DisparityGrid(start, step, -(-count // whole) * whole)


def enlarged(views: np.ndarray, scale: int, shape: tuple[int, ...]) -> np.ndarray:
    """Views of reduced size with every pixel repeated, up to `shape`: [K, h, w] -> [K, H, W]."""
    if scale == 1:
        return views
    whole = views.repeat(scale, 1).repeat(scale, 2)
    missing = [(0, 0)] + [(0, max(0, want - have)) for want, have in zip(shape[1:], whole.shape[1:], strict=True)]
    return np.ascontiguousarray(np.pad(whole, missing, mode="edge")[:, : shape[1], : shape[2]])


def thinned(grid: DisparityGrid, every: int) -> DisparityGrid:
    """Every so many-th candidate."""
    return DisparityGrid(grid.first, grid.step * every, -(-grid.count // every))


LANES = 32  # candidates are a multiple of these, so that no loop over them has a remainder


def search_range(geometry: ArrayGeometry, options: Options) -> DisparityGrid:
    """What is looked through at first: options.range in whole pixels; 0.45 x the width beyond the views' own shifts."""
    wanted = replace(options.range, step=1.0)
    if not wanted.max_disparity:
        far = np.abs(geometry.offsets[:, 0]) > 0.5
        beyond = max(0.0, float((geometry.offsets[far, 3] / geometry.offsets[far, 0]).max(initial=0)))
        wanted = replace(wanted, max_disparity=min(4096.0, 0.45 * geometry.size[0] + beyond))
    return DisparityGrid.of(wanted, geometry.size[0])


def surfaces(
    colour: np.ndarray,
    geometry: ArrayGeometry,
    search: DisparityGrid,
    scale: int,
    o: MultiviewOptions,
    backend: ModuleType,
) -> Surfaces:
    """What every camera sees, people included, on views reduced `scale` times: no masks, full search range."""
    small = reduced(geometry, scale)
    size = small.size
    if scale > 1:
        colour = np.stack([cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in colour])
    static = np.ones(colour.shape[:-1], bool)
    count = -(-((search.count - 1) // scale + 1) // LANES) * LANES
    grid = DisparityGrid(search.first // scale, search.step, count)
    penalties = Penalties.of(o.small_penalty, o.large_penalty, o.least_penalty, 0)
    features = backend.describe(colour, static)
    views = [small.seen_from(k) for k in range(len(colour))]
    found = np.stack(
        [
            aggregated(
                backend, backend.volume(features, view, grid, PairCosts.of(o)), colour[k], static[k], grid, penalties
            )
            for k, view in enumerate(views)
        ]
    )
    agree = [backend.witnesses(found[k], found, static, view, k, agreement(o))[0] > 0 for k, view in enumerate(views)]
    return Surfaces(found, np.stack(agree))


def reduced(geometry: ArrayGeometry, scale: int) -> ArrayGeometry:
    """The array with `scale` x `scale` pixels averaged into one."""
    if scale == 1:
        return geometry
    width, height = geometry.size
    cx, cy = ((c - (scale - 1) / 2) / scale for c in geometry.center)
    return replace(
        geometry,
        focal=(geometry.focal[0] / scale, geometry.focal[1] / scale),
        center=(cx, cy),
        size=(max(1, width // scale), max(1, height // scale)),
        shifts=geometry.shifts / scale,
    )


# ------------------------------------------------------------------------------------------------- picture


def picture(
    colour: np.ndarray,
    shown: np.ndarray,
    passing: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    d: np.ndarray,
    keep: np.ndarray,
    options: Options,
    backend: ModuleType,
) -> np.ndarray:
    """Colours: of the rays that show the surface, else of any static ray, else continued from around.

    `shown`, `passing` uint16 [H, W] from `labels`; keep bool [H, W]: own pixels of the reference. The 3x3 median
    is for seams only, where disparity or coverage change; elsewhere it would blur.
    """
    rays = np.where(shown > 0, shown, passing)
    background = backend.blend(
        colour,
        rays,
        edge_weights(static, options.multiview),
        camera_weights(geometry, options.multiview),
        geometry,
        d,
        ~keep,
    )
    seen = ((rays > 0) | keep).astype(np.uint8)
    if not seen.all():
        background = backend.fill_unseen(background, seen, d.astype(np.float32) / np.float32(UNITS))
    if options.refocus.median:
        square = np.ones((3, 3), np.uint8)
        seams = cv2.morphologyEx(d, cv2.MORPH_GRADIENT, square) > UNITS
        seams |= cv2.morphologyEx(ray_count(shown), cv2.MORPH_GRADIENT, square) > 0
        background = np.where((seams & ~keep)[..., None], cv2.medianBlur(background, 3), background)
    return background


def edge_weights(static: np.ndarray, o: MultiviewOptions) -> np.ndarray:
    """float32 [K, H, W]: pixels within 2 px of a mask may hold some of the person's colour, and count little."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    clear = np.stack([cv2.erode(view.view(np.uint8), disc, borderValue=1) for view in static])
    return np.where(clear > 0, np.float32(1), np.float32(o.edge_weight))


def camera_weights(geometry: ArrayGeometry, o: MultiviewOptions) -> np.ndarray:
    """float32 [K]: 1 / k^camera_falloff, k the distance of camera k in units of the nearest one's."""
    distance = np.linalg.norm(geometry.positions, axis=1)
    unit = distance[distance > 0].min()
    return np.where(distance > 0, (unit / np.maximum(distance, 1e-12)) ** o.camera_falloff, 1).astype(np.float32)
