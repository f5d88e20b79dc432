"""The registry of readers: guessed, forced, and of one's own."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from recordings import write_recording
from seepast.cli import main
from seepast.datasets import READERS, FolderDataset, Reader, find_datasets, find_reader, open_dataset
from seepast.errors import DatasetError, OptionsError

OWN_READER = """
from seepast.datasets import FolderDataset, Reader

READER = Reader(lambda path: path.suffix == ".array", lambda path, options: FolderDataset(path.with_suffix(""), "none"))
NOT_ONE = 3
"""


def test_a_reader_of_ones_own_in_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "walk", masks=None)
    (tmp_path / "walk.array").touch()
    (tmp_path / "my_reader.py").write_text(OWN_READER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    arguments = ["--out", "out", "--preset", "paper", "--reader", "my_reader:READER"]
    assert main(["run", "walk.array", *arguments]) == 0
    assert "1 frame" in capsys.readouterr().out
    assert main(["check", ".", "--reader", "my_reader:READER"]) == 0
    for wrong, problem in (("my_reader:NOT_ONE", "is a int"), ("my_reader:NONE", "cannot be"), ("no_one:X", "no_one")):
        with pytest.raises(OptionsError, match=problem):
            find_reader(wrong)


def test_a_reader_in_the_registry_goes_before_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_recording(tmp_path / "walk", masks=None)
    own = Reader(lambda path: (path / "rig.yaml").is_file(), lambda path, options: FolderDataset(path, "none"))
    monkeypatch.setitem(READERS, "mine", own)
    assert open_dataset(path).frame("000000").masks is None
    with pytest.raises(DatasetError, match="no such folder of masks"):
        open_dataset(path, reader="folder")


def test_an_option_that_a_reader_does_not_take_is_an_error(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "walk")
    with pytest.raises(OptionsError, match="--topics: the reader 'folder' does not take it, but --bits, --masks"):
        open_dataset(path, topics="/a,/b,/c")
    with pytest.raises(OptionsError, match="--tolerance"):
        open_dataset(path, tolerance=0.1)


def test_an_unknown_reader_names_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(
        OptionsError, match=r"--reader tape: there is folder, .*rosbag.*; one of your own is module:NAME"
    ):
        open_dataset(write_recording(tmp_path / "walk"), reader="tape")


def test_the_only_recording_of_a_folder_is_opened_and_several_are_named(tmp_path: Path) -> None:
    write_recording(tmp_path / "a")
    assert open_dataset(tmp_path).name == "a"
    write_recording(tmp_path / "b")
    assert find_datasets(tmp_path, reader="folder") == [tmp_path / "a", tmp_path / "b"]
    with pytest.raises(DatasetError, match="holds 2 recordings; name one of a, b"):
        open_dataset(tmp_path)
