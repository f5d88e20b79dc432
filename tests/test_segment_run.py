"""Masks of a segmenter on their way through a recording: into the frames, into run.json, and when going on."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import onnx_nets as nets
from recordings import SIZE, write_recording
from seepast import cli
from seepast.datasets import NO_MASKS, open_dataset
from seepast.errors import InputError, ModelError
from seepast.segment import PRESETS, SegmentedDataset, open_segmenter
from seepast.segment.models import MODELS

OWN = """
import numpy as np

def bright(classes=("person",)):
    def segment(images):
        return [image.mean(axis=2) > {threshold} for image in images]
    return segment

class Half:
    def __call__(self, images):
        return [np.full(image.shape[:2], 0.5, np.float32) for image in images]
    def describe(self):
        return {{"share": 0.5}}

def wrong_size():
    return lambda images: [np.zeros((3, 3), np.uint8) for _ in images]

def too_few():
    return lambda images: [np.zeros(images[0].shape[:2], np.uint8)]

def nothing():
    return None
"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "rec", stamps=("a", "b"), masks=None)


def own(folder: Path, threshold: int = 128) -> Path:
    path = folder / "own.py"
    path.write_text(OWN.format(threshold=threshold))
    return path


def run(recording: Path, out: Path, *more: object) -> int:
    words = ["run", recording, "--out", out, "--preset", "paper", "--set", "range.max_disparity=8", *more]
    return cli.main([str(word) for word in words])


def test_frames_have_the_masks_of_the_network(recording: Path, tmp_path: Path) -> None:
    segmenter = open_segmenter(f"onnx:{nets.selfie(tmp_path / 'net.onnx', (1, 0, 0))}")
    plain = open_dataset(recording, masks=NO_MASKS)
    dataset = SegmentedDataset(plain, segmenter)
    assert (dataset.name, dataset.path, len(dataset), dataset.masks) == (plain.name, plain.path, 2, None)
    for frame in dataset:
        expected = segmenter(frame.images)
        assert frame.masks is not None and frame.timings["segment"] > 0
        assert frame.masks[0].shape == (SIZE[1], SIZE[0]) and frame.masks[0].std() > 1
        assert all(np.array_equal(a, b) for a, b in zip(frame.masks, expected, strict=True))
    assert plain.frame("a").masks is None


def test_masks_of_ones_own_may_be_bool_or_float(recording: Path, tmp_path: Path) -> None:
    plain = open_dataset(recording, masks=NO_MASKS)
    bright = SegmentedDataset(plain, open_segmenter(f"{own(tmp_path)}:bright")).frame("a")
    assert bright.masks is not None and set(np.unique(bright.masks[0])) == {0, 255}
    assert np.array_equal(bright.masks[1] == 255, bright.images[1].mean(axis=2) > 128)
    half = SegmentedDataset(plain, open_segmenter(f"{own(tmp_path)}:Half")).frame("a")
    assert half.masks is not None and (half.masks[0] == 128).all() and half.masks[0].dtype == np.uint8


def test_ones_own_is_described_by_its_file_and_by_itself(tmp_path: Path) -> None:
    path = own(tmp_path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert open_segmenter(f"{path}:bright", ["car"]).describe() == {
        "kind": f"{path}:bright", "file_sha256": digest, "classes": ["car"]
    }  # fmt: skip
    assert open_segmenter(f"{path}:Half").describe() == {"kind": f"{path}:Half", "file_sha256": digest, "share": 0.5}


def test_a_module_in_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own(tmp_path).rename(tmp_path / "my_own_segmenter.py")
    monkeypatch.chdir(tmp_path)
    assert open_segmenter("my_own_segmenter:Half").describe()["share"] == 0.5


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("own.py:missing", "AttributeError: .*missing"),
        ("own.py:nothing", "nothing returned a NoneType, which cannot be called"),
        ("nowhere.py:bright", "FileNotFoundError: no file nowhere.py; mend nowhere.py"),
        ("no_such_module:bright", "ModuleNotFoundError"),
        ("model.onnx", "write onnx:MODEL.onnx"),
        ("onnx:", "no such file"),
    ],
)
def test_a_segmenter_that_cannot_be_had(spec: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=said):
        open_segmenter(spec)


@pytest.mark.parametrize(
    ("factory", "said"),
    [
        ("wrong_size", "frame a, from the segmenter: mask of cam0 is 3x3"),
        ("too_few", "from the segmenter: masks: 1 given"),
    ],
)
def test_masks_that_do_not_fit(recording: Path, tmp_path: Path, factory: str, said: str) -> None:
    segmenter = open_segmenter(f"{own(tmp_path)}:{factory}")
    with pytest.raises(InputError, match=said):
        SegmentedDataset(open_dataset(recording, masks=NO_MASKS), segmenter).frame("a")


# ------------------------------------------------------------------------------------------------ run
def test_run_records_the_model_and_refuses_to_go_on_with_another(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, net = tmp_path / "out", nets.selfie(tmp_path / "net.onnx", (1, 0, 0))
    assert run(recording, out, "--segmenter", f"onnx:{net}") == 0
    told = json.loads((out / "run.json").read_text())
    assert told["masks"] == "none"
    assert told["segmenter"] == {
        "kind": "onnx", "model": str(net), "sha256": hashlib.sha256(net.read_bytes()).hexdigest(),
        "preset": "selfie", "provider": "CPU",
    }  # fmt: skip
    assert told["milliseconds"]["segment"] > 0
    assert told["milliseconds"]["total"] > told["milliseconds"]["segment"]

    os.unlink(out / "coverage" / "b.png")  # as if interrupted before the second frame was finished
    capsys.readouterr()
    assert run(recording, out, "--segmenter", f"onnx:{net}") == 0
    assert "2 frames (1 from before)" in capsys.readouterr().out

    old = hashlib.sha256(net.read_bytes()).hexdigest()
    nets.selfie(net, (0, 1, 0))
    assert run(recording, out, "--segmenter", f"onnx:{net}") == 2
    said = capsys.readouterr().err
    assert f"segmenter.sha256: {old} there, {hashlib.sha256(net.read_bytes()).hexdigest()} now" in said
    assert "--overwrite" in said
    assert run(recording, out, "--masks", "none") == 2
    assert run(recording, out, "--segmenter", f"onnx:{net}", "--overwrite") == 0


def test_a_run_with_files_cannot_be_gone_on_with_by_a_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, out = write_recording(tmp_path / "rec"), tmp_path / "out"
    assert run(recording, out, "--masks", "none") == 0
    assert json.loads((out / "run.json").read_text())["segmenter"] is None
    assert run(recording, out, "--masks", "none") == 0
    assert run(recording, out, "--segmenter", f"{own(tmp_path)}:bright") == 2
    assert f"segmenter: files there, {tmp_path}/own.py:bright now" in capsys.readouterr().err


def test_another_file_of_ones_own_is_another_segmenter(recording: Path, tmp_path: Path, capsys) -> None:
    spec = f"{own(tmp_path)}:bright"
    assert run(recording, tmp_path / "out", "--segmenter", spec) == 0
    own(tmp_path, threshold=99)
    assert run(recording, tmp_path / "out", "--segmenter", spec) == 2
    assert "segmenter.file_sha256" in capsys.readouterr().err


def test_what_the_segmenter_calls_dynamic_changes_the_output(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "all.py").write_text("def f():\n return lambda images: [i[..., 0] >= 0 for i in images]\n")
    assert run(recording, tmp_path / "all", "--segmenter", f"{tmp_path / 'all.py'}:f") == 0
    assert run(recording, tmp_path / "none", "--masks", "none") == 0
    coverage = [cv2.imread(str(tmp_path / n / "coverage" / "a.png"), 0) for n in ("all", "none")]
    assert coverage[0].max() == 0 and (coverage[1] > 0).mean() > 0.5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--masks", "masks", "--segmenter", "onnx:x.onnx"), "leave one of them out"),
        (("--classes", "person"), "--classes: chooses what a segmenter looks for; add --segmenter"),
        (("--segmenter", "onnx:x.onnx", "--classes", " , "), "names nothing"),
        (("--segmenter", "onnx:x.onnx"), "x.onnx: no such file"),
    ],
)
def test_options_that_do_not_go_together(recording: Path, tmp_path: Path, capsys, words, said: str) -> None:
    assert run(recording, tmp_path / "out", *words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_check_looks_at_the_masks_of_a_network(recording: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "half.py").write_text(
        "import numpy as np\ndef f():\n def s(images):\n  m = np.zeros(images[0].shape[:2], bool)\n"
        "  m[:, : m.shape[1] // 4] = True\n  return [m] * len(images)\n return s\n"
    )
    assert cli.main(["check", str(recording), "--segmenter", f"{tmp_path / 'half.py'}:f"]) == 0
    assert "25.0 % dynamic" in capsys.readouterr().out


def test_the_readme_does_as_it_says(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    section = readme.partition("## Your own segmentation network\n")[2].partition("\n## ")[0]
    commands = re.findall(r"^    seepast (.+?)(?:  .*)?$", section, re.MULTILINE)
    assert len(commands) >= 7 and all(f"`{preset}`" in section for preset in PRESETS)

    recording.rename(tmp_path / "recording")
    (tmp_path / "mine.py").write_text(section.partition("```python\n")[2].partition("```")[0])
    nets.logits(tmp_path / "net.onnx", np.eye(19, 3), (64, 64))
    fetched = nets.logits(tmp_path / "pphumanseg.onnx", np.eye(2, 3), (192, 192), batch=1)
    known = replace(MODELS["pphumanseg"], sha256=hashlib.sha256(fetched.read_bytes()).hexdigest())
    monkeypatch.setitem(MODELS, "pphumanseg", known)
    monkeypatch.setenv("SEEPAST_MODELS", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for command in commands:
        words = command.split()
        assert cli.main(words + ["--preset", "paper"] * (words[0] == "run")) == 0, command
        shutil.rmtree(tmp_path / "out", ignore_errors=True)


COUNTING = """
import pathlib
import numpy as np

def make():
    def segment(images):
        with pathlib.Path("calls").open("a") as file:
            file.write("x")
        return [np.where(image.mean(axis=2) > 128, 255, 0).astype(np.uint8) for image in images]
    return segment
"""
FAST = ["--preset", "paper", "--set", "range.max_disparity=12"]


@pytest.fixture
def counted(recording: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(recording.parent)
    (recording.parent / "counting.py").write_text(COUNTING)
    return recording.parent / "calls"


def bright(recording: Path, camera: str, stamp: str) -> np.ndarray:
    image = cv2.imread(str(recording / camera / f"{stamp}.png"))
    return np.where(image.mean(axis=2) > 128, 255, 0).astype(np.uint8)


@pytest.mark.parametrize("words", [[], ["--segmenter", "counting.py:make"]])
def test_the_viewer_shows_the_masks_that_the_segmenter_made(words: list[str], recording: Path, counted: Path) -> None:
    pytest.importorskip("rerun")
    from test_viewing import decoded, read_back

    run = ["run", "rec", "--out", "out", "--segmenter", "counting.py:make", *FAST, "--save", "run.rrd"]
    assert cli.main(run) == 0
    assert counted.read_text() == "xx", "once per frame, though the viewer reads beside"
    assert cli.main(["view", "out", "--save", "later.rrd", *words]) == 0
    for file in ("run.rrd", "later.rrd"):
        rows = read_back(Path(file))
        for i, stamp in enumerate(("a", "b")):
            before = decoded(rows["/masks_before/cam1"][i])[..., 3]
            np.testing.assert_array_equal(before, bright(recording, "cam1", stamp))
    assert cli.main(["view", "out", "--save", "none.rrd", "--masks", "none"]) == 0
    assert "/masks_before/cam1" not in read_back(Path("none.rrd"))


def test_a_segmenter_that_is_gone_is_no_obstacle_to_the_viewer(
    recording: Path, counted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    from test_viewing import read_back

    assert cli.main(["run", "rec", "--out", "out", "--segmenter", "counting.py:make", *FAST]) == 0
    Path("counting.py").unlink()
    assert cli.main(["view", "out", "--save", "out.rrd"]) == 0
    assert "the masks before are left out" in capsys.readouterr().err
    rows = read_back(Path("out.rrd"))
    assert "/masks_before/cam1" not in rows and "/input/cam1" in rows
    asked = ["view", "out", "--save", "b.rrd", "--segmenter", "counting.py:make"]
    assert cli.main(asked) == 2, "asked for, and missing"


def test_refocus_and_epi_take_a_segmenter(recording: Path, counted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        for k in range(3):
            path = recording / "masks_same" / f"cam{k}" / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), bright(recording, f"cam{k}", name))
    how = {"seg": ["--segmenter", "counting.py:make"], "files": ["--masks", "masks_same"], "plain": []}
    for out, words in how.items():
        assert cli.main(["refocus", "rec", "--out", out, "--disparity", "4", *words]) == 0
    same, files, plain = (Path(out, "a.png").read_bytes() for out in how)
    assert same == files != plain
    capsys.readouterr()
    epi = ["epi", "rec", "--row", "20", "--out", "e.png", "--segmenter", "counting.py:make", "--json"]
    assert cli.main(epi) == 0
    assert 0.1 < json.loads(capsys.readouterr().out)["struck_out"] < 0.9
    assert cli.main(["refocus", "rec", "--out", "c", "--depth", "3", "--classes", "car"]) == 2
    assert "--classes" in capsys.readouterr().err
