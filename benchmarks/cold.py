"""The first frame in a fresh process, and its memory: speed.py runs this once per measurement.

    python benchmarks/cold.py FOLDER PRESET MAX_DISPARITY THREADS

FOLDER holds rig.yaml and frame.npz (images, masks). Prints JSON: first_ms is from rig and arrays in memory to the
first result (backend loading and rectification maps included, imports not); idle_mb the resident memory just
before, peak_mb the highest resident memory over that frame and two more.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from seepast.options import Options
from seepast.pipeline import Reconstructor
from seepast.rig import Rig

STATUS, CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def main() -> None:
    folder, preset, max_disparity, threads = sys.argv[1:]
    rig = Rig.from_kalibr(Path(folder) / "rig.yaml")
    with np.load(Path(folder) / "frame.npz") as frame:
        images, masks = list(frame["images"]), list(frame["masks"])
    _forget_peak()
    idle = _resident("VmRSS")
    start = time.perf_counter()
    options = Options.preset(preset).updated({"range.max_disparity": max_disparity})
    run = Reconstructor(rig, options=options, threads=int(threads))
    run(images, masks)
    first = 1e3 * (time.perf_counter() - start)
    for _ in range(2):
        run(images, masks)
    print(json.dumps({"first_ms": first, "idle_mb": idle, "peak_mb": _resident("VmHWM")}))


def _forget_peak() -> None:
    """Loading the frame must not count: Linux starts the high-water mark anew."""
    try:
        CLEAR_REFS.write_text("5")
    except OSError:
        print("the peak includes loading the frame: /proc/self/clear_refs cannot be written", file=sys.stderr)


def _resident(key: str) -> float:
    """MB of a line of /proc/self/status; NaN where the system has none."""
    if not STATUS.is_file():
        return float("nan")
    lines = (line.partition(":") for line in STATUS.read_text().splitlines())
    return next(float(value.split()[0]) for name, _, value in lines if name == key) / 1024


if __name__ == "__main__":
    main()
