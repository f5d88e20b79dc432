"""What the other cameras see behind objects that may be people: gaps of an object show that, a person does not.

Background subtraction from one instant. With all objects left out, bodies and what they fatten alike, the static scene
behind them is found as for the picture, only coarsely, and every camera's pixels there are predicted by the rays of the
others. How much they differ tells arms from the gaps beside them, and hair that a network missed from a wall. Beside
the objects, where the scene is in sight, the same comparison shows how well such predictions hold here (people.py).
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np

from .geometry import ArrayGeometry
from .levels import Level, Pictures
from .many import UNITS
from .options import Options
from .picture import camera_weights
from .rectify import NO_RAY
from .surfaces import Surfaces, looks, static_span

BESIDE = 8  # px beside objects that are predicted, too

# of a level and the span of its disparities: those of all views, uint16 [K, h, w] (multiview.unhidden)
Unhidden = Callable[[Level, tuple[float, float], Options, ModuleType], np.ndarray]


def surprise(
    dynamic: np.ndarray,
    pictures: Pictures,
    seen: Surfaces,
    geometry: ArrayGeometry,
    options: Options,
    backend: ModuleType,
    people: ModuleType,
    unhidden: Unhidden,
    objects: np.ndarray,
    stride: int,
) -> np.ndarray:
    """How much pixels in and beside `objects` differ from what other cameras see behind: levels uint8 [K, H, W] of
    people.LEVELS; people.NO_SAY elsewhere, and where no other camera sees anything.

    dynamic  uint8 [K, H, W]: NO_RAY where a view has no source pixel
    objects  uint8 [K, h, w]: 1 where every stride-th pixel lies on an object (people.object_region)
    """
    has_ray = dynamic != NO_RAY
    hidden = backend.enlarged(objects.view(bool), stride, dynamic.shape[1:])
    static, wanted = has_ray & ~hidden, has_ray & backend.beside(hidden, BESIDE, BESIDE)
    without = Pictures(pictures.colour, static, geometry, backend)
    d = disparities(without, seen, static, geometry, options, backend, unhidden)
    o = options.multiview
    clear, tolerance = backend.clear_of_masks(static), round(UNITS * o.label_tolerance)
    expected, rays = [], []
    for k, view in enumerate(geometry.views):
        others = backend.copied(static)
        others[k] &= ~wanted[k]  # what it sees itself is no prediction
        shown, _, _ = backend.labels(d[k], d, others, view, tolerance, wanted[k])
        near = camera_weights(view, o)
        expected.append(backend.blend(pictures.colour, shown, clear, near, o.edge_weight, view, d[k], wanted[k]))
        rays.append(shown)
    return people.surprises(pictures.colour, expected, rays, wanted)


def disparities(
    without: Pictures,
    seen: Surfaces,
    static: np.ndarray,
    geometry: ArrayGeometry,
    options: Options,
    backend: ModuleType,
    unhidden: Unhidden,
) -> np.ndarray:
    """D_k of the static scene in all views, looked for as coarsely as surfaces are at first: uint16 [K, H, W]."""
    look, shape = looks(geometry, options)[0], static.shape[1:]
    span = static_span(seen, static, geometry, options, backend)
    found = unhidden(without.level(look.scale, look.half_rows), span, options, backend)
    rows = shape[0] // (1 + look.half_rows)
    d = backend.enlarged(found, look.scale, (rows, shape[1]), look.scale)
    return backend.double_rows(d, shape[0]) if look.half_rows else d
