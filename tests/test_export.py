"""Writing folders: the files, their contents, and what is left when a run does not reach its end."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from seepast.errors import OutputError
from seepast.export import FolderWriter, Run, atomic
from seepast.export.folder import depth_millimetres
from seepast.geometry import ArrayGeometry
from seepast.options import Options
from seepast.result import Result

CAMERAS = ("cam0", "cam1", "cam2")
RUN = Run("0.1.0", "/data/rec", "/data/rec/masks", "0123", "cam1", "cpu", False, Options.preset("paper").flat())
GEOMETRY = ArrayGeometry((50.0, 50.0), (23.5, 17.0), (48, 35), np.array([[-0.1, 0, 0], [0, 0, 0], [0.2, 0, 0.0]]), 1)


def result(seed: int = 0, milliseconds: float = 10.0) -> Result:
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(1, 30, (35, 48)).astype(np.float32)
    disparity[:2] = 0
    coverage = rng.integers(1, 4, (35, 48)).astype(np.uint8)
    coverage[:7] = 0
    return Result(
        background=rng.integers(0, 255, (35, 48, 3), np.uint8),
        disparity=disparity,
        depth=GEOMETRY.depth(disparity),
        confidence=rng.random((35, 48), np.float32),
        coverage=coverage,
        labels=np.zeros((35, 48), np.uint16),
        masks=tuple(rng.integers(0, 255, (36, 50), np.uint8) for _ in CAMERAS),
        geometry=GEOMETRY,
        timings={"rectify": milliseconds, "disparity": 2 * milliseconds},
        rounds=2,
        options=Options.preset("paper"),
        backend="cpu",
    )


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def frame_names(stamp: str) -> set[str]:
    masks = {f"masks/{camera}/{stamp}.png" for camera in CAMERAS}
    singles = {f"{kind}/{stamp}.png" for kind in ("background", "depth", "confidence", "coverage")}
    return masks | singles | {f"disparity/{stamp}.pfm"}


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def test_exactly_the_files_of_the_format_and_they_read_back(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    frame = result()
    with FolderWriter(out, RUN, CAMERAS) as writer:
        assert not writer.done("000007")
        writer.write("000007", frame, 33.0)
        assert writer.done("000007")
    assert names(out) == frame_names("000007") | {"camera.yaml", "run.json"}
    np.testing.assert_array_equal(read(out / "background/000007.png"), frame.background)
    np.testing.assert_array_equal(read(out / "disparity/000007.pfm"), frame.disparity)
    np.testing.assert_array_equal(read(out / "coverage/000007.png"), frame.coverage)
    for camera, mask in zip(CAMERAS, frame.masks, strict=True):
        np.testing.assert_array_equal(read(out / f"masks/{camera}/000007.png"), mask)
    depth = read(out / "depth/000007.png")
    assert depth.dtype == np.uint16
    np.testing.assert_allclose(depth, 1000 * frame.depth, atol=0.5)


def test_pfm_is_bottom_up_and_little_endian(tmp_path: Path) -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    atomic.write_pfm(tmp_path / "a.pfm", values)
    data = (tmp_path / "a.pfm").read_bytes()
    assert data.startswith(b"Pf\n3 2\n-1.0\n")
    np.testing.assert_array_equal(np.frombuffer(data[-24:], "<f4"), [3, 4, 5, 0, 1, 2])


def test_depth_in_millimetres_knows_its_limits() -> None:
    metres = np.array([[0, 0.0004, 1.2346, 65.535, 70, 1e9, np.inf, np.nan, -1]], np.float32)
    np.testing.assert_array_equal(depth_millimetres(metres), [[0, 0, 1235, 65535, 0, 0, 0, 0, 0]])


def test_camera_yaml_describes_the_reference_view(tmp_path: Path) -> None:
    rotation = cv2.Rodrigues(np.array([0.1, 0.02, -0.03]))[0]
    with FolderWriter(tmp_path, RUN, CAMERAS, rotation=rotation) as writer:
        writer.write("0", result(), 1.0)
    camera = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    assert camera["camera"] == "cam1" and camera["cameras"] == list(CAMERAS)
    assert camera["intrinsics"] == [50, 50, 23.5, 17] and camera["resolution"] == [48, 35]
    np.testing.assert_array_equal(camera["rectified_from_cam"], rotation)
    assert camera["baseline"] == pytest.approx(0.2) and camera["focal_baseline"] == pytest.approx(10)


def test_run_json_tells_options_versions_and_median_times(tmp_path: Path) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        for n, milliseconds in enumerate((10.0, 50.0, 11.0)):
            writer.write(str(n), result(n, milliseconds), 4 * milliseconds)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["options"] == Options.preset("paper").flat()
    assert set(run["versions"]) == {"seepast", "python", "numpy", "opencv"}
    assert run["milliseconds"] == {"rectify": 11, "disparity": 22, "total": 44}
    assert (run["frames"], run["timed_frames"]) == (3, 3)
    assert run["coverage_share"] == pytest.approx(0.8)
    assert (run["backend"], run["reference"], run["dataset"]) == ("cpu", "cam1", "/data/rec")


def test_an_equal_run_goes_on_and_redoes_what_is_unfinished(tmp_path: Path) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        for stamp in "012":
            writer.write(stamp, result(), 20.0)
    (tmp_path / "depth" / "1.png").unlink()
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        assert [writer.done(stamp) for stamp in "0123"] == [True, False, True, False]
        writer.write("1", result(5), 30.0)
    np.testing.assert_array_equal(read(tmp_path / "background" / "1.png"), result(5).background)
    assert json.loads((tmp_path / "run.json").read_text())["frames"] == 3


def test_a_run_with_nothing_left_to_do_keeps_the_figures(tmp_path: Path) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 20.0)
    before = (tmp_path / "run.json").read_text()
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        assert writer.summary()["milliseconds"]["total"] == 20
    assert (tmp_path / "run.json").read_text() == before


class Crash(BaseException):
    """Something that no handler expects."""


@pytest.mark.parametrize("file", range(7))
def test_a_crash_between_or_within_files_leaves_whole_files_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: int
) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 1.0)
    really_replace, calls = os.replace, []

    def replace_until_crash(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == file + 1:
            raise Crash
        really_replace(source, target)

    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        monkeypatch.setattr(os, "replace", replace_until_crash)
        with pytest.raises(Crash):
            writer.write("1", result(1), 1.0)
        monkeypatch.undo()
        assert writer.done("0") and not writer.done("1")
    finished = names(tmp_path)
    assert len(finished & frame_names("1")) == file
    assert finished <= frame_names("0") | frame_names("1") | {"camera.yaml", "run.json"}, "no half-written files"
    for name in finished & frame_names("1"):
        read(tmp_path / name)
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("1", result(1), 1.0)
        assert writer.done("1")


def test_an_unfinished_frame_that_was_finished_once_is_redone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 1.0)
        monkeypatch.setattr(atomic, "write_pfm", lambda *_: (_ for _ in ()).throw(Crash))
        with pytest.raises(Crash):
            writer.write("0", result(1), 1.0)
        assert not writer.done("0"), "half old, half new is not done"


def test_leftovers_of_a_killed_run_go_away(tmp_path: Path) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 1.0)
    leftover = tmp_path / "background" / ".1.png.part"
    leftover.write_bytes(b"half")
    FolderWriter(tmp_path, RUN, CAMERAS).close()
    assert not leftover.exists()


def test_another_run_is_refused_and_overwritten_on_request(tmp_path: Path) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 1.0)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "background" / "notes.txt").write_text("mine")
    other = replace(RUN, reference="cam0", options=Options.preset("paper").updated({"disparity.beta": 0.5}).flat())
    with pytest.raises(OutputError, match="--overwrite") as caught:
        FolderWriter(tmp_path, other, CAMERAS)
    assert "reference: cam1 there, cam0 now" in str(caught.value)
    assert "disparity.beta" in str(caught.value) and "0.5 now" in str(caught.value)
    assert frame_names("0") <= names(tmp_path), "refusing removes nothing"
    with FolderWriter(tmp_path, other, CAMERAS, overwrite=True) as writer:
        assert names(tmp_path) == {"notes.txt", "background/notes.txt"}
        writer.write("1", result(), 1.0)
    assert json.loads((tmp_path / "run.json").read_text())["reference"] == "cam0"


@pytest.mark.parametrize(
    "other",
    [
        replace(RUN, dataset="/data/b"),
        replace(RUN, masks="none"),
        replace(RUN, rig="9"),
        replace(RUN, backend="x"),
        replace(RUN, dynamic_only=True),
        replace(RUN, seepast="0.2.0"),
    ],
)
def test_every_setting_counts_as_another_run(tmp_path: Path, other: Run) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        writer.write("0", result(), 1.0)
    with pytest.raises(OutputError, match="another run"):
        FolderWriter(tmp_path, other, CAMERAS)


def test_a_run_that_finished_no_frame_is_in_nobodys_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer:
        monkeypatch.setattr(atomic, "write_pfm", lambda *_: (_ for _ in ()).throw(Crash))
        with pytest.raises(Crash):
            writer.write("0", result(), 1.0)
        monkeypatch.undo()
    FolderWriter(tmp_path, replace(RUN, reference="cam0"), CAMERAS).close()
    assert names(tmp_path) == set()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "text"), [("rig.yaml", "cam0:"), ("run.json", "{}"), ("run.json", "[1"), ("a", "")])
def test_a_folder_of_something_else_is_never_touched(tmp_path: Path, name: str, text: str, overwrite: bool) -> None:
    (tmp_path / "masks" / "cam0").mkdir(parents=True)
    (tmp_path / "masks" / "cam0" / "0.png").write_bytes(b"precious")
    (tmp_path / name).write_text(text)
    before = names(tmp_path)
    with pytest.raises(OutputError, match="something else"):
        FolderWriter(tmp_path, RUN, CAMERAS, overwrite=overwrite)
    assert names(tmp_path) == before


def test_an_output_that_is_a_file_or_lies_below_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for out, says in ((tmp_path / "file", "is a file"), (tmp_path / "file" / "out", "cannot be made")):
        with pytest.raises(OutputError, match=says):
            FolderWriter(out, RUN, CAMERAS)


def test_a_read_only_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # permissions do not bind a test that runs as root
    with pytest.raises(OutputError, match="permissions"):
        FolderWriter(tmp_path, RUN, CAMERAS)


def test_a_full_disk_is_an_output_error_and_leaves_nothing_half(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really_write = Path.write_bytes

    def write_half(path: Path, data: bytes) -> int:
        if "depth" in str(path):
            really_write(path, data[: len(data) // 2])
            raise OSError(28, "No space left on device")
        return really_write(path, data)

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with FolderWriter(tmp_path, RUN, CAMERAS) as writer, pytest.raises(OutputError, match="No space left"):
        writer.write("0", result(), 1.0)
    assert not any("depth" in name for name in names(tmp_path))
    assert not writer.done("0")


def test_run_json_tells_every_frame_of_both_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("seepast.export.folder.RUN_FILE_EVERY", 0.0)
    out = tmp_path / "out"
    with FolderWriter(out, RUN, CAMERAS) as writer:
        writer.write("a", result(milliseconds=2.0), 9.0)
        early = json.loads((out / "run.json").read_text())
        assert early["frame_milliseconds"] == {"a": {"rectify": 2.0, "disparity": 4.0, "total": 9.0}}
    with FolderWriter(out, RUN, CAMERAS) as writer:
        writer.write("b", result(milliseconds=3.0), 10.0)
    both = json.loads((out / "run.json").read_text())["frame_milliseconds"]
    assert {stamp: ms["rectify"] for stamp, ms in both.items()} == {"a": 2.0, "b": 3.0}
    with FolderWriter(out, RUN, CAMERAS, overwrite=True) as writer:
        writer.write("b", result(milliseconds=4.0), 10.0)
    assert list(json.loads((out / "run.json").read_text())["frame_milliseconds"]) == ["b"]
