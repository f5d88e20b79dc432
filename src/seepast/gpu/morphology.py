"""Masks on the device, dilated and eroded by rectangles."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import device

MOST_REACH = 16  # px, of one launch


def dilated(masks: Any, across: int, down: int | None = None) -> Any:
    """bool [.., H, W]: pixels within `across` columns and `down` rows, or as many, of one that is set."""
    return _grown(masks, across, across if down is None else down, False)


def eroded(masks: Any, reach: int) -> Any:
    """bool [.., H, W]: pixels with none that is not set within `reach` rows and columns; outside does not count."""
    return _grown(masks, reach, reach, True)


def _grown(masks: Any, across: int, down: int, invert: bool) -> Any:
    """A rectangle of rectangles is a rectangle: long ways go in steps. One launch each, the first of which makes a
    copy."""
    used, (height, width) = device.current(), masks.shape[-2:]
    views = masks.size // (height * width)
    first = True
    while first or across or down:
        step, out = (min(across, MOST_REACH), min(down, MOST_REACH)), used.xp.empty_like(masks)
        used.launch(
            "morphology", "grow",
            grid=(-(-width // 32), -(-height // 32), views), block=(32, 8),
            args=[masks, *(np.int32(n) for n in (height, width, *step, invert)), out],
        )  # fmt: skip
        masks, across, down, first = out, across - step[0], down - step[1], False
    return masks
