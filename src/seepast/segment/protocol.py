"""What every segmenter looks like to the rest of seepast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np


class Segmenter(Protocol):
    """Says where in the images of one instant something may move.

    Called with the K images of one instant, uint8 [h, w] grey or [h, w, 3] BGR in the cameras' own pixels, it returns
    K masks of the same sizes: uint8 255 * P(dynamic), or bool, or float P(dynamic) in 0..1.
    """

    def __call__(self, images: Sequence[np.ndarray]) -> Sequence[np.ndarray]: ...

    def describe(self) -> Mapping[str, Any]:
        """What determines the masks, for run.json: names, settings, hashes. An output made with a segmenter that
        describes itself otherwise is not gone on with."""
        ...
