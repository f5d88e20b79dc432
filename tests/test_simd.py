"""Every level of SIMD gives the same bits: the core's calls, recorded here, are repeated by builds for one level each.

The builds are kept in build/replay: the first run takes a minute or two, the next ones seconds.
"""

from __future__ import annotations

import platform
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from arrays import SPACING, make_scene
from replay import record
from seepast import Options, Rig, _core, reconstruct
from seepast.threads import cores

ROOT = Path(__file__).parents[1]
BUILDS = ROOT / "build" / "replay"
PRESETS = ("paper", "accurate", "fast")
LEVELS = ("baseline", "AVX2", "AVX-512")
LENS = (-0.05, 0.01, 0.0, 0.0)
CROSS = (
    "-DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++",
    "-DCMAKE_SYSTEM_NAME=Linux",
    "-DCMAKE_SYSTEM_PROCESSOR=aarch64",
)


def crooked(rig: Rig) -> Rig:
    """The rig with its cameras off their line, so that views are enlarged and shifted down by disparity; and seen
    through lenses, so that they must be rectified."""
    rng = np.random.default_rng(1)
    cameras = list(rig.cameras)
    for k in range(1, len(cameras)):
        pose = cameras[k].cam_from_rig.copy()
        pose[1:3, 3] += rng.uniform(-0.02, 0.02, 2)
        cameras[k] = replace(cameras[k], cam_from_rig=pose)
    cameras = [replace(camera, distortion="radtan", distortion_coeffs=LENS) for camera in cameras]
    return replace(rig, cameras=tuple(cameras))


def see_past(preset: str) -> None:
    """Everything that the preset does, on small scenes."""
    options = Options.preset(preset).updated({"range.max_disparity": 60})
    for cameras, kind in ((5, "soft"), (3, "exact")):
        scene = make_scene(cameras, (136, 56), surface="step", masks=kind, colour=True, noise=2, seed=cameras)
        rig = Rig.linear(cameras, focal=scene.geometry.focal[0], spacing=SPACING, size=scene.geometry.size)
        if cameras == 3:
            rig = crooked(rig)
        reconstruct(list(scene.views), scene.masks, rig, options=options, dynamic_only=cameras == 3)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, dict[str, int]]]:
    """preset -> the recording of its calls, and how many there are of every function."""
    folder = tmp_path_factory.mktemp("recordings")
    made = {}
    for preset in PRESETS:
        path = folder / preset
        made[preset] = path, record(path, partial(see_past, preset), pytest.MonkeyPatch())
    return made


def tool(name: str) -> str:
    """A program of this environment, or of the system."""
    found = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def built(name: str, *settings: str) -> Path:
    """The program that repeats calls, built with these settings of tests/cpp/CMakeLists.txt."""
    cmake, folder = tool("cmake"), BUILDS / name
    fresh = [] if (folder / "CMakeCache.txt").exists() else ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={tool('ninja')}"]
    commands = (
        [cmake, "-S", str(ROOT / "tests" / "cpp"), "-B", str(folder), *fresh, *settings],
        [cmake, "--build", str(folder), "--parallel", str(cores())],
    )
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return folder / "replay"


def repeated(command: list[str | Path], recording: Path) -> tuple[dict[str, int], dict[str, int], str]:
    """How many calls of every function were repeated, how many gave something else, and the level of SIMD."""
    done = subprocess.run([*command, recording], capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stderr
    counts = re.findall(r"(\w+) (\d+) (\d+)\n", done.stdout)
    calls, differ = ({row[0]: int(row[i]) for row in counts} for i in (1, 2))
    return calls, {name: n for name, n in differ.items() if n}, done.stdout.rpartition("simd ")[2].strip()


def assert_same(command: list[str | Path], level: str, recordings: dict[str, tuple[Path, dict[str, int]]]) -> None:
    for preset, (recording, calls) in recordings.items():
        assert repeated(command, recording) == (calls, {}, level), preset


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64")
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
@pytest.mark.parametrize("level", LEVELS)
def test_every_level_of_this_machine_gives_the_same_bits(level, recordings):
    if LEVELS.index(level) > LEVELS.index(_core.simd()):
        pytest.skip(f"this processor has no {level}")
    name = level.lower().replace("-", "")
    program = built(name, "-DCMAKE_CXX_COMPILER=g++", f"-DSEEPAST_ARCH={name}")
    assert_same([program], level, recordings)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64")
@pytest.mark.skipif(shutil.which("qemu-x86_64") is None, reason="qemu-x86_64 is not installed (Debian: qemu-user)")
@pytest.mark.parametrize(("processor", "level"), [("Nehalem", "baseline"), ("Haswell", "AVX2")])
def test_the_loops_of_a_wheel_are_chosen_by_the_processor(processor, level, recordings):
    """Among all levels, as a wheel has them; of one too high the emulator would know no instruction."""
    program = built("wheel", "-DCMAKE_CXX_COMPILER=g++")
    few = {preset: recordings[preset] for preset in ("paper", "fast")}
    assert_same(["qemu-x86_64", "-cpu", processor, program], level, few)


def test_neon_gives_the_same_bits(recordings):
    for name in ("aarch64-linux-gnu-g++", "qemu-aarch64"):
        if shutil.which(name) is None:
            pytest.skip(f"{name} is not installed (Debian: g++-aarch64-linux-gnu, qemu-user)")
    assert_same(["qemu-aarch64", built("aarch64", *CROSS)], "NEON", recordings)


def test_recordings_hold_the_core_of_every_preset(recordings):
    called = {preset: set(calls) for preset, (_, calls) in recordings.items()}
    assert {"support_of_camera", "disparity", "segmentation", "refocus"} <= called["paper"]
    for preset in ("accurate", "fast"):
        assert {"volumes", "aggregates", "graded", "witnesses", "blend"} <= called[preset]
    everything = {n for n in dir(_core) if not n.startswith("_") and "func" in type(getattr(_core, n)).__name__}
    missing = everything - set().union(*called.values()) - {"set_threads", "simd"}
    assert not missing, "these are never compared"


def test_a_call_that_gives_something_else_is_found(recordings, tmp_path):
    """A bit of what volumes was given is turned over, and so what it writes."""
    if not (BUILDS / "baseline" / "replay").exists():
        pytest.skip("the baseline is not built")
    path, calls = recordings["fast"]
    bytes_ = bytearray(path.read_bytes())
    name = bytes_.index(b"\x07volumes")
    colour = bytes_.index(b"a\x02u1\x04", name) + 5
    shape = struct.unpack_from("<4q", bytes_, colour)
    bytes_[colour + 40 + int(np.prod(shape)) // 2] ^= 128
    changed = tmp_path / "changed"
    changed.write_bytes(bytes_)
    found, differ, _ = repeated([BUILDS / "baseline" / "replay"], changed)
    assert found == calls and differ == {"volumes": 1}
