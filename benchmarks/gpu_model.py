"""What a frame costs a GPU, counted: operations, bytes of device memory and launches per kernel, and the time that this
bounds on a GPU of given peaks.

Operations are instructions of a thread in the machine code for compute capability 9.0 (inner loops times their trips),
bytes those that must cross device memory once; both per unit of work, below. The units (pixels, candidates, what people
hide) are counted while the cpu backend reconstructs the very frame: all backends do the same work.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from seepast import multiview
from seepast.backends import cpu_multiview
from seepast.candidates import CHUNK
from seepast.confidence import ray_count
from seepast.frames import Frame
from seepast.geometry import ArrayGeometry
from seepast.options import Options
from seepast.pipeline import Clock

MICROSECONDS_PER_LAUNCH = 4.0  # of the model: what lies between two kernels
REACHED = (0.5, 0.8)  # of the model: parts of the peak of operations and of memory that good kernels reach


@dataclass(frozen=True)
class Gpu:
    """Peaks from data sheets: lanes (multiprocessors x 128), clock in GHz, memory in GB/s."""

    name: str
    lanes: int
    clock: float
    memory: float

    def bound(self, work: Work) -> float:
        """Least ms for one kernel's work."""
        return max(work.operations / (self.lanes * self.clock * 1e6), work.bytes / (self.memory * 1e6))

    def modelled(self, work: Work) -> float:
        """Ms with REACHED parts of the peaks, and the launches."""
        of_operations, of_memory = REACHED
        computing = work.operations / (of_operations * self.lanes * self.clock * 1e6)
        moving = work.bytes / (of_memory * self.memory * 1e6)
        return max(computing, moving) + 1e-3 * MICROSECONDS_PER_LAUNCH * work.launches


GPUS = (
    Gpu("H200", 132 * 128, 1.75, 4800),
    Gpu("Jetson AGX Orin", 16 * 128, 1.3, 204.8),
    Gpu("GTX 1060", 10 * 128, 1.7, 192),
)


@dataclass
class Work:
    """Of one kernel, or several that belong together, in a frame."""

    operations: float = 0
    bytes: float = 0
    launches: int = 0

    def add(self, units: float, operations: float, moved: float, launches: int = 0) -> None:
        self.operations += units * operations
        self.bytes += units * moved
        self.launches += launches


@dataclass
class Counted:
    """The many-view stages of the cpu backend, which count what their kernels would do on a GPU."""

    cameras: int
    kernels: dict[str, Work] = field(default_factory=lambda: defaultdict(Work))

    def stages(self) -> Any:
        """For multiview.see_past."""
        counting = {name: getattr(self, name) for name in dir(self) if hasattr(cpu_multiview, name)}
        return SimpleNamespace(**{**vars(cpu_multiview), **counting})

    def describe(self, colour, static):
        self.kernels["census"].add(static.size, 550, 28, 1)
        return cpu_multiview.describe(colour, static)

    def windows_of_views(self, disparity, where, ratio, grid, reach, spread, shape, within=None, whole=-1):
        self.kernels["windows"].add(disparity.size, 390, 11, 3)
        self.kernels["windows"].add(len(disparity) * np.prod(shape), 160, 20)
        return cpu_multiview.windows_of_views(disparity, where, ratio, grid, reach, spread, shape, within, whole)

    def volumes(self, features, views, candidates, costs):
        for of in candidates:
            per_ray = 58 if self.cameras <= 5 else 75
            self.kernels["volume"].add(CHUNK * of.chunks, per_ray * (self.cameras - 1), 1)
            self.kernels["volume"].add(of.active.size, 0, 16 * self.cameras)
        self.kernels["volume"].launches += 2
        return cpu_multiview.volumes(features, views, candidates, costs)

    def aggregates(self, costs, images, static, candidates, penalties, paths=8, otherwise=None):
        for of in candidates:
            self._smoothing(of, paths, otherwise is None)
        self.kernels["paths"].launches += 3
        return cpu_multiview.aggregates(costs, images, static, candidates, penalties, paths, otherwise)

    def aggregate(self, costs, image, static, candidates, penalties, paths=8, otherwise=None):
        self._smoothing(candidates, paths, otherwise is None)
        self.kernels["paths"].launches += 3
        return cpu_multiview.aggregate(costs, image, static, candidates, penalties, paths, otherwise)

    def _smoothing(self, candidates, paths: int, everywhere: bool) -> None:
        active = np.count_nonzero(candidates.active)
        chunks = int(np.unpackbits(np.ascontiguousarray(candidates.active).view(np.uint8)).sum())
        more = max(0.0, chunks / max(active, 1) - 2) / 2  # pairs of chunks beyond the first
        self.kernels["paths"].add(paths * active, 910 + 370 * more, 16)
        self.kernels["paths"].add(paths * chunks, 0, 2 * CHUNK)
        self.kernels["winners"].add(chunks, 240 + 70 * (paths == 8), CHUNK * (1 + paths))
        self.kernels["winners"].add(candidates.active.size, 0, 14)
        self.kernels["median"].add(candidates.active.size, 0, 4 if everywhere else 12)
        self.kernels["median"].add(candidates.active.size if everywhere else active, 430, 0)

    def votes_of_views(self, costs, disparities, confidence, statics, views, candidates, skips, weights, outs=None):
        for of, static in zip(candidates, statics, strict=True):
            self._voting(of, static, weights)
        self.kernels["votes"].launches += 1
        given = costs, disparities, confidence, statics, views, candidates, skips, weights, outs
        return cpu_multiview.votes_of_views(*given)

    def votes(self, costs, disparities, confidence, static, geometry, candidates, skip, weights, out=None):
        self._voting(candidates, static, weights)
        self.kernels["votes"].launches += 1
        return cpu_multiview.votes(costs, disparities, confidence, static, geometry, candidates, skip, weights, out)

    def _voting(self, candidates, static, weights) -> None:
        active = candidates.active if weights.visible else candidates.active[~static]
        polled = CHUNK * int(np.unpackbits(np.ascontiguousarray(active).view(np.uint8)).sum())
        self.kernels["votes"].add(polled, 27 * (self.cameras - 1) + 55, 2)
        self.kernels["votes"].add(candidates.active.size, 0, 13 + 3 * self.cameras)

    def graded_of_views(self, found, static, views, tolerance, lone, doubtful, candidates=None):
        if candidates is None:
            asked = found.size
        else:
            asked = sum(np.count_nonzero(of.active) for of in candidates if of is not None)
        self.kernels["graded"].add(asked, 73 * (self.cameras - 1) + 95, 5, 1)
        self.kernels["graded"].add(found.size, 0, 4)
        return cpu_multiview.graded_of_views(found, static, views, tolerance, lone, doubtful, candidates)

    def witnesses(self, disparity, disparities, static, geometry, skip, tolerance):
        self.kernels["graded"].add(disparity.size, 73 * (self.cameras - 1) + 60, 4 + 3 * self.cameras, 1)
        return cpu_multiview.witnesses(disparity, disparities, static, geometry, skip, tolerance)

    def planes_of_views(self, found, sure, colour, static):
        self.kernels["planes"].add(np.count_nonzero(~sure), 6950, 0, 1)
        self.kernels["planes"].add(found.size, 160, 9)
        return cpu_multiview.planes_of_views(found, sure, colour, static)

    def planes(self, disparity, trusted, wanted, image, static):
        self.kernels["planes"].add(np.count_nonzero(wanted), 6950, 0, 1)
        self.kernels["planes"].add(disparity.size, 160, 9)
        return cpu_multiview.planes(disparity, trusted, wanted, image, static)

    def labels(self, disparity, disparities, static, geometry, tolerance, wanted=None):
        asked = disparity.size if wanted is None else np.count_nonzero(wanted)
        self.kernels["labels"].add(asked, 77 * self.cameras + 60, 2 + 3 * self.cameras, 1)
        self.kernels["labels"].add(disparity.size, 0, 6)
        return cpu_multiview.labels(disparity, disparities, static, geometry, tolerance, wanted)

    def blend(self, colour, rays, clear, near, edge, geometry, disparity, wanted):
        used = int(ray_count(rays)[wanted].sum())
        self.kernels["blend"].add(used, 450, 0, 1)
        self.kernels["blend"].add(rays.size, 40, 8 + 4 * self.cameras)
        return cpu_multiview.blend(colour, rays, clear, near, edge, geometry, disparity, wanted)

    def evidence(self, d, static, close, shown):
        self.kernels["evidence"].add(d.size, 337, 7, 2)
        return cpu_multiview.evidence(d, static, close, shown)

    def averaged(self, colour, static, size, scale):
        small = len(colour) * size[0] * size[1]
        self.kernels["levels"].add(small, 15 * scale**2 + 60, 4 * scale**2 + 4, 1)
        return cpu_multiview.averaged(colour, static, size, scale)

    def half_rows(self, colour, static):
        self.kernels["levels"].add(static.size // 2, 45, 12, 1)
        return cpu_multiview.half_rows(colour, static)

    def double_rows(self, views, height):
        self.kernels["levels"].add(len(views) * height * views.shape[2], 30, 3, 1)
        return cpu_multiview.double_rows(views, height)

    def enlarged(self, views, ratio, shape, factor=1):
        self.kernels["levels"].add(len(views) * np.prod(shape), 45, 3, 1)
        return cpu_multiview.enlarged(views, ratio, shape, factor)

    def beside(self, views, across, down):
        turns = -(-max(across, down) // 16)
        self.kernels["levels"].add(views.size, turns * 110 + 14 * down, 3, turns)
        return cpu_multiview.beside(views, across, down)

    def told(self, d, evidence, table, shown, keep=None):
        self.kernels["evidence"].add(d.size, 19, 5, 1)  # probability
        self.kernels["evidence"].add(d.size, 10, 14, 2)  # disparity in px, by CuPy
        return cpu_multiview.told(d, evidence, table, shown, keep)

    def fill_unseen(self, background, coverage, disparity):
        self.kernels["blend"].add(coverage.size, 21, 1, 1)
        return cpu_multiview.fill_unseen(background, coverage, disparity)

    def witnessed(self, hidden, disparities, static, geometry, most, tolerance):
        self.kernels["levels"].add(hidden.size, 25, 6, 2)
        self.kernels["levels"].add(np.count_nonzero(hidden), 111 * self.cameras, 0)
        return cpu_multiview.witnessed(hidden, disparities, static, geometry, most, tolerance)

    def landings(self, hidden, low, high, geometry):
        self.kernels["levels"].add(hidden.size, 25, 6, 2)
        self.kernels["levels"].add(np.count_nonzero(hidden), 111 * self.cameras, 0)
        return cpu_multiview.landings(hidden, low, high, geometry)

    def clear_of_masks(self, static):
        self.kernels["levels"].add(static.size, 25, 2, 1)
        return cpu_multiview.clear_of_masks(static)

    def inner_span(self, disparity, agree, static, scale, reach, percentiles):
        self.kernels["levels"].add(disparity.size, 30, 4, 3)
        return cpu_multiview.inner_span(disparity, agree, static, scale, reach, percentiles)


def counted(frame: Frame, geometry: ArrayGeometry, options: Options) -> dict[str, Work]:
    """Work by kernel of one frame of rectified views."""
    counts = Counted(geometry.cameras)
    cubic = options.rectify.interpolation == "cubic"
    counts.kernels["rectify"].add(frame.dynamic.size, 620 if cubic else 250, 16, 1)  # of images and masks
    counts.kernels["rectify"].add(frame.dynamic.size, 130, 10, 1)  # of masks, back
    counts.kernels["evidence"].add(frame.dynamic[0].size, 37, 8, 1)  # depth
    multiview.see_past(frame, geometry, options, counts.stages(), False, Clock())
    return dict(counts.kernels)
