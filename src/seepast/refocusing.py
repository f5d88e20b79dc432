"""Plain synthetic aperture refocusing of whole recordings, on one plane or on many: the baseline that people know."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from .datasets import Dataset
from .errors import OptionsError, OutputError
from .export.atomic import write_png
from .export.video import check_video_path, write_video
from .focal import WIDE_OPEN, Aperture, refocus_at
from .geometry import ArrayGeometry
from .rectify import rectify

MAX_PLANES = 10_000
FRAMES_PER_SECOND = 10.0

Sweep = tuple[float, float, int]


def refocus_sequence(
    dataset: Dataset,
    out: str | Path | None,
    *,
    depth: float | None = None,
    disparity: float | None = None,
    sweep: Sweep | None = None,
    aperture: Aperture = WIDE_OPEN,
    video: str | Path | None = None,
    frames_per_second: float = FRAMES_PER_SECOND,
    frame: str | None = None,
    reference: int | str = 0,
    overwrite: bool = False,
    on_frame: Callable[[], None] = lambda: None,
) -> list[float]:
    """Plain synthetic aperture refocusing; returns the disparities of the planes, px over the full array.

    out          folder: <stamp>.png for a single plane, <stamp>/000.png, 001.png ... for a sweep; None: only the video
    depth        metres, or disparity in px over the full array: the one plane
    sweep        (near, far, n): n planes between two depths in metres, evenly apart in disparity, in that order
    video        file for the same pictures in a row: .mp4, .mkv or .avi
    frame        stamp of the only frame to be refocused. None: all of them; a video of a sweep shows the first
    on_frame     called after every picture; `pictures` tells how many there will be

    Where the dataset has masks, only static rays take part. Raises OptionsError, OutputError, DatasetError.
    """
    if out is None and video is None:
        raise OptionsError("refocusing needs somewhere to write to: give --out FOLDER, --video FILE, or both")
    rectification = rectify(dataset.rig, dataset.rig.index(reference))
    planes = planes_of(rectification.geometry, depth, disparity, sweep)
    stamps = _stamps(dataset, frame, only_one=sweep is not None and video is not None)
    names = [f"{stamp}/{i:03d}.png" if sweep else f"{stamp}.png" for stamp in stamps for i in range(len(planes))]
    targets = [] if out is None else [Path(out) / name for name in names]
    if video is not None:
        check_video_path(Path(video))
        if not (math.isfinite(frames_per_second) and frames_per_second > 0):
            raise OptionsError(f"--fps {frames_per_second}: give pictures per second above 0")
    _refuse_what_is_there(targets + ([] if video is None else [Path(video)]), overwrite)

    def pictures() -> Iterator[np.ndarray]:
        made = _refocused(dataset, stamps, planes, reference, aperture)
        for i, picture in enumerate(made):
            if targets:
                write_png(targets[i], picture)
            yield picture
            on_frame()

    if video is not None:
        write_video(Path(video), pictures(), frames_per_second)
    else:
        for _ in pictures():
            pass
    return planes


def picture_count(dataset: Dataset, sweep: Sweep | None, frame: str | None, video: bool) -> int:
    """How many pictures `refocus_sequence` makes."""
    stamps = 1 if frame is not None or (sweep is not None and video) else len(dataset.stamps)
    return stamps * (sweep[2] if sweep else 1)


def planes_of(
    geometry: ArrayGeometry, depth: float | None, disparity: float | None, sweep: Sweep | None
) -> list[float]:
    """Disparities of the planes that exactly one of the three asks for. Raises OptionsError."""
    if sum(given is not None for given in (depth, disparity, sweep)) != 1:
        raise OptionsError(
            "refocusing needs one plane or one sweep: give either --depth M, --disparity PX or --sweep NEAR FAR N"
        )
    if sweep is not None:
        near, far, count = sweep
        if not (0 < near < math.inf and 0 < far < math.inf and near != far):
            raise OptionsError(f"--sweep {near:g} {far:g} {count}: give two distances in metres above 0")
        if not 2 <= count <= MAX_PLANES:
            raise OptionsError(f"--sweep {near:g} {far:g} {count}: give between 2 and {MAX_PLANES} planes")
        return [float(d) for d in geometry.focal_baseline * np.linspace(1 / near, 1 / far, count)]
    if depth is not None:
        if not (math.isfinite(depth) and depth > 0):
            raise OptionsError(f"--depth {depth}: give a distance in metres above 0")
        return [geometry.focal_baseline / depth]
    assert disparity is not None
    if not (math.isfinite(disparity) and disparity >= 0):
        raise OptionsError(f"--disparity {disparity}: give px over the full array, 0 or more")
    return [disparity]


def _stamps(dataset: Dataset, frame: str | None, only_one: bool) -> list[str]:
    if frame is None:
        return list(dataset.stamps[:1] if only_one else dataset.stamps)
    if frame not in dataset.stamps:
        raise OptionsError(f"--frame {frame}: {dataset.path} has {dataset.stamps[0]} .. {dataset.stamps[-1]}")
    return [frame]


def _refuse_what_is_there(targets: list[Path], overwrite: bool) -> None:
    there = [path for path in targets if path.exists()]
    if there and not overwrite:
        raise OutputError(f"{there[0]}: is there already; add --overwrite or name another folder")


def _refocused(
    dataset: Dataset, stamps: list[str], planes: list[float], reference: int | str, aperture: Aperture
) -> Iterator[np.ndarray]:
    """All pictures, frame by frame, plane by plane."""
    rectification = rectify(dataset.rig, dataset.rig.index(reference))
    for stamp in stamps:
        frame = dataset.frame(stamp)
        views = [rectification.image(k, image) for k, image in enumerate(frame.images)]
        dynamic = None
        if frame.masks is not None:
            dynamic = np.stack([rectification.dynamic(k, mask) for k, mask in enumerate(frame.masks)])
        for plane in planes:
            yield refocus_at(views, rectification.geometry, plane, dynamic, aperture)
