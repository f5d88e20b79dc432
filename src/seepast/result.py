"""What one instant yields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .geometry import ArrayGeometry
from .options import Options


@dataclass(frozen=True, eq=False)
class Result:
    """The static scene in the rectified reference camera (H x W pixels), from one instant of K cameras.

    background  uint8 [H, W, 3] BGR, or [H, W] for grey input: the scene as if the people were not there
    disparity   float32 [H, W] px over the array, f * B / Z (geometry.py); 0 = unknown
    depth       float32 [H, W] metres along the reference camera's z axis; 0 = unknown
    confidence  float32 [H, W] in 0..1, P(|disparity - truth| <= 1 px), calibrated on scenes with truth (confidence.py);
                0 where no camera saw the pixel or the disparity is unknown
    coverage    uint8 [H, W]: how many cameras' static rays the pixel rests on. 0 = no camera saw it: what
                stands there is a guess
    labels      uint16 [H, W]: which rays, bit k = camera k
    masks       K x uint8 [h, w]: 255 * refined P(dynamic), in each camera's own input pixels; the
                masks that came in where there was nothing to refine
    geometry    the view and the array that all of this lives in
    timings     milliseconds per stage
    rounds      EM rounds until the labels stood still
    """

    background: np.ndarray
    disparity: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray
    coverage: np.ndarray
    labels: np.ndarray
    masks: tuple[np.ndarray, ...]
    geometry: ArrayGeometry
    timings: dict[str, float]
    rounds: int
    options: Options
    backend: str
