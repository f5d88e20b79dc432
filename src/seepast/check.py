"""Is a recording fit to be run? Every file is read, the calibration is held against the first images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .datasets import Dataset
from .geometry import ArrayGeometry
from .rectify import measured_row_error, rectify


@dataclass(frozen=True, eq=False)
class Report:
    """What `check` found in a recording whose files are all in order.

    geometry       the rectified array
    frames         number of complete frames
    dynamic_share  mean share of pixels that the masks call dynamic (P >= 0.5); None without masks
    row_error_px   median |dy| of matches in the first frame from the row the calibration predicts; NaN if
                   matches are too few
    """

    geometry: ArrayGeometry
    frames: int
    dynamic_share: float | None
    row_error_px: float


def check(dataset: Dataset, reference: int | str = 0, *, on_frame: Callable[[], None] = lambda: None) -> Report:
    """Read all of `dataset` and measure. Raises DatasetError or RigError for the first thing wrong."""
    rectification = rectify(dataset.rig, dataset.rig.index(reference))
    row_error = float("nan")
    shares = []
    for stamp in dataset.stamps:
        frame = dataset.frame(stamp)
        if stamp == dataset.stamps[0]:
            views = [rectification.image(k, image) for k, image in enumerate(frame.images)]
            row_error = measured_row_error(views, rectification.geometry)
        if frame.masks is not None:
            shares.append(np.mean([(mask >= 128).mean() for mask in frame.masks]))
        on_frame()
    dynamic_share = float(np.mean(shares)) if shares else None
    return Report(rectification.geometry, len(dataset.stamps), dynamic_share, row_error)
