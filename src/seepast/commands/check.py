"""seepast check: is a recording fit, and what would mend it?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .console import Json, progress
from .segmenting import Classes, SegmenterName, opened_recording, opened_segmenter
from .source import GUESSED, Source


def check(
    dataset: Path,
    /,
    *,
    masks: Annotated[str | None, Parameter(show_default=False)] = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    reference: str = "cam0",
    depths: Annotated[tuple[float, float], Parameter(negative=())] = (1.0, 20.0),
    background: Annotated[float | None, Parameter(show_default=False)] = None,
    html: Annotated[Path | None, Parameter(show_default=False)] = None,
    json_: Json = False,
    source: Source = GUESSED,
) -> int:
    """Measure what decides success, and say what would mend it.

    For example

      seepast check recording
      seepast check recording --depths 1.5 12 --html report.html
      seepast check recording --background 4 --json

    Every file of the recording is read. Exit code 0 whatever the verdicts; 2 where a run would be impossible (files
    missing or damaged, an unusable calibration), told in one line on stderr.

    Parameters
    ----------
    dataset
        Folder with rig.yaml, cam0/ cam1/ ... and masks/; or another recording that `run` reads.
    masks
        Folder of masks in the dataset (default: masks); 'none': no masks.
    reference
        The camera whose view would be reconstructed.
    depths
        NEAR FAR metres: the surfaces that matter to you.
    background
        Metres to what people stand before; measured from the images if not given.
    html
        Also write the report, with pictures, to this one file.
    """
    from ..check import check as check_dataset

    recording = opened_recording(source, dataset, masks, opened_segmenter(segmenter, classes, masks))
    with progress(recording.name, len(recording.stamps)) as advance:
        report = check_dataset(recording, reference, depths=depths, background=background, on_frame=advance)
    if json_:
        print(json.dumps(report.as_dict()))
    else:
        from ..checks.screen import show

        show(report)
    if html is not None:
        from ..checks.page import page
        from ..export.atomic import write_bytes

        write_bytes(html, page(report).encode())
    return 0
