"""Runs in the rerun viewer: what is saved is read back; what is served is served to this machine only."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recordings import SIZE, write_recording
from seepast import cli
from seepast.export.reading import RunFolder, read_pfm
from seepast.export.times import timeline

STAMPS = ("1403636579763555584", "1403636579863555584")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a small run; its recording lies beside it, in rec/."""
    folder = tmp_path_factory.mktemp("viewing")
    write_recording(folder / "rec", stamps=STAMPS)
    out = folder / "out"
    settings = ("--preset", "paper", "--backend", "reference", "--set", "range.max_disparity=12")
    assert cli.main(["run", str(folder / "rec"), "--out", str(out), *settings]) == 0
    return out


def test_without_rerun_the_extra_is_named(run: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.main(["view", str(run), "--save", str(run.parent / "x.rrd")]) == 2
    assert "seepast[view]" in capsys.readouterr().err and not (run.parent / "x.rrd").exists()


def test_a_folder_that_is_no_run_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", str(tmp_path), "--save", str(tmp_path / "x.rrd")]) == 2
    assert "run.json" in capsys.readouterr().err


def read_back(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Entity -> its rows in the order of time, {column: value}; the static ones under "/static"."""
    chunk = pytest.importorskip("rerun.chunk")
    rows: dict[str, list[dict[str, Any]]] = {}
    for part in chunk.RrdReader(path).stream().collect().stream():
        rows.setdefault(part.entity_path, []).extend(plain(part.to_record_batch()))
    return {entity: sorted(found, key=lambda row: row.get("frame") or 0) for entity, found in rows.items()}


def plain(batch: Any) -> list[dict[str, Any]]:
    """Rows of an Arrow batch; times as whole nanoseconds, which datetime cannot hold."""
    columns = {
        name: (column.cast("int64") if str(column.type).startswith("timestamp") else column).to_pylist()
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
    }
    return [{name: values[i] for name, values in columns.items()} for i in range(batch.num_rows)]


def value(row: dict[str, Any], component: str) -> Any:
    (name,) = (name for name in row if name.endswith(":" + component))
    return row[name][0]


def decoded(row: dict[str, Any]) -> np.ndarray:
    blob = np.frombuffer(bytes(value(row, "blob")), np.uint8)
    return np.asarray(cv2.imdecode(blob, cv2.IMREAD_UNCHANGED))


@pytest.fixture(scope="module")
def rows(run: Path) -> dict[str, list[dict[str, Any]]]:
    pytest.importorskip("rerun")
    path = run.parent / "saved.rrd"
    assert cli.main(["view", str(run), "--save", str(path)]) == 0
    assert not [p for p in run.parent.iterdir() if p.name.startswith(".")]
    return read_back(path)


def test_every_frame_is_there_at_its_time(rows) -> None:
    for entity in ("/input/cam2", "/masks_before/cam0", "/masks_after/cam1", "/scene/background", "/world/points"):
        assert [row["frame"] for row in rows[entity]] == [0, 1], entity
        assert [row["time"] for row in rows[entity]] == [ns for ns, _ in timeline(STAMPS)], entity


def test_pictures_and_masks_are_what_lies_in_the_folders(rows, run: Path) -> None:
    folder = RunFolder(run)
    for i, stamp in enumerate(STAMPS):
        background = decoded(rows["/scene/background"][i]).astype(int)
        own, other = (abs(background - folder.frame(s).background).mean() for s in (stamp, STAMPS[1 - i]))
        assert own < 0.3 * other, "JPEG of noise"
        after = decoded(rows["/masks_after/cam1"][i])
        assert after.shape == (SIZE[1], SIZE[0], 4)
        assert np.array_equal(after[..., 3], folder.frame(stamp).masks["cam1"])
    before = cv2.imread(str(run.parent / "rec" / "masks" / "cam0" / f"{STAMPS[0]}.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(decoded(rows["/masks_before/cam0"][0])[..., 3], before)


def test_disparity_and_points_are_metric(rows, run: Path) -> None:
    folder = RunFolder(run)
    disparity = np.frombuffer(bytes(value(rows["/scene/disparity"][1], "buffer")), np.float32)
    truth = read_pfm(run / "disparity" / f"{STAMPS[1]}.pfm")
    assert np.array_equal(disparity.reshape(truth.shape), truth)
    frame = folder.frame(STAMPS[1])
    (name,) = (name for name in rows["/world/points"][1] if name.endswith(":positions"))
    points = np.array(rows["/world/points"][1][name])
    assert len(points) == ((frame.depth > 0) & (frame.coverage > 0)).sum() > 0.5 * frame.depth.size
    fx, cx = folder.view.focal[0], folder.view.center[0]
    u = fx * points[:, 0] / points[:, 2] + cx
    assert abs(u - np.rint(u)).max() < 1e-2 and u.min() > -0.01 and u.max() < SIZE[0] - 0.99
    assert np.median(points[:, 2]) == pytest.approx(2.4, rel=0.1)  # the wall: f B / d = 48 px * 0.2 m / 4 px


def test_stage_times_of_every_frame_are_there(rows, run: Path) -> None:
    told = RunFolder(run).settings["frame_milliseconds"]
    assert list(told) == list(STAMPS)
    for stage in told[STAMPS[0]]:
        (name,) = (name for name in rows[f"/milliseconds/{stage}"][0] if name.endswith(":scalars"))
        assert [row[name][0] for row in rows[f"/milliseconds/{stage}"]] == [told[stamp][stage] for stamp in STAMPS]


def test_what_is_there_is_kept_and_missing_inputs_are_no_obstacle(
    rows, run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = run.parent / "saved.rrd"
    before = path.read_bytes()
    assert cli.main(["view", str(run), "--save", str(path)]) == 2
    assert "--overwrite" in capsys.readouterr().err and path.read_bytes() == before
    hidden = run.parent / "rec_moved"
    (run.parent / "rec").rename(hidden)
    try:
        assert cli.main(["view", str(run), "--save", str(tmp_path / "alone.rrd")]) == 0
        assert "--dataset" in capsys.readouterr().err
        assert cli.main(["view", str(run), "--save", str(tmp_path / "b.rrd"), "--dataset", str(hidden)]) == 0
    finally:
        hidden.rename(run.parent / "rec")
    alone = read_back(tmp_path / "alone.rrd")
    assert "/input/cam0" not in alone and len(alone["/scene/background"]) == 2
    assert len(read_back(tmp_path / "b.rrd")["/input/cam0"]) == 2


def test_a_run_can_be_saved_while_it_goes_on(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    rec = write_recording(tmp_path / "rec", stamps=("a", "b", "c"))
    settings = ("--preset", "paper", "--backend", "reference", "--set", "range.max_disparity=12")
    arguments = ["run", str(rec), "--out", str(tmp_path / "out"), *settings]
    assert cli.main([*arguments, "--save", str(tmp_path / "x.rrd")]) == 0
    found = read_back(tmp_path / "x.rrd")
    assert [row["frame"] for row in found["/scene/coverage"] if "frame" in row and row["frame"] is not None] == [
        0,
        1,
        2,
    ]
    assert len(found["/milliseconds/total"]) == 3 and "time" not in found["/scene/background"][0]


def test_two_recordings_do_not_go_into_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        write_recording(tmp_path / "recs" / name)
    assert cli.main(["run", str(tmp_path / "recs"), "--out", str(tmp_path / "o"), "--save", str(tmp_path / "x")]) == 2
    assert "--save" in capsys.readouterr().err and not (tmp_path / "o").exists()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="tells listening sockets on Linux only")
def test_the_page_is_served_to_this_machine_only(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun")
    import urllib.request

    from seepast.view_server import view_server

    with view_server(0) as server:
        ports = {int(server.page.split("/")[2].split(":")[1]), int(server.grpc.split("/")[2].split(":")[1])}
        tables = [Path("/proc/net") / name for name in ("tcp", "tcp6")]
        listening = [row.split() for table in tables if table.exists() for row in table.read_text().splitlines()]
        own = [row[1].split(":") for row in listening if row[3] == "0A" and int(row[1].split(":")[1], 16) in ports]
        assert {address for address, _ in own} == {"0100007F"} and len(own) == 2
        with urllib.request.urlopen(server.page, timeout=10) as page:
            assert b"rerun" in page.read().lower()
        assert cli.main(["view", str(run), "--port", str(min(ports))]) == 2
        assert "taken" in capsys.readouterr().err
    for port in ports:
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0, "nothing is left running"


def test_a_run_is_shown_until_ctrl_c(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    rec = write_recording(tmp_path / "rec")
    settings = ["--preset", "paper", "--backend", "reference", "--set", "range.max_disparity=12", "--json"]
    command = [sys.executable, "-m", "seepast.cli", "run", str(rec), "--out", str(tmp_path / "out"), *settings]
    process = subprocess.Popen(
        [*command, "--view", "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stderr is not None
    shown = process.stderr.readline()
    port = int(shown.split("127.0.0.1:")[1].split("/")[0])
    assert json.loads(process.stdout.readline())["frames"] == 1
    assert process.stderr.readline().startswith("still shown at")
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=30)
    assert process.returncode == 0 and out == errors == ""
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
