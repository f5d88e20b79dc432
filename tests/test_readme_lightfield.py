"""The README's commands of the report, refocusing, epipolar-plane images and the viewer do what stands there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from recordings import write_recording
from seepast import cli

README = Path(__file__).parents[1] / "README.md"
SIZE = (96, 240)  # the README's row 200 must be there
ELSEWHERE = {"--reader", "--segmenter"}  # run by other tests, on recordings of their own


def commands() -> list[list[str]]:
    """Arguments of every `seepast check|refocus|epi|view ...` in the README, without the words that explain it."""
    lines = re.findall(r"^ +(?:\S*/)?seepast ((?:check|refocus|epi|view) .*)$", README.read_text(), re.MULTILINE)
    found = [shlex.split(re.split(r" {2,}| #", line)[0]) for line in lines]
    return [words for words in found if not ELSEWHERE & set(words)]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_recording(tmp_path / "recording", size=SIZE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_readme_shows_them() -> None:
    shown = [words[0] for words in commands()]
    assert {"check", "refocus", "epi", "view"} == set(shown) and len(shown) >= 6


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_it_runs(words: list[str], here: Path) -> None:
    if words[0] == "view":
        pytest.importorskip("rerun")
        run = ["run", "recording", "--out", "out", "--preset", "paper", "--set", "range.max_disparity=12"]
        assert cli.main(run) == 0
    assert cli.main(words) == 0
    for option in ("--out", "--html", "--video", "--save"):
        if option in words:
            assert Path(words[words.index(option) + 1]).exists()
