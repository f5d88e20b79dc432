"""The loops of the mask refinement on the GPU: names, arguments and results of reference_people.py and host_people.py.

Arrays of pixels are the device's. Small tables come in and go out as NumPy arrays: what is learnt from an instant is
worked out on the CPU (people.py), where logarithms are the same for all backends. It waits for the GPU ten times.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..geometry import ArrayGeometry
from ..gpu import device
from ..gpu.launches import int32, launch_line, launch_tiles
from ..gpu.tables import constant, views_table
from ..options import PeopleOptions
from ..people import COLOURS, LEVELS, MOMENTS, SHARE, SURPRISE, Cells, FieldCosts, Terms
from .cuda_levels import grown
from .host_people import disc

__all__ = [
    "border_counts",
    "colour_moments",
    "disagreement",
    "field",
    "histograms",
    "log_odds",
    "object_grid",
    "object_slice",
    "potentials",
    "probability",
    "share_histograms",
    "sloping",
    "sure_labels",
    "surface_range",
    "surprise_counts",
    "surprises",
    "within",
    "witnesses",
]


def witnesses(dynamic, surfaces, geometry: ArrayGeometry, tolerance: float):
    saw = device.current().xp.empty((*dynamic.shape, len(dynamic)), np.uint8)
    launch_tiles(
        "people", "witnesses", dynamic.shape, *_views(geometry), dynamic, surfaces, np.float32(tolerance),
        *int32(*dynamic.shape), saw,
    )  # fmt: skip
    return saw


def disagreement(saw, step: int) -> float:
    K, height, width = saw.shape[:3]
    looked_at = -(-height // step), -(-width // step)
    sums = device.current().xp.zeros(2, np.uint64)
    launch_tiles(
        "people", "disagreement", (K, *looked_at), saw, *int32(K, height, width, step, *looked_at), sums
    )  # fmt: skip
    low, high = device.current().download(sums).tolist()
    return 1 - low / high if high else 0.0


def surface_range(surfaces) -> tuple[float, float]:
    sample = device.current().download(device.current().xp.ascontiguousarray(surfaces[:, ::8, ::8]))
    return float(np.percentile(sample, 99)), float(surfaces.max())


def sloping(surfaces, least: float, rows: int, stride: int):
    out = device.current().xp.empty(_lattice(surfaces, stride), np.uint16)
    launch_tiles(
        "people", "sloping", out.shape, surfaces, np.float32(least), *int32(rows, *surfaces.shape[1:], stride), out
    )
    return out


def object_grid(saw, surfaces, geometry: ArrayGeometry, cells: Cells, stride: int, floor):
    """The sums are a NumPy array: their blur is in float64, and small."""
    xp, shape = device.current().xp, _lattice(surfaces, stride)
    mean, sums = xp.empty(shape, np.uint16), xp.zeros((2, *cells.count), np.int64)
    launch_tiles(
        "people", "object_grid", shape, *_views(geometry), saw, surfaces, *_cells(cells),
        *int32(geometry.reference, *surfaces.shape, stride), floor, mean, sums,
    )  # fmt: skip
    return mean, device.current().download(sums)


def object_slice(grid: np.ndarray, mean, surfaces, geometry: ArrayGeometry, cells: Cells, stride: int):
    share = device.current().xp.empty_like(mean)
    launch_tiles(
        "people", "object_slice", mean.shape, *_views(geometry), device.current().upload(grid), mean, surfaces,
        *_cells(cells), *int32(geometry.reference, *surfaces.shape, stride), share,
    )  # fmt: skip
    return share


def share_histograms(share, mean, step: int) -> np.ndarray:
    bins, (K, h, w) = device.current().xp.zeros((2, SHARE + 1), np.int64), share.shape
    looked_at = -(-h // step), -(-w // step)
    launch_tiles("people", "share_histograms", (K, *looked_at), share, mean, *int32(h, w, step, *looked_at), bins)
    return device.current().download(bins)


def border_counts(share, mean, surfaces, thresholds: np.ndarray, step: float, stride: int) -> np.ndarray:
    rank = (np.arange(SHARE + 1)[:, None] > thresholds).sum(1).astype(np.uint8)
    totals = device.current().xp.zeros((4, len(thresholds) + 1), np.int64)
    launch_tiles(
        "people", "border_counts", share.shape, share, mean, surfaces, device.current().upload(rank),
        np.int32(len(thresholds)), np.float32(step), *int32(*surfaces.shape[1:], stride), totals,
        shared=4 * totals.size,
    )  # fmt: skip
    return device.current().download(totals).cumsum(1)[:, :-1]


def surprises(colour, behind: list, rays: list, wanted):
    xp = device.current().xp
    out = xp.empty(wanted.shape, np.uint8)
    launch_tiles(
        "people", "surprises", wanted.shape, colour, xp.stack(behind), xp.stack(rays), wanted, constant(SURPRISE),
        *int32(*wanted.shape[1:]), out,
    )  # fmt: skip
    return out


def surprise_counts(surprise, sure, stride: int) -> np.ndarray:
    counts = device.current().xp.zeros((len(sure), 2, LEVELS), np.int64)
    launch_tiles("people", "surprise_counts", sure.shape, surprise, sure, *int32(*surprise.shape[1:], stride), counts)
    return device.current().download(counts)


def within(region, radius: int):
    return grown(region, disc(radius))


def histograms(dynamic, colour, person, stride: int) -> tuple[np.ndarray, np.ndarray]:
    xp, K = device.current().xp, len(dynamic)
    levels, colours = xp.zeros((K, 2, LEVELS), np.int64), xp.zeros((2, COLOURS**3), np.int64)
    launch_tiles(
        "people", "histograms", person.shape, dynamic, colour, person,
        *int32(colour.shape[-1], *dynamic.shape[1:], stride), levels, colours,
    )  # fmt: skip
    return device.current().download(levels), device.current().download(colours)


def colour_moments(colour, sure, stride: int, block: int) -> np.ndarray:
    K, h, w = sure.shape
    rows, columns = -(-h // block), -(-w // block)
    moments = device.current().xp.empty((K, rows, columns, MOMENTS), np.int32)
    device.current().launch(
        "people", "colour_moments", grid=(columns, rows, K), block=(32,),
        args=[colour, sure, *int32(colour.shape[3], *colour.shape[1:3], stride, block), moments],
    )  # fmt: skip
    return device.current().download(moments)


def log_odds(saw, levels: np.ndarray, stride: int):
    out = device.current().xp.empty(_lattice(saw, stride), np.float32)
    launch_tiles(
        "people", "log_odds", out.shape, saw, device.current().upload(levels), *int32(*saw.shape[:3], stride), out
    )
    return out


def sure_labels(region, said, options: PeopleOptions):
    xp = device.current().xp
    out, said = xp.empty(region.shape, np.int8), xp.ascontiguousarray(said)
    deep, around = grown(region, disc(options.inner), erode=True), grown(region, disc(options.outer))
    launch_line(
        "people", "sure_labels", region.size, deep, around, said, np.float32(options.sure_said),
        np.int32(region.size), out,
    )  # fmt: skip
    return out


def potentials(
    said, dynamic, colour, linear: np.ndarray, sure, surprise, terms: Terms, stride: int, cell: int, size: int
):
    u = device.current().xp.empty(said.shape, np.int16)
    rows, columns = linear.shape[1:3]
    height, width = dynamic.shape[1:]
    launch_tiles(
        "people", "potentials", said.shape, said, dynamic, colour, device.current().upload(linear),
        *_between(rows, size, height), *_between(columns, size, width), sure, constant(terms.sure), surprise,
        device.current().upload(terms.behind), device.current().upload(terms.colours), np.float32(terms.said),
        np.float32(terms.local), *int32(rows, columns, colour.shape[-1], height, width, *sure.shape[1:], stride, cell),
        u,
    )  # fmt: skip
    return u


def _between(blocks: int, size: int, count: int) -> tuple:
    """Of `count` pixels, the block of `size` pixels whose centre lies before each, int32, and the next one's share,
    float32; beyond the outermost centres those blocks alone. As OpenCV's INTER_LINEAR computes them."""
    place = (np.minimum(np.arange(count), blocks * size - 1) + 0.5) * (1 / size) - 0.5
    first = np.floor(place)
    outside = (first < 0) | (first >= blocks - 1)
    share = np.where(outside, 0, place - first).astype(np.float32)
    return constant(first.clip(0, blocks - 1).astype(np.int32)), constant(share)


def field(u, colour, surfaces, costs: FieldCosts, stride: int):
    xp, (K, h, w) = device.current().xp, u.shape
    change, total = xp.empty((4, K, h, w), np.int16), xp.empty((K, h, w), np.int32)
    launch_tiles(
        "people_field", "change_costs", u.shape, colour, surfaces, constant(costs.contrast),
        np.int32(len(costs.contrast)), np.float32(costs.depth_step),
        *int32(costs.cut, colour.shape[-1], *surfaces.shape[1:], stride), change,
    )  # fmt: skip
    device.current().launch(
        "people_field", "along_rows", grid=(-(-K * h // 8),), block=(256,), args=[u, change, *int32(K * h, w), total]
    )
    device.current().launch(
        "people_field", "across_rows", grid=(-(-w // 128), 6, K), block=(128,), args=[u, change, *int32(h, w), total]
    )
    return total.astype(np.int16)


def probability(belief, dynamic, table: np.ndarray, grow: bool):
    out = device.current().xp.empty_like(dynamic)
    launch_tiles(
        "people", "probability", dynamic.shape, belief, dynamic, constant(table), *int32(*dynamic.shape[1:], grow), out
    )
    return out


def _views(geometry: ArrayGeometry):
    return views_table(_seen_from_all(geometry))


@lru_cache(maxsize=64)
def _seen_from_all(geometry: ArrayGeometry) -> list[ArrayGeometry]:
    """The same objects for every frame: their tables are kept by them."""
    return [geometry.seen_from(k) for k in range(geometry.cameras)]


def _cells(cells: Cells) -> list:
    places = np.concatenate([cells.low, np.divide(1, cells.size), cells.last]).astype(np.float32)
    return [device.current().upload(places), *int32(*cells.count)]


def _lattice(plane, stride: int) -> tuple[int, ...]:
    return plane[:, stride // 2 :: stride, stride // 2 :: stride].shape[:3]
