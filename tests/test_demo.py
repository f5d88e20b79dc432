"""The demonstration: the sample inside the package, and how it is drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from seepast.demo import SAMPLE, contact_sheet, paint_coverage, paint_disparity, run_demo


def test_the_sample_is_small() -> None:
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) < 1_500_000


def test_the_demonstration_brings_back_most_of_what_people_hide(tmp_path: Path) -> None:
    for _ in range(2):  # a second time into the same folder, too
        done = run_demo(tmp_path / "demo")
    assert done.picture == tmp_path / "demo" / "before_after.png"
    picture = cv2.imread(str(done.picture))
    assert picture is not None and picture.shape[1] > 3 * 360
    assert 0.1 < done.hidden_share < 0.3
    assert done.seen_share > 0.9
    assert done.psnr > 22


def test_coverage_grows_lighter_with_every_camera_and_red_means_none() -> None:
    painted = paint_coverage(np.array([[0, 1, 2, 3, 4, 5]], np.uint8), 5)[0].astype(int)
    assert painted[0, 2] > 2 * painted[0, 0], "BGR: red"
    assert (np.diff(painted[1:, 0]) > 0).all() and painted[5].tolist() == [255, 255, 255]
    assert (painted[1:] == painted[1:, :1]).all()


def test_disparity_goes_from_blue_to_red_and_unknown_is_black() -> None:
    painted = paint_disparity(np.linspace(0, 50, 101, dtype=np.float32)[None])[0].astype(int)
    assert painted[0].tolist() == [0, 0, 0]
    assert painted[20, 0] > painted[20, 2] and painted[90, 2] > painted[90, 0]
    assert not paint_disparity(np.zeros((2, 3), np.float32)).any()


def test_a_contact_sheet_keeps_every_panel_as_it_is() -> None:
    rng = np.random.default_rng(0)
    panels = {f"panel {n}": rng.integers(0, 200, (20, 150, 3), np.uint8) for n in range(5)}
    sheet = contact_sheet(panels, columns=3)
    for image in panels.values():
        x, y = cv2.minMaxLoc(cv2.matchTemplate(sheet, image, cv2.TM_SQDIFF))[2]
        np.testing.assert_array_equal(sheet[y : y + 20, x : x + 150], image)
