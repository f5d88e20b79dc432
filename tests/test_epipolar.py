"""Epipolar-plane images: slope is disparity, and what a person's rays touch is struck out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from arrays import FAR, NEAR, make_scene, painted, texture, unwarped
from recordings import write_recording
from seepast import cli
from seepast.epipolar import LEGEND, STRUCK, UNSEEN, draw, epipolar_image, spread
from seepast.errors import OptionsError
from seepast.geometry import ArrayGeometry


def uneven_array(reference: int = 0) -> ArrayGeometry:
    """Four cameras whose order along the line is not their number."""
    positions = np.zeros((4, 3))
    positions[:, 0] = [0.0, 0.3, 0.1, 0.45]
    return ArrayGeometry((120.0, 120.0), (80.0, 30.0), (160, 60), positions - positions[reference], reference)


def wall(geometry: ArrayGeometry, disparity: float) -> list[np.ndarray]:
    image = texture((400, 300), np.random.default_rng(2), blur=2.0)
    views = []
    for k in range(geometry.cameras):
        x, y = unwarped(geometry, k, lambda x, y: np.full_like(x, disparity))
        views.append(painted(image, x, y))
    return views


def shift(first: np.ndarray, second: np.ndarray) -> float:
    """Columns that `second` [W, C] is moved to the right against `first`: the best of whole ones, then a parabola."""
    reach, inner = range(-40, 41), slice(45, -45)
    rolled = [np.roll(second.astype(float), -s, axis=0) for s in reach]
    cost = np.array([np.square(r[inner] - first[inner].astype(float)).mean() for r in rolled])
    i = int(cost[1:-1].argmin()) + 1
    a, b, c = cost[i - 1 : i + 2]
    return reach[i] + 0.5 * (a - c) / (a - 2 * b + c)


@pytest.mark.parametrize("reference", [0, 2])
@pytest.mark.parametrize("disparity", [9.0, 23.5])
def test_slopes_are_disparities_at_true_positions(reference: int, disparity: float) -> None:
    geometry = uneven_array(reference)
    epi = epipolar_image(wall(geometry, disparity), geometry, 20)
    assert epi.cameras == (0, 2, 1, 3) and (np.diff(epi.places) > 0).all()
    own = epi.colours[epi.cameras.index(reference)]
    shifts = [shift(own, line) for line in epi.colours]
    assert shifts == pytest.approx(list(-disparity * epi.places), abs=0.1)
    slope = np.polyfit(epi.places, shifts, 1)[0]
    assert slope == pytest.approx(-disparity, abs=0.1)


def test_a_shear_makes_its_disparity_vertical_and_takes_it_off_the_others() -> None:
    geometry = uneven_array()
    epi = epipolar_image(wall(geometry, 23.5), geometry, 20, shear=23.5)
    inner = epi.seen.all(axis=0)
    assert inner.sum() > 100
    spreads = np.ptp(epi.colours[:, inner].astype(int), axis=0)
    assert np.median(spreads) <= 4
    assert (~epi.seen[-1]).sum() == pytest.approx(23.5, abs=1), "columns that the last camera does not see"
    epi = epipolar_image(wall(geometry, 23.5), geometry, 20, shear=9.0)
    assert [shift(epi.colours[0], line) for line in epi.colours] == pytest.approx(list(-14.5 * epi.places), abs=0.1)


def test_cameras_off_the_line_and_shifted_views_are_followed() -> None:
    scene = make_scene(5, (160, 60), person=False, masks="none", residual=True, reference=1, colour=True)
    epi = epipolar_image(list(scene.views), scene.geometry, 30, shear=FAR)
    inner = epi.seen.all(axis=0)
    assert np.median(np.ptp(epi.colours[:, inner].astype(int), axis=0)) < 25
    wrong = epipolar_image(list(scene.views), scene.geometry, 30, shear=FAR + 12)
    assert np.median(np.ptp(wrong.colours[:, wrong.seen.all(axis=0)].astype(int), axis=0)) > 50


def test_the_person_is_struck_out_and_nothing_else() -> None:
    scene = make_scene(5, (160, 60), masks="exact", colour=True)
    epi = epipolar_image(list(scene.views), scene.geometry, 30, scene.dynamic, shear=NEAR)
    columns = np.flatnonzero(scene.person[0, 30])
    struck = epi.dynamic & epi.seen
    assert (struck[:, columns[1:-1]] | ~epi.seen[:, columns[1:-1]]).all(), "vertical at the person's disparity"
    beyond = np.ones(160, bool)
    beyond[columns[0] - 1 : columns[-1] + 2] = False
    assert not struck[:, beyond].any()
    picture = spread(epi, 50)
    red = (picture == STRUCK).all(axis=-1)
    assert 0.3 < red[:, columns[1:-1]].mean() < 0.6 and not red[:, beyond].any()


def test_lines_stand_where_the_cameras_do() -> None:
    geometry = uneven_array()
    levels = np.array([10, 90, 170, 250])
    views = [np.full((60, 160), level, np.uint8) for level in levels]
    epi = epipolar_image(views, geometry, 5)
    picture = spread(epi, 451)
    assert picture.shape == (451, 160, 3)
    assert [int(picture[y, 3, 0]) for y in (0, 49, 51, 100, 199, 201, 300, 374, 376, 450)] == [
        10, 10, 170, 170, 170, 90, 90, 90, 250, 250,
    ]  # fmt: skip
    mixed = spread(epi, 451, "linear")
    assert [int(mixed[y, 3, 0]) for y in (0, 50, 100, 200, 300, 450)] == [10, 90, 170, 130, 90, 250]


def test_what_lies_outside_a_view_is_grey() -> None:
    geometry = uneven_array()
    epi = epipolar_image([np.zeros((60, 160), np.uint8)] * 4, geometry, 5, shear=20.0)
    grey = (spread(epi, 40) == UNSEEN).all(axis=-1)
    assert grey[-1, :20].all() and not grey[-1, 20:].any() and not grey[0].any()


@pytest.mark.parametrize("row", [0, 29, 59])
def test_the_drawing_marks_the_row(row: int) -> None:
    geometry = uneven_array()
    views = [np.full((60, 160), 77, np.uint8)] * 4
    picture = draw(epipolar_image(views, geometry, row), views[0], row, ["a", "b", "c", "d"], 40)
    marked = (picture[:60, LEGEND:] != 77).any(axis=-1).all(axis=1)
    assert list(np.flatnonzero(marked)) == [row] and picture.shape == (60 + 6 + 40, LEGEND + 160, 3)


@pytest.mark.parametrize(("row", "shear"), [(-1, 0.0), (60, 0.0), (5, -1.0), (5, float("nan"))])
def test_rows_and_shears_that_are_none(row: int, shear: float) -> None:
    with pytest.raises(OptionsError, match=r"--row|--shear"):
        epipolar_image([np.zeros((60, 160), np.uint8)] * 4, uneven_array(), row, shear=shear)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec, out = write_recording(tmp_path / "rec"), tmp_path / "epi.png"
    assert cli.main(["epi", str(rec), "--row", "18", "--out", str(out), "--shear", "4"]) == 0
    assert "row 18 of 000000, 3 cameras" in capsys.readouterr().out
    picture = cv2.imread(str(out))
    assert picture is not None and picture.shape == (36 + 6 + 120, LEGEND + 48, 3)
    assert cli.main(["epi", str(rec), "--row", "18", "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main(["epi", str(rec), "--row", "36", "--out", str(tmp_path / "b.png")]) == 2
    assert "rows 0 .. 35" in capsys.readouterr().err
