"""How long a frame takes: every preset, full frame and dynamic-only, stage by stage, beside OpenCV's SGBM.

    make bench-speed [PRESETS=paper,...] [QUICK=1] [LIBELAS=path/to/elas] [WRITE=benchmarks/RESULTS.md]

Five cameras of 720x540 in colour, distorted and twisted (rectification of images and masks is part of the time),
range 0..150 px in half-pixel steps, exact masks with people on about 15 % of the frame; input and output in memory.
The full frame also with masks that are some pixels off, which the many-view presets refine.
All that is compared runs in turn, round after round, and medians are given: a busy moment hits everybody alike. The
last row compares with SGBM 3-way in the same round, since one machine is not as fast as itself an hour ago.

LIBELAS names the demo program of libelas (not part of seepast: GPL), which is then run on the same pair.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import cv2
import numpy as np

import scenes
from common import machine, markdown_table, preset_names, replace_section
from seepast.options import Options
from seepast.pipeline import Reconstructor
from seepast.rectify import rectify

SIZE, CAMERAS, RANGE = (720, 540), 5, 150  # px, cameras, px
SWEEP_CAMERAS = (2, 3, 5, 9, 16)
SWEEP_WIDTHS = (360, 540, 720, 1080)
SWEEP_RANGES = (75, 150, 300)
QUICK = 3  # of a sweep, how many
TOTAL = "total"

Milliseconds = dict[str, float]  # stage -> ms, and TOTAL
Task = Callable[[], Milliseconds]
Label = tuple[str, str]  # preset, "full frame" | "dynamic-only" | "inexact masks" | what is swept
PEER: Label = ("SGBM", "3-way")


def main() -> None:
    arguments = _arguments()
    if arguments.threads:
        cv2.setNumThreads(arguments.threads)
    words = machine()
    recording = scenes.make(CAMERAS, SIZE)
    parts = [
        _input_in_words(recording),
        stages(recording, arguments),
        cold_and_memory(recording, arguments),
        *sweeps(arguments),
    ]
    report = "\n\n".join([f"On {words}; {arguments.threads or 'all'} threads.", *parts])
    print(f"\n{report}")
    if arguments.write:
        quick = " --quick" if arguments.quick else ""
        presets = ",".join(arguments.presets)
        command = f"`python benchmarks/speed.py --presets {presets}{quick} --rounds {arguments.rounds}`"
        replace_section(arguments.write, "speed", f"{command}\n\n{report}")
        print(f"\nwritten: {arguments.write}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", type=preset_names, default="", help="comma-separated; default: all")
    parser.add_argument("--rounds", type=int, default=0, help="of the stage table (15; 3 with --quick)")
    parser.add_argument("--threads", type=int, default=0, help="default: all cores")
    parser.add_argument("--quick", action="store_true", help="few rounds and short sweeps, for a first look")
    parser.add_argument("--libelas", type=Path, metavar="PROGRAM", help="run as PROGRAM left.pgm right.pgm, if given")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="replace the section 'speed' of this file")
    arguments = parser.parse_args()
    arguments.rounds = arguments.rounds or (3 if arguments.quick else 15)
    return arguments


def _input_in_words(recording: scenes.Recording) -> str:
    people = 100 * np.mean([mask > 0 for mask in recording.masks])
    return f"{CAMERAS} cameras, {SIZE[0]}x{SIZE[1]} colour, 0..{RANGE} px, people on {people:.0f} % of the frame."


def stages(recording: scenes.Recording, arguments: argparse.Namespace) -> str:
    """Medians per stage of every preset, full frame and dynamic-only, interleaved with SGBM."""
    tasks: dict[Label, Task] = {}
    for name in arguments.presets:
        tasks[name, "full frame"] = frame_task(recording, name, arguments.threads)
        tasks[name, "dynamic-only"] = frame_task(recording, name, arguments.threads, dynamic_only=True)
        if Options.preset(name).multiview.enabled:  # which refines masks that are not exact
            tasks[name, "inexact masks"] = frame_task(scenes.inexact(recording), name, arguments.threads)
    left, right = _outer_pair(recording)
    tasks[PEER] = partial(sgbm, left, right, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    tasks["SGBM", "full"] = partial(sgbm, left, right, cv2.STEREO_SGBM_MODE_HH)
    note = f"SGBM: one rectified grey pair of the same size, {_pair_range()} disparities, all threads of OpenCV."
    with tempfile.TemporaryDirectory() as folder:
        if arguments.libelas:
            tasks["libelas", "as a process"] = libelas(arguments.libelas, left, right, Path(folder))
            note += " libelas: the same pair, its start and the reading and writing of files included."
        runs = interleaved(tasks, arguments.rounds)
    medians = {label: _medians(found) for label, found in runs.items()}
    names = list(dict.fromkeys(stage for found in medians.values() for stage in found if stage != TOTAL))
    rows = [[stage, *(_cell(found.get(stage) or None) for found in medians.values())] for stage in (*names, TOTAL)]
    rows.append([f"x {' '.join(PEER)}", *(f"{_ratio(found, runs[PEER]):.2f}" for found in runs.values())])
    head = f"### Milliseconds per frame, medians of {arguments.rounds} interleaved rounds"
    return "\n\n".join([head, markdown_table(["stage", *map(", ".join, medians)], rows), note])


def libelas(program: Path, left: np.ndarray, right: np.ndarray, folder: Path) -> Task:
    """Runs libelas's demo program on the pair, written to `folder`; it writes its disparities beside it."""
    files = [str(folder / name) for name in ("left.pgm", "right.pgm")]
    for file, view in zip(files, (left, right), strict=True):
        cv2.imwrite(file, view)

    def once() -> Milliseconds:
        start = time.perf_counter()
        subprocess.run([str(program.resolve()), *files], check=True, stdout=subprocess.DEVNULL, cwd=folder)
        return {TOTAL: 1e3 * (time.perf_counter() - start)}

    return once


def _ratio(found: Sequence[Milliseconds], peer: Sequence[Milliseconds]) -> float:
    """Median over the rounds of how many times as long as the peer it took."""
    return median(run[TOTAL] / other[TOTAL] for run, other in zip(found, peer, strict=True))


def frame_task(
    recording: scenes.Recording, preset: str, threads: int, *, dynamic_only: bool = False, max_disparity: int = RANGE
) -> Task:
    """A callable that reconstructs the recording once and says how long that took, with maps and buffers kept."""
    options = Options.preset(preset).updated({"range.max_disparity": max_disparity, "range.step": 0.5})
    run = Reconstructor(recording.rig, options=options, dynamic_only=dynamic_only, threads=threads)

    def once() -> Milliseconds:
        start = time.perf_counter()
        result = run(recording.images, recording.masks)
        return {**result.timings, TOTAL: 1e3 * (time.perf_counter() - start)}

    return once


def _outer_pair(recording: scenes.Recording) -> tuple[np.ndarray, np.ndarray]:
    """The first and the last camera's rectified grey views: their disparity is the array's."""
    rectification, last = rectify(recording.rig), len(recording.images) - 1
    views = (rectification.image(k, recording.images[k]) for k in (0, last))
    left, right = (cv2.cvtColor(view, cv2.COLOR_BGR2GRAY) for view in views)
    return left, right


def _pair_range() -> int:
    return -(-RANGE // 16) * 16


def sgbm(left: np.ndarray, right: np.ndarray, mode: int) -> Milliseconds:
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=_pair_range(), blockSize=5, P1=200, P2=800, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=100, speckleRange=2, mode=mode,
    )  # fmt: skip
    start = time.perf_counter()
    matcher.compute(left, right)
    return {TOTAL: 1e3 * (time.perf_counter() - start)}


def sgbm_clock() -> Callable[[], float]:
    """What says how long one rectified pair of this size takes SGBM, 3-way, at this moment: how busy the machine is."""
    left, right = _outer_pair(scenes.make(CAMERAS, SIZE))
    return lambda: sgbm(left, right, cv2.STEREO_SGBM_MODE_SGBM_3WAY)[TOTAL]


def interleaved(tasks: Mapping[Label, Task], rounds: int) -> dict[Label, list[Milliseconds]]:
    """Every round's times; the tasks run in turn, after one run of each that does not count."""
    for label, task in tasks.items():
        print(f"warming up: {', '.join(label)}", file=sys.stderr, flush=True)
        task()
    found: dict[Label, list[Milliseconds]] = {label: [] for label in tasks}
    for number in range(rounds):
        print(f"round {number + 1} of {rounds}", file=sys.stderr, flush=True)
        for label, task in tasks.items():
            found[label].append(task())
    return found


def _medians(runs: Sequence[Milliseconds]) -> Milliseconds:
    return {stage: median(run[stage] for run in runs) for stage in runs[0]}


def cold_and_memory(recording: scenes.Recording, arguments: argparse.Namespace) -> str:
    """First frame of a fresh process and its memory, medians over processes."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        recording.rig.to_kalibr(Path(folder) / "rig.yaml")
        np.savez(Path(folder) / "frame.npz", images=recording.images, masks=recording.masks)
        for name in arguments.presets:
            runs = [_cold(folder, name, arguments.threads) for _ in range(1 if arguments.quick else 5)]
            first, idle, peak = (median(run[key] for run in runs) for key in ("first_ms", "idle_mb", "peak_mb"))
            rows.append([name, f"{first:.0f}", f"{idle:.0f}", f"{peak:.0f}", f"{peak - idle:.0f}"])
    header = ["preset", "first frame, ms", "idle, MB", "peak, MB", "over idle, MB"]
    return "### Cold: first frame after import, and memory\n\n" + markdown_table(header, rows)


def _cold(folder: str, preset: str, threads: int) -> dict[str, float]:
    command = [sys.executable, str(Path(__file__).with_name("cold.py")), folder, preset, str(RANGE), str(threads)]
    return dict(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))


def sweeps(arguments: argparse.Namespace) -> list[str]:
    """Growth with cameras, pixels and range, each with its fitted exponent."""
    counts, widths, ranges = (
        sweep[:QUICK] if arguments.quick else sweep for sweep in (SWEEP_CAMERAS, SWEEP_WIDTHS, SWEEP_RANGES)
    )
    sizes = [(width, width * SIZE[1] // SIZE[0]) for width in widths]
    same = scenes.make(CAMERAS, SIZE)
    of_count = {str(k): (k, scenes.make(k, SIZE), RANGE) for k in counts}
    of_size = {f"{w}x{h}": (w * h, scenes.make(CAMERAS, (w, h)), RANGE) for w, h in sizes}
    of_range = {f"0..{r} px": (r, same, r) for r in ranges}
    swept = {"cameras": of_count, "pixels": of_size, "range": of_range}
    return [_sweep(what, cases, arguments) for what, cases in swept.items()]


Case = tuple[float, scenes.Recording, int]  # what the time may grow with, the input, the largest disparity


def _sweep(what: str, cases: Mapping[str, Case], arguments: argparse.Namespace) -> str:
    tasks = {
        (preset, name): frame_task(recording, preset, arguments.threads, max_disparity=largest)
        for preset in arguments.presets
        for name, (_, recording, largest) in cases.items()
    }
    rounds = max(1, arguments.rounds // 3)
    medians = {label: _medians(runs) for label, runs in interleaved(tasks, rounds).items()}
    values = [value for value, _, _ in cases.values()]
    rows = []
    for preset in arguments.presets:
        ms = [medians[preset, name][TOTAL] for name in cases]
        rows.append([preset, *map(_cell, ms), f"{growth(values, ms):.2f}"])
    head = f"### Full frame against {what}: ms, medians of {rounds} interleaved rounds"
    return f"{head}\n\n" + markdown_table(["preset", *cases, "exponent"], rows)


def growth(values: Sequence[float], ms: Sequence[float]) -> float:
    """e of the least-squares fit ms ~ values^e."""
    return float(np.polyfit(np.log(values), np.log(ms), 1)[0])


def _cell(ms: float | None) -> str:
    return "-" if ms is None else f"{ms:.1f}"


if __name__ == "__main__":
    main()
