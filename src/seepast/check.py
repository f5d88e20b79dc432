"""Is a recording fit to be run? Every file is read; what decides success is measured, judged, and mended in words.

Each check is one Line (checks/lines.py). Thresholds stand beside what they judge: checks/array.py, images.py, masks.py;
how wide a person can be and still be seen past is derived in checks/seeing.py. None of it runs the method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .checks import array, images, masks
from .checks.lines import Line, Verdict, worst
from .datasets import Dataset, Frame
from .errors import OptionsError
from .geometry import ArrayGeometry
from .matching import Matches, neighbour_matches
from .rectify import Rectification, rectify

__all__ = ["DEPTHS", "Line", "Look", "Report", "check"]

DEPTHS = (1.0, 20.0)  # metres: what the disparity range is told for
LOOKED_AT = 3  # frames whose images and masks are compared; of the others only what a single file tells
ENOUGH_POINTS = 30  # static matches that say where the background is


@dataclass(frozen=True, eq=False)
class Look:
    """A frame whose images were compared: rectified views, dynamic uint8 [K, H, W] or None, matches, hidden pixels."""

    stamp: str
    views: list[np.ndarray]
    dynamic: np.ndarray | None
    matches: list[Matches]
    hidden: masks.Hidden | None


@dataclass(frozen=True, eq=False)
class Report:
    """What `check` found in a recording whose files are all in order.

    name, cameras  of the recording; frames: number of complete ones
    geometry       the rectified array
    lines          one per check, in the order in which they matter
    depths         metres; background: metres, what people stand before
    first          the first frame, for pictures
    """

    name: str
    cameras: tuple[str, ...]
    frames: int
    geometry: ArrayGeometry
    lines: tuple[Line, ...]
    depths: tuple[float, float]
    background: float
    first: Look = field(repr=False)

    @property
    def verdict(self) -> Verdict:
        return worst(line.verdict for line in self.lines)

    def line(self, name: str) -> Line:
        """The check of that name. Raises KeyError."""
        return {line.name: line for line in self.lines}[name]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: what is not known is None."""
        return _plain(
            {
                "name": self.name,
                "cameras": self.cameras,
                "frames": self.frames,
                "reference": self.cameras[self.geometry.reference],
                "size": self.geometry.size,
                "focal_px": self.geometry.focal[0],
                "verdict": self.verdict,
                "checks": {
                    line.name: {"verdict": line.verdict, "value": line.value, "remedy": line.remedy, **line.figures}
                    for line in self.lines
                },
            }
        )


def check(
    dataset: Dataset,
    reference: int | str = 0,
    *,
    depths: tuple[float, float] = DEPTHS,
    background: float | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> Report:
    """Read all of `dataset` and measure.

    reference   camera whose view would be reconstructed
    depths      nearest and farthest surface that matters, metres
    background  metres to what people stand before; None: the median of the static matches, or the far one of
                `depths` where those are fewer than ENOUGH_POINTS

    Raises DatasetError or RigError for the first thing that makes a run impossible, OptionsError for depths that
    are none. `on_frame` is called after every frame.
    """
    _check_depths(depths, background)
    rectification = rectify(dataset.rig, dataset.rig.index(reference))
    geometry, names = rectification.geometry, tuple(camera.name for camera in dataset.rig.cameras)
    chosen = {dataset.stamps[i] for i in np.linspace(0, len(dataset.stamps) - 1, LOOKED_AT).astype(int)}
    read = _Readings()
    for stamp in dataset.stamps:
        read.add(dataset.frame(stamp), rectification, stamp in chosen, depths[1])
        on_frame()
    points = np.concatenate(read.static)
    known = "as given"
    if background is None:
        enough = len(points) >= ENOUGH_POINTS
        background = geometry.focal_baseline / float(np.median(points[:, 2])) if enough else depths[1]
        known = "median of the matches" if enough else "the farther of --depths"
    pairs = [look.matches for look in read.looks]
    lines = [
        images.measured_rows(pairs, names),
        images.skew_line(_times(dataset), names, geometry, depths[0]),
        *images.dropped_lines(getattr(dataset, "dropped", None), len(names) * len(dataset.stamps)),
        images.gain_line(_typical(np.stack(read.gains)), names, geometry.reference),
        images.exposure_line(np.mean(read.clipped, axis=0), names),
        *array.array_lines(rectification, names, depths, background, known),
        masks.content_line(read.masks, names),
    ]
    if read.masks:
        lines.append(masks.disagreement_line(read.disagreement))
        lines.append(masks.hidden_line([look.hidden for look in read.looks if look.hidden is not None]))
    return Report(dataset.name, names, len(dataset.stamps), geometry, tuple(lines), depths, background, read.looks[0])


@dataclass(eq=False)
class _Readings:
    """What is gathered frame by frame; images are kept of the first one only."""

    masks: list[masks.MaskFigures] = field(default_factory=list)
    clipped: list[np.ndarray] = field(default_factory=list)
    gains: list[np.ndarray] = field(default_factory=list)
    static: list[np.ndarray] = field(default_factory=list)
    disagreement: list[float] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)

    def add(self, frame: Frame, rectification: Rectification, look: bool, far: float) -> None:
        if frame.masks is not None:
            self.masks.append(masks.mask_figures(frame.masks))
        self.clipped.append(images.clipped(frame.images))
        if look:
            self._look(frame, rectification, far)

    def _look(self, frame: Frame, rectification: Rectification, far: float) -> None:
        geometry = rectification.geometry
        views = [rectification.image(k, image) for k, image in enumerate(frame.images)]
        given = frame.masks if frame.masks is not None else (None,) * geometry.cameras
        dynamic = np.stack([rectification.dynamic(k, mask) for k, mask in enumerate(given)])
        matches = neighbour_matches(views, geometry)
        points = masks.static_points(matches, dynamic, geometry)
        self.static.append(points)
        self.gains.append(images.gains(views, matches, geometry))
        behind = None
        if frame.masks is not None:
            self.disagreement.append(masks.disagreement(dynamic, geometry))
            behind = masks.hidden(dynamic, geometry, points, geometry.focal_baseline / far)
        first = not self.looks
        self.looks.append(
            Look(frame.stamp, views if first else [], dynamic if first and behind else None, matches, behind)
        )


def _times(dataset: Dataset) -> np.ndarray:
    """float64 [frames, K] seconds from the first frame on, of readers that know a time per image; else empty."""
    times = getattr(dataset, "times", None)
    if times is None:
        return np.zeros((0, len(dataset.rig.cameras)))
    times = np.asarray(times, np.int64)
    return (times - times.min(initial=np.iinfo(np.int64).max)) / 1e9  # whole nanoseconds do not fit a float


def _typical(gains: np.ndarray) -> np.ndarray:
    """Median over frames [F, K, C] of what is known: [K, C], NaN where no frame knows."""
    known = ~np.isnan(gains)
    filled = np.where(known.any(axis=0), gains, 1.0)
    return np.where(known.any(axis=0), np.nanmedian(filled, axis=0), np.nan)


def _check_depths(depths: tuple[float, float], background: float | None) -> None:
    near, far = depths
    if not (0 < near < far < math.inf):
        raise OptionsError(f"--depths {near:g} {far:g}: give the nearest and the farthest surface, metres above 0")
    if background is not None and not (0 < background < math.inf):
        raise OptionsError(f"--background {background:g}: give a distance in metres above 0")


def _plain(value: Any) -> Any:
    """NaN and infinity as None, tuples and mappings as JSON knows them."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
