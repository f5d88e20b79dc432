"""seepast export: what a run wrote, in the formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from .console import Json, count, progress, say

Flag = Annotated[bool, Parameter(negative=(), show_default=False)]


def export(
    run: Path,
    /,
    *,
    to: str,
    out: Annotated[Path | None, Parameter(show_default=False)] = None,
    stamps: Literal["auto", "s", "ms", "us", "ns", "index"] = "auto",
    rate: float = 10.0,
    min_coverage: int = 1,
    depth: Literal["32FC1", "16UC1"] = "32FC1",
    depth_factor: float = 5000.0,
    overwrite: Flag = False,
    json_: Json = False,
) -> int:
    """Write what `run` made in the formats of other tools.

    For example

      seepast export out --to tum                     for ORB-SLAM, DynaSLAM
      seepast export out --to mcap --out run7.mcap    for Foxglove and ROS 2
      seepast export out --to rosbag2 --depth 16UC1   depth in millimetres
      seepast export out --to rosbag1 --rate 20       numbered frames at 20 Hz
      seepast export out --to ply --min-coverage 2    points that two cameras saw
      seepast export out --to exr --overwrite

    The export appears whole or not at all. What is there already is not touched without --overwrite.

    Parameters
    ----------
    run
        A folder that `seepast run` wrote.
    to
        tum (RGB-D folder), mcap, rosbag2, rosbag1, ply (coloured points) or exr (multi-channel images).
    out
        File or folder to write; if not given, beside RUN and named after it.
    stamps
        What frames' names are. auto: decimals s, 19 digits ns (EuRoC), 16 us, 13 ms, 10 s, else an index.
    rate
        Frames per second where the names are no times.
    min_coverage
        Depth where fewer cameras saw the pixel counts as unknown; 0 keeps the guesses.
    depth
        Depth images in bags: 32FC1 metres, or 16UC1 millimetres.
    depth_factor
        Units per metre of the depth images of tum: 5000 reaches 13.1 m, 1000 reaches 65.5 m.
    overwrite
        Replace an earlier export.
    """
    from ..export.exporters import export, exporter_of
    from ..export.protocol import ExportOptions
    from ..export.reading import RunFolder

    exporter_of(to)
    options = ExportOptions(stamps, rate, min_coverage, depth, depth_factor)
    folder = RunFolder(run)
    name = folder.path.resolve().name
    with progress(name, len(folder.stamps)) as advance:
        done = export(folder, to, out, options, overwrite=overwrite, on_frame=advance)
    values = {"name": name, "to": to, "path": str(done.path), "frames": done.frames}
    say(f"{name}: {count(done.frames, 'frame')} as {to}, {done.path}", values, json_)
    return 0
