"""Settings from files: what may stand in them, who wins, and runs repeated from their run.json, byte for byte."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings import write_recording
from seepast import cli
from seepast.errors import OptionsError
from seepast.options import Options
from seepast.settings import FLAGS, FileSettings, planned, read_settings

QUICK = ["--preset", "paper", "--set", "range.max_disparity=12"]


def written(folder: Path, text: str, name: str = "settings.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def outputs(out: Path) -> dict[str, bytes]:
    """Every file but run.json, which holds times."""
    files = (path for path in out.rglob("*") if path.is_file() and path.name != "run.json")
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def test_flags_nested_stages_and_flat_keys_are_all_read(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "dataset: recording\nreference: cam2\ndynamic-only: true\nclasses: [person, 3]\npreset: paper\n"
        "range: {max_disparity: 150, step: 1}\ndisparity.beta: 1e-2\nmasks:\n",
    )
    file = read_settings(path)
    assert file.flags == {
        "dataset": "recording",
        "reference": "cam2",
        "dynamic_only": True,
        "classes": "person,3",
        "preset": "paper",
    }
    plan = planned({}, {}, file)
    expected = {"range.max_disparity": 150, "range.step": 1, "disparity.beta": 0.01}
    assert plan.options == Options.preset("paper").updated(expected)
    assert (plan.dataset, plan.reference, plan.dynamic_only, plan.masks) == (Path("recording"), "cam2", True, None)


def test_an_empty_file_says_nothing(tmp_path: Path) -> None:
    plan = planned({"dataset": Path("r")}, {}, read_settings(written(tmp_path, "# nothing yet\n")))
    assert plan == planned({"dataset": Path("r")}, {}, FileSettings())


def test_the_command_line_wins(tmp_path: Path) -> None:
    file = read_settings(
        written(tmp_path, "dataset: a\nreference: cam2\npreset: paper\nrange: {step: 1}\nmasks: net\n")
    )
    given = {"dataset": Path("b"), "reference": "cam1", "preset": "accurate", "masks": None, "threads": 0}
    plan = planned(given, {"range.step": "0.25"}, file)
    assert (plan.dataset, plan.reference, plan.masks) == (Path("b"), "cam1", "net")
    assert plan.options == Options.preset("accurate").updated({"range.step": 0.25})


def test_masks_and_segmenter_replace_each_other(tmp_path: Path) -> None:
    network = read_settings(written(tmp_path, "dataset: a\nsegmenter: onnx:n.onnx\nclasses: car\n"))
    plan = planned({"masks": "none"}, {}, network)
    assert (plan.masks, plan.segmenter, plan.classes) == ("none", None, None)
    masks = read_settings(written(tmp_path, "dataset: a\nmasks: net\n"))
    plan = planned({"segmenter": "onnx:n.onnx"}, {}, masks)
    assert (plan.masks, plan.segmenter) == (None, "onnx:n.onnx")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("referense: cam1", "did you mean reference"),
        ("rnge: {max_disparity: 5}", "did you mean range"),
        ("range: {max_disparty: 5}", "did you mean range.max_disparity"),
        ("range.max_disparty: 5", "did you mean range.max_disparity"),
        ("qqqq: 5", "run.json"),
        ("range: 5", "range: {field: value}"),
        ("range: {max_disparity: near}", "not a number"),
        ("range: {max_disparity: -5}", "outside"),
        ("dynamic_only: perhaps", "true or false"),
        ("threads: true", "a whole number"),
        ("masks: 3", "a word"),
        ("- reference", "name: value"),
        ("a: b: c", "neither YAML"),
    ],
)
def test_what_is_wrong_in_a_file_is_told_with_its_name(tmp_path: Path, text: str, says: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(OptionsError) as caught:
        read_settings(path)
    assert str(path) in str(caught.value) and says in str(caught.value) and "\n" not in str(caught.value)


def test_every_flag_of_the_file_is_one_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    for name in set(FLAGS) - {"dataset"}:
        assert f" --{name.replace('_', '-')} " in text, name


def test_no_recording_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--out", str(tmp_path / "out")]) == 2
    assert "DATASET" in capsys.readouterr().err
    assert cli.main(["run", "--out", str(tmp_path / "out"), "--settings", str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml" in capsys.readouterr().err


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_recording(tmp_path / "rec", stamps=("a", "b"))


def run(*words: object) -> None:
    assert cli.main(["run", *map(str, words)]) == 0


def repeated(elsewhere: Path, monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    """Repeat out/run.json of the working directory from another one, and compare."""
    out = Path("out").resolve()
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    run("--settings", out / "run.json", "--out", "again", *words)
    assert len(outputs(out)) > 10 and outputs(elsewhere / "again") == outputs(out)


def test_a_run_is_repeated_from_its_run_json(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(recording, stamps=("a", "b"), masks="net", seed=1)
    shift = {"range.max_disparity": "12", "refocus.median": "false", "disparity.beta": "0.0123456789"}
    sets = [word for name, value in shift.items() for word in ("--set", f"{name}={value}")]
    run("rec", "--out", "out", "--preset", "paper", "--reference", "cam2", "--masks", "net", "--dynamic-only", *sets)
    run("rec", "--out", "plain", *QUICK)
    assert outputs(Path("plain")) != outputs(Path("out"))
    repeated(recording.parent / "elsewhere", monkeypatch)
    assert capsys.readouterr().err == "", "nothing has changed"
    first, again = (json.loads(Path(out, "run.json").read_text()) for out in ("../out", "again"))
    for key in ("settings", "options", "rig", "masks", "reading", "segmenter"):
        assert first[key] == again[key], key
    assert first["settings"]["masks"] == "net", "in the recording, so that it holds for other recordings, too"
    assert first["settings"]["reader"] == "folder" and Path(first["settings"]["dataset"]) == recording


def test_a_run_is_repeated_on_another_recording(recording: Path) -> None:
    run("rec", "--out", "out", *QUICK, "--reference", "cam1")
    write_recording(Path("other"), seed=3)
    run("other", "--out", "one", *QUICK, "--reference", "cam1")
    run("other", "--out", "two", "--settings", "out/run.json")
    assert outputs(Path("one")) == outputs(Path("two"))


def test_own_segmenters_and_rigs_are_found_again(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = "def make(classes=('a',)):\n    return lambda images: [i[..., 2] > 40 * len(classes) for i in images]\n"
    written(recording.parent, make, "mine.py")
    run("rec", "--out", "out", *QUICK, "--segmenter", "mine.py:make", "--classes", "x,y")
    settings = json.loads(Path("out/run.json").read_text())["settings"]
    assert settings["segmenter"] == f"{recording.parent / 'mine.py'}:make" and "masks" not in settings
    repeated(recording.parent / "elsewhere", monkeypatch)


def test_bags_are_read_the_same_way_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rosbags")
    import cv2

    from bags import START, Shot, write_bag

    monkeypatch.chdir(tmp_path)
    rec = write_recording(tmp_path / "rec", stamps=("a", "b"))
    topics: dict[str, Any] = {}
    for k in range(3):
        for what, folder, encoding in (("image", f"cam{k}", "bgr8"), ("mask", f"masks/cam{k}", "mono8")):
            images = [cv2.imread(str(rec / folder / f"{s}.png"), cv2.IMREAD_UNCHANGED) for s in "ab"]
            late = 8_000_000 * (k == 1)  # ns: more than is allowed if nothing is said
            topics[f"/c/cam{k}/{what}"] = [
                Shot(START + n * 10**9 + late, np.ascontiguousarray(image), encoding) for n, image in enumerate(images)
            ]
    write_bag(tmp_path / "walk", "mcap", topics)
    how = ["--rig", "rec/rig.yaml", "--topics", "/c/{}/image", "--masks", "topics:/c/{}/mask", "--tolerance", "0.01"]
    run("walk", "--out", "out", *QUICK, *how)
    settings = json.loads(Path("out/run.json").read_text())["settings"]
    assert settings["reader"] == "rosbag" and settings["rig"] == str(rec / "rig.yaml")
    assert settings["tolerance"] == 0.01 and settings["masks"] == "topics:/c/cam0/mask,/c/cam1/mask,/c/cam2/mask"
    repeated(tmp_path / "elsewhere", monkeypatch)


def test_what_no_longer_is_as_it_was_draws_a_warning(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(recording.parent, "def make():\n    return lambda images: [i[..., 2] > 90 for i in images]\n", "mine.py")
    run("rec", "--out", "out", *QUICK, "--segmenter", "mine.py:make")
    written(recording.parent, "def make():\n    return lambda images: [i[..., 2] > 91 for i in images]\n", "mine.py")
    rig = recording / "rig.yaml"
    rig.write_text(rig.read_text().replace("48.0", "48.5"))
    content = json.loads(Path("out/run.json").read_text())
    content["versions"]["numpy"] = "1.0.0"
    Path("out/run.json").write_text(json.dumps(content))
    capsys.readouterr()
    run("--settings", "out/run.json", "--out", "again")
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "rig: " in said and "file_sha256: " in said and "numpy: 1.0.0 there" in said
    run("--settings", "out/run.json", "--out", "masks", "--masks", "masks")
    assert "sha256" not in capsys.readouterr().err, "other masks were asked for"


def test_a_preset_over_a_file_that_says_every_number_is_refused(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("rec", "--out", "out", *QUICK)
    assert cli.main(["run", "--settings", "out/run.json", "--out", "b", "--preset", "accurate"]) == 2
    assert "--preset" in capsys.readouterr().err


def test_a_run_json_without_settings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionsError, match="settings"):
        read_settings(written(tmp_path, '{"versions": {"seepast": "0.0.9"}}', "run.json"))
