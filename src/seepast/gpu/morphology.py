"""Masks on the device, dilated and eroded by squares."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import device

MOST_REACH = 16  # px, of one launch


def dilated(masks: Any, reach: int) -> Any:
    """bool [.., H, W]: pixels within `reach` rows and columns of one that is set."""
    return _grown(masks, reach, False)


def eroded(masks: Any, reach: int) -> Any:
    """bool [.., H, W]: pixels with none that is not set within `reach` rows and columns; outside does not count."""
    return _grown(masks, reach, True)


def _grown(masks: Any, reach: int, invert: bool) -> Any:
    """A square of squares is a square: long ways go in steps. One launch each, the first of which makes a copy."""
    used, (height, width) = device.current(), masks.shape[-2:]
    views = masks.size // (height * width)
    first = True
    while first or reach:
        step, out = min(reach, MOST_REACH), used.xp.empty_like(masks)
        used.launch(
            "morphology", "grow",
            grid=(-(-width // 32), -(-height // 32), views), block=(32, 8),
            args=[masks, np.int32(height), np.int32(width), np.int32(step), np.int32(invert), out],
        )  # fmt: skip
        masks, reach, first = out, reach - step, False
    return masks
