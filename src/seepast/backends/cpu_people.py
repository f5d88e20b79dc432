"""The C++ core under the names of reference_people.py: shapes and glue here, loops in cpp/people*.cpp."""

from __future__ import annotations

import numpy as np

from .. import _core
from ..geometry import ArrayGeometry
from ..people import COLOURS, LEVELS, MOMENTS, SURPRISE, Cells, FieldCosts, Terms
from .cpu import view_arrays
from .host_people import (  # noqa: F401
    potentials_by,
    probability,
    share_histograms,
    sure_labels,
    surface_range,
    within,
)

set_threads = _core.set_threads


def witnesses(dynamic: np.ndarray, surfaces: np.ndarray, geometry: ArrayGeometry, tolerance: float) -> np.ndarray:
    saw = np.empty((*dynamic.shape, len(dynamic)), np.uint8)
    _core.witnesses(*_views(geometry), dynamic, surfaces, tolerance, saw)
    return saw


def disagreement(saw: np.ndarray, step: int) -> float:
    sums = np.empty(2, np.int64)
    _core.disagreement(saw, step, sums)
    low, high = sums.tolist()
    return 1 - low / high if high else 0.0


def sloping(surfaces: np.ndarray, least: float, rows: int, stride: int) -> np.ndarray:
    out = np.empty(_lattice(surfaces, stride), np.uint16)
    _core.sloping(surfaces, least, rows, stride, out)
    return out


def object_grid(saw, surfaces, geometry, cells: Cells, stride, floor) -> tuple[np.ndarray, np.ndarray]:
    mean, sums = np.empty(_lattice(surfaces, stride), np.uint16), np.empty((2, *cells.count), np.int64)
    _core.object_grid(*_views(geometry), geometry.reference, saw, surfaces, _cells(cells), stride, floor, mean, sums)
    return mean, sums


def object_slice(grid: np.ndarray, mean, surfaces, geometry, cells: Cells, stride) -> np.ndarray:
    share = np.empty(mean.shape, np.uint16)
    _core.object_slice(*_views(geometry), geometry.reference, grid, mean, surfaces, _cells(cells), stride, share)
    return share


def border_counts(share, mean, surfaces, thresholds: np.ndarray, step: float, stride: int) -> np.ndarray:
    counts = np.empty((4, len(thresholds)), np.int64)
    _core.border_counts(share, mean, surfaces, thresholds, step, stride, counts)
    return counts


def surprises(colour: np.ndarray, behind: list[np.ndarray], rays: list[np.ndarray], wanted: np.ndarray) -> np.ndarray:
    out = np.empty(wanted.shape, np.uint8)
    for k, (expected, seen) in enumerate(zip(behind, rays, strict=True)):
        _core.surprise(colour[k], expected, seen, wanted[k].view(np.uint8), SURPRISE, out[k])
    return out


def surprise_counts(surprise: np.ndarray, sure: np.ndarray, stride: int) -> np.ndarray:
    counts = np.empty((len(sure), 2, LEVELS), np.int64)
    _core.surprise_counts(surprise, sure, stride, counts)
    return counts


def histograms(dynamic, colour, person, stride) -> tuple[np.ndarray, np.ndarray]:
    levels, colours = np.empty((len(dynamic), 2, LEVELS), np.int64), np.empty((2, COLOURS**3), np.int64)
    _core.people_histograms(dynamic, colour, person, stride, levels, colours)
    return levels, colours


def colour_moments(colour, sure, stride, block) -> np.ndarray:
    K, h, w = sure.shape
    moments = np.empty((K, -(-h // block), -(-w // block), MOMENTS), np.int32)
    _core.colour_moments(colour, sure, stride, block, moments)
    return moments


def log_odds(saw, levels: np.ndarray, stride) -> np.ndarray:
    out = np.empty(_lattice(saw, stride), np.float32)
    _core.log_odds(saw, levels, stride, out)
    return out


def potential(said, dynamic, colour, linear, sure, surprise, behind, terms: Terms, stride, cell) -> np.ndarray:
    u = np.empty(said.shape, np.int16)
    _core.potential(
        said, dynamic, colour, linear, sure, surprise, behind, terms.sure, terms.said, terms.local, terms.colours,
        stride, cell, u,
    )  # fmt: skip
    return u


potentials = potentials_by(potential)


def field(u: np.ndarray, colour, surfaces, costs: FieldCosts, stride) -> np.ndarray:
    belief = np.empty(u.shape, np.int16)
    _core.people_field(u, colour, surfaces, costs.contrast, costs.depth_step, costs.cut, stride, belief)
    return belief


def _views(geometry: ArrayGeometry) -> tuple[np.ndarray, np.ndarray]:
    """The array as seen from each of its cameras: offsets float32 [K, K, 5], centres float32 [K, 2]."""
    return view_arrays(geometry.views)


def _cells(cells: Cells) -> _core.Cells:
    low, size, last = (np.array(v, np.float32) for v in (cells.low, np.divide(1, cells.size), cells.last))
    return _core.Cells(low, size, last, np.array(cells.count, np.int32))


def _lattice(plane: np.ndarray, stride: int) -> tuple[int, int, int]:
    return plane[:, stride // 2 :: stride, stride // 2 :: stride].shape[:3]
