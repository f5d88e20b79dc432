"""Checks of the masks: what they hold, whether the cameras agree, and what they leave for nobody to see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..focal import DYNAMIC
from ..geometry import ArrayGeometry
from ..matching import Matches
from ..rectify import NO_RAY
from .lines import Line, Verdict, line, verdict_of

BINARY = 128  # input masks: 255 * P(dynamic) of at least this is dynamic
GRID = 160  # px across at which objects are compared
STEPS = 160  # disparities tried
LEAST_INSIDE = 0.5  # of an object's rays must end inside the other views for a disparity to count
DISAGREEMENT = (0.15, 0.35)  # medians over the README's scenes: exact 0.01, good 0.10, network 0.11, poor 0.41
OUTLINE = 9  # px around people where a match may be theirs: half of what the matching looks at
NEIGHBOURS = 9  # static matches whose median is the background's disparity at a hidden pixel


@dataclass(frozen=True, eq=False)
class MaskFigures:
    """What the K masks of one frame hold, float64 or bool [K].

    share  of pixels called dynamic (P >= 0.5); unsure: of those neither nearly 0 nor nearly 1
    zero, full  nothing at all is dynamic, or everything; ones: only 0 and 1 are there, as in boolean masks
    """

    share: np.ndarray
    unsure: np.ndarray
    zero: np.ndarray
    full: np.ndarray
    ones: np.ndarray


def mask_figures(masks: Sequence[np.ndarray]) -> MaskFigures:
    """masks: K uint8 [h, w] of 255 * P(dynamic), as they lie in the recording."""
    share = [float((m >= BINARY).mean()) for m in masks]
    unsure = [float(((m > 12) & (m < 243)).mean()) for m in masks]
    lowest, highest = np.array([m.min() for m in masks]), np.array([m.max() for m in masks])
    return MaskFigures(np.array(share), np.array(unsure), highest == 0, lowest == 255, highest == 1)


def content_line(frames: Sequence[MaskFigures], names: Sequence[str]) -> Line:
    """One line for all masks of the recording."""
    if not frames:
        return line(
            "masks", "none: nothing is taken for dynamic", "unknown", "give masks of what moves: --masks FOLDER"
        )
    share = np.array([f.share for f in frames])
    total = share.size
    zero, full, ones = (int(np.sum([getattr(f, kind) for f in frames])) for kind in ("zero", "full", "ones"))
    verdict, remedy = _content_verdict(share, zero / total, full / total, ones)
    unsure = float(np.mean([f.unsure for f in frames]))
    odd = [(zero, "all 0"), (full, "all 255"), (ones, "of 0 and 1 only")]
    odd_text = "".join(f"; {count} of {total} {what}" for count, what in odd if count)
    return line(
        "masks",
        f"{100 * share.mean():.1f} % dynamic ({100 * share.min():.1f} to {100 * share.max():.1f} %), "
        f"{100 * unsure:.1f} % unsure{odd_text}",
        verdict,
        remedy,
        share=float(share.mean()),
        share_by_camera=dict(zip(names, share.mean(axis=0).tolist(), strict=True)),
        unsure=unsure,
        all_0=zero,
        all_255=full,
        only_0_and_1=ones,
        masks=total,
    )


def _content_verdict(share: np.ndarray, zero: float, full: float, ones: int) -> tuple[Verdict, str]:
    """zero, full: shares of the masks; ones: their number."""
    if ones:
        return "bad", "255 means dynamic: multiply masks of 0 and 1 by 255"
    if share.mean() > 0.7:
        return "bad", "nearly everything is called dynamic: do the masks say 255 for static? Invert them"
    if full:
        return "doubtful", "some masks call everything dynamic: was a camera covered, or did the segmenter fail there?"
    if zero == 1:
        return "doubtful", "no mask calls anything dynamic: is nobody there, or did the segmenter fail?"
    if share.mean() > 0.4:
        return "doubtful", "people fill much of the views: step back, or mask less"
    return "good", ""


def disagreement(dynamic: np.ndarray, geometry: ArrayGeometry) -> float:
    """How much the cameras' masks contradict each other, 0 .. 1; NaN where no mask calls anything dynamic.

    dynamic: uint8 [K, H, W], Rectification.dynamic

    An object of one camera (a connected part of its mask) must be found in the other masks at one disparity. Of its
    pixels, the share whose rays are dynamic in the other views, at the disparity where that is most, is its
    agreement; the mean over all objects of all cameras, weighed by area, taken from 1. Thus a false alarm in one
    view counts, and so does a limb that one view misses; what all views miss alike cannot be noticed.
    """
    parts = [_object_agreement(dynamic, geometry.seen_from(k)) for k in range(geometry.cameras)]
    area = np.concatenate([p[0] for p in parts])
    agreed = np.concatenate([p[1] for p in parts])
    return float(1 - (area * agreed).sum() / area.sum()) if area.sum() else float("nan")


def _object_agreement(dynamic: np.ndarray, view: ArrayGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Area and agreement, float64[objects], of what the mask of `view`'s reference calls dynamic."""
    step = max(1, view.size[0] // GRID)
    own = _is_dynamic(dynamic[view.reference, ::step, ::step])
    count, objects = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)
    y, x = np.nonzero(own)
    if not len(y):
        return np.zeros(0), np.zeros(0)
    of = objects[y, x] - 1
    area = np.bincount(of, minlength=count - 1).astype(np.float64)
    best = np.zeros(count - 1)
    for d in np.linspace(0, 0.45 * view.size[0] + abs(view.shifts[:, 0]).max(), STEPS):
        hits, rays = np.zeros(count - 1), np.zeros(count - 1)
        for k in range(view.cameras):
            if k == view.reference:
                continue
            inside, found = _looked_up(dynamic[k], view, k, x * step, y * step, d)
            rays += np.bincount(of, inside, count - 1)
            hits += np.bincount(of, inside & found, count - 1)
        enough = rays >= LEAST_INSIDE * area * (view.cameras - 1)
        best = np.where(enough, np.maximum(best, hits / np.maximum(rays, 1)), best)
    return area, best


def _is_dynamic(dynamic: np.ndarray) -> np.ndarray:
    return (dynamic >= DYNAMIC) & (dynamic != NO_RAY)


def _looked_up(dynamic: np.ndarray, view: ArrayGeometry, camera: int, x, y, d) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of reference pixels (x, y) at disparity d end inside `camera`'s view; whether dynamic there."""
    width, height = view.size
    u, v = (np.rint(p).astype(int) for p in view.warp(camera, x, y, np.broadcast_to(np.float32(d), np.shape(x))))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    value = dynamic[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    inside &= value != NO_RAY
    return inside, _is_dynamic(value)


def disagreement_line(values: Sequence[float]) -> Line:
    """`values`: disagreement of the frames that were looked at."""
    known = [v for v in values if v == v]
    if not known:
        return line("masks, agreement", "nothing to compare: no mask calls anything dynamic", "unknown", "see masks")
    mean = float(np.mean(known))
    return line(
        "masks, agreement",
        f"{100 * mean:.0f} % of what one camera calls dynamic is static to the others",
        verdict_of(mean, *DISAGREEMENT),
        "the segmenter misses limbs or sees people who are not there: try a better one; the preset accurate repairs "
        "much of it, paper does not",
        disagreement=mean,
    )


@dataclass(frozen=True, eq=False)
class Hidden:
    """Every `step`-th pixel of the reference that a mask hides: (x, y), int [N], and how many cameras see behind."""

    x: np.ndarray
    y: np.ndarray
    seen: np.ndarray
    step: int

    @property
    def unseen_share(self) -> float:
        return float((self.seen == 0).mean()) if len(self.seen) else float("nan")


def static_points(pairs: Sequence[Matches], dynamic: np.ndarray, geometry: ArrayGeometry) -> np.ndarray:
    """float32[N, 3]: (x, y, disparity) in the reference view of the matches farther than OUTLINE from every mask."""
    points = []
    height, width = dynamic.shape[1:]
    window = np.ones((2 * OUTLINE + 1, 2 * OUTLINE + 1), np.uint8)
    near = [cv2.dilate(_is_dynamic(view).astype(np.uint8), window) > 0 for view in dynamic]
    for m in pairs:
        u, v = np.rint(m.x).astype(int).clip(0, width - 1), np.rint(m.y).astype(int).clip(0, height - 1)
        u2, v2 = np.rint(m.x2).astype(int).clip(0, width - 1), np.rint(m.y2).astype(int).clip(0, height - 1)
        static = ~near[m.first][v, u] & ~near[m.second][v2, u2] & (m.disparity > 0)
        view = geometry.seen_from(m.first)
        d = m.disparity[static]
        x, y = view.warp(geometry.reference, m.x[static], m.y[static], d)
        points.append(np.stack([x, y, d / (1 - d * view.offsets[geometry.reference, 2])], axis=-1))
    return np.concatenate(points).astype(np.float32)


def hidden(dynamic: np.ndarray, geometry: ArrayGeometry, points: np.ndarray, otherwise: float) -> Hidden:
    """Which pixels of the reference people hide, and who sees the background behind each.

    dynamic    uint8 [K, H, W], Rectification.dynamic
    points     float32[N, 3], static_points: the background's disparity at a pixel is the median of the
               NEIGHBOURS nearest ones
    otherwise  the disparity that stands for it where points are fewer

    An estimate: what else may hide the background is not known here. Over the 12 scenes of the README's table, exact
    masks, it is off by 6 % of the hidden pixels in the mean.
    """
    step = max(1, geometry.size[0] // (2 * GRID))
    y, x = np.nonzero(_is_dynamic(dynamic[geometry.reference, ::step, ::step]))
    x, y = x * step, y * step
    d = _nearest_median(points, x, y) if len(points) >= NEIGHBOURS else np.full(len(x), np.float32(otherwise))
    seen = np.zeros(len(x), int)
    for k in range(geometry.cameras):
        if k != geometry.reference:
            inside, found = _looked_up(dynamic[k], geometry, k, x, y, d)
            seen += inside & ~found
    return Hidden(x, y, seen, step)


def _nearest_median(points: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """float32 like x: the median disparity of the nearest points, a bounded number of pixels at a time."""
    found = np.empty(len(x), np.float32)
    for i in range(0, len(x), 2048):
        part = slice(i, i + 2048)
        away = (x[part, None] - points[None, :, 0]) ** 2 + (y[part, None] - points[None, :, 1]) ** 2
        nearest = np.argpartition(away, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
        found[part] = np.median(points[nearest, 2], axis=1)
    return found


def hidden_line(frames: Sequence[Hidden]) -> Line:
    """`frames`: those that were looked at."""
    seen = np.concatenate([f.seen for f in frames]) if frames else np.zeros(0)
    if not len(seen):
        return line("hidden from all", "no pixel of the reference is masked", "good", "", unseen=float("nan"))
    unseen, once = float((seen == 0).mean()), float((seen == 1).mean())
    return line(
        "hidden from all",
        f"{100 * unseen:.1f} % of what people hide is seen by no camera, {100 * once:.1f} % by one only",
        verdict_of(unseen, 0.05, 0.3),
        "people are too wide or too far for this array, or the masks too generous: widen the array, let people come "
        "nearer to it; coverage 0 says where the picture is a guess",
        unseen=unseen,
        seen_by_one=once,
    )
