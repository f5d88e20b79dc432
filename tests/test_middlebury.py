"""Middlebury multi-view folders in."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import save
from seepast import cli
from seepast.datasets import find_datasets, open_dataset
from seepast.datasets.middlebury import FOCAL, SPACING, MiddleburyDataset
from seepast.errors import DatasetError
from seepast.evaluate import evaluate
from seepast.rectify import rectify
from seepast.rig import Rig

THIRD = (60, 370)  # px, width and height: the height of the third size


def make(path: Path, names: list[str], size: tuple[int, int] = THIRD) -> Path:
    rng = np.random.default_rng(0)
    for name in names:
        save(path / name, rng.integers(0, 255, (size[1], size[0], 3), np.uint8))
    return path


def coded(path: Path, value: int, size: tuple[int, int] = THIRD) -> Path:
    disparity = np.full(size[::-1], value, np.uint8)
    disparity[0] = 0
    return save(path, disparity)


def test_views_of_2006_have_metres_and_truth(tmp_path: Path) -> None:
    path = make(tmp_path / "Aloe", [f"view{n}.png" for n in range(7)])
    coded(path / "disp1.png", 60)  # 20 px at third size
    (path / "dmin.txt").write_text("270\n")  # 90 px at third size
    dataset = open_dataset(path)
    assert isinstance(dataset, MiddleburyDataset) and dataset.masks is None
    assert list(dataset.stamps) == ["000000"] and dataset.truth == ("cam1",)
    focal = FOCAL / 3
    np.testing.assert_allclose(dataset.rig.centers[:, 0], SPACING * np.arange(7))
    assert dataset.rig.cameras[0].intrinsics[0] == focal
    geometry = rectify(dataset.rig, 1).geometry
    disparity = dataset.true_disparity("cam1")
    assert disparity.dtype == np.float32 and not disparity[0].any()
    assert disparity[1, 0] == (20 + 90) * 5 / 4  # from view1 to view6, the farthest, are 5 steps
    depth = geometry.focal_baseline / disparity[1, 0]
    assert depth == pytest.approx(focal * 0.16 / 110)
    seen = [camera.project(np.array([0.03, 0.0, depth]) - camera.center) for camera in dataset.rig.cameras]
    assert seen[1][0] - seen[5][0] == pytest.approx(20)  # what the truth image says of the cropped views


def test_the_exposures_of_2006_take_the_truth_above(tmp_path: Path) -> None:
    path = make(tmp_path / "Aloe" / "Illum1" / "Exp1", ["view1.png", "view5.png"])
    coded(tmp_path / "Aloe" / "disp5.png", 30)
    dataset = open_dataset(path)
    assert dataset.truth == ("cam1",)
    np.testing.assert_allclose(dataset.rig.centers[:, 0], [0, 4 * SPACING])
    assert dataset.true_disparity("cam1")[1, 0] == 10
    with pytest.raises(DatasetError, match="no true disparity of cam0, only of cam1"):
        dataset.true_disparity("cam0")


def test_views_of_2003_and_2001(tmp_path: Path) -> None:
    quarter = make(tmp_path / "cones", [f"im{n}.ppm" for n in range(9)], (450, 375))
    coded(quarter / "disp2.pgm", 200, (450, 375))
    dataset = open_dataset(quarter)
    assert len(dataset.rig) == 9 and dataset.truth == ("cam2",)
    assert dataset.true_disparity("cam2")[5, 5] == 200 / 4 / 4 * 6
    older = make(tmp_path / "venus", ["im2.ppm", "im6.ppm"], (434, 383))
    coded(older / "disp6.pgm", 160, (434, 383))
    assert open_dataset(older).true_disparity("cam1")[5, 5] == 20
    assert find_datasets(tmp_path) == [quarter, older]


def test_own_rig_and_own_masks(tmp_path: Path) -> None:
    path = make(tmp_path / "r", ["view0.png", "view1.png"], (48, 36))
    Rig.linear(2, focal=99.0, spacing=0.5, size=(48, 36)).to_kalibr(path / "rig.yaml")
    for k in range(2):
        save(path / "masks" / f"cam{k}" / "000000.png", np.full((36, 48), 7 + k, np.uint8))
    dataset = open_dataset(path)
    assert isinstance(dataset, MiddleburyDataset)
    assert dataset.rig.cameras[0].intrinsics[0] == 99.0
    assert [int(mask[0, 0]) for mask in dataset.frame("000000").masks or ()] == [7, 8]
    assert open_dataset(path, masks="none").frame("000000").masks is None
    Rig.linear(3, focal=99.0, spacing=0.5, size=(48, 36)).to_kalibr(path / "rig.yaml")
    with pytest.raises(DatasetError, match=r"has 3 cameras, but .* 2 views"):
        open_dataset(path)


def test_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    path = make(tmp_path / "r", ["view0.png", "view1.png"], (48, 36))
    coded(path / "disp1.png", 9, (48, 36))
    with pytest.raises(DatasetError, match=r"disp1\.png: is 36 rows high, its scale is known for 1110, 555 and 370"):
        open_dataset(path).true_disparity("cam1")
    save(path / "view1.png", np.zeros((36, 50, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"view1\.png: is 50x36, but .* says 48x36"):
        open_dataset(path).frame("000000")
    calibrated = make(tmp_path / "2014", ["im0.png", "im1.png"])
    (calibrated / "calib.txt").write_text("cam0=[1 0 0]")
    with pytest.raises(DatasetError, match="no recording here"):
        open_dataset(calibrated)


def wall(path: Path, step: int, names: tuple[str, ...] = tuple(f"view{n}" for n in range(7))) -> Path:
    """Views of a flat wall that moves by `step` px from one to the next, and its truth."""
    width, height = 120, 370
    texture = cv2.resize(np.random.default_rng(3).integers(0, 255, (height // 2, 150, 3), np.uint8), (300, height))
    for n, name in enumerate(names):
        save(path / f"{name}.png", texture[:, n * step : n * step + width])
    for n in (1, 5):
        coded(path / f"disp{n}.png", 3 * 4 * step, (width, height))
    return path


@pytest.mark.parametrize("masked", [False, True])
def test_evaluate_takes_the_truth_that_is_there(
    masked: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("skimage")
    path, out = wall(tmp_path / "Wall", 2), tmp_path / "out"
    box = np.zeros((370, 120), np.uint8)
    box[150:220, 40:60] = 255
    for k in range(7 if masked else 0):
        save(path / "masks" / f"cam{k}" / "000000.png", box)
    quick = ["--preset", "paper", "--set", "range.max_disparity=20"]
    assert cli.main(["run", str(path), "--out", str(out), "--reference", "cam1", *quick]) == 0
    capsys.readouterr()
    assert cli.main(["evaluate", str(path), str(out), "--json"]) == 0
    row = json.loads(capsys.readouterr().out)["Wall"]
    assert row["bad1 vis"] < 5 and row["psnr"] is None
    assert (row["bad1 hid"] is not None) == masked
    disparity = out / "disparity" / "000000.pfm"
    image = cv2.imread(str(disparity), cv2.IMREAD_UNCHANGED)
    image[:185] += 1.5
    cv2.imwrite(str(disparity), image)
    assert 45 < evaluate(path, out)["Wall"]["bad1 vis"] < 60, "half of it is wrong now"
    assert list(evaluate(tmp_path / "Wall", out)) == ["Wall", "MEAN"]


def test_evaluate_names_the_views_with_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("skimage")
    path, out = wall(tmp_path / "Wall", 1), tmp_path / "out"
    quick = ["--preset", "paper", "--set", "range.max_disparity=8"]
    assert cli.main(["run", str(path), "--out", str(out), *quick]) == 0
    assert cli.main(["evaluate", str(path), str(out)]) == 2
    assert "is of cam1 and cam5; run again with --reference cam1" in capsys.readouterr().err
