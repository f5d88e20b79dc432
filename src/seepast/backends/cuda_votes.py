"""What the views say about each other, on the GPU: the stages of reference_multiview.py behind the matching.

Arrays are the device's (gpu.device). Functions of several views do in one launch what the stage does for one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..candidates import Candidates
from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.tables import addresses, constant, views_table
from ..many import CONFIDENT, VoteWeights

__all__ = ["confidence_of", "confirmed", "labels", "votes", "votes_of_views", "witnesses"]

TILE = (32, 8)  # threads of a block, one per pixel


def witnesses(disparity, disparities, static, geometry: ArrayGeometry, skip: int, tolerance: int):
    xp, shape = device.current().xp, disparity.shape
    agree, farther = xp.empty(shape, np.uint8), xp.empty(shape, bool)
    _launch_tiles(
        "witness", "witnesses", shape, 1, *views_table([geometry]), disparity, disparities, static, constant(np.array([skip], np.int32)),
        np.int32(geometry.cameras), *_int32(*shape, tolerance), agree, farther,
    )  # fmt: skip
    return agree, farther


def confirmed(disparities, static, views: Sequence[ArrayGeometry], tolerance: int, lone: int, doubtful: int):
    """Of every view by the others: confidence uint8 [K, H, W] (confidence_of), and bool [K, H, W] what `planes` may
    trust, and what it is wanted for."""
    xp, shape = device.current().xp, disparities.shape
    confidence, trusted, wanted = xp.empty(shape, np.uint8), xp.empty(shape, bool), xp.empty(shape, bool)
    _launch_tiles(
        "witness", "confirm", shape[1:], shape[0], *views_table(views), disparities, static,
        *_int32(*shape, tolerance, CONFIDENT, lone, doubtful), confidence, trusted, wanted,
    )  # fmt: skip
    return confidence, trusted, wanted


def labels(disparity, disparities, static, geometry: ArrayGeometry, tolerance: int):
    xp, shape = device.current().xp, disparity.shape
    shown, passing = xp.empty(shape, np.uint16), xp.empty(shape, np.uint16)
    _launch_tiles(
        "witness", "labels", shape, 1, constant(geometry.offsets), *np.array(geometry.center, np.float32), disparity,
        disparities, static, *_int32(geometry.reference, geometry.cameras, *shape, tolerance), shown, passing,
    )  # fmt: skip
    return shown, passing


def confidence_of(agree, farther, static, lone: int, doubtful: int):
    out = device.current().xp.empty(agree.shape, np.uint8)
    device.current().launch(
        "witness", "confidence_of", grid=(-(-agree.size // 256),), block=(256,),
        args=[agree, farther, static, *_int32(agree.size, CONFIDENT, lone, doubtful), out],
    )  # fmt: skip
    return out


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
            *_int32(
                len(disparities), height, width, grid.first, grid.step, weights.base, weights.gain, weights.hide,
                weights.volume, weights.visible,
            ),
        ],
    )  # fmt: skip
    return outs


def _int32(*values: int) -> list[np.int32]:
    return [np.int32(v) for v in values]


def _launch_tiles(file: str, kernel: str, shape: tuple[int, int], views: int, *args) -> None:
    """One thread per pixel of `views` images of `shape` (height, width)."""
    height, width = shape
    grid = (-(-width // TILE[0]), -(-height // TILE[1]), views)
    device.current().launch(file, kernel, grid=grid, block=TILE, args=args)
