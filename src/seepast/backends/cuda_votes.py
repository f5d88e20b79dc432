"""What the views say about each other, on the GPU: the stages of reference_multiview.py behind the matching.

Arrays are the device's (gpu.device). Functions of several views do in one launch what the stage does for one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..candidates import Candidates
from ..confidence import CLOSE
from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.launches import int32, launch_tiles, view_table
from ..gpu.tables import address, addresses, constant, views_table
from ..many import CONFIDENT, VoteWeights

__all__ = ["graded_of_views", "labels", "votes", "votes_of_views", "witnesses"]


def witnesses(disparity, disparities, static, geometry: ArrayGeometry, skip: int, tolerance: int):
    agree, farther = _witnesses(disparity[None], disparities, static, [geometry], [skip], tolerance)
    return agree[0], farther[0]


def _witnesses(found, disparities, static, views, skips, tolerance: int):
    xp, shape = device.current().xp, found.shape
    agree, farther = xp.empty(shape, np.uint8), xp.empty(shape, bool)
    skipped = constant(np.array(skips, np.int32))
    launch_tiles(
        "witness", "witnesses", shape, *views_table(views), found, disparities, static, skipped,
        *int32(len(static), *shape[1:], tolerance), agree, farther,
    )  # fmt: skip
    return agree, farther


def labels(disparity, disparities, static, geometry: ArrayGeometry, tolerance: int, wanted=None):
    xp, shape = device.current().xp, disparity.shape
    shown, rays, close = xp.empty(shape, np.uint16), xp.empty(shape, np.uint16), xp.empty(shape, np.uint8)
    wanted = xp.ones(shape, bool) if wanted is None else wanted
    launch_tiles(
        "witness", "labels", (1, *shape), *view_table(geometry), disparity, disparities, static, wanted,
        *int32(geometry.reference, geometry.cameras, *shape, tolerance, CLOSE), shown, rays, close,
    )  # fmt: skip
    return shown, rays, close


def graded_of_views(
    found,
    static,
    views: Sequence[ArrayGeometry],
    tolerance: int,
    lone: int,
    doubtful: int,
    candidates: Sequence[Candidates | None] | None = None,
):
    """`graded` of every view by the others: uint8 and bool [K, H, W]. candidates: nothing is asked of a view that has
    None, and everything if there are none at all."""
    xp, K = device.current().xp, len(views)
    confidence, sure = xp.empty(found.shape, np.uint8), xp.empty(found.shape, bool)
    asked = [1] * K if candidates is None else [0 if c is None else address(c.active) for c in candidates]
    launch_tiles(
        "witness", "graded", found.shape, *views_table(views), found, static, constant(np.array(asked, np.uint64)),
        *int32(K, *found.shape[1:], tolerance, CONFIDENT, lone, doubtful), confidence, sure,
    )  # fmt: skip
    return confidence, sure


def votes(
    costs,
    disparities,
    confidence,
    static,
    geometry: ArrayGeometry,
    candidates: Candidates,
    skip: int,
    weights: VoteWeights,
    out=None,
):
    """`out`, where the energies go, may be `costs`."""
    outs = None if out is None else [out]
    return votes_of_views([costs], disparities, confidence, [static], [geometry], [candidates], [skip], weights, outs)[
        0
    ]


def votes_of_views(
    costs: Sequence,
    disparities,
    confidence,
    statics: Sequence,
    views: Sequence[ArrayGeometry],
    candidates: Sequence[Candidates],
    skips: Sequence[int],
    weights: VoteWeights,
    outs: Sequence | None = None,
) -> list:
    """`votes` of several views with the same grid: one of everything but disparities and confidence per view."""
    if not views:
        return []
    (height, width), grid = statics[0].shape, candidates[0].grid
    outs = [c.copy() for c in costs] if outs is None else list(outs)
    rows = [
        (cost, static, own.active, own.start, out)
        for cost, static, own, out in zip(costs, statics, candidates, outs, strict=True)
    ]
    device.current().launch(
        "vote", "votes", grid=(-(-width // 32), height, len(views)), block=(256,),
        args=[
            *views_table(views), addresses(rows), constant(np.array(skips, np.int32)), disparities, confidence,
            *int32(
                len(disparities), height, width, grid.first, grid.step, weights.base, weights.gain, weights.hide,
                weights.volume, weights.visible,
            ),
        ],
    )  # fmt: skip
    return outs
