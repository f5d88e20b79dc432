"""The many-view stages of all views by those of one view, for backends that take one view after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from ..candidates import Candidates, DisparityGrid
from ..geometry import ArrayGeometry
from ..many import PairCosts, Penalties, VoteWeights


@dataclass(frozen=True)
class OneByOne:
    """Of the module `stages`. views: the array as seen from every camera, or from those that are asked for."""

    stages: ModuleType

    def windows_of_views(
        self,
        disparity: np.ndarray,
        where: np.ndarray,
        ratio: int,
        grid: DisparityGrid,
        reach: int,
        spread: int,
        shape: tuple[int, ...],
        within: np.ndarray | None = None,
        whole: int = -1,
    ) -> list[Candidates]:
        """`windows` of disparity uint16 [K, h, w], where bool [K, h, w]; within bool [K, H, W], of all views but
        `whole`."""
        kept = [None if within is None or k == whole else within[k] for k in range(len(disparity))]
        of = self.stages.windows
        given = zip(disparity, where, kept, strict=True)
        return [of(d, here, ratio, grid, reach, spread, shape, inside) for d, here, inside in given]

    def volumes(
        self, features: object, views: Sequence[ArrayGeometry], candidates: Sequence[Candidates], costs: PairCosts
    ) -> Iterator[np.ndarray]:
        """`volume` of every view, made when it is asked for."""
        return (self.stages.volume(features, view, of, costs) for view, of in zip(views, candidates, strict=True))

    def aggregates(
        self,
        costs: Iterable[np.ndarray],
        images: Sequence[np.ndarray],
        static: Sequence[np.ndarray],
        candidates: Sequence[Candidates],
        penalties: Penalties,
        paths: int = 8,
        otherwise: Sequence[np.ndarray] | None = None,
    ) -> np.ndarray:
        """`aggregate` of n views: uint16 [n, H, W]."""
        kept = [None] * len(images) if otherwise is None else otherwise
        return np.stack([
            self.stages.aggregate(volume, image, still, of, penalties, paths, else_)
            for volume, image, still, of, else_ in zip(costs, images, static, candidates, kept, strict=True)
        ])  # fmt: skip

    def votes_of_views(
        self,
        costs: Sequence[np.ndarray],
        disparities: np.ndarray,
        confidence: np.ndarray,
        statics: Sequence[np.ndarray],
        views: Sequence[ArrayGeometry],
        candidates: Sequence[Candidates],
        skips: Sequence[int],
        weights: VoteWeights,
        outs: Sequence[np.ndarray] | None = None,
    ) -> Iterator[np.ndarray]:
        """`votes` of n views, made when they are asked for; `outs`, where they go, may be `costs`."""
        places: Sequence[np.ndarray | None] = [None] * len(views) if outs is None else outs
        each = zip(costs, statics, views, candidates, skips, places, strict=True)
        return (
            self.stages.votes(volume, disparities, confidence, static, view, of, skip, weights, out)
            for volume, static, view, of, skip, out in each
        )

    def graded_of_views(
        self,
        found: np.ndarray,
        static: np.ndarray,
        views: Sequence[ArrayGeometry],
        tolerance: int,
        lone: int,
        doubtful: int,
        candidates: Sequence[Candidates | None] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`graded` of all views, found uint16 [K, H, W]: uint8 and bool [K, H, W]. candidates: nothing is asked of a
        view that has None, and everything if there are none at all."""
        confidence, sure = np.zeros(found.shape, np.uint8), np.zeros(found.shape, bool)
        for k, view in enumerate(views):
            of = None if candidates is None else candidates[k]
            if candidates is None or of is not None:
                given = found[k], found, static, view, tolerance, lone, doubtful, of
                confidence[k], sure[k] = self.stages.graded(*given)
        return confidence, sure

    def planes_of_views(
        self, found: np.ndarray, sure: np.ndarray, colour: np.ndarray, static: np.ndarray
    ) -> np.ndarray:
        """`planes` of all views, where they are not sure (bool [K, H, W], of `graded`): uint16 [K, H, W]."""
        of = self.stages.planes
        return np.stack([
            of(found[k], sure[k] & static[k], ~sure[k], colour[k], static[k]) for k in range(len(found))
        ])  # fmt: skip
