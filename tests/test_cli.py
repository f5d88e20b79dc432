"""The command line: what it prints where, exit codes, several recordings, resuming, interruption."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recordings import write_recording
from seepast import __version__, cli, sequence
from seepast.errors import InputError
from seepast.options import DEFAULT_PRESET, Options
from seepast.rectify import rectify
from seepast.result import Result

FAKE_MS = 5.0


class FakeReconstructor:
    """Stands in for the method: gives back the reference image; half of it covered, all of it 2 m away."""

    made: list[FakeReconstructor] = []  # noqa: RUF012

    def __init__(self, rig: Any, **settings: Any):
        self.rig, self.settings, self.frames = rig, settings, 0
        self.geometry = rectify(rig, settings["reference"]).geometry
        FakeReconstructor.made.append(self)

    def __call__(self, images: Any, masks: Any) -> Result:
        self.frames += 1
        height, width = images[0].shape[:2]
        coverage = np.ones((height, width), np.uint8)
        coverage[: height // 2] = 0
        depth = np.full((height, width), 2, np.float32)
        return Result(
            background=images[self.settings["reference"]],
            disparity=depth,
            depth=depth,
            confidence=np.ones_like(depth),
            coverage=coverage,
            labels=np.zeros((height, width), np.uint16),
            masks=tuple(masks or [np.zeros((height, width), np.uint8) for _ in images]),
            geometry=self.geometry,
            timings={"rectify": FAKE_MS},
            rounds=1,
            options=self.settings["options"],
            backend="reference",
        )

    def stream(self, frames: Any) -> Iterator[Result]:
        return (self(*frame) for frame in frames)


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeReconstructor]:
    FakeReconstructor.made = []
    monkeypatch.setattr(sequence, "Reconstructor", FakeReconstructor)
    return FakeReconstructor


def seepast(*arguments: object) -> int:
    words = [str(a) for a in arguments]
    return cli.main([*words, "--backend", "reference"] if words and words[0] == "run" else words)


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_run_writes_the_output_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path / "rec", stamps=("a", "b"))
    assert seepast("run", tmp_path / "rec", "--out", tmp_path / "out") == 0
    printed = capsys.readouterr()
    line = rf"rec: 2 frames, \d+ ms per frame, coverage 50\.0 %, {re.escape(str(tmp_path / 'out'))}\n"
    assert re.fullmatch(line, printed.out)
    assert printed.err == "", "no progress bar where there is no terminal"
    kinds = {"background/{}.png", "disparity/{}.pfm", "depth/{}.png", "confidence/{}.png", "coverage/{}.png"}
    kinds |= {f"masks/cam{k}/{{}}.png" for k in range(3)}
    assert names(tmp_path / "out") == {k.format(s) for k in kinds for s in "ab"} | {"run.json", "camera.yaml"}


def test_settings_reach_the_method(tmp_path: Path, fake: type[FakeReconstructor]) -> None:
    write_recording(tmp_path / "rec")
    settings = ["--reference", "cam2", "--dynamic-only", "--threads", "3", "--masks", "none"]
    options = ["--set", "disparity.beta=0.25", "--set", "range.max_disparity=77"]
    assert seepast("run", tmp_path / "rec", "--out", tmp_path / "out", *settings, *options) == 0
    (made,) = fake.made
    expected = Options.preset(DEFAULT_PRESET).updated({"disparity.beta": 0.25, "range.max_disparity": 77})
    assert made.settings["options"] == expected
    assert (made.settings["reference"], made.settings["dynamic_only"], made.settings["threads"]) == (
        2,
        True,
        3,
    )
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (run["reference"], run["dynamic_only"], run["masks"]) == ("cam2", True, "none")
    assert run["options"]["disparity.beta"] == 0.25
    there = cv2.imread(str(tmp_path / "rec/cam2/000000.png"))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out/background/000000.png")), there)


def test_a_folder_of_recordings_and_a_bad_one_among_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in "abc":
        write_recording(tmp_path / "data" / name)
    (tmp_path / "data" / "b" / "cam1" / "000000.png").write_bytes(b"")
    assert seepast("run", tmp_path / "data", "--out", tmp_path / "out") == 2
    printed = capsys.readouterr()
    assert [line.split(":")[0] for line in printed.out.splitlines()] == ["a", "c"]
    assert printed.err.startswith("seepast: error:") and "b/cam1/000000.png" in printed.err
    assert (tmp_path / "out" / "a" / "run.json").is_file() and (tmp_path / "out" / "c" / "run.json").is_file()


def test_json_is_one_line_for_machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path / "rec")
    assert seepast("run", tmp_path / "rec", "--out", tmp_path / "out", "--json") == 0
    (line,) = capsys.readouterr().out.splitlines()
    summary = json.loads(line)
    assert summary["name"] == "rec" and summary["frames"] == 1 and summary["coverage_share"] == pytest.approx(0.5)
    assert summary["milliseconds"]["rectify"] == FAKE_MS


def test_the_same_command_goes_on_where_it_stopped(
    tmp_path: Path, fake: type[FakeReconstructor], capsys: pytest.CaptureFixture[str]
) -> None:
    rec = write_recording(tmp_path / "rec", stamps=("a", "b", "c"))
    good = (rec / "cam1" / "b.png").read_bytes()
    (rec / "cam1" / "b.png").write_bytes(good[:99])
    assert seepast("run", rec, "--out", tmp_path / "out") == 2
    assert "cam1/b.png" in capsys.readouterr().err
    (rec / "cam1" / "b.png").write_bytes(good)
    assert seepast("run", rec, "--out", tmp_path / "out") == 0
    assert "3 frames (1 from before)" in capsys.readouterr().out
    assert [made.frames for made in fake.made] == [1, 2]
    assert seepast("run", rec, "--out", tmp_path / "out") == 0
    assert "3 frames (3 from before)" in capsys.readouterr().out
    assert fake.made[-1].frames == 0


def test_another_run_needs_overwrite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec = write_recording(tmp_path / "rec")
    assert seepast("run", rec, "--out", tmp_path / "out") == 0
    assert seepast("run", rec, "--out", tmp_path / "out", "--reference", "cam1") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert seepast("run", rec, "--out", tmp_path / "out", "--reference", "cam1", "--overwrite") == 0


def test_the_dataset_itself_is_never_an_output(tmp_path: Path) -> None:
    rec = write_recording(tmp_path / "rec")
    before = names(rec)
    assert seepast("run", rec, "--out", rec, "--overwrite") == 2
    assert seepast("run", tmp_path, "--out", tmp_path, "--overwrite") == 2
    assert names(rec) == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "REC", "--out", "OUT", "--set", "disparity.bta=1"], "disparity.beta"),
        (["run", "REC", "--out", "OUT", "--set", "disparity.beta"], "stage.field=value"),
        (["run", "REC", "--out", "OUT", "--set", "disparity.beta=nan"], "disparity.beta"),
        (["run", "REC", "--out", "OUT", "--preset", "papper"], "paper"),
        (["run", "REC", "--out", "OUT", "--reference", "cam9"], "cam9"),
        (["run", "REC", "--out", "OUT", "--masks", "no_such"], "no_such"),
        (["run", "REC/cam0", "--out", "OUT"], "rig.yaml"),
        (["run", "nowhere", "--out", "OUT"], "nowhere"),
        (["run", "REC", "--out", "REC/rig.yaml"], "is a file"),
        (["run", "REC"], "--out"),
        (["run", "REC", "--out", "OUT", "--colour"], "--colour"),
        (["rum"], "rum"),
        (["refocus", "REC", "--out", "OUT"], "--depth"),
        (["refocus", "REC", "--out", "OUT", "--depth", "2", "--disparity", "3"], "--depth"),
        (["refocus", "REC", "--out", "OUT", "--depth", "0"], "--depth"),
        (["refocus", "REC", "--out", "OUT", "--disparity=-1"], "--disparity"),
        (["synth", "OUT", "--rig", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_every_error_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    rec = write_recording(tmp_path / "rec")
    words = [word.replace("REC", str(rec)).replace("OUT", str(tmp_path / "out")) for word in words]
    assert seepast(*words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("seepast: error: ") and printed.err.count("\n") == 1
    assert says in printed.err


def test_warnings_are_one_line_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec = write_recording(tmp_path / "rec", stamps=("a", "b"))
    (rec / "cam2" / "b.png").unlink()
    assert seepast("run", rec, "--out", tmp_path / "out") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("seepast: warning: ") and "1 of 2" in line


def test_a_recording_without_anything_static_draws_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    really = FakeReconstructor.__call__

    def see_nothing(self: FakeReconstructor, *arguments: Any) -> Result:
        result = really(self, *arguments)
        return replace(result, coverage=np.zeros_like(result.coverage))

    monkeypatch.setattr(FakeReconstructor, "__call__", see_nothing)
    assert seepast("run", write_recording(tmp_path / "rec", stamps="ab"), "--out", tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert "coverage 0.0 %" in printed.out
    assert printed.err.startswith("seepast: warning: ") and "2 frames" in printed.err and "255" in printed.err


def test_whatever_the_method_refuses_is_told_the_same_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> Result:
        raise InputError("images: something\nis wrong")

    monkeypatch.setattr(FakeReconstructor, "__call__", refuse)
    assert seepast("run", write_recording(tmp_path / "rec"), "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err == "seepast: error: images: something is wrong\n"


def test_keyboard_interrupt_is_130_and_keeps_whole_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    really = FakeReconstructor.__call__

    def interrupted(self: FakeReconstructor, *arguments: Any) -> Result:
        if self.frames == 2:
            raise KeyboardInterrupt
        return really(self, *arguments)

    monkeypatch.setattr(FakeReconstructor, "__call__", interrupted)
    rec = write_recording(tmp_path / "rec", stamps=("a", "b", "c", "d"))
    assert seepast("run", rec, "--out", tmp_path / "out") == 130
    assert "interrupted" in capsys.readouterr().err
    assert {p.stem for p in (tmp_path / "out" / "coverage").iterdir()} == {"a", "b"}
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames"] == 2


def test_check_reads_everything_and_measures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec = write_recording(tmp_path / "rec", stamps=("a", "b"))
    assert seepast("check", rec) == 0
    first, view, *table = capsys.readouterr().out.splitlines()
    assert first == "rec: 3 cameras, 2 frames, 5.6 % dynamic"
    assert view.startswith("view: 48x36, f 48.0 px, baseline 0.200 m: 5 m away is 1.9 px")
    assert any("rows, measured" in row for row in table)
    (rec / "masks" / "cam2" / "b.png").write_bytes(b"")
    assert seepast("check", rec) == 2
    assert "masks/cam2/b.png" in capsys.readouterr().err


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert text.index("seepast run recording") < text.index("Commands"), "examples come first"
    for command in ("run", "check", "refocus", "epi", "view", "synth", "evaluate", "demo"):
        assert re.search(rf"│ {command} ", text), command
        assert cli.main([command, "--help"]) == 0
    for code in (cli.EXIT_ERROR, cli.EXIT_INTERRUPTED, cli.EXIT_TERMINATED):
        assert str(code) in text
    capsys.readouterr()
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith(f"seepast {__version__}\n")


def test_help_loads_no_engine() -> None:
    """--help must not pay for what only the commands need."""
    code = (
        "import sys; from seepast import cli; cli.main(['--help']);"
        "heavy = {'scipy', 'skimage', 'trimesh', 'rich.progress', 'seepast.sequence', 'seepast.synth'};"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def environment() -> dict[str, str]:
    source = str(Path(cli.__file__).parents[1])
    return {**os.environ, "PYTHONPATH": os.pathsep.join([source, os.environ.get("PYTHONPATH", "")])}


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_real_run_that_is_interrupted_leaves_whole_frames_and_resumes(
    tmp_path: Path, sent: signal.Signals, code: int
) -> None:
    stamps = tuple(f"{n:03d}" for n in range(200))
    rec = write_recording(tmp_path / "rec", cameras=2, stamps=stamps[:1], size=(32, 24))
    for folder in [base / f"cam{k}" for base in (rec, rec / "masks") for k in range(2)]:
        for stamp in stamps[1:]:
            os.link(folder / "000.png", folder / f"{stamp}.png")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "seepast.cli", "run", str(rec), "--out", str(out)]
    process = subprocess.Popen(
        [*command, "--backend", "reference"], env=environment(), stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not list(out.glob("coverage/*.png")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(sent)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code, said
    assert said.startswith("seepast: error: ") and said.count("\n") == 1
    finished = sorted(p.stem for p in out.glob("coverage/*.png"))
    assert 1 <= len(finished) < len(stamps)
    for path in names(out):
        assert Path(path).suffix in (".png", ".pfm", ".json", ".yaml")
        if path.endswith(("png", "pfm")):
            assert cv2.imread(str(out / path), cv2.IMREAD_UNCHANGED) is not None
    assert json.loads((out / "run.json").read_text())["frames"] == len(finished)
    broken = rec / "cam0" / f"{stamps[len(finished) + 1]}.png"  # ends the second run soon
    broken.unlink()
    broken.write_bytes(b"")
    again = subprocess.run([*command, "--backend", "reference"], env=environment(), capture_output=True)
    assert again.returncode == 2
    assert sorted(p.stem for p in out.glob("coverage/*.png")) == [*finished, stamps[len(finished)]]
