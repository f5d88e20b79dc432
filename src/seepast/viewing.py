"""What a run made, for the rerun viewer: inputs, masks before and after, the static scene, 3-D points, stage times.

Entities, on the timelines "frame" (the place in the run) and, where the names of the frames are times, "time":

    input/camK, masks_before/camK, masks_after/camK    each camera's own pixels; masks red, as opaque as P(dynamic)
    scene/background, scene/disparity, scene/coverage  the rectified reference view; disparity in px over the array
    world/points, world/camK                           metres in the reference view's axes: x right, y down, z forward
    milliseconds/STAGE                                 of this frame
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .datasets import Dataset
from .errors import OutputError
from .export.atomic import replacing
from .export.folder import CAMERA_FILE, RUN_FILE
from .export.reading import RunFolder, View, Written, colour, read_view
from .export.times import guessed_unit, timeline
from .extras import require

APPLICATION = "seepast"
MAX_POINTS = 150_000  # of a frame: more than that only slows the viewer down
JPEG_QUALITY = 90
MASK_RED = (40, 40, 230)  # BGR
UNSEEN_RED = (220, 60, 60)  # RGB, of coverage 0


def recording_stream(name: str) -> Any:
    """A rerun.RecordingStream for one run. Raises MissingExtraError."""
    rr = require("rerun", "view", "the viewer")
    stream = rr.RecordingStream(APPLICATION)
    stream.send_recording_name(name)
    return stream


@contextlib.contextmanager
def saved(stream: Any, path: Path, overwrite: bool = False) -> Iterator[None]:
    """What is logged to `stream` within goes to the file `path`, whole or not at all. Raises OutputError."""
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; add --overwrite or name another file")
    with replacing(path) as part:
        try:
            stream.save(part)
            yield
        finally:
            stream.disconnect()  # writes what is pending


class RunLogger:
    """Logs the frames of a run's folder, each once; the run may still be going on.

    out      the folder `seepast run` writes or wrote
    stream   a rerun.RecordingStream
    dataset  what the run reads, for the inputs; None: they are left out
    """

    def __init__(self, out: str | Path, stream: Any, dataset: Dataset | None = None):
        self.out = Path(out)
        self._stream, self._dataset = stream, dataset
        self._rr = require("rerun", "view", "the viewer")
        self._folder: RunFolder | None = None
        self._stamps: list[str] = []
        self._timed: set[str] = set()

    def log_new(self, on_frame: Callable[[], None] = lambda: None) -> int:
        """Log all frames finished since the last call; returns their number. Raises DatasetError."""
        logged = set(self._stamps)
        new = [stamp for stamp in finished(self.out) if stamp not in logged]
        if new and self._folder is None:
            self._folder = _GrowingRun(self.out)
            self._log_array(self._folder.view)
        times = self._milliseconds()
        for stamp in new:
            assert self._folder is not None
            self._stamps.append(stamp)
            self._at(stamp)
            self._log_inputs(stamp)
            self._log_frame(self._folder.frame(stamp), self._folder.view)
            self._log_milliseconds(stamp, times)
            on_frame()
        late = [stamp for stamp in self._stamps[: len(logged)] if stamp not in self._timed]
        for stamp in late:  # run.json tells the times after the frames are there
            self._log_milliseconds(stamp, times)
        self._stream.flush()
        return len(new)

    def _at(self, stamp: str) -> None:
        self._stream.set_time("frame", sequence=self._stamps.index(stamp))
        if guessed_unit([stamp]) != "index":
            self._stream.set_time("time", timestamp=np.datetime64(timeline([stamp])[0][0], "ns"))

    def _log_array(self, view: View) -> None:
        rr, log = self._rr, self._stream.log
        self._stream.send_blueprint(blueprint(view))
        log("world", rr.ViewCoordinates.RDF, static=True)
        for name, position in zip(view.cameras, view.positions, strict=True):
            log(f"world/{name}", rr.Transform3D(translation=position), static=True)
            pinhole = rr.Pinhole(
                image_from_camera=view.matrix, resolution=view.size, image_plane_distance=0.4 * view.baseline
            )
            log(f"world/{name}", pinhole, static=True)
        shades = [(0, "unseen", UNSEEN_RED)]
        shades += [(n, f"{n} cameras", (grey,) * 3) for n, grey in enumerate(_greys(len(view.cameras)), 1)]
        log("scene/coverage", rr.AnnotationContext(shades), static=True)

    def _log_inputs(self, stamp: str) -> None:
        if self._dataset is None or stamp not in self._dataset.stamps:
            return
        frame = self._dataset.frame(stamp)
        names = [camera.name for camera in self._dataset.rig.cameras]
        for name, image in zip(names, frame.images, strict=True):
            self._stream.log(f"input/{name}", self._jpeg(image))
        for name, mask in zip(names, frame.masks or (), strict=False):
            self._stream.log(f"masks_before/{name}", self._red(mask))

    def _log_frame(self, frame: Written, view: View) -> None:
        rr, log = self._rr, self._stream.log
        for name, mask in frame.masks.items():
            log(f"masks_after/{name}", self._red(mask))
        log("scene/background", self._jpeg(frame.background))
        log("scene/disparity", rr.DepthImage(frame.disparity, meter=1.0, colormap="turbo"))
        log("scene/coverage", rr.SegmentationImage(frame.coverage))
        points, colours = scene_points(frame, view)
        log("world/points", rr.Points3D(points, colors=colours))

    def _milliseconds(self) -> dict[str, dict[str, float]]:
        """Of every frame that run.json tells about by now."""
        try:
            told = json.loads((self.out / RUN_FILE).read_text()).get("frame_milliseconds", {})
        except (OSError, ValueError):
            return {}
        return dict(told)

    def _log_milliseconds(self, stamp: str, times: dict[str, dict[str, float]]) -> None:
        if stamp in times:
            self._timed.add(stamp)
            self._at(stamp)
            for stage, milliseconds in times[stamp].items():
                self._stream.log(f"milliseconds/{stage}", self._rr.Scalars(milliseconds))

    def _jpeg(self, image: np.ndarray) -> Any:
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return self._rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")

    def _red(self, mask: np.ndarray) -> Any:
        """255 * P(dynamic) as a picture to lay over the input."""
        picture = np.empty((*mask.shape, 4), np.uint8)
        picture[..., :3] = MASK_RED
        picture[..., 3] = mask
        _, data = cv2.imencode(".png", picture)
        return self._rr.EncodedImage(contents=data.tobytes(), media_type="image/png", opacity=0.6, draw_order=1.0)


class _GrowingRun(RunFolder):
    """A run that need not be finished: its frames are decoded by name, none is missed."""

    def __init__(self, path: Path):
        self.path, self.stamps = path, ()
        self.settings: dict[str, Any] = {}
        self.view = read_view(path / CAMERA_FILE)


def finished(out: Path) -> list[str]:
    """Names of the frames that are written completely, sorted: coverage is a frame's last file."""
    return sorted(path.stem for path in (out / "coverage").glob("*.png") if not path.name.startswith("."))


def scene_points(frame: Written, view: View, most: int = MAX_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """Points float32 [N, 3], metres in the view's axes, and colours uint8 [N, 3] RGB, of at most about `most` pixels
    that some camera saw; every so-manieth row and column where there are more."""
    known = (frame.depth > 0) & (frame.coverage > 0)
    step = max(1, math.ceil(math.sqrt(known.sum() / most)))
    grid = np.zeros_like(known)
    grid[::step, ::step] = True
    known &= grid
    return view.points(frame.depth)[known], colour(frame.background)[known][:, ::-1]


def blueprint(view: View) -> Any:
    """Where everything stands on the screen; the points are seen from behind and above the array."""
    rrb = require("rerun.blueprint", "view", "the viewer")

    def over_inputs(kind: str) -> Any:
        views = [
            rrb.Spatial2DView(
                origin=f"input/{name}", contents=[f"input/{name}", f"masks_{kind}/{name}"], name=f"{name}, mask {kind}"
            )
            for name in view.cameras
        ]
        return rrb.Horizontal(*views)

    scene = [
        rrb.Spatial2DView(origin=f"scene/{name}", name=title)
        for name, title in (
            ("background", "static scene"),
            ("disparity", "disparity, px over the array"),
            ("coverage", "coverage, red: unseen"),
        )
    ]
    middle, b = view.positions.mean(axis=0), view.baseline
    behind, ahead = b * np.array([2.0, -2.0, -3.0]), b * np.array([0.0, 0.0, 8.0])
    eye = rrb.EyeControls3D(position=middle + behind, look_target=middle + ahead, eye_up=(0, -1, 0))
    world = rrb.Spatial3DView(origin="world", name="static points", eye_controls=eye)
    times = rrb.TimeSeriesView(origin="milliseconds", name="milliseconds per stage")
    rows = rrb.Vertical(
        over_inputs("before"),
        over_inputs("after"),
        rrb.Horizontal(*scene),
        rrb.Horizontal(world, times),
        row_shares=[2, 2, 3, 3],
    )
    return rrb.Blueprint(rows, collapse_panels=True)


def _greys(cameras: int) -> list[int]:
    return [round(60 + 195 * n / cameras) for n in range(1, cameras + 1)]
