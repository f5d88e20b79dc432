"""The evaluation against figures worked out by hand on small made-up truths."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from seepast.errors import DatasetError, MissingExtraError
from seepast.evaluate import COLUMNS, MEAN, evaluate, read_truth, table
from seepast.export.atomic import write_bytes, write_pfm, write_png

STAMP = "000007"
H, W = 20, 24
HIDDEN = np.s_[5:15, 8:18]  # 100 px: 20 seen by none, 30 by one, 50 by two cameras


def seen_by(dtype=np.uint8) -> np.ndarray:
    seen = np.full((H, W), 0b111, dtype)
    high = dtype(0b10) if dtype is np.uint8 else dtype(1 << 11)
    seen[5:7, 8:18] = 0
    seen[7:10, 8:18] = high
    seen[10:15, 8:18] = high | dtype(0b100)
    return seen


def hidden_mask() -> np.ndarray:
    mask = np.zeros((H, W), np.uint8)
    mask[HIDDEN] = 255
    return mask


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Path]:
    """A dataset with truth and an output that equals it, with coverage 0 exactly where nobody sees."""
    pytest.importorskip("skimage", reason="the evaluation needs scikit-image")
    return dataset(tmp_path / "data"), perfect(tmp_path / "out")


def background() -> np.ndarray:
    return np.random.default_rng(0).integers(20, 200, (H, W, 3), dtype=np.uint8)


def dataset(folder: Path, stamp: str = STAMP, seen: np.ndarray | None = None) -> Path:
    truth = folder / "truth"
    write_png(truth / "background" / f"{stamp}.png", background())
    write_pfm(truth / "disparity" / f"{stamp}.pfm", np.full((H, W), 30, np.float32))
    write_png(truth / "seen_by" / f"{stamp}.png", seen_by() if seen is None else seen)
    for k in range(3):
        mask = np.roll(hidden_mask(), -2 * k, axis=1)
        write_png(truth / "masks" / f"cam{k}" / f"{stamp}.png", mask)
        write_png(folder / "masks" / f"cam{k}" / f"{stamp}.png", np.roll(mask, 5, axis=0))
    return folder


def perfect(out: Path, stamp: str = STAMP) -> Path:
    coverage = np.full((H, W), 2, np.uint8)
    coverage[5:7, 8:18] = 0
    write_png(out / "background" / f"{stamp}.png", background())
    write_pfm(out / "disparity" / f"{stamp}.pfm", np.full((H, W), 30, np.float32))
    write_png(out / "coverage" / f"{stamp}.png", coverage)
    for k in range(3):
        write_png(out / "masks" / f"cam{k}" / f"{stamp}.png", np.roll(hidden_mask(), -2 * k, axis=1))
    return out


def test_a_perfect_output_has_perfect_figures(made):
    rows = evaluate(*made)
    assert list(rows) == [STAMP, MEAN]
    row = rows[STAMP]
    assert tuple(row) == COLUMNS
    assert row["psnr"] == row["psnr 1"] == row["psnr 2+"] == pytest.approx(138.13, abs=0.01)
    assert row["ssim"] == pytest.approx(1)
    assert row["bad1 hid"] == row["bad1 1"] == row["bad1 2+"] == row["bad1 vis"] == row["lost"] == 0
    assert row["flag"] == 100
    assert row["iou in"] == pytest.approx(50 / 150) and row["iou out"] == 1
    assert rows[MEAN] == row


def test_each_error_counts_where_it_belongs(made):
    data, out = made
    image = background()
    image[7:10, 8:18] += 10  # where one camera sees
    image[5:7, 8:18] = 255  # where none does: no figure may look at it
    write_png(out / "background" / f"{STAMP}.png", image)
    disparity = np.full((H, W), 30, np.float32)
    disparity[7, 8:18] = 31.5  # 10 of the 30 of one camera
    disparity[10:12, 8:13] = np.nan  # 10 of the 50 of more
    disparity[12, 8:13] = 0  # and 5 more
    disparity[13, 8:18] = 29.1  # good enough
    disparity[0, :19] = 0  # 19 of the 380 visible
    disparity[5:7] = 0  # the 20 that nobody sees, and 28 visible
    write_pfm(out / "disparity" / f"{STAMP}.pfm", disparity)
    coverage = np.ones((H, W), np.uint8)
    coverage[5, 8:13] = 0  # 5 of the 20 of none
    coverage[14, 8:16] = 0  # 8 of the 80 of some
    coverage[0, 0] = 0  # not hidden: no figure
    write_png(out / "coverage" / f"{STAMP}.png", coverage)
    row = evaluate(data, out)[STAMP]
    assert row["psnr 1"] == pytest.approx(10 * np.log10(255**2 / 100))
    assert row["psnr"] == pytest.approx(10 * np.log10(255**2 / (100 * 30 / 80)))
    assert row["psnr 2+"] > 100
    assert row["ssim"] < 1
    assert row["bad1 1"] == pytest.approx(100 * 10 / 30)
    assert row["bad1 2+"] == pytest.approx(100 * 15 / 50)
    assert row["bad1 hid"] == pytest.approx(100 * 25 / 80)
    assert row["bad1 vis"] == pytest.approx(100 * 47 / 380)
    assert row["flag"] == pytest.approx(25) and row["lost"] == pytest.approx(10)


def test_pixels_without_truth_or_without_a_reference_ray_count_nowhere(made):
    data, out = made
    hidden = hidden_mask()
    hidden[0] = 64  # no ray of the reference camera
    write_png(data / "truth" / "hidden" / f"{STAMP}.png", hidden)
    disparity = np.full((H, W), 30, np.float32)
    disparity[1] = disparity[14] = 0
    write_pfm(data / "truth" / "disparity" / f"{STAMP}.pfm", disparity)
    wrong = np.full((H, W), 30, np.float32)
    wrong[[0, 1, 14]] = 99
    write_pfm(out / "disparity" / f"{STAMP}.pfm", wrong)
    row = evaluate(data, out)[STAMP]
    assert row["bad1 vis"] == row["bad1 hid"] == 0
    truth = read_truth(data, STAMP)
    assert truth.hidden.sum() == 90 and truth.visible.sum() == H * W - 100 - 2 * W - (W - 10)


def test_hidden_is_the_reference_cameras_mask_unless_told(made):
    data, out = made
    write_bytes(data / "truth" / "camera.yaml", b"camera: cam2\n")
    write_bytes(out / "camera.yaml", b"camera: cam2\n")
    assert read_truth(data, STAMP, "cam2").hidden[10, 4]
    disparity = np.full((H, W), 30, np.float32)
    disparity[10, 4:8] = 0  # hidden from cam2 alone
    write_pfm(out / "disparity" / f"{STAMP}.pfm", disparity)
    assert evaluate(data, out)[STAMP]["bad1 hid"] > 0
    write_bytes(out / "camera.yaml", b"camera: cam0\n")
    with pytest.raises(DatasetError, match=r"view of cam0.*cam2.*--reference cam2"):
        evaluate(data, out)


def test_sixteen_bit_seen_by_and_grey_images(tmp_path):
    pytest.importorskip("skimage", reason="the evaluation needs scikit-image")
    data, out = dataset(tmp_path / "data", seen=seen_by(np.uint16)), perfect(tmp_path / "out")
    grey = background()[..., 0]
    write_png(data / "truth" / "background" / f"{STAMP}.png", grey)
    off = grey.copy()
    off[10:15, 8:18] += 20
    write_png(out / "background" / f"{STAMP}.png", off)
    row = evaluate(data, out)[STAMP]
    assert row["psnr 2+"] == pytest.approx(10 * np.log10(255**2 / 400))
    assert row["psnr 1"] > 100 and 0 < row["ssim"] < 1


def test_many_stamps_and_folders_of_recordings(tmp_path):
    pytest.importorskip("skimage", reason="the evaluation needs scikit-image")
    for name, stamps in (("a", ("1", "2")), ("b", ("1",))):
        for stamp in stamps:
            dataset(tmp_path / "data" / name, stamp)
            perfect(tmp_path / "out" / name, stamp)
    nothing = np.zeros((H, W), np.uint8)
    write_png(tmp_path / "data" / "b" / "truth" / "seen_by" / "1.png", nothing)  # no figure for psnr
    rows = evaluate(tmp_path / "data", tmp_path / "out", masks=None)
    assert list(rows) == ["a/1", "a/2", "b", MEAN]
    assert np.isnan(rows["b"]["psnr"]) and np.isnan(rows["b"]["ssim"])
    assert rows["b"]["flag"] == 20 and rows[MEAN]["flag"] == pytest.approx(220 / 3)
    assert rows[MEAN]["psnr"] == rows["a/1"]["psnr"]
    assert np.isnan(rows[MEAN]["iou in"])
    assert list(evaluate(tmp_path / "data" / "a", tmp_path / "out" / "a")) == ["1", "2", MEAN]


def test_the_table_shows_every_row_and_column(made):
    lines = table(evaluate(*made)).splitlines()
    assert len(lines) == 3
    assert lines[0].split() == " ".join(COLUMNS).split()
    assert lines[1].split()[:2] == [STAMP, "138.13"] and lines[1].split()[-2:] == ["0.333", "1.000"]
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("lost", ["background/{}.png", "disparity/{}.pfm", "coverage/{}.png", "masks/cam1/{}.png"])
def test_names_the_file_that_is_missing(made, lost):
    path = made[1] / lost.format(STAMP)
    path.unlink()
    with pytest.raises(DatasetError, match=f"{path}.*missing"):
        evaluate(*made)


def test_refuses_what_does_not_belong_together(made):
    data, out = made
    with pytest.raises(DatasetError, match="no truth"):
        evaluate(out, out)
    with pytest.raises(DatasetError, match="masks_of_mine"):
        evaluate(data, out, "masks_of_mine")
    write_pfm(out / "disparity" / f"{STAMP}.pfm", np.zeros((H, W + 1), np.float32))
    with pytest.raises(DatasetError, match=r"disparity.*25.*24"):
        evaluate(data, out)
    shutil.rmtree(data / "truth" / "background")
    with pytest.raises(DatasetError, match="holds no PNG"):
        evaluate(data, out)


def test_names_the_extra_when_scikit_image_is_missing(made, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)
    with pytest.raises(MissingExtraError, match=r"seepast\[evaluate\]"):
        evaluate(*made)
