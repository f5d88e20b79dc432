"""Plain refocusing: what lies on the focal surface is sharp, what lies off it smears."""

from __future__ import annotations

import numpy as np
import pytest

from arrays import FAR, NEAR, Scene, make_scene, slanted
from seepast.errors import InputError
from seepast.focal import DYNAMIC, Aperture, refocus_at
from seepast.rectify import NO_RAY


def error(picture: np.ndarray, truth: np.ndarray, where) -> float:
    return float(np.abs(picture.astype(float) - truth)[where].mean())


INNER = (slice(4, -4), slice(14, -14))  # all cameras look here, at FAR


def empty(**settings) -> Scene:
    return make_scene(person=False, masks="none", **settings)


@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
@pytest.mark.parametrize("reference", [0, 2, 4])
def test_on_the_plane_it_is_the_texture(reference, colour):
    scene = empty(reference=reference, colour=colour)
    d = scene.disparity[0, 0]
    assert d == FAR
    picture = refocus_at(list(scene.views), scene.geometry, float(d))
    assert picture.shape == scene.views.shape[1:]
    assert picture.dtype == np.uint8
    assert error(picture, scene.background, INNER) < 0.5
    assert error(refocus_at(list(scene.views), scene.geometry, FAR + 8), scene.background, INNER) > 15


def test_offsets_in_y_and_z_and_shifted_views_are_followed():
    scene = empty(residual=True, reference=1)
    picture = refocus_at(list(scene.views), scene.geometry, FAR)
    assert error(picture, scene.background, INNER) < 10  # interpolated twice
    blurred = refocus_at(list(scene.views), scene.geometry, FAR + 8)
    assert error(blurred, scene.background, INNER) > 3 * error(picture, scene.background, INNER)


def test_off_the_plane_contrast_fades():
    scene = empty()
    contrast = [refocus_at(list(scene.views), scene.geometry, d)[INNER].std() for d in (FAR, FAR + 2, FAR + 12)]
    assert contrast[0] > contrast[1] > contrast[2]
    assert contrast[2] < 0.6 * contrast[0]


def test_a_surface_of_its_own_disparity_per_pixel():
    scene = empty(surface="slanted")
    surface = refocus_at(list(scene.views), scene.geometry, scene.disparity)
    y, x = np.mgrid[: scene.disparity.shape[0], : scene.disparity.shape[1]]
    assert np.allclose(scene.disparity, slanted(scene.geometry)(x, y), atol=1e-4)
    plane = refocus_at(list(scene.views), scene.geometry, FAR)
    assert error(surface, scene.background, INNER) < 0.5 * error(plane, scene.background, INNER)


def test_masked_rays_drop_people():
    scene = make_scene()
    hidden = scene.person[0]
    bare = refocus_at(list(scene.views), scene.geometry, FAR)
    masked = refocus_at(list(scene.views), scene.geometry, FAR, scene.dynamic)
    assert error(masked, scene.background, hidden) < 1
    assert error(bare, scene.background, hidden) > 5


def test_a_ray_counts_below_one_half():
    scene = empty(cameras=2)
    dynamic = np.zeros_like(scene.dynamic)
    views = [np.full_like(scene.views[0], 100), np.full_like(scene.views[0], 200)]
    for p, expected in ((DYNAMIC - 1, 150), (DYNAMIC, 100), (254, 100), (NO_RAY, 100)):
        dynamic[1] = p
        assert (refocus_at(views, scene.geometry, FAR, dynamic)[INNER] == expected).all()


def test_black_where_no_ray_is_left():
    scene = make_scene(3)
    dynamic = scene.dynamic.copy()
    dynamic[:, 20:30] = 254
    dynamic[:, 40:50] = NO_RAY
    picture = refocus_at([np.full_like(v, 77) for v in scene.views], scene.geometry, FAR, dynamic)
    assert (picture[20:30] == 0).all()
    assert (picture[40:50] == 0).all()
    assert (picture[:15, 30:] == 77).all()


def test_rays_beyond_a_view_do_not_count():
    scene = empty(cameras=3)
    views = [np.full_like(v, 60 * (k + 1)) for k, v in enumerate(scene.views)]
    picture = refocus_at(views, scene.geometry, 20.0)  # camera 1 sees columns from 10 on, camera 2 from 20
    assert (picture[:, :10] == 60).all()
    assert (picture[:, 10:20] == 90).all()
    assert (picture[:, 20:] == 120).all()


def test_near_things_come_into_focus_too():
    scene = make_scene()
    person = np.zeros_like(scene.person[0])
    person[20:44, 42:48] = True  # well inside
    assert scene.person[0][person].all()
    sharp = refocus_at(list(scene.views), scene.geometry, NEAR)
    assert error(sharp, scene.views[0], person) < 0.5


def test_inputs_stay_as_they_were():
    scene = make_scene()
    views, dynamic = scene.views.copy(), scene.dynamic.copy()
    refocus_at(list(views), scene.geometry, FAR, dynamic)
    assert np.array_equal(views, scene.views)
    assert np.array_equal(dynamic, scene.dynamic)


def test_wrong_views_are_refused():
    scene = empty(cameras=3)
    with pytest.raises(InputError, match="3 rectified views of 96x64"):
        refocus_at(list(scene.views[:2]), scene.geometry, FAR)
    with pytest.raises(InputError, match="rectified views"):
        refocus_at([*scene.views[:2], scene.views[2, :, :-1]], scene.geometry, FAR)


def test_an_aperture_uses_only_its_cameras():
    scene = make_scene(masks="exact")
    views = list(scene.views)
    alone = refocus_at(views, scene.geometry, FAR, aperture=Aperture((scene.geometry.reference,)))
    assert np.array_equal(alone, scene.views[scene.geometry.reference])
    spoilt = [view if k in (0, 3) else np.zeros_like(view) for k, view in enumerate(views)]
    pair = Aperture((0, 3))
    assert np.array_equal(
        refocus_at(views, scene.geometry, FAR, aperture=pair), refocus_at(spoilt, scene.geometry, FAR, aperture=pair)
    )
    with pytest.raises(InputError, match="aperture"):
        refocus_at(views, scene.geometry, FAR, aperture=Aperture((5,)))


@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
def test_the_median_is_that_of_the_rays_that_count(colour):
    """Views of one grey level each, so that every ray's colour is known."""
    levels = [10, 200, 30, 100, 50]
    scene = empty(colour=colour)
    views = [np.full_like(view, level) for view, level in zip(scene.views, levels, strict=True)]
    median = Aperture(blend="median")
    picture = refocus_at(views, scene.geometry, 0.0, aperture=median)
    assert (picture == 50).all() and picture.shape == views[0].shape
    dynamic = np.zeros((5, *views[0].shape[:2]), np.uint8)
    dynamic[1, :20], dynamic[:, 20:30] = 254, NO_RAY
    picture = refocus_at(views, scene.geometry, 0.0, dynamic, median)
    assert (picture[:20] == 40).all() and (picture[20:30] == 0).all() and (picture[30:] == 50).all()


def test_the_median_drops_a_person_that_the_mean_keeps():
    scene = make_scene(masks="none", cameras=9)
    d = float(scene.disparity[0, 0])
    where = np.zeros(scene.disparity.shape, bool)
    where[INNER] = scene.person[0][INNER] & (scene.seen_by()[INNER] >= 6)
    assert where.sum() > 50
    mean, median = (
        error(refocus_at(list(scene.views), scene.geometry, d, aperture=Aperture(blend=blend)), scene.background, where)
        for blend in ("mean", "median")
    )
    assert median < 0.6 * mean
