"""From PNG files to PNG files: does reading, rectifying, reconstructing and writing of successive frames overlap?

    python benchmarks/stream.py [RECORDING] [--presets paper,...] [--frames 12] [--rounds 5] [--write RESULTS.md]

Milliseconds per frame of reading alone, of reconstructing alone, of both and writing one after the other, and of
`seepast run`. The goal: run takes at most 1.2 times the slower of reading and reconstructing. All run in turn, round
after round, with SGBM (3-way, one pair of 720x540) among them to tell how busy the machine is; medians. Without
RECORDING, the scene of speed.py, written once per frame.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import cv2

import scenes
from common import machine, markdown_table, preset_names, replace_section
from seepast.datasets import Dataset, open_dataset
from seepast.export import FolderWriter
from seepast.options import Options
from seepast.pipeline import Reconstructor
from seepast.sequence import Settings, describe_run, process
from speed import CAMERAS, RANGE, SIZE, sgbm_clock

SGBM = "SGBM pair"
HEADER = ("preset", "read", "reconstruct", "one by one", "stream", "run", SGBM, "run / the slower")


def main() -> None:
    arguments = _arguments()
    words = machine()
    arguments.clock = sgbm_clock()
    with _recording(arguments.recording, arguments.frames) as folder:
        dataset = open_dataset(folder)
        rows = [_row(dataset, preset, arguments) for preset in arguments.presets]
        frames = len(dataset.stamps[: arguments.frames])
    head = f"On {words}.\n\nMilliseconds per frame, medians of {arguments.rounds} rounds of {frames} frames."
    report = f"{head}\n\n{markdown_table(HEADER, rows)}"
    print(report)
    if arguments.write:
        command = f"`python benchmarks/stream.py --presets {','.join(arguments.presets)} --frames {arguments.frames}`"
        replace_section(arguments.write, "stream", f"{command}\n\n{report}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?")
    parser.add_argument("--presets", type=preset_names, default="", help="comma-separated; default: all")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="replace the section 'stream' of this file")
    return parser.parse_args()


@contextlib.contextmanager
def _recording(given: Path | None, frames: int) -> Iterator[Path]:
    if given is not None:
        yield given
        return
    made = scenes.make(CAMERAS, SIZE)
    with tempfile.TemporaryDirectory() as folder:
        made.rig.to_kalibr(Path(folder) / "rig.yaml")
        for camera, image, mask in zip(made.rig.cameras, made.images, made.masks, strict=True):
            for sub, picture in ((camera.name, image), (f"masks/{camera.name}", mask)):
                (Path(folder) / sub).mkdir(parents=True)
                cv2.imwrite(str(Path(folder) / sub / "000000.png"), picture)
                for number in range(1, frames):
                    shutil.copy(Path(folder) / sub / "000000.png", Path(folder) / sub / f"{number:06d}.png")
        yield Path(folder)


def _row(dataset: Dataset, preset: str, arguments: argparse.Namespace) -> list[str]:
    """Median ms per frame of every task, and the median over the rounds of run / max(read, reconstruct)."""
    options = Options.preset(preset).updated({"range.max_disparity": RANGE})
    dataset.stamps = dataset.stamps[: arguments.frames]
    tasks = _tasks(dataset, options)
    tasks["reconstruct"]()  # what only a first frame needs does not count
    found: dict[str, list[float]] = {name: [] for name in (*tasks, SGBM)}
    for _ in range(arguments.rounds):
        found[SGBM].append(arguments.clock())
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            found[name].append(1e3 * (time.perf_counter() - start) / len(dataset.stamps))
    slower = map(max, found["read"], found["reconstruct"])
    ratio = median(run / best for run, best in zip(found["run"], slower, strict=True))
    return [preset, *(f"{median(found[name]):.1f}" for name in HEADER[1:-1]), f"{ratio:.2f}"]


def _tasks(dataset: Dataset, options: Options) -> dict[str, Callable[[], None]]:
    frames = [dataset.frame(stamp) for stamp in dataset.stamps]
    reconstructor, settings = Reconstructor(dataset.rig, options=options), Settings(options, overwrite=True)
    names = [camera.name for camera in dataset.rig.cameras]

    def read() -> None:
        for stamp in dataset.stamps:
            dataset.frame(stamp)

    def reconstruct() -> None:
        for frame in frames:
            reconstructor(frame.images, frame.masks)

    def one_by_one() -> None:
        with (
            tempfile.TemporaryDirectory() as out,
            FolderWriter(out, describe_run(dataset, settings), names) as writer,
        ):
            for frame in map(dataset.frame, dataset.stamps):
                writer.write(frame.stamp, reconstructor(frame.images, frame.masks), 0.0)

    def stream() -> None:
        frames = map(dataset.frame, dataset.stamps)
        for _ in reconstructor.stream((frame.images, frame.masks) for frame in frames):
            pass

    def run() -> None:
        with tempfile.TemporaryDirectory() as out:
            process(dataset, out, settings)

    return {"read": read, "reconstruct": reconstruct, "one by one": one_by_one, "stream": stream, "run": run}


if __name__ == "__main__":
    main()
