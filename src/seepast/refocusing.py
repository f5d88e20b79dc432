"""Plain synthetic aperture refocusing of whole recordings: the baseline that people know."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .datasets import Dataset
from .errors import OptionsError, OutputError
from .export.atomic import write_png
from .focal import refocus_at
from .geometry import ArrayGeometry
from .rectify import rectify


def refocus_sequence(
    dataset: Dataset,
    out: str | Path,
    *,
    depth: float | None = None,
    disparity: float | None = None,
    reference: int | str = 0,
    overwrite: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> float:
    """Plain synthetic aperture refocusing of every frame on one plane, to out/<stamp>.png.

    The plane is `depth` in metres or `disparity` in px over the full array; returns that disparity. Where the
    dataset has masks, only static rays are averaged. Raises OptionsError, OutputError, DatasetError.
    """
    out = Path(out)
    rectification = rectify(dataset.rig, dataset.rig.index(reference))
    plane = _plane_disparity(rectification.geometry, depth, disparity)
    there = [stamp for stamp in dataset.stamps if (out / f"{stamp}.png").exists()]
    if there and not overwrite:
        raise OutputError(f"{out / there[0]}.png: is there already; add --overwrite or name another folder")
    for stamp in dataset.stamps:
        frame = dataset.frame(stamp)
        views = [rectification.image(k, image) for k, image in enumerate(frame.images)]
        dynamic = None
        if frame.masks is not None:
            dynamic = np.stack([rectification.dynamic(k, mask) for k, mask in enumerate(frame.masks)])
        write_png(out / f"{stamp}.png", refocus_at(views, rectification.geometry, plane, dynamic))
        on_frame()
    return plane


def _plane_disparity(geometry: ArrayGeometry, depth: float | None, disparity: float | None) -> float:
    if (depth is None) == (disparity is None):
        raise OptionsError("refocusing needs one plane: give either --depth M or --disparity PX")
    if depth is not None:
        if not (math.isfinite(depth) and depth > 0):
            raise OptionsError(f"--depth {depth}: give a distance in metres above 0")
        return geometry.focal_baseline / depth
    assert disparity is not None
    if not (math.isfinite(disparity) and disparity >= 0):
        raise OptionsError(f"--disparity {disparity}: give px over the full array, 0 or more")
    return disparity
