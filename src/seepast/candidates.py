"""What disparities are chosen from: the grid of candidates, what of it every pixel is matched at, the planar prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import OptionsError
from .options import PriorOptions, RangeOptions

EIGHTHS = 8  # disparities of candidates and of the prior mean are whole eighths of a pixel
CHUNK = 16  # neighbouring candidates that are matched together
CELL = (16, 32)  # rows, columns: pixels of one cell share the candidates of the support points around them


@dataclass(frozen=True)
class DisparityGrid:
    """Candidate disparities d_i = (first + i * step) / 8 px over the full array, i = 0 .. count - 1."""

    first: int
    step: int
    count: int

    @staticmethod
    def of(options: RangeOptions, width: int) -> DisparityGrid:
        """The grid that `options` asks for in images `width` px wide. Raises OptionsError if it is empty."""
        low, high = options.min_disparity, options.max_disparity or 0.45 * width
        if high <= low:
            raise OptionsError(
                f"options range.min_disparity ({low:g} px) and range.max_disparity ({high:g} px) leave nothing between"
            )
        step = max(1, round(EIGHTHS * options.step))
        first = round(EIGHTHS * low)
        return DisparityGrid(first, step, int((round(EIGHTHS * high) - first) // step) + 1)

    @property
    def values(self) -> np.ndarray:
        """float32 [count] px."""
        return (np.float32(self.first) + np.float32(self.step) * np.arange(self.count, dtype=np.float32)) / EIGHTHS


@dataclass(frozen=True, eq=False)
class Candidates:
    """Which of the grid every pixel of a view is matched at, in chunks of CHUNK neighbouring candidates.

    grid    grid.count is a multiple of CHUNK, at most 64 of them
    active  uint64 [H, W], bit j: candidates CHUNK j .. CHUNK (j + 1) - 1. A pixel without any is not matched at all
    start   int32 [H W + 1]: the chunks of pixel p = y W + x are the rows of a volume uint8 [start[-1], CHUNK] from
            start[p] on, the farthest (lowest j) first
    """

    grid: DisparityGrid
    active: np.ndarray
    start: np.ndarray

    @staticmethod
    def of(grid: DisparityGrid, active: np.ndarray) -> Candidates:
        bits = np.unpackbits(np.ascontiguousarray(active).reshape(-1, 1).view(np.uint8), axis=-1)
        start = np.zeros(active.size + 1, np.int32)
        np.cumsum(bits.sum(-1, dtype=np.int32), out=start[1:])
        return Candidates(grid, active, start)

    @staticmethod
    def all(grid: DisparityGrid, shape: tuple[int, int]) -> Candidates:
        """Every pixel at the whole grid."""
        chunks = grid.count // CHUNK
        active = np.full(shape, (1 << chunks) - 1, np.uint64)
        return Candidates(grid, active, chunks * np.arange(active.size + 1, dtype=np.int32))

    def where(self, wanted: np.ndarray) -> Candidates:
        """Those of the pixels of `wanted`, bool [H, W]: rows of the same volume."""
        return Candidates(self.grid, np.where(wanted, self.active, np.uint64(0)), self.start)

    @property
    def chunks(self) -> int:
        """Rows of a volume."""
        return int(self.start[-1])

    @property
    def rows(self) -> np.ndarray:
        """Rows of the active chunks, pixel by pixel: int [n]."""
        mask = self.mask[..., ::CHUNK].reshape(self.active.size, -1)
        return (self.start[:-1, None] + mask.cumsum(1) - 1)[mask]

    @property
    def mask(self) -> np.ndarray:
        """bool [H, W, count]: the candidates of every pixel."""
        chunks = np.arange(self.grid.count // CHUNK, dtype=np.uint64)
        return (self.active[..., None] >> chunks & np.uint64(1)).astype(bool).repeat(CHUNK, -1)


@dataclass(frozen=True, eq=False)
class Prior:
    """p(d | T, x): the plane means mu(x) and the candidate disparities of every cell.

    mean   int32 [H, W], mu in eighths of a pixel of disparity
    cells  uint8 [ceil(H/16), ceil(W/32), count], 1 = candidate for every pixel of the cell
    """

    mean: np.ndarray
    cells: np.ndarray


def prior_energy(options: PriorOptions) -> np.ndarray:
    """-log[gamma + exp(-(d - mu)^2 / (2 sigma^2))] for |d - mu| = 0, 1/8, 2/8 ... px; the last entry is the tail.

    float32; index min(8 |d - mu|, len - 1).
    """
    reach = int(np.ceil(EIGHTHS * 6 * options.sigma)) + 1
    t = np.arange(reach) / EIGHTHS
    energy = -np.log(options.gamma + np.exp(-(t**2) / (2 * options.sigma**2)))
    return np.append(energy, -np.log(options.gamma)).astype(np.float32)
