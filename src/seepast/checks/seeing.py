"""How wide a person can be and still be seen past: plain geometry of a line of cameras.

Cameras stand on the x axis at c_k, a person is an opaque strip of width w parallel to it at depth z, and behind,
at depth b > z, lies the background. The ray from camera k to the background point P crosses the person's plane at

    u_k = c_k + (P - c_k) z / b = c_k (1 - z / b) + P z / b,

that is: on the person's plane, the crossings of one background point are the array itself, shrunk by (1 - z / b)
and moved along with P. So

* P is hidden from every camera only if all crossings fall on the strip, which asks for w >= A (1 - z / b), with A
  the aperture, the distance between the outermost cameras. A person narrower than that hides no point from all:
  `widest_seen_past`.
* P is seen by two cameras at least unless K - 1 crossings or more fall on the strip. K - 1 neighbours span
  least without one of the outermost cameras: the same with A less the larger of the two outermost gaps,
  `aperture_for_two`. Two rays are what it takes to measure the depth of P.
* Of a wider person, the points that a camera does not see have its crossing on the strip: an interval of
  length w. Those that no camera sees have all crossings there: an interval of length w - A (1 - z / b). Hence
  `unseen_share`, whichever camera is the reference and wherever the person stands.

Left out: the borders of the views (a ray may end outside its image), other people in the way, and offsets of the
cameras off their line, which are small beside A in any array that `rectify` accepts without a warning.
"""

from __future__ import annotations

import numpy as np


def shrunk(depth: float | np.ndarray, background: float) -> float | np.ndarray:
    """1 - z / b: how much of the array's extent is left on the person's plane; 0 for a person behind b."""
    return np.maximum(0.0, 1.0 - np.asarray(depth, np.float64) / background)


def aperture(along: np.ndarray) -> float:
    """Metres between the outermost cameras, from their places float64[K] along the line."""
    return float(np.ptp(along))


def aperture_for_two(along: np.ndarray) -> float:
    """Metres that K - 1 neighbouring cameras span at least; 0 for two cameras."""
    ordered = np.sort(along)
    return float(min(ordered[-1] - ordered[1], ordered[-2] - ordered[0]))


def widest_seen_past(along: np.ndarray, depth: float, background: float, cameras: int = 1) -> float:
    """The widest person, metres, of whose background every point is seen by `cameras` (1 or 2) at least.

    along       float64[K], metres: the cameras' places along their line
    depth       of the person, and background: of what is behind, metres from the line
    """
    span = aperture(along) if cameras == 1 else aperture_for_two(along)
    return float(span * shrunk(depth, background))


def unseen_share(along: np.ndarray, width: float, depth: float, background: float) -> float:
    """Share, 0..1, of the background points hidden from one camera by a person that no camera sees."""
    return max(0.0, 1.0 - widest_seen_past(along, depth, background) / width)
