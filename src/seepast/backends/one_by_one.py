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
    ) -> list[Candidates]:
        """`windows` of disparity uint16 [K, h, w], where bool [K, h, w]."""
        of = self.stages.windows
        return [of(d, here, ratio, grid, reach, spread, shape) for d, here in zip(disparity, where, strict=True)]

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
    ) -> Iterator[np.ndarray]:
        """`votes` of n views, made when they are asked for."""
        each = zip(costs, statics, views, candidates, skips, strict=True)
        return (
            self.stages.votes(volume, disparities, confidence, static, view, of, skip, weights)
            for volume, static, view, of, skip in each
        )

    def witnesses_of_views(
        self, found: np.ndarray, static: np.ndarray, views: Sequence[ArrayGeometry], tolerance: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """`witnesses` of all views, found uint16 [K, H, W], each but itself: uint8 and bool [K, H, W]."""
        agree, farther = zip(
            *(self.stages.witnesses(found[k], found, static, view, k, tolerance) for k, view in enumerate(views)),
            strict=True,
        )
        return np.stack(agree), np.stack(farther)

    def planes_of_views(
        self, found: np.ndarray, agree: np.ndarray, colour: np.ndarray, static: np.ndarray
    ) -> np.ndarray:
        """`planes` of all views, where none of the others agrees (agree uint8 [K, H, W]): uint16 [K, H, W]."""
        of, sure = self.stages.planes, agree > 0
        return np.stack([
            of(found[k], sure[k] & static[k], ~sure[k], colour[k], static[k]) for k in range(len(found))
        ])  # fmt: skip
