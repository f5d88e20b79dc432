"""The stages of reference.py on a GPU: shapes, tables and launches here, loops in gpu/kernels/.

Arrays are the device's (gpu/device.py), but for support points: their triangulation is made on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..candidates import CELL, EIGHTHS, DisparityGrid, Prior, prior_energy
from ..evidence import NATS, POSTERIOR, POSTERIOR_SCALE, prior_costs
from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.morphology import dilated, eroded
from ..gpu.tables import constant, views_table
from ..options import DisparityOptions, Options, PriorOptions, RefocusOptions, SupportOptions
from ..triangulation import delaunay, with_corners
from .cuda_lanes import QUEUES, after, faults, fetched, lane, mark, received
from .cuda_rectify import input_masks, rectified_frame
from .reference import (
    BLOCK_REACH,
    FOREGROUND_WEIGHT,
    NEAR,
    NEARER,
    NO_PLANE,
    PATTERN_REACH,
    REFINE_REACH,
    SAMPLES,
    neighbour_camera,
)

__all__ = [
    "QUEUES",
    "affected",
    "after",
    "depth",
    "describe",
    "disparity",
    "download",
    "evidence",
    "faults",
    "fetched",
    "fill_unseen",
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
    "smooth",
    "support",
]

TILE = (32, 8)  # threads of a block, of kernels with one thread per pixel
LINE = 256  # the same where rows do not matter
BLIND_REACH = 8  # px: points of other cameras that end farther from what the reference does not see are left out early
PERSISTENT = 1056  # blocks of a kernel that takes work from a list: 8 for each multiprocessor of the largest GPU


@dataclass(frozen=True, eq=False)
class Features:
    """gradients int8 [K, H, W, 2], (du, dv) / 2; descriptors uint8 [K, H, W, 16], the same sampled, biased by 128."""

    gradients: Any
    descriptors: Any


def tiles(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Blocks of TILE for [H, W] or [K, H, W]."""
    height, width = shape[-2:]
    return -(-width // TILE[0]), -(-height // TILE[1]), shape[0] if len(shape) == 3 else 1


def lines(count: int) -> int:
    """Blocks of LINE threads for `count` of them."""
    return -(-count // LINE)


def i32(*values: int) -> list[np.int32]:
    return [np.int32(v) for v in values]


def f32(*values: float) -> list[np.float32]:
    return [np.float32(v) for v in values]


def download(found: Any) -> Any:
    """What a method found, a device's array or a tuple or dict of them, in NumPy's arrays."""
    if isinstance(found, dict):
        return {name: download(value) for name, value in found.items()}
    if isinstance(found, tuple):
        return tuple(download(value) for value in found)
    return device.current().download(found)


# ------------------------------------------------------------------------------------ describe, support, prior


def describe(grey: Any) -> Features:
    used, (K, height, width) = device.current(), grey.shape
    features = Features(used.xp.empty((K, height, width, 2), np.int8), used.xp.empty((K, height, width, 16), np.uint8))
    used.launch(
        "describe", "describe", grid=tiles(grey.shape), block=TILE,
        args=[grey, *i32(height, width), features.gradients.view(np.uint8), features.descriptors],
    )  # fmt: skip
    return features


def neighbourhood(wanted: Any) -> Any:
    return dilated(wanted, NEAR)


@lru_cache(maxsize=32)
def _views(geometry: ArrayGeometry) -> list[ArrayGeometry]:
    """The array as seen from every camera."""
    return [geometry.seen_from(k) for k in range(geometry.cameras)]


@lru_cache(maxsize=32)
def _searches(geometry: ArrayGeometry, grid: DisparityGrid) -> tuple[np.ndarray, np.ndarray]:
    """What kernel `support` looks for from every camera: pairs int32 [K, 4] and spacing float32 [K, 2], see there."""
    views, values = _views(geometry), grid.values
    pairs, spacing = [], []
    for base, view in enumerate(views):
        partner = neighbour_camera(geometry, base)
        step, back = (
            np.float32(1) / np.abs(v.offsets[other, 0]) for v, other in ((view, partner), (views[partner], base))
        )
        there, again = (int((values[-1] - values[0]) / s) + 1 for s in (step, back))
        reach = REFINE_REACH / np.abs(view.offsets[partner, 0])
        pairs.append((partner, there, again, int(np.ceil(reach / np.float32(grid.step / 8)))))
        spacing.append((step, back))
    return np.array(pairs, np.int32), np.array(spacing, np.float32)


def support(
    features: Features,
    static: Any,
    geometry: ArrayGeometry,
    grid: DisparityGrid,
    options: SupportOptions,
    near: Any | None = None,
) -> np.ndarray:
    """As reference.support, but of NumPy: the triangulation on the CPU waits for it (12 bytes per grid point)."""
    used, (K, height, width) = device.current(), static.shape
    rows, columns = (-(-size // options.grid) for size in (height, width))
    clear, seeing = eroded(static, BLOCK_REACH), eroded(static[geometry.reference], BLIND_REACH)
    found = used.xp.empty((K, rows, columns, 4), np.float32)
    bins = used.xp.full((rows, columns), np.uint64(2**64 - 1), np.uint64)
    offsets, centers = views_table(_views(geometry))
    pairs, spacing = _searches(geometry, grid)
    used.launch(
        "support", "support", grid=(-(-columns // 4), rows, K), block=(32, 4),
        args=[
            features.descriptors, clear, static, static if near is None else near, np.int32(near is not None),
            seeing, np.int32(BLIND_REACH), offsets, centers, constant(pairs), constant(spacing),
            *i32(K, height, width, geometry.reference, options.grid, rows, columns, options.texture),
            np.int32(options.left_right), *f32(options.uniqueness, options.max_cost * 4 * SAMPLES),
            *i32(grid.first, grid.step, grid.count), found, bins,
        ],
    )  # fmt: skip
    kept = used.xp.empty((rows, columns, 3), np.float32)
    used.launch(
        "support", "consistent", grid=tiles((rows, columns)), block=TILE,
        args=[
            found, bins, *i32(rows, columns, options.window // options.grid), np.float32(options.similar),
            np.int32(options.min_agreeing), kept,
        ],
    )  # fmt: skip
    points = used.download(kept)
    return points[points[..., 0] >= 0]


def prior(points: np.ndarray, shape: tuple[int, int], grid: DisparityGrid, options: PriorOptions) -> Prior:
    """As reference.prior: points NumPy's, of `support`; the Prior has the device's arrays."""
    used, (height, width) = device.current(), shape
    rows, columns = (-(-size // cell) for size, cell in zip(shape, CELL, strict=True))
    if not len(points):
        return Prior(
            used.xp.full(shape, np.int32(grid.first), np.int32), used.xp.ones((rows, columns, grid.count), np.uint8)
        )
    corners = np.ascontiguousarray(with_corners(points, shape))
    on_gpu, cells = used.upload(corners), used.xp.zeros((rows, columns, grid.count), np.uint8)
    used.launch(  # first, since the GPU would else have nothing to do while the CPU triangulates
        "prior", "cell_candidates", grid=(lines(9 * len(points)),), block=(LINE,),
        args=[
            on_gpu, *i32(len(points), rows, columns, grid.first, grid.step, grid.count),
            np.float32(options.neighbour_radius), cells,
        ],
    )  # fmt: skip
    owners = used.xp.full(shape, np.uint64(2**64 - 1), np.uint64)
    triangles = np.ascontiguousarray(delaunay(corners, shape))
    if len(triangles):
        used.launch(
            "prior", "plane_means", grid=(-(-len(triangles) // 4), -(-height // 64)), block=(8, 4, 4),
            args=[
                on_gpu, used.upload(triangles), *i32(len(triangles), width), np.float64(options.max_step), owners,
            ],
        )  # fmt: skip
    filled, mean = used.xp.empty(shape, np.int32), used.xp.empty(shape, np.int32)
    used.launch(
        "prior", "fill_rows", grid=tiles(shape), block=TILE, args=[owners, *i32(height, width, NO_PLANE), filled]
    )
    last = grid.first + grid.step * (grid.count - 1)
    used.launch(
        "prior", "fill_columns", grid=tiles(shape), block=TILE,
        args=[filled, *i32(height, width, NO_PLANE, grid.first, last), mean],
    )  # fmt: skip
    return Prior(mean, cells)


# ---------------------------------------------------------------------------------------------------- disparity


@lru_cache(maxsize=32)
def _shifts(geometry: ArrayGeometry, grid: DisparityGrid) -> np.ndarray:
    """pixel.h ray_shift of every candidate and camera: float32 [count, K, 3] of (zoom, parallax x, y)."""
    d, (ax, ay, az) = grid.values[:, None], geometry.offsets[:, :3].T
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # candidates behind a camera: never seen
        s = np.float32(1) / (np.float32(1) - d * az)
        return np.stack([s - np.float32(1), d * ax * s, d * ay * s], axis=-1)


def _cell_arguments(
    geometry: ArrayGeometry, prior: Prior, grid: DisparityGrid, wanted: Any
) -> tuple[list[Any], dict[str, Any]]:
    """Arguments that `disparity` and `affected` begin with, and how they are launched: a block per cell."""
    height, width = wanted.shape
    arguments = [
        constant(_shifts(geometry, grid)), constant(geometry.offsets), *i32(geometry.cameras, height, width),
        *f32(*geometry.center), prior.mean, prior.cells, *i32(grid.first, grid.step, grid.count), wanted,
    ]  # fmt: skip
    rows, columns = prior.cells.shape[:2]
    return arguments, {"grid": (columns, rows), "block": TILE, "shared": 4 * -(-grid.count // 32)}


def disparity(
    features: Features,
    static: Any,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: Any,
    options: Options,
) -> Any:
    used = device.current()
    gradients = used.xp.empty(static.size + 1, np.uint32)
    used.launch(
        "disparity", "static_gradients", grid=(lines(static.size + 1),), block=(LINE,),
        args=[features.gradients, static, np.int32(static.size), gradients],
    )  # fmt: skip
    out = used.xp.empty(wanted.shape, np.float32)
    arguments, launch = _cell_arguments(geometry, prior, grid, wanted)
    o, table = options.disparity, prior_energy(options.prior)
    used.launch(
        "disparity", "disparity", **launch,
        args=[
            gradients, *arguments, *f32(o.beta, o.lone_variance, o.unseen_variance),
            np.int32(EIGHTHS * options.prior.radius), constant(table), np.int32(len(table) - 1), out,
        ],
    )  # fmt: skip
    return out


def affected(
    changed: Any,
    geometry: ArrayGeometry,
    prior: Prior,
    grid: DisparityGrid,
    wanted: Any,
    options: Options,
) -> Any:
    used = device.current()
    out = used.xp.empty(wanted.shape, bool)
    arguments, launch = _cell_arguments(geometry, prior, grid, wanted)
    near = dilated(changed, PATTERN_REACH + 1)
    used.launch(
        "disparity", "affected", **launch,
        args=[near, *arguments, np.int32(EIGHTHS * options.prior.radius), out],
    )  # fmt: skip
    return out


def smooth(disparity: Any, prior: Prior, wanted: Any, options: DisparityOptions) -> Any:
    used, xp = device.current(), device.current().xp
    passes = options.median_passes
    if not passes:
        return xp.where(wanted, disparity, np.float32(0))
    height, width = wanted.shape
    for i in range(passes):
        out = xp.empty_like(disparity)
        used.launch(
            "smooth", "smooth", grid=tiles(wanted.shape), block=TILE,
            args=[disparity, prior.mean, wanted, *i32(height, width, i == 0, i == passes - 1), out],
        )  # fmt: skip
        disparity = out
    return disparity


# -------------------------------------------------------------------------------------------- segmentation, masks


def segmentation(
    features: Features,
    dynamic: Any,
    geometry: ArrayGeometry,
    disparity: Any,
    wanted: Any,
    options: Options,
) -> tuple[Any, Any]:
    used, xp, (height, width) = device.current(), device.current().xp, disparity.shape
    labels, posterior = xp.empty(disparity.shape, np.uint16), xp.empty_like(dynamic)
    hard, count = xp.empty(disparity.shape, np.int32), xp.zeros(1, np.int32)
    costs = constant(prior_costs(options.segmentation))
    energies = [np.float64(NATS * options.segmentation.beta), np.float64(options.disparity.lone_variance)]
    rays = [
        features.descriptors, dynamic, constant(geometry.offsets), *i32(geometry.cameras, height, width),
        *f32(*geometry.center), disparity,
    ]  # fmt: skip
    used.launch(
        "segmentation", "segmentation", grid=tiles(disparity.shape), block=TILE,
        args=[*rays, wanted, *energies, costs, labels, posterior, hard, count],
    )  # fmt: skip
    used.launch(
        "segmentation", "flips", grid=(min(PERSISTENT, -(-disparity.size // 4)),), block=(32, 4),
        args=[
            *rays, *energies, costs, constant(POSTERIOR), np.int32(len(POSTERIOR) // 2),
            np.float64(POSTERIOR_SCALE), hard, count, labels, posterior,
        ],
    )  # fmt: skip
    return labels, posterior


def masks(
    labels: Any,
    posterior: Any,
    geometry: ArrayGeometry,
    disparity: Any,
    wanted: Any,
    dynamic: Any,
    static: Any,
) -> tuple[Any, Any]:
    used, xp, (height, width) = device.current(), device.current().xp, disparity.shape
    ranks = xp.zeros(dynamic.shape, np.uint64)
    used.launch(
        "masks", "land", grid=tiles(dynamic.shape), block=TILE,
        args=[constant(geometry.offsets), *i32(height, width), *f32(*geometry.center), disparity, wanted, ranks],
    )  # fmt: skip
    refined = xp.empty_like(dynamic), xp.empty_like(static)
    used.launch(
        "masks", "carry_back", grid=(lines(height * width), len(dynamic)), block=(LINE,),
        args=[ranks, labels, posterior, dynamic, static, np.int32(height * width), *refined],
    )  # fmt: skip
    return refined


# ------------------------------------------------------------------------------------------- refocus, confidence


def refocus(
    colour: Any,
    labels: Any,
    geometry: ArrayGeometry,
    disparity: Any,
    keep: Any,
    options: RefocusOptions,
) -> tuple[Any, Any]:
    used, xp, (_, height, width, channels) = device.current(), device.current().xp, colour.shape
    background, coverage = xp.empty((height, width, channels), np.uint8), xp.empty((height, width), np.uint8)
    used.launch(
        "refocus", "refocus", grid=tiles(labels.shape), block=TILE,
        args=[
            colour, labels, constant(geometry.offsets), *i32(height, width, channels, geometry.reference),
            *f32(*geometry.center), disparity, keep, background, coverage,
        ],
    )  # fmt: skip
    _fill(background, coverage, disparity)
    if not options.median:
        return background, coverage
    smoothed = xp.empty_like(background)
    used.launch(
        "refocus", "median3", grid=tiles(labels.shape), block=TILE,
        args=[background, keep, *i32(height, width, channels), smoothed],
    )  # fmt: skip
    return smoothed, coverage


def fill_unseen(background: Any, coverage: Any, disparity: Any) -> Any:
    """As reference.fill_unseen; disparity float32 [H, W] px."""
    filled = background.copy()
    _fill(filled, coverage, disparity)
    return filled


def _fill(background: Any, coverage: Any, disparity: Any) -> None:
    height, width, channels = background.shape
    device.current().launch(
        "refocus", "fill_unseen", grid=tiles(coverage.shape), block=TILE,
        args=[
            coverage, disparity, *i32(height, width, channels), *f32(NEARER, FOREGROUND_WEIGHT), background,
        ],
    )  # fmt: skip


def evidence(disparity: Any, labels: Any, reference: int) -> Any:
    """confidence.of_labels: uint8 [H, W]."""
    used, (height, width) = device.current(), disparity.shape
    out = used.xp.empty(disparity.shape, np.uint8)
    used.launch(
        "confidence", "evidence_of_labels", grid=tiles(disparity.shape), block=TILE,
        args=[disparity, labels, *i32(reference, height, width), out],
    )  # fmt: skip
    return out


def probability(evidence: Any, table: np.ndarray) -> Any:
    """P(|disparity error| <= 1 px over the array) of evidence bytes: float32, by table float32 [256] of the host."""
    used = device.current()
    out = used.xp.empty(evidence.shape, np.float32)
    used.launch(
        "confidence", "probability", grid=(lines(evidence.size),), block=(LINE,),
        args=[evidence, constant(table), np.int32(evidence.size), out],
    )  # fmt: skip
    return out


def depth(disparity: Any, geometry: ArrayGeometry) -> Any:
    """Metres in the reference camera: float32, 0 where the disparity is 0 (unknown)."""
    used = device.current()
    out = used.xp.empty(disparity.shape, np.float32)
    used.launch(
        "confidence", "depth", grid=(lines(disparity.size),), block=(LINE,),
        args=[disparity, np.float32(geometry.focal_baseline), np.int32(disparity.size), out],
    )  # fmt: skip
    return out
