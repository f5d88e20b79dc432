"""How long a frame takes on a GPU, beside what its data sheet allows; and a model of GPUs that are not there.

    make bench-gpu [PRESETS=paper,...] [WRITE=benchmarks/RESULTS.md]

Five cameras of 720x540 in colour, distorted and twisted, range 0..150 px in half-pixel steps, exact masks: the frame of
benchmarks/speed.py. Without a GPU only what is counted is printed, and what is a model says so.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import scenes
from common import machine, markdown_table, preset_names, replace_section
from gpu_model import GPUS, MICROSECONDS_PER_LAUNCH, REACHED, Gpu, Work, counted
from seepast import Options, Reconstructor
from seepast.errors import SeepastError
from seepast.frames import rectified_frame
from seepast.gpu import device
from seepast.rectify import rectify

SIZE, CAMERAS, RANGE = (720, 540), 5, 150  # px, cameras, px
LARGE, MANY = (1440, 1080), 9
FRAMES = 200  # of the stream
COUNTED = ("fast", "accurate")
GROUPS = {  # kernels by the beginnings of their names: what gpu_model.py counts them under
    "aggregate.paths": "paths",
    "aggregate.winners": "winners",
    "aggregate.median": "median",
    "blend.": "blend",
    "census.": "census",
    "level.": "levels",
    "plane_fit.": "planes",
    "span.": "levels",
    "confidence.": "evidence",
    "morphology.": "levels",
    "rectify.": "rectify",
    "refocus.": "blend",
    "volume.": "volume",
    "vote.": "votes",
    "windows.": "windows",
    "witness.evidence": "evidence",
    "witness.labels": "labels",
    "witness.": "graded",
}


def main() -> None:
    arguments = _arguments()
    recording = scenes.make(CAMERAS, SIZE)
    parts = [f"On {machine()}; {gpu_in_words()}."]
    parts += measured(recording, arguments) if has_gpu() else [f"NO GPU: nothing is measured here. {gpu_in_words()}"]
    parts += [roofline(recording, name) for name in arguments.presets if name in COUNTED]
    report = "\n\n".join(parts)
    print(report)
    if arguments.write:
        command = f"`make bench-gpu PRESETS={','.join(arguments.presets)}`"
        replace_section(arguments.write, "gpu", f"{command}\n\n{report}")
        print(f"\nwritten: {arguments.write}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", type=preset_names, default="", help="comma-separated; default: all")
    parser.add_argument("--rounds", type=int, default=30, help="per number (30)")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="replace the section 'gpu' of this file")
    return parser.parse_args()


def has_gpu() -> bool:
    try:
        device.current()
    except SeepastError:
        return False
    return True


def gpu_in_words() -> str:
    try:
        return device.current().name
    except SeepastError as error:
        return str(error)


def options_of(preset: str) -> Options:
    return Options.preset(preset).updated({"range.max_disparity": RANGE, "range.step": 0.5})


# ---------------------------------------------------------------------------------------------- measured on a GPU


def measured(recording: scenes.Recording, arguments: argparse.Namespace) -> list[str]:
    header = ["", *arguments.presets]
    large = scenes.make(MANY, LARGE)
    grows = MANY * np.prod(LARGE) / (CAMERAS * np.prod(SIZE))
    kept = [on_gpu(recording, preset, arguments.rounds) for preset in arguments.presets]
    longer = [on_gpu(large, preset, 9) / ms for preset, ms in zip(arguments.presets, kept, strict=True)]
    rows = [
        ["ms per frame, arrays on the GPU", *(f"{ms:.2f}" for ms in kept)],
        ["frames/s, upload and download, streaming", *(f"{streaming(recording, p):.0f}" for p in arguments.presets)],
        ["MB of device memory", *(f"{memory(recording, p):.0f}" for p in arguments.presets)],
        [f"{LARGE[0]}x{LARGE[1]}x{MANY}: times as long; pixels x cameras {grows:.1f}", *(f"{n:.1f}" for n in longer)],
    ]
    return ["### Measured", markdown_table(header, rows), *(kernels(recording, p) for p in arguments.presets)]


def uploaded(recording: scenes.Recording) -> tuple[list[Any], list[Any]]:
    upload = device.current().upload
    return [upload(image) for image in recording.images], [upload(mask) for mask in recording.masks]


def on_gpu(recording: scenes.Recording, preset: str, rounds: int) -> float:
    """Median ms of a frame, input and output on the GPU."""
    run = Reconstructor(recording.rig, options=options_of(preset), backend="cuda", on_device=True)
    images, masks = uploaded(recording)
    took = []
    for _ in range(rounds + 3):
        device.current().synchronize()
        start = time.perf_counter()
        run(images, masks)
        device.current().synchronize()
        took.append(1e3 * (time.perf_counter() - start))
    return median(took[3:])


def streaming(recording: scenes.Recording, preset: str) -> float:
    """Frames per second of `Reconstructor.stream`, from and to NumPy's arrays."""
    run = Reconstructor(recording.rig, options=options_of(preset), backend="cuda")
    frames = ((recording.images, recording.masks) for _ in range(FRAMES + 20))
    start = 0.0
    for i, _ in enumerate(run.stream(frames)):
        if i == 19:
            start = time.perf_counter()
    return FRAMES / (time.perf_counter() - start)


def memory(recording: scenes.Recording, preset: str) -> float:
    """MB that CuPy's pool holds after some frames: the most that was needed at any time."""
    pool = device.current().xp.get_default_memory_pool()
    pool.free_all_blocks()
    before = pool.total_bytes()
    run = Reconstructor(recording.rig, options=options_of(preset), backend="cuda", on_device=True)
    images, masks = uploaded(recording)
    for _ in range(3):
        run(images, masks)
    return (pool.total_bytes() - before) / 2**20


class Timed:
    """The device, with events around every launch."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner
        self.events: list[tuple[str, Any, Any]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def launch(self, file: str, kernel: str, **how: Any) -> None:
        cuda = self._inner.xp.cuda
        before, after = cuda.Event(), cuda.Event()
        before.record()
        self._inner.launch(file, kernel, **how)
        after.record()
        self.events.append((f"{file}.{kernel}", before, after))


@contextmanager
def timed() -> Iterator[Timed]:
    watched = Timed(device.current())
    with device.use(watched):  # type: ignore[arg-type]
        yield watched


def kernels(recording: scenes.Recording, preset: str) -> str:
    """Ms of every kernel in one frame, by the GPU's own clock."""
    run = Reconstructor(recording.rig, options=options_of(preset), backend="cuda", on_device=True)
    images, masks = uploaded(recording)
    with timed() as watched:
        for _ in range(3):
            watched.events.clear()
            run(images, masks)
        device.current().synchronize()
    took: dict[str, list[float]] = defaultdict(list)
    for kernel, before, after in watched.events:
        took[group(kernel)].append(watched.xp.cuda.get_elapsed_time(before, after))
    bounds = least(recording, preset)
    rows = []
    for name, ms in sorted(took.items(), key=lambda of: -sum(of[1])):
        share = f"{100 * bounds[name] / sum(ms):.0f} %" if name in bounds else "-"
        rows.append([name, str(len(ms)), f"{sum(ms):.3f}", share])
    rows.append(["all", str(len(watched.events)), f"{sum(map(sum, took.values())):.3f}", "-"])
    head = f"### {preset}: kernels, by the GPU's own clock"
    return f"{head}\n\n" + markdown_table(["kernel", "launches", "ms", "of the bound reached"], rows)


def group(kernel: str) -> str:
    """The name that gpu_model.py counts a kernel under."""
    for start, name in GROUPS.items():
        if kernel.startswith(start):
            return name
    return kernel


def least(recording: scenes.Recording, preset: str) -> dict[str, float]:
    """Ms that the data sheet of this GPU allows, by kernel; nothing where it is not in GPUS, or nothing is counted."""
    known = [gpu for gpu in GPUS if gpu.name in device.current().name]
    if not known or preset not in COUNTED:
        return {}
    return {name: known[0].bound(work) for name, work in work_of(recording, preset).items()}


# --------------------------------------------------------------------------------------------- counted and modelled


def roofline(recording: scenes.Recording, preset: str) -> str:
    """Work of a frame by kernel, the least time it takes on GPUs by their data sheets, and the model's total."""
    work = work_of(recording, preset)
    header = ["kernel", "launches", "10^9 operations", "MB", *(f"bound on {gpu.name}, ms" for gpu in GPUS)]
    rows = [_row(name, [of], GPUS) for name, of in sorted(work.items(), key=lambda of: -of[1].operations)]
    rows.append(_row("all", list(work.values()), GPUS))
    modelled = ", ".join(f"{gpu.name} {sum(map(gpu.modelled, work.values())):.1f} ms" for gpu in GPUS)
    operations, moved = (f"{100 * share:.0f} %" for share in REACHED)
    note = (
        f"MODEL, not measured: with {operations} of the peak of operations, {moved} of that of memory and "
        f"{MICROSECONDS_PER_LAUNCH:g} us per launch: {modelled}. Left out: the look whether the masks agree, "
        "and CuPy's own element-wise launches."
    )
    return f"### {preset}: counted work of one frame, and bounds\n\n{markdown_table(header, rows)}\n\n{note}"


def work_of(recording: scenes.Recording, preset: str) -> dict[str, Work]:
    rectification = rectify(recording.rig)
    frame = rectified_frame(rectification, recording.images, recording.masks)
    return counted(frame, rectification.geometry, options_of(preset))


def _row(name: str, work: Sequence[Work], gpus: Sequence[Gpu]) -> list[str]:
    total = Work(sum(of.operations for of in work), sum(of.bytes for of in work), sum(of.launches for of in work))
    bounds = [f"{sum(gpu.bound(of) for of in work):.3f}" for gpu in gpus]
    return [name, str(total.launches), f"{total.operations / 1e9:.2f}", f"{total.bytes / 2**20:.0f}", *bounds]


if __name__ == "__main__":
    main()
