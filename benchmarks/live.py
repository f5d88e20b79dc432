"""`seepast serve` between processes: what comes out, how late, what is dropped, and does memory grow?

    python benchmarks/live.py [--size 320x240] [--hz 20] [--seconds 60] [--lose cam3:10] [--write RESULTS.md]
                              [--serve "--preset paper --dynamic-only"]

The cameras are a process of their own (tests/ros_wire.py) that publishes images and masks of five cameras over
CycloneDDS, on the loopback interface; the scene is that of speed.py. Needs seepast[test].
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import cv2
import numpy as np

import scenes
from common import machine, replace_section
from speed import sgbm_clock

TESTS = Path(__file__).parents[1] / "tests"
EVERY = 1.0  # seconds between two looks at it
ROUNDS = 9  # of SGBM, which tells how busy the machine is


def main() -> None:
    arguments = _arguments()
    words = machine()
    with tempfile.TemporaryDirectory() as folder:
        _write_scene(Path(folder), arguments.size)
        clock = sgbm_clock()
        before = median(clock() for _ in range(ROUNDS))
        report, memory = _measure(Path(folder), arguments)
        after = median(clock() for _ in range(ROUNDS))
    busy = f"SGBM, 3-way, one pair of 720x540, all threads: {before:.0f} ms before, {after:.0f} ms after."
    told = f"On {words}.\n\n{_told(report, memory)}\n\n{busy}"
    print(told)
    if arguments.write:
        options = (
            f"--size {arguments.size[0]}x{arguments.size[1]} --hz {arguments.hz:g} --seconds {arguments.seconds:g}"
        )
        lose = f" --lose {arguments.lose}" if arguments.lose else ""
        command = f'`python benchmarks/live.py {options}{lose} --serve "{arguments.serve}"`'
        replace_section(arguments.write, arguments.section, f"{command}\n\n{told}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=lambda text: tuple(map(int, text.split("x"))), default=(320, 240))
    parser.add_argument("--hz", type=float, default=20)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--lose", help="cam3:10 loses every tenth image of cam3")
    parser.add_argument("--serve", default="--preset paper --dynamic-only", help="options of seepast serve")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="replace a section of this file")
    parser.add_argument("--section", default="live", help="which; default: live")
    return parser.parse_args()


def _write_scene(folder: Path, size: tuple[int, int]) -> None:
    made = scenes.make(5, size)
    made.rig.to_kalibr(folder / "rig.yaml")
    for camera, image, mask in zip(made.rig.cameras, made.images, made.masks, strict=True):
        for sub, picture in ((camera.name, image), (f"masks/{camera.name}", mask)):
            (folder / sub).mkdir(parents=True)
            cv2.imwrite(str(folder / sub / "000000.png"), picture)


def _measure(folder: Path, arguments: argparse.Namespace) -> tuple[dict, np.ndarray]:
    """The server's own report, and [n, 2] of seconds and resident MB of its process."""
    sys.path.insert(0, str(TESTS))
    from ros_wire import DOMAIN, LOOPBACK

    environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK, "ROS_DOMAIN_ID": str(DOMAIN)}
    serve = [sys.executable, "-m", "seepast.cli", "serve", "--rig", str(folder / "rig.yaml"), "--json"]
    serve += ["--transport", "dds", "--topics", "/{}/image_raw", "--masks", "topics:/{}/mask"]
    server = subprocess.Popen([*serve, *shlex.split(arguments.serve)], env=environment, stdout=subprocess.PIPE)
    cameras = [sys.executable, str(TESTS / "ros_wire.py"), str(folder), "--masks", "masks"]
    cameras += ["--hz", str(arguments.hz), "--seconds", str(arguments.seconds)]
    cameras += ["--lose", arguments.lose] if arguments.lose else []
    memory = []
    try:
        publishing = subprocess.Popen(cameras, env=environment, stdout=subprocess.DEVNULL)
        start = time.monotonic()
        while publishing.poll() is None and server.poll() is None:
            memory.append((time.monotonic() - start, _resident(server.pid)))
            time.sleep(EVERY)
    finally:
        publishing.kill()
        server.send_signal(signal.SIGTERM)
    out, _ = server.communicate(timeout=60)
    if server.returncode:
        raise SystemExit(f"seepast serve ended with {server.returncode}")
    return json.loads(out), np.array(memory)


def _resident(process: int) -> float:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def _told(report: dict, memory: np.ndarray) -> str:
    halves = [half[:, 1] for half in np.array_split(memory[len(memory) // 10 :], 2)]
    low, high = min(map(np.min, halves)), max(map(np.max, halves))
    latency, age = report["latency_ms"], report["age_ms"]
    lines = [
        f"{report['images']} messages, {report['frames']} instants, {report['published']} results; latency "
        f"{latency[0]:.0f} ms median, {latency[1]:.0f} ms 95 % ({age[0]:.0f} and {age[1]:.0f} since the stamp).",
        f"Resident memory {low:.0f} to {high:.0f} MB; mean of the first half {halves[0].mean():.0f}, of the second "
        f"{halves[1].mean():.0f} MB.",
    ]
    for what in ("frames", "images"):
        for reason, number in report[f"{what}_dropped"].items():
            lines.append(f"- {number} {'instants' if what == 'frames' else 'messages'} dropped: {reason}")
    return "\n".join([lines[0], "", lines[1], "", *lines[2:]])


if __name__ == "__main__":
    main()
