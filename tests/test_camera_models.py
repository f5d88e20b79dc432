"""Camera models: against OpenCV where it has the model, against their definition, and round trips."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from seepast.camera_models import check_model, project, unproject
from seepast.errors import RigError

PINHOLE = (461.6, 460.2, 362.7, 246.1)
BARREL = (-0.277, 0.067, 0.0009, -0.0012)
FISHEYE = (-0.035, 0.0053, -0.009, 0.0023)

MODELS = {
    "pinhole none": ("pinhole", "none", PINHOLE, ()),
    "pinhole radtan 4": ("pinhole", "radtan", PINHOLE, BARREL),
    "pinhole radtan 5": ("pinhole", "radtan", PINHOLE, (*BARREL, 0.011)),
    "pinhole pincushion": ("pinhole", "radtan", PINHOLE, (0.2, 0.05, 0.002, 0.001)),
    "pinhole equidistant": ("pinhole", "equidistant", PINHOLE, FISHEYE),
    "omni none": ("omni", "none", (0.9, *PINHOLE), ()),
    "omni radtan": ("omni", "radtan", (0.8, 833.0, 830.3, 373.9, 253.7), (-0.335, 0.132, 0.0006, 0.0006)),
    "omni xi > 1": ("omni", "radtan", (2.13, 1150.9, 1151.1, 607.3, 354.3), (-0.205, 0.55, -1e-4, 9e-4)),
    "omni xi = 0": ("omni", "none", (0.0, *PINHOLE), ()),
    "double sphere": ("ds", "none", (-0.2, 0.592, 317.6, 316.2, 359.9, 239.6), ()),
    "double sphere, small alpha": ("ds", "none", (0.1, 0.3, 317.6, 316.2, 359.9, 239.6), ()),
}


def pixel_grid(width: int = 720, height: int = 480, step: int = 24) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    return np.stack([x, y], axis=-1).astype(np.float64)


@pytest.mark.parametrize("camera", MODELS.values(), ids=MODELS.keys())
def test_projecting_an_unprojected_pixel_returns_it(camera):
    pixels = pixel_grid()
    rays = unproject(*camera, pixels)
    assert rays.shape == (*pixels.shape[:2], 3) and rays.dtype == np.float64
    # A unified camera with xi > 1 sees a disc: plane radius up to 1 / sqrt(xi^2 - 1), about 600 px here.
    seen = np.isfinite(rays).all(axis=-1)
    assert seen.all() or (camera[2][0] == 2.13 and seen[np.hypot(*(pixels - [607, 354]).T).T < 560].all())
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(project(*camera, rays * 7.3)[seen], pixels[seen], atol=1e-7)


@pytest.mark.parametrize("camera", MODELS.values(), ids=MODELS.keys())
def test_unprojecting_a_projected_ray_returns_it(camera):
    rng = np.random.default_rng(1)
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(unproject(*camera, project(*camera, rays)), rays, atol=1e-9)


@pytest.mark.parametrize("camera", MODELS.values(), ids=MODELS.keys())
def test_the_axis_and_what_lies_behind(camera):
    center = np.array(camera[2][-2:])
    np.testing.assert_allclose(project(*camera, np.array([0, 0, 2.0])), center)
    np.testing.assert_allclose(unproject(*camera, center), [0, 0, 1], atol=1e-12)
    assert np.isnan(project(*camera, np.array([0.1, 0.05, -1.0]))).all() or camera[1] == "equidistant"
    assert np.isnan(project(*camera, np.array([0.0, 0.0, -1.0]))).all()


@pytest.mark.parametrize("name", ["pinhole none", "pinhole radtan 4", "pinhole radtan 5", "pinhole pincushion"])
def test_radtan_is_opencvs(name):
    _, _, (fu, fv, pu, pv), coefficients = camera = MODELS[name]
    points = np.random.default_rng(2).uniform([-1, -0.7, 1.5], [1, 0.7, 4], (300, 3))
    matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix, np.array([*coefficients, 0, 0, 0, 0, 0])[:5]
    )
    np.testing.assert_allclose(project(*camera, points), expected.reshape(-1, 2), atol=1e-9)


def test_equidistant_is_opencvs():
    _, _, (fu, fv, pu, pv), coefficients = camera = MODELS["pinhole equidistant"]
    points = np.random.default_rng(3).uniform([-3, -3, 1], [3, 3, 2], (300, 3))
    matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    np.testing.assert_allclose(project(*camera, points), expected.reshape(-1, 2), atol=1e-9)


def test_omni_by_hand():
    # Ray (3, 0, 4) / 5: X / (Z + xi) with unit length = 0.6 / (0.8 + 0.9).
    pixel = project("omni", "none", (0.9, 100.0, 100.0, 10.0, 20.0), (), np.array([3.0, 0, 4.0]))
    np.testing.assert_allclose(pixel, [10 + 100 * 0.6 / 1.7, 20])
    plain = project("omni", "none", (0.0, *PINHOLE), (), np.array([3.0, 1, 4.0]))
    np.testing.assert_allclose(plain, project("pinhole", "none", PINHOLE, (), np.array([3.0, 1, 4.0])))


def test_double_sphere_by_hand():
    # (3, 0, 4): d1 = 5, xi d1 + Z = 3, d2 = |(3, 0, 3)|, denominator = alpha d2 + (1 - alpha) 3.
    pixel = project("ds", "none", (-0.2, 0.6, 100.0, 100.0, 10.0, 20.0), (), np.array([3.0, 0, 4.0]))
    np.testing.assert_allclose(pixel, [10 + 100 * 3 / (0.6 * np.sqrt(18) + 0.4 * 3), 20])


def test_fisheyes_see_sideways_and_pinholes_do_not():
    sideways = np.array([1.0, 0.1, -0.05])
    assert np.isfinite(project(*MODELS["double sphere"], sideways)).all()
    assert np.isfinite(project(*MODELS["omni none"], sideways)).all()
    assert np.isnan(project(*MODELS["pinhole none"], sideways)).all()


def test_a_folding_polynomial_ends_where_it_turns():
    # r (1 - 0.3 r^2) turns at r^2 = 1 / 0.9; farther rays would come back into the image.
    camera = ("pinhole", "radtan", (500.0, 500.0, 320.0, 240.0), (-0.3, 0.0, 0.0, 0.0))
    turn = np.sqrt(1 / 0.9)
    assert np.isfinite(project(*camera, np.array([turn * 0.99, 0, 1]))).all()
    assert np.isnan(project(*camera, np.array([turn * 1.01, 0, 1]))).all()
    reach = 500 * turn * (1 - 0.3 * turn**2)
    assert np.isfinite(unproject(*camera, np.array([320 + reach - 1, 240]))).all()
    assert np.isnan(unproject(*camera, np.array([320 + reach + 1, 240]))).all()
    sixth = ("pinhole", "radtan", (500.0, 500.0, 320.0, 240.0), (0.0, 0.0, 0.0, 0.0, -0.1))
    turn = (1 / 0.7) ** (1 / 6)
    assert np.isfinite(project(*sixth, np.array([turn * 0.99, 0, 1]))).all()
    assert np.isnan(project(*sixth, np.array([turn * 1.01, 0, 1]))).all()
    wild = ("pinhole", "equidistant", (500.0, 500.0, 320.0, 240.0), (-0.5, 0.0, 0.0, 0.0))
    assert np.isnan(project(*wild, np.array([np.tan(0.9), 0, 1]))).all()  # turns at theta = 0.816
    assert np.isnan(unproject(*wild, np.array([320 + 500 * 0.6, 240]))).all()


def test_pixels_no_ray_reaches_are_nan():
    assert np.isnan(unproject(*MODELS["double sphere"], np.array([5000.0, 240]))).all()
    assert np.isnan(unproject("omni", "none", (2.0, 100.0, 100.0, 0.0, 0.0), (), np.array([60.0, 0]))).all()


@pytest.mark.parametrize(
    ("model", "distortion", "intrinsics", "coefficients", "said"),
    [
        ("eucm", "none", (0.5, 1, 1, 1, 1, 1), (), "'eucm' is not supported"),
        ("pinhole", "fov", PINHOLE, (0.9,), "'fov' is not supported with camera_model 'pinhole'"),
        (
            "omni",
            "equidistant",
            (0.9, *PINHOLE),
            FISHEYE,
            "'equidistant' is not supported with camera_model 'omni'",
        ),
        ("pinhole", "radtan", PINHOLE[:3], BARREL, r"4 numbers \(fu, fv, pu, pv\), not 3"),
        ("pinhole", "radtan", PINHOLE, BARREL[:3], "4 or 5 numbers, not 3"),
        ("pinhole", "equidistant", PINHOLE, (*FISHEYE, 0.1), "4 numbers, not 5"),
        ("pinhole", "none", PINHOLE, BARREL, "distortion_model is 'none'"),
        ("pinhole", "none", (0.0, *PINHOLE[1:]), (), "singular"),
        ("pinhole", "radtan", PINHOLE, (np.nan, 0, 0, 0), "NaN"),
        ("pinhole", "none", (np.inf, *PINHOLE[1:]), (), "infinity"),
        ("ds", "none", (-0.2, 1.4, *PINHOLE), (), "alpha = 1.4"),
        ("omni", "none", (-0.2, *PINHOLE), (), "xi = -0.2"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name(model, distortion, intrinsics, coefficients, said):
    with pytest.raises(RigError, match=rf"cam3.*{said}"):
        check_model("cam3", model, distortion, intrinsics, coefficients)
