"""What all commands have in common: help, --json, --version, completion."""

from __future__ import annotations

import json
import os
import re
import select
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from recordings import write_recording
from seepast import __version__, about, backends, cli
from seepast.commands.reflow import reflowed
from seepast.errors import BackendError

QUICK = ["--preset", "paper", "--set", "range.max_disparity=12"]


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(list(words)) == 0
    return capsys.readouterr().out


def commands() -> list[str]:
    """Every command but the flags."""
    return [name for name in cli.app if not name.startswith("-")]


def test_every_command_has_one_line_of_help(capsys: pytest.CaptureFixture[str]) -> None:
    table = shown(capsys, "--help").partition("─ Commands ─")[2]
    rows = re.findall(r"^│ (.{11,13}?) (.*?) *│$", table, re.MULTILINE)
    assert len(commands()) >= 11
    assert {name.split()[0] for name, _ in rows} >= {*commands(), "--version"}, "a line that is broken has no name"
    for name, help_line in rows:
        assert name.strip() and len(help_line) > 15 and help_line.endswith("."), (name, help_line)


@pytest.mark.parametrize("command", commands())
def test_help_opens_with_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, command, "--help")
    options = re.search(r"─ (Arguments|Parameters|Commands) ─", text)
    assert options and f"  seepast {command}" in text[: options.start()]


def test_the_examples_of_help_name_options_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands():
        text = shown(capsys, command, "--help")
        told = set(re.findall(r"(--[a-z][a-z-]*)", text.partition("─ Parameters ─")[2]))
        for line in re.findall(rf"^  seepast ({command} .*)$", text, re.MULTILINE):
            for option in re.findall(r" (--[a-z][a-z-]*)", re.split(r" {2,}", line)[0]):
                assert option in told, (line, option)


def test_version_tells_what_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, "--version")
    assert text.startswith(f"seepast {__version__}\n") and "backend reference: found" in text and "numpy" in text
    facts = json.loads(shown(capsys, "--version", "--json"))
    assert facts["seepast"] == __version__ and facts["backends"]["reference"] is None and facts["cores"] >= 1


def test_version_tells_why_a_backend_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def get(name: str) -> None:
        if name == "cpu":
            raise BackendError("backend 'cpu' cannot be loaded (no _core): reinstall")

    monkeypatch.setattr(backends, "get", get)
    text = shown(capsys, "--version")
    assert "backend cpu: backend 'cpu' cannot be loaded (no _core): reinstall" in text
    assert "backend reference: found" in text


def test_extras_and_how_to_get_those_that_are_missing() -> None:
    needs = ['numpy>=1.26; extra == "here"', 'no-such-thing>=2; extra == "gone"', 'pytest; extra == "test"', "numpy"]
    found = about.extras(["here", "gone", "test"], needs)
    assert set(found) == {"here", "gone"} and found["here"]["numpy"] and found["gone"] == {"no-such-thing": None}
    facts = {**about.about(), "extras": found}
    assert "extra gone: pip install 'seepast[gone]'" in about.about_text(facts)


def test_the_instruction_set_is_what_the_core_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    assert about.simd() in ("AVX-512", "AVX2", "NEON", "baseline")
    monkeypatch.setattr("seepast._core.simd", lambda: "AVX2")
    assert "SIMD AVX2," in about.about_text(about.about())


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        (["run", "rec", "--out", "again", *QUICK], {"name", "out", "frames", "milliseconds", "coverage_share"}),
        (["check", "rec"], {"cameras", "frames"}),
        (["export", "out", "--to", "ply"], {"name", "to", "path", "frames"}),
        (["refocus", "rec", "--out", "flat", "--depth", "3"], {"name", "frames", "disparities", "paths"}),
        (["epi", "rec", "--row", "20", "--out", "epi.png"], {"name", "frame", "row", "cameras", "struck_out", "path"}),
        (["models"], {"pphumanseg"}),
        (["demo"], {"picture", "psnr", "hidden_share", "seen_share", "milliseconds"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_json_is_one_line_on_stdout(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    keys: set[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "rec")
    if words[0] == "export":
        shown(capsys, "run", "rec", "--out", "out", *QUICK)
    printed = shown(capsys, *words, "--json")
    assert printed.count("\n") == 1 and keys <= set(json.loads(printed))


def test_json_of_synth_and_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex")
    pytest.importorskip("skimage")
    rig = write_recording(tmp_path / "rec", size=(96, 72)) / "rig.yaml"
    made, out = str(tmp_path / "made"), str(tmp_path / "out")
    said = json.loads(shown(capsys, "synth", made, "--rig", str(rig), "--frames", "1", "--samples", "1", "--json"))
    assert said == {"name": "made", "frames": 1, "figures": 2, "seed": 0, "path": made}
    shown(capsys, "run", made, "--out", out, *QUICK)
    printed = shown(capsys, "evaluate", made, out, "--json")
    rows = json.loads(printed)
    assert printed.count("\n") == 1 and len(rows) == 2 and all("NaN" not in printed for _ in rows)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    script = shown(capsys, "completion", shell)
    for word in (*commands(), "settings", "segmenter", "min-coverage"):
        assert word in script, word
    if shutil.which(shell):
        (tmp_path / "script").write_text(script)
        done = subprocess.run([shell, "-n", str(tmp_path / "script")], capture_output=True, text=True)
        assert done.returncode == 0 and done.stderr == "", done.stderr


@pytest.mark.skipif(not shutil.which("bash"), reason="there is no bash")
@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("seepast ", set(commands())),
        ("seepast r", {"run", "refocus"}),
        ("seepast run --se", {"--segmenter", "--settings", "--set"}),
        ("seepast run rec --backend ", {"auto", "cpu", "cuda", "reference"}),
        ("seepast models ", {"get"}),
    ],
)
def test_bash_completes(typed: str, completed: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "script").write_text(shown(capsys, "completion", "bash"))
    words = shlex.split(typed) + ([""] if typed.endswith(" ") else [])
    quoted = " ".join(shlex.quote(word) for word in words)
    drive = (
        f"source {shlex.quote(str(tmp_path / 'script'))}; COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; "
        'seepast_done() { printf "%s\\n" "${COMPREPLY[@]}"; }; _seepast; seepast_done'
    )
    done = subprocess.run(["bash", "-c", drive], capture_output=True, text=True)
    assert completed <= set(done.stdout.split()), (done.stdout, done.stderr)
    if not typed.endswith(" "):
        assert set(done.stdout.split()) == completed


def typed_in_zsh(script: Path, way: str, typed: str, awaited: set[str]) -> str:
    """What an interactive zsh shows after `typed` and two tabs, read until all `awaited` words are there."""
    leader, follower = os.openpty()
    environment = {"TERM": "dumb", "HOME": str(script.parent), "PATH": os.environ["PATH"], "COLUMNS": "200"}
    ends = {"stdin": follower, "stdout": follower, "stderr": follower}
    zsh = subprocess.Popen(["zsh", "-f", "-i"], env=environment, start_new_session=True, **ends)
    os.close(follower)
    load = {
        "file": f"fpath=({script.parent} $fpath); autoload -U compinit; compinit -D -u",
        "eval": f'autoload -U compinit; compinit -D -u; eval "$(cat {script})"',
    }[way]
    try:
        _read_until(leader, f"stty cols 200; {load}; echo do''ne\n", {"done\r"})
        return _read_until(leader, f"{typed}\t\t", awaited)
    finally:
        zsh.kill()
        zsh.wait()
        os.close(leader)


def _read_until(terminal: int, written: str, awaited: set[str]) -> str:
    os.write(terminal, written.encode())
    shown, end = "", time.monotonic() + 60
    while time.monotonic() < end and not all(word in shown for word in awaited):
        if select.select([terminal], [], [], 0.2)[0]:
            shown += os.read(terminal, 65536).decode(errors="replace")
    return shown


COMPLETED = [
    ("seepast re", {"refocus"}),
    ("seepast run --se", {"--segmenter", "--settings", "--set"}),
    ("seepast run rec --backend ", {"auto", "cpu", "reference"}),
    ("seepast models g", {"get"}),
]


@pytest.mark.skipif(not shutil.which("zsh"), reason="there is no zsh")
@pytest.mark.parametrize("way", ["file", "eval"])
@pytest.mark.parametrize(("typed", "completed"), COMPLETED)
def test_zsh_completes(
    way: str, typed: str, completed: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "_seepast"
    script.write_text(shown(capsys, "completion", "zsh"))
    seen = typed_in_zsh(script, way, typed, completed)
    assert all(word in seen for word in completed), seen


@pytest.mark.skipif(not shutil.which("fish"), reason="there is no fish")
@pytest.mark.parametrize(("typed", "completed"), COMPLETED)
def test_fish_completes(typed: str, completed: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "seepast.fish"
    script.write_text(shown(capsys, "completion", "fish"))
    drive = f"source {shlex.quote(str(script))}; complete -C {shlex.quote(typed)}"
    environment = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(["fish", "-N", "-c", drive], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert {line.split("\t")[0] for line in done.stdout.splitlines()} >= completed, done.stderr


@pytest.mark.parametrize(
    "words", ["--version", "--help", "run --help", "completion fish", "--version --json", "models"]
)
def test_a_reader_that_goes_away_ends_a_command_quietly(words: str) -> None:
    """As in `seepast --help | head -1`; the reader is gone before anything is written."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "seepast.cli", *words.split()]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (cli.EXIT_PIPE, "")


def test_help_joins_the_lines_of_paragraphs_and_nothing_else() -> None:
    written = """One line.

    A paragraph of
    two lines

      seepast an example
      seepast another

    Parameters
    ----------
    out
        Described in
        two lines.
    other
        In one.
    """
    assert reflowed(written) == (
        "One line.\n\nA paragraph of two lines\n\n  seepast an example\n  seepast another\n\n"
        "Parameters\n----------\nout\n    Described in two lines.\nother\n    In one."
    )
