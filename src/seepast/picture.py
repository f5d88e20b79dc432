"""Stage "refocus" of the many-view method: what colour the rays give every pixel."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

import numpy as np

from .geometry import ArrayGeometry
from .many import UNITS
from .options import MultiviewOptions, Options


def picture(
    colour: np.ndarray,
    rays: np.ndarray,
    static: np.ndarray,
    geometry: ArrayGeometry,
    d: np.ndarray,
    keep: np.ndarray,
    options: Options,
    backend: ModuleType,
) -> np.ndarray:
    """Colours: of the rays uint16 [H, W] (`labels`), or continued from around where there are none.

    keep bool [H, W]: own pixels of the reference. No median: it mends the picture of wrong disparities, and blurs that
    of right ones.
    """
    clear, near = backend.clear_of_masks(static), camera_weights(geometry, options.multiview)
    background = backend.blend(colour, rays, clear, near, options.multiview.edge_weight, geometry, d, ~keep)
    seen = rays > 0
    if not seen.all():
        background = backend.fill_unseen(background, seen.view(np.uint8), d.astype(np.float32) / np.float32(UNITS))
    return background


@lru_cache(maxsize=64)
def camera_weights(geometry: ArrayGeometry, o: MultiviewOptions) -> np.ndarray:
    """float32 [K]: 1 / k^camera_falloff, k the distance of camera k in units of the nearest one's."""
    distance = np.linalg.norm(geometry.positions, axis=1)
    unit = distance[distance > 0].min()
    return np.where(distance > 0, (unit / np.maximum(distance, 1e-12)) ** o.camera_falloff, 1).astype(np.float32)
