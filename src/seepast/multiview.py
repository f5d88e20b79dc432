"""The many-view method on one screen: every camera is a reference once, then they vote.

What people hide from one camera is plainly visible to another. So the static disparity is estimated in every view,
on its static pixels, and all of them vote on what the wanted view cannot see itself. `see_past` calls one function
per stage, in order, of the backend's many-view module (backends.multiview).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from . import backends, confidence
from .balance import balanced
from .behind import surprise
from .candidates import Candidates, DisparityGrid
from .frames import Frame
from .geometry import ArrayGeometry
from .levels import Level, Pictures, Views, level_grid, scales
from .many import UNITS, PairCosts, Penalties, VoteWeights
from .options import MultiviewOptions, Options
from .people import refine_people, trusted
from .picture import picture
from .surfaces import Surfaces, looks, static_span, surfaces

Clock = Callable[[str], AbstractContextManager[Any]]  # pipeline.Clock: counts the time of a stage
CONTEXT = 16  # px of full size around what matters that a coarse level takes along
ANY_DISTANCE = 1 << 20  # 32nds of a pixel: farther than any two disparities


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
    o, r = options.multiview, geometry.reference
    colour = backend.three_channels(frame.colour)

    dynamic, people, most = frame.dynamic, backends.people(backend), np.uint8(254 * (1 - o.threshold))
    static = dynamic <= most
    pictures = Pictures(colour, static, geometry, backend)
    seen: Surfaces | None = None
    for look in looks(geometry, options):
        first = seen is None
        with clock("surfaces"):  # what every camera sees, people included, at a coarse look
            seen = surfaces(pictures, geometry, look, options, backend, seen)
        if first:
            with clock("balance"):  # exposures are made equal
                given, frame = frame, balanced(frame, seen, o.balance, backend)
                if frame is not given:
                    colour = backend.three_channels(frame.colour)
                    pictures = Pictures(colour, static, geometry, backend)
        with clock("people"):  # exact masks need no closer look
            exact = not options.people.enabled or trusted(dynamic, seen, options.people, people)
        if exact:
            break
    assert seen is not None
    if not exact:
        with clock("people"):  # masks from all views: people as surfaces that all cameras see, unlike what is behind
            whole = seen.at_full_size(dynamic.shape[1:], backend)
            unlike = partial(surprise, dynamic, pictures, seen, geometry, options, backend, people, unhidden)
            known = unlike if options.people.behind else None
            dynamic = refine_people(frame, whole, geometry, options.people, people, known)
            static = dynamic <= most
            pictures = Pictures(colour, static, geometry, backend)
    with clock("range"):  # candidates: between what the static surfaces span
        span = static_span(seen, static, geometry, options, backend)

    disparities = views_disparities(pictures, geometry, span, dynamic_only, options, backend, clock)
    d = disparities[r]

    keep = static[r]  # the reference sees these itself
    with clock("labels"):  # S^k: ray k is static and |D_k(x^k) - d| <= label_tolerance
        wanted = ~keep if dynamic_only else None
        tolerance = round(UNITS * o.label_tolerance)
        shown, rays, close = backend.labels(d, disparities, static, geometry, tolerance, wanted)
    with clock("refocus"):  # I* = sum_k w_k S^k I_k(x^k) / sum_k w_k S^k
        kept = keep if options.refocus.keep_reference or dynamic_only else np.zeros_like(keep)
        background = picture(colour, rays, static, geometry, d, kept, options, backend)
    with clock("confidence"):  # P(|d - truth| <= 1 px)
        evidence = backend.evidence(d, keep, close, shown)
        table = confidence.calibration(options).table
        disparity, sure, coverage = backend.told(d, evidence, table, shown, keep if dynamic_only else None)
    return {
        "background": background[..., : frame.colour.shape[-1]],
        "disparity": disparity,
        "confidence": sure,
        "coverage": coverage,
        "labels": shown,
        "dynamic": dynamic,
    }, o.rounds


def unhidden(level: Level, span: tuple[float, float], options: Options, backend: ModuleType) -> np.ndarray:
    """D_k of all views on one level, each asked of the others what is hidden from it: uint16 [K, h, w]."""
    each = replace(options.multiview, rounds=2, planes=False)
    return at_level(level, span, None, False, replace(options, multiview=each), backend, nullcontext).disparity


def views_disparities(
    pictures: Pictures,
    geometry: ArrayGeometry,
    span: tuple[float, float],
    dynamic_only: bool,
    options: Options,
    backend: ModuleType,
    clock: Clock,
) -> np.ndarray:
    """D_k of all views: uint16 [K, H, W] in 32nds of a pixel over the array. Coarse to fine: each level looks around
    what the one before it found."""
    o, height = options.multiview, geometry.size[1]
    halved = o.half_rows and height > 1  # a row more or less is nothing to a disparity
    found: Views | None = None
    for scale in scales(geometry, o):
        with clock("describe"):
            level = pictures.level(scale, halved)
        found = at_level(level, span, found, dynamic_only, options, backend, clock)
    assert found is not None
    with clock("labels"):
        return backend.double_rows(found.disparity, height) if halved else found.disparity


def agreement(o: MultiviewOptions) -> int:
    """Views whose disparities differ by no more agree: 32nds of a pixel."""
    return round(UNITS * o.tolerance)


def at_level(
    level: Level,
    span: tuple[float, float],
    before: Views | None,
    dynamic_only: bool,
    options: Options,
    backend: ModuleType,
    clock: Clock,
) -> Views:
    """Every camera is a reference once, then they vote: D_k and c_k of all views; the wanted one's with its own vote.

    span    (low, high) of the disparities, px of full-size views
    before  what the next coarser level found; None: the whole span is looked through
    """
    o, r, K = options.multiview, level.geometry.reference, level.geometry.cameras
    first, final = penalties(o)
    colour, static, views = level.colour, level.static, level.views
    grid = level_grid(span, level.scale, options.range.step)
    with clock("candidates"):  # what is not matched here stays as the coarser level found it
        hides = None if before is None else around_people(before, o, backend)
        area = asked_for(hides, before, level, span, o, dynamic_only, backend)
        everywhere = area is None or bool(area.all())
        candidates = around(before, area, level, grid, o, backend)
        found = np.zeros_like(static, np.uint16) if before is None else before.at(level, backend)
        matched = [k for k in range(K) if candidates[k].chunks]
    with clock("describe"):  # census and colour at pixels and half way between
        features = backend.describe(colour, static)
    with clock("volume"):  # C_k(x, d): mean of the smaller half of the static pairs' costs
        of_matched = backend.volumes(
            features, [views[k] for k in matched], [candidates[k] for k in matched], PairCosts.of(o, r)
        )
        costs = dict(zip(matched, of_matched, strict=True))
        del features  # on a GPU they are large, and nobody asks for them again
    with clock("aggregate"):  # D_k = argmin of C_k smoothed along the paths
        # where views are matched around people only, the coarser level told the others all that this one knows
        whole = everywhere or before is None
        voters = matched if whole or o.rounds > 1 else [k for k in matched if k != r]
        better = smoothed(found, level, voters, [costs[k] for k in voters], candidates, first, o, backend)
    asked = graded_on(candidates, whole, everywhere, level, o, dynamic_only)
    seen = confirmed(better, level, asked, o, backend, clock)
    own = costs.get(r)
    for left in reversed(range(o.rounds - 1)):  # with what others saw; other views are heard on what is hidden only
        with clock("votes"):  # E_k(x, d) = base - gain s + gain v + hide o + C_k / 2
            polled = candidates if hides is None else asked_on(hides, before, level, candidates, backend)
            if not left and r in matched:  # from here on, the wanted view alone needs its costs
                own = backend.copied(costs[r])
            energies = voted(costs, polled, seen, VoteWeights.of(o), backend, in_place=not left)
        with clock("aggregate"):
            of_matched = timed(energies, clock, "votes")
            better = smoothed(seen.disparity, level, matched, of_matched, polled, first, o, backend)
        seen = confirmed(better, level, asked, o, backend, clock)
    if own is not None:
        # views that are known to 2 px only have no say where the wanted one sees for itself
        weights = replace(VoteWeights.of(o), visible=whole)
        smooth = final if whole else first
        seen.disparity[r] = wanted_view(seen, own, candidates[r], smooth, weights, o, backend, clock)
    return seen


def smoothed(
    found: np.ndarray,
    level: Level,
    matched: list[int],
    costs: Iterable[np.ndarray],
    candidates: list[Candidates],
    penalties: Penalties,
    o: MultiviewOptions,
    backend: ModuleType,
) -> np.ndarray:
    """uint16 [K, h, w]: the `matched` views by their `costs`, where they have candidates; `found`, whose memory it
    takes, elsewhere."""
    if not matched:
        return found
    colour, static, polled, kept = ([of[k] for k in matched] for of in (level.colour, level.static, candidates, found))
    better = backend.aggregates(costs, colour, static, polled, penalties, o.paths, kept)
    if len(matched) == len(found):
        return better
    for k, view in zip(matched, better, strict=True):
        found[k] = view
    return found


def voted(
    costs: dict[int, np.ndarray],
    candidates: list[Candidates],
    seen: Views,
    weights: VoteWeights,
    backend: ModuleType,
    in_place: bool,
) -> Iterable[np.ndarray]:
    """Energies of the views by their costs, whose place they may take, and the other views' votes."""
    views, matched, volumes = seen.level.views, list(costs), list(costs.values())
    static, geometry, polled = ([of[k] for k in matched] for of in (seen.level.static, views, candidates))
    return backend.votes_of_views(
        volumes, seen.disparity, seen.confidence, static, geometry, polled, matched, weights,
        volumes if in_place else None,
    )  # fmt: skip


def timed(made: Iterable[np.ndarray], clock: Clock, stage: str) -> Iterator[np.ndarray]:
    """The same, with the time that making them takes counted for `stage`."""
    making = iter(made)
    while True:
        with clock(stage):
            one = next(making, None)
        if one is None:
            return
        yield one


def wanted_view(
    seen: Views,
    costs: np.ndarray,
    candidates: Candidates,
    smooth: Penalties,
    weights: VoteWeights,
    o: MultiviewOptions,
    backend: ModuleType,
    clock: Clock,
) -> np.ndarray:
    """The wanted view's disparity by all views' votes, its own included: uint16 [h, w]."""
    level, geometry, r = seen.level, seen.level.geometry, seen.level.geometry.reference
    colour, static = level.colour[r], level.static[r]
    with clock("votes"):
        # nobody needs the costs any more: the energies take their place
        energy = backend.votes(
            costs, seen.disparity, seen.confidence, static, geometry, candidates, -1, weights, out=costs
        )
    with clock("aggregate"):
        d = backend.aggregate(energy, colour, static, candidates, smooth, o.paths, seen.disparity[r])
    if o.planes:
        with clock("planes"):  # where fewer than two static views agree
            agree, _ = backend.witnesses(d, seen.disparity, level.static, geometry, -1, agreement(o))
            known, asked = (agree >= 2) & (d > 0), (agree < 2) & (candidates.active != 0)
            d = backend.planes(d, known, asked, colour, static)
    return d


def around_people(found: Views, o: MultiviewOptions, backend: ModuleType) -> np.ndarray:
    """Where what people hide from the wanted view lies in the views that are asked of it, and `around` px of full size
    beside it, in rows no more than that: bool [K, h, w]."""
    level, geometry = found.level, found.level.geometry
    hidden = ~level.static[geometry.reference]
    there = backend.witnessed(hidden, found.disparity, level.static, geometry, o.witnesses, agreement(o))
    tall = 2 if o.half_rows else 1  # px of full size that a row of full size stands for
    return backend.beside(there, -(-o.around // level.scale), o.around // (tall * level.scale))


def within_reach(level: Level, span: tuple[float, float], o: MultiviewOptions, backend: ModuleType) -> np.ndarray:
    """Where what people hide from the wanted view may lie in every view, whatever its disparity, and up to CONTEXT px
    (of full size) beside it: bool [K, h, w]."""
    hidden, context = ~level.static[level.geometry.reference], max(1, CONTEXT // level.scale)
    low, high = (np.full_like(hidden, d / level.scale, np.float32) for d in span)
    there = backend.landings(hidden, low, high, level.geometry)
    return backend.beside(there, context, max(1, context // (2 if o.half_rows else 1)))


def graded_on(
    candidates: list[Candidates], whole: bool, everywhere: bool, level: Level, o: MultiviewOptions, dynamic_only: bool
) -> list[Candidates | None] | None:
    """Where disparities are graded: None for everywhere. Views have a say where they were matched; on finer levels the
    wanted one has none, who asks only where it sees nothing."""
    if everywhere or (o.planes and not dynamic_only):
        return None
    r = level.geometry.reference
    return [None if k == r and not (whole or o.planes) else own for k, own in enumerate(candidates)]


def asked_for(
    hides: np.ndarray | None,
    before: Views | None,
    level: Level,
    span: tuple[float, float],
    o: MultiviewOptions,
    dynamic_only: bool,
    backend: ModuleType,
) -> np.ndarray | None:
    """Where a level is matched: bool [K, h, w] in the pixels of the coarser one, or of the coarsest one itself; None:
    everywhere.

    Everywhere; with dynamic_only within reach of what people hide. Without fine_views finer levels match the other
    views only around what people hide from the wanted one, and there only at what they see themselves, or a coarse
    pixel beside it (`around` is exact); with dynamic_only that one too.
    """
    if hides is None or before is None:
        return within_reach(level, span, o, backend) if dynamic_only else None
    r = before.level.geometry.reference
    area = hides.copy() if dynamic_only or not o.fine_views else np.ones_like(hides)
    if not o.fine_views:
        area &= backend.beside(before.level.static, 1, 1)
    area[r] = hides[r] if dynamic_only else True
    return area


def asked_on(
    hides: np.ndarray, before: Views | None, level: Level, candidates: list[Candidates], backend: ModuleType
) -> list[Candidates]:
    """The other views' candidates on what people hide from the wanted one, bool [K, h, w] of the coarser level."""
    assert before is not None
    there = backend.enlarged(hides, before.level.scale // level.scale, level.static.shape[1:])
    r = level.geometry.reference
    return [own if k == r else own.where(there[k]) for k, own in enumerate(candidates)]


def around(
    before: Views | None,
    area: np.ndarray | None,
    level: Level,
    grid: DisparityGrid,
    o: MultiviewOptions,
    backend: ModuleType,
) -> list[Candidates]:
    """What every view is matched at: within `area` around what the coarser level found; at first everything there."""
    K, *shape = level.static.shape
    if area is None:
        return [backend.everything(grid, tuple(shape))] * K
    if before is None:
        anything = np.zeros_like(area, np.uint16)
        return backend.windows_of_views(anything, area, 1, grid, ANY_DISTANCE, 0, tuple(shape), None, -1)
    ratio, reach = before.level.scale // level.scale, round(UNITS * o.window)
    # the wanted view is asked what lies behind people too; the others, without fine_views, what they see themselves
    within, whole = (None, -1) if o.fine_views else (level.static, level.geometry.reference)
    return backend.windows_of_views(before.disparity, area, ratio, grid, reach, o.spread, tuple(shape), within, whole)


def penalties(o: MultiviewOptions) -> tuple[Penalties, Penalties]:
    """Of the views' passes, and of the wanted one's last."""
    return (
        Penalties.of(o.small_penalty, o.large_penalty, o.least_penalty, o.dynamic_penalty),
        Penalties.of(o.final_small_penalty, o.final_large_penalty, o.final_least_penalty, o.final_dynamic_penalty),
    )


def confirmed(
    found: np.ndarray,
    level: Level,
    candidates: list[Candidates | None] | None,
    o: MultiviewOptions,
    backend: ModuleType,
    clock: Clock,
) -> Views:
    """Every view's disparities, uint16 [K, h, w], with unconfirmed ones put on planes; and their confidence, 0 where a
    view has no candidates (candidates None: as if it had some everywhere)."""
    with clock("confidence"):  # 1 where another view agrees, little where one sees farther
        doubtful, lone = round(20 * o.doubtful_confidence), round(20 * o.lone_confidence)
        given = found, level.static, level.views, agreement(o), lone, doubtful, candidates
        confidence, sure = backend.graded_of_views(*given)
    if o.planes:
        with clock("planes"):  # least squares through the confirmed pixels around
            static = level.static
            if candidates is not None:  # not where nothing was matched
                looked = np.stack([of.active != 0 for of in candidates if of is not None])
                static, sure = static & looked, sure | ~looked
            found = backend.planes_of_views(found, sure, level.colour, static)
    return Views(level, found, confidence)
