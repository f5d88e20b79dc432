"""seepast refocus: plain synthetic aperture pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from .console import Json, count, progress, say
from .segmenting import Classes, SegmenterName, opened_recording, opened_segmenter
from .source import GUESSED, Source

Optional = Parameter(negative=(), show_default=False)


def refocus(
    dataset: Path,
    /,
    *,
    out: Annotated[Path | None, Optional] = None,
    depth: Annotated[float | None, Optional] = None,
    disparity: Annotated[float | None, Optional] = None,
    sweep: Annotated[tuple[float, float, int] | None, Optional] = None,
    video: Annotated[Path | None, Optional] = None,
    fps: float = 10.0,
    frame: Annotated[str | None, Optional] = None,
    cameras: Annotated[str | None, Optional] = None,
    aperture: Literal["mean", "median", "masked-mean"] = "mean",
    masked: Annotated[bool, Optional] = False,
    masks: Annotated[str | None, Optional] = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    reference: str = "cam0",
    overwrite: Annotated[bool, Optional] = False,
    json_: Json = False,
    source: Source = GUESSED,
) -> int:
    """Refocus plainly, by synthetic aperture: rays through one plane.

    For example

      seepast refocus recording --out out --depth 5
      seepast refocus recording --out out --depth 5 --aperture median --cameras cam0,cam2,cam4
      seepast refocus recording --sweep 1 10 60 --video sweep.mp4 --masked
      seepast refocus recording --out out --depth 5 --segmenter onnx:net.onnx

    This is the baseline people know: all cameras' rays, dynamic ones, too, unless --masked.

    Parameters
    ----------
    dataset
        Folder with rig.yaml and cam0/ cam1/ ...; or another recording that `run` reads.
    out
        Output folder: <stamp>.png in the rectified reference view; in a sweep <stamp>/000.png, 001.png ...
    depth
        Depth of the plane in metres; or give --disparity or --sweep.
    disparity
        The same in px over the full array (reference to farthest camera).
    sweep
        NEAR FAR N: N planes between two depths in metres, evenly apart in disparity.
    video
        The pictures as a video (.mp4, .mkv, .avi): all frames on one plane, or the sweep of one frame.
    fps
        Pictures per second of the video.
    frame
        Stamp of the only frame wanted (default: all; the first for a video of a sweep).
    cameras
        The aperture: names separated by commas, cam0,cam2,cam4 (default: all).
    aperture
        What becomes of the rays: their mean, their median (drops what few cameras see), or masked-mean, which is
        mean with --masked.
    masked
        Use only rays that the masks call static; --masks and --segmenter imply it.
    masks
        Folder of masks in the dataset (default: masks).
    reference
        The camera whose view is synthesised.
    overwrite
        Replace what is there.
    """
    from ..datasets import NO_MASKS
    from ..focal import Aperture
    from ..refocusing import picture_count, refocus_sequence

    network = opened_segmenter(segmenter, classes, masks)
    masked = masked or aperture == "masked-mean" or network is not None or masks is not None
    recording = opened_recording(source, dataset, masks if masked else NO_MASKS, network)
    named = [recording.rig.index(name.strip()) for name in cameras.split(",")] if cameras else None
    chosen = None if named is None else tuple(dict.fromkeys(named))
    pictures = picture_count(recording, sweep, frame, video is not None)
    with progress(recording.name, pictures) as advance:
        planes = refocus_sequence(
            recording,
            out,
            depth=depth,
            disparity=disparity,
            sweep=sweep,
            aperture=Aperture(chosen, "median" if aperture == "median" else "mean"),
            video=video,
            frames_per_second=fps,
            frame=frame,
            reference=reference,
            overwrite=overwrite,
            on_frame=advance,
        )
    frames = count(pictures // len(planes), "frame")
    at = f"{planes[0]:.2f} px" if len(planes) == 1 else f"{len(planes)} planes, {planes[0]:.2f} to {planes[-1]:.2f} px"
    paths = [str(path) for path in (out, video) if path]
    values = {"name": recording.name, "frames": pictures // len(planes), "disparities": planes, "paths": paths}
    say(f"{recording.name}: {frames} refocused at {at}, {' and '.join(paths)}", values, json_)
    return 0
