"""The C++ core under the stage names of reference.py: shapes and glue here, loops in cpp/."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .. import _core
from ..candidates import CELL, EIGHTHS, DisparityGrid, Prior, prior_energy
from ..confidence import of_labels as evidence
from ..evidence import NATS, POSTERIOR, POSTERIOR_SCALE, prior_costs
from ..geometry import ArrayGeometry
from ..options import Options, PriorOptions, RefocusOptions, SupportOptions
from ..triangulation import delaunay, with_corners
from .host import QUEUES, after, faults, fetched, input_masks, lane, mark, probability, received, rectified_frame
from .reference import (
    FOREGROUND_WEIGHT,
    NEARER,
    NO_PLANE,
    PATTERN_REACH,
    SUPPORT_MARGIN,
    clear_of_people,
    consistent,
    fill_gaps,
    into_reference,
    median3,
    merged,
    neighbour_camera,
    neighbourhood,
    smooth,
)
from .workspace import Workspace

__all__ = [
    "QUEUES",
    "affected",
    "after",
    "depth",
    "describe",
    "disparity",
    "evidence",
    "faults",
    "fetched",
    "input_masks",
    "lane",
    "mark",
    "masks",
    "neighbourhood",
    "prior",
    "probability",
    "received",
    "rectified_frame",
    "refocus",
    "segmentation",
    "set_threads",
    "smooth",
    "support",
]
set_threads = _core.set_threads
workspace = Workspace()  # of big arrays, used again when nobody holds them any more


@dataclass(frozen=True, eq=False)
class Features:
    """gradients int8 [K, 2, H, W]; descriptors uint8 [K, H, W, 16], the same sampled, biased by 128."""

    gradients: np.ndarray
    descriptors: np.ndarray


def depth(disparity: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    out = workspace.empty(disparity.shape, np.float32)
    _core.depth(disparity, geometry.focal_baseline, out)
    return out


def view_arrays(views: Sequence[ArrayGeometry]) -> tuple[np.ndarray, np.ndarray]:
    """The array as seen from several cameras: offsets float32 [n, K, 5], centres float32 [n, 2]."""
    return np.stack([v.offsets for v in views]), np.array([v.center for v in views], np.float32)


def describe(grey: np.ndarray) -> Features:
    K, height, width = grey.shape
    features = Features(np.empty((K, 2, height, width), np.int8), np.empty((K, height, width, 16), np.uint8))
    _core.describe(np.ascontiguousarray(grey), features.gradients, features.descriptors)
    return features


def support(
    features: Features,
    static: np.ndarray,
    geometry: ArrayGeometry,
    grid: DisparityGrid,
    options: SupportOptions,
    near: np.ndarray | None = None,
) -> np.ndarray:
    clear, reference, found = clear_of_people(static), geometry.reference, []
    blind = cv2.dilate(_bytes(~static[reference]), np.ones((2 * SUPPORT_MARGIN + 1,) * 2, np.uint8))
    own = np.ones_like(blind) if near is None else _bytes(near)
    for base in range(geometry.cameras):
        where = own if base == reference else blind
        points = _match_camera(features, clear, where, geometry, base, grid, options)
        found.append(into_reference(static, geometry, base, points))
    return consistent(merged(np.concatenate(found), static.shape[1:], options), options)


def _match_camera(
    features: Features,
    clear: np.ndarray,
    where: np.ndarray,
    geometry: ArrayGeometry,
    base: int,
    grid: DisparityGrid,
    options: SupportOptions,
) -> np.ndarray:
    partner = neighbour_camera(geometry, base)
    view, back = geometry.seen_from(base), geometry.seen_from(partner)
    params = _core.SupportParams(
        options.grid, options.texture, options.left_right, options.uniqueness, options.max_cost
    )
    tried = np.prod([-(-size // options.grid) for size in clear.shape[1:]])
    points = np.empty((tried, 4), np.float32)
    count = _core.support_of_camera(
        view.offsets, back.offsets, *view.center, *back.center, base, partner,
        features.descriptors, _bytes(clear), where, geometry.reference, _grid(grid), params, points,
    )  # fmt: skip
    return points[:count]


def prior(points: np.ndarray, shape: tuple[int, int], grid: DisparityGrid, options: PriorOptions) -> Prior:
    rows, columns = (-(-size // cell) for size, cell in zip(shape, CELL, strict=True))
    if not len(points):
        return Prior(np.full(shape, grid.first, np.int32), np.ones((rows, columns, grid.count), np.uint8))
    corners = with_corners(points, shape)
    mean = np.empty(shape, np.int32)
    _core.plane_means(corners, delaunay(corners, shape), options.max_step, NO_PLANE, mean)
    cells = np.zeros((rows, columns, grid.count), np.uint8)
    _core.cell_candidates(np.ascontiguousarray(points), _grid(grid), options.neighbour_radius, cells)
    last = grid.first + grid.step * (grid.count - 1)
    return Prior(fill_gaps(mean).clip(grid.first, last), cells)


def disparity(
    features: Features,
    static: np.ndarray,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: np.ndarray,
    options: Options,
) -> np.ndarray:
    K, height, width = static.shape
    phases = _scratch((K, 4, 3, height, width))
    _core.phase_planes(geometry.offsets, features.gradients, _bytes(static), phases)
    out = np.empty((height, width), np.float32)
    _core.disparity(
        geometry.offsets, *_center(geometry), phases, prior.mean, prior.cells, _grid(grid), _bytes(wanted),
        options.disparity.beta, options.disparity.lone_variance, options.disparity.unseen_variance,
        int(EIGHTHS * options.prior.radius), prior_energy(options.prior), out,
    )  # fmt: skip
    return out


def affected(
    changed: np.ndarray,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: np.ndarray,
    options: Options,
) -> np.ndarray:
    square = np.ones((2 * (PATTERN_REACH + 1) + 1,) * 2, np.uint8)
    near = np.stack([cv2.dilate(view.view(np.uint8), square) for view in changed])
    out = np.empty(wanted.shape, bool)
    _core.affected(
        geometry.offsets, *_center(geometry), near, prior.mean, prior.cells, _grid(grid), _bytes(wanted),
        int(EIGHTHS * options.prior.radius), _bytes(out),
    )  # fmt: skip
    return out


def segmentation(
    features: Features,
    dynamic: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
    options: Options,
) -> tuple[np.ndarray, np.ndarray]:
    labels, posterior = np.empty(disparity.shape, np.uint16), np.empty(dynamic.shape, np.uint8)
    _core.segmentation(
        geometry.offsets, *_center(geometry), features.descriptors, dynamic, disparity, _bytes(wanted),
        NATS * options.segmentation.beta, options.disparity.lone_variance, prior_costs(options.segmentation),
        POSTERIOR, POSTERIOR_SCALE, labels, posterior,
    )  # fmt: skip
    return labels, posterior


def masks(
    labels: np.ndarray,
    posterior: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    wanted: np.ndarray,
    dynamic: np.ndarray,
    static: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    dynamic, static = dynamic.copy(), static.copy()
    _core.masks(
        geometry.offsets,
        *_center(geometry),
        labels,
        posterior,
        disparity,
        _bytes(wanted),
        dynamic,
        _bytes(static),
    )
    return dynamic, static


def refocus(
    colour: np.ndarray,
    labels: np.ndarray,
    geometry: ArrayGeometry,
    disparity: np.ndarray,
    keep: np.ndarray,
    options: RefocusOptions,
) -> tuple[np.ndarray, np.ndarray]:
    background, coverage = np.empty(colour.shape[1:], np.uint8), np.empty(labels.shape, np.uint8)
    _core.refocus(
        geometry.offsets, *_center(geometry), colour, geometry.reference, labels, disparity, _bytes(keep),
        background, coverage,
    )  # fmt: skip
    if not coverage.all():
        _core.fill_unseen(coverage, disparity, NEARER, FOREGROUND_WEIGHT, background)
    if options.median:
        background = np.where(keep[..., None], background, median3(background))
    return background, coverage


_buffers = threading.local()


def _scratch(shape: tuple[int, ...]) -> np.ndarray:
    """int8 memory that this thread used for the last frame too: fresh pages would cost more than the work in them."""
    if getattr(_buffers, "phases", np.empty(0)).shape != shape:
        _buffers.phases = np.empty(shape, np.int8)
    return _buffers.phases


def _bytes(mask: np.ndarray) -> np.ndarray:
    return mask.view(np.uint8)  # bool and uint8 share their bytes: no copy, and writes go through


def _center(geometry: ArrayGeometry) -> tuple[float, float]:
    return geometry.center


def _grid(grid: DisparityGrid) -> _core.Grid:
    return _core.Grid(grid.first, grid.step, grid.count)
