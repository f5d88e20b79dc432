"""seepast epi: the epipolar-plane image of a row."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from .console import Json, say
from .segmenting import Classes, SegmenterName, opened_recording, opened_segmenter
from .source import GUESSED, Source

Optional = Parameter(negative=(), show_default=False)


def epi(
    dataset: Path,
    /,
    *,
    row: int,
    out: Path,
    shear: float = 0.0,
    fill: Literal["nearest", "linear"] = "nearest",
    height: Annotated[int | None, Optional] = None,
    frame: Annotated[str | None, Optional] = None,
    masks: Annotated[str | None, Optional] = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    reference: str = "cam0",
    overwrite: Annotated[bool, Optional] = False,
    json_: Json = False,
    source: Source = GUESSED,
) -> int:
    """Draw a row's epipolar-plane image, people's rays struck out.

    For example

      seepast epi recording --row 200 --out epi.png
      seepast epi recording --row 200 --shear 40 --out wall.png --overwrite
      seepast epi recording --row 200 --fill linear --masks none --out epi.png

    In it, slope is disparity.

    Parameters
    ----------
    dataset
        Folder with rig.yaml, cam0/ cam1/ ... and masks/.
    row
        Row of the rectified reference view.
    out
        PNG: the reference around the row, and below it, column for column, one line per camera, spaced as the cameras
        are; what the masks call dynamic is striped in red.
    shear
        Disparity in px over the full array that stands vertical: refocusing there is averaging the columns.
    fill
        Between the cameras' lines: nearest repeats the nearest camera, linear mixes the two around.
    height
        Px of the epipolar-plane image (default: 40 per camera).
    frame
        Stamp of the frame (default: the first).
    masks
        Folder of masks in the dataset (default: masks); 'none': no masks.
    reference
        The camera whose row it is.
    overwrite
        Replace the picture if it is there.
    """
    import numpy as np

    from ..epipolar import ROW_HEIGHT, draw, epipolar_image
    from ..errors import OptionsError, OutputError
    from ..export.atomic import write_png
    from ..rectify import rectify

    recording = opened_recording(source, dataset, masks, opened_segmenter(segmenter, classes, masks))
    stamp = recording.stamps[0] if frame is None else frame
    if stamp not in recording.stamps:
        raise OptionsError(f"--frame {stamp}: {dataset} has {recording.stamps[0]} .. {recording.stamps[-1]}")
    names = [camera.name for camera in recording.rig.cameras]
    height = ROW_HEIGHT * len(names) if height is None else height
    if not len(names) <= height <= 10_000:
        raise OptionsError(f"--height {height}: give between {len(names)} and 10000 px")
    if out.exists() and not overwrite:
        raise OutputError(f"{out}: is there already; add --overwrite or name another file")
    rectification = rectify(recording.rig, recording.rig.index(reference))
    geometry, images = rectification.geometry, recording.frame(stamp)
    views = [rectification.image(k, image) for k, image in enumerate(images.images)]
    given = images.masks if images.masks is not None else (None,) * len(views)
    dynamic = np.stack([rectification.dynamic(k, mask) for k, mask in enumerate(given)])
    made = epipolar_image(views, geometry, row, dynamic, shear)
    write_png(out, draw(made, views[geometry.reference], row, names, height, fill))
    span, struck = float(np.ptp(made.places)), float(made.dynamic.mean())
    values = {"name": recording.name, "frame": stamp, "row": row, "cameras": names, "struck_out": struck}
    text = f"{recording.name}: row {row} of {stamp}, {len(names)} cameras over {span:.2f} B"
    say(f"{text}, {100 * struck:.1f} % struck out, {out}", {**values, "path": str(out)}, json_)
    return 0
