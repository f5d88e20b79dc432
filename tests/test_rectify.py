"""Rectification: against scene points projected through the calibrated cameras, not against itself."""

from __future__ import annotations

import gc
import logging
import weakref
from dataclasses import replace

import cv2
import numpy as np
import pytest

from seepast import pixel_maps
from seepast.errors import InputError, OptionsError, RigError
from seepast.frames import input_masks, rectified_frame
from seepast.options import Options
from seepast.rectify import MAX_DYNAMIC, NO_RAY, measured_row_error, rectify
from seepast.rig import Camera, Rig

BARREL = (-0.2, 0.12, 0.001, -0.0008)


def turn(x: float, y: float, z: float) -> np.ndarray:
    return cv2.Rodrigues(np.array([x, y, z], np.float64))[0]


def camera(k: int, rotation: np.ndarray, center, model=("pinhole", "radtan", BARREL), focal=300.0) -> Camera:
    kind, distortion, coefficients = model
    extra = {"pinhole": (), "omni": (0.8,), "ds": (-0.2, 0.59)}[kind]
    if kind == "omni":
        focal = focal * 1.8
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ np.asarray(center, np.float64)
    intrinsics = (*extra, focal + 2 * k, focal + 2 * k + 1, 118.0 + 3 * k % 7, 93.0 - 2 * k % 5)
    return Camera(f"cam{k}", kind, distortion, intrinsics, coefficients, (240, 180), pose)


def crooked_rig(cameras: int, seed: int = 0, tilt=(0.1, -0.2, 0.15)) -> Rig:
    """Rotated by a few degrees each, off the line by millimetres, distorted, and tilted as a whole."""
    rng = np.random.default_rng(seed)
    models = [
        ("pinhole", "radtan", BARREL),
        ("pinhole", "equidistant", (-0.03, 0.005, -0.009, 0.002)),
        ("omni", "radtan", (-0.1, 0.05, 0.0005, 0.0005)),
        ("pinhole", "none", ()),
    ]
    made = []
    for k in range(cameras):
        center = turn(*tilt).T @ [0.165 * k, *rng.uniform(-0.004, 0.004, 2)]
        made.append(camera(k, turn(*rng.uniform(-0.03, 0.03, 3)), center, models[k % 4]))
    return Rig(tuple(made))


def scene(rectification, rng, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random rectified reference pixels, their disparities, and the points in the rectified reference."""
    geometry = rectification.geometry
    (fx, fy), (cx, cy) = geometry.focal, geometry.center
    x = rng.uniform(0, geometry.size[0] - 1, count)
    y = rng.uniform(0, geometry.size[1] - 1, count)
    depth = geometry.baseline * 10 ** rng.uniform(0.3, 2, count)
    points = np.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], axis=-1)
    return x, y, geometry.focal[0] * geometry.baseline / depth, points


def rectified_pixels(rig: Rig, rectification, k: int, points: np.ndarray) -> np.ndarray:
    """The points' true rectified pixels in camera k, through the rig's poses and lenses only."""
    reference = rectification.geometry.reference
    in_reference = points @ rectification.rotation_from_cam[reference]
    cam_from_reference = rig.cameras[k].cam_from_rig @ np.linalg.inv(rig.cameras[reference].cam_from_rig)
    in_camera = in_reference @ cam_from_reference[:3, :3].T + cam_from_reference[:3, 3]
    raw = rig.cameras[k].project(in_camera)
    rays = rig.cameras[k].unproject(raw) @ rectification.rotation_from_cam[k].T
    geometry = rectification.geometry
    return rays[:, :2] / rays[:, 2:] * geometry.focal + geometry.center + geometry.shifts[k]


@pytest.mark.parametrize("cameras", [2, 3, 5, 16])
@pytest.mark.parametrize("which", ["first", "middle", "last"])
def test_the_warp_predicts_every_camera(cameras, which):
    rig = crooked_rig(cameras)
    reference = {"first": 0, "middle": cameras // 2, "last": cameras - 1}[which]
    rectification = rectify(rig, reference)
    geometry = rectification.geometry
    assert geometry.reference == reference and geometry.cameras == cameras
    np.testing.assert_array_equal(geometry.positions[reference], 0)
    x, y, d, points = scene(rectification, np.random.default_rng(5))
    for k in range(cameras):
        xk, yk = geometry.warp(k, x, y, d)
        truth = rectified_pixels(rig, rectification, k, points)
        np.testing.assert_allclose(np.stack([xk, yk], axis=-1), truth, atol=1e-3)
    assert 0 < rectification.row_error_px < 1e-3


@pytest.mark.parametrize("reference", [0, 4])
def test_the_maps_lead_to_the_true_source_pixels(reference):
    rig = crooked_rig(5)
    rectification = rectify(rig, reference)
    fx, fy = rectification.geometry.focal
    width, height = rectification.geometry.size
    for k in range(5):
        map_x, map_y = rectification.maps[k]
        cx, cy = np.array(rectification.geometry.center) + rectification.geometry.shifts[k]
        assert map_x.shape == map_y.shape == (height, width) and map_x.dtype == map_y.dtype == np.float32
        v, u = np.mgrid[3:height:17, 3:width:17]
        ray = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
        source = rig.cameras[k].project(ray @ rectification.rotation_from_cam[k])
        inside = ((source >= -0.5) & (source <= [239.5, 179.5])).all(axis=-1)
        assert inside.mean() > 0.8
        found = np.stack([map_x[v, u], map_y[v, u]], axis=-1)
        np.testing.assert_allclose(found[inside], source[inside], atol=1e-3)
        assert np.isnan(found[~inside]).all()


def test_the_orientation_follows_the_line_and_the_axes():
    rig = crooked_rig(5)
    rectification = rectify(rig)
    positions = rectification.geometry.positions
    assert (np.diff(positions[:, 0]) > 0.16).all()  # along +x, as in the reference's image
    # Least squares: no further rotation lowers what is off the line.
    centered = positions - positions.mean(axis=0)
    np.testing.assert_allclose(centered[:, 1:].T @ centered[:, 0], 0, atol=1e-12)
    assert abs(positions[:, 1:]).max() < 0.01
    axes = np.stack([rotation[:, 2] for rotation in rectification.rotation_from_cam])
    assert abs(axes.mean(axis=0)[1]) < 1e-12  # z cannot be turned about x to see nearer the mean axis
    for rotation in rectification.rotation_from_cam:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0


def test_an_array_calibrated_from_right_to_left_has_negative_positions():
    rig = Rig(tuple(camera(k, turn(0.01 * k, 0.02, 0), [-0.1 * k, 0, 0]) for k in range(3)))
    rectification = rectify(rig)
    assert (np.diff(rectification.geometry.positions[:, 0]) < -0.09).all()
    assert rectification.rotation_from_cam[0][0, 0] > 0.9


def test_an_upright_array_turns_the_view():
    rig = Rig(tuple(camera(k, turn(0.01 * k, 0, 0), [0.001 * k, 0.1 * k, 0]) for k in range(3)))
    rectification = rectify(rig)
    assert rectification.geometry.size == (180, 240)
    assert (np.diff(rectification.geometry.positions[:, 0]) > 0.09).all()
    assert np.mean([np.isnan(m[0]).mean() for m in rectification.maps]) < 0.1
    x, y, d, points = scene(rectification, np.random.default_rng(1))
    truth = rectified_pixels(rig, rectification, 2, points)
    np.testing.assert_allclose(np.stack(rectification.geometry.warp(2, x, y, d), axis=-1), truth, atol=1e-3)


@pytest.mark.parametrize("reference", [0, 2, 4])
def test_a_rectified_array_passes_through_untouched(reference):
    rig = Rig.linear(5, focal=700.0, spacing=0.05, size=(65, 49), center=(31.3, 22.0))
    rectification = rectify(rig, reference)
    geometry = rectification.geometry
    assert rectification.maps == (None,) * 5
    assert geometry.focal == (700.0, 700.0) and geometry.center == (31.3, 22.0) and geometry.size == (65, 49)
    np.testing.assert_allclose(geometry.positions[:, 0], 0.05 * (np.arange(5) - reference))
    np.testing.assert_array_equal(geometry.positions[:, 1:], 0)
    image = np.random.default_rng(0).integers(0, 256, (49, 65, 3), np.uint8)
    mask = image[..., 0].copy()
    for k in range(5):
        np.testing.assert_array_equal(rectification.rotation_from_cam[k], np.eye(3))
        assert rectification.image(k, image) is image
        assert rectification.masks_to_input(k, mask, mask) is mask
        dynamic = rectification.dynamic(k, mask)
        np.testing.assert_array_equal(dynamic, np.minimum(mask, 254))
        assert not rectification.dynamic(k, None).any()
    np.testing.assert_array_equal(mask, image[..., 0])  # the input mask is not written to
    assert rectification.row_offset_px() == 0


def test_a_rectified_array_read_from_a_file_with_zero_distortion_passes_through(tmp_path):
    linear = Rig.linear(4, focal=889.5, spacing=0.165, size=(72, 54))
    zeros = tuple(replace(c, distortion="radtan", distortion_coeffs=(0, 0, 0, 0)) for c in linear.cameras)
    Rig(zeros).to_kalibr(tmp_path / "rig.yaml")
    assert rectify(Rig.from_kalibr(tmp_path / "rig.yaml"), "cam3").maps == (None,) * 4


def test_other_principal_points_pass_through_with_a_shift():
    linear = Rig.linear(4, focal=100.0, spacing=0.1, size=(64, 48), center=(31.0, 23.0))
    moved = replace(linear.cameras[1], intrinsics=(100.0, 100.0, 34.5, 22.0))
    longer = replace(linear.cameras[2], intrinsics=(120.0, 120.0, 31.0, 23.0))
    between_rows = replace(linear.cameras[3], intrinsics=(100.0, 100.0, 31.0, 23.5))
    rig = Rig((linear.cameras[0], moved, longer, between_rows))
    rectification = rectify(rig)
    geometry = rectification.geometry
    assert rectification.maps[0] is None and geometry.center == (31.0, 23.0)
    assert rectification.maps[1] is None  # no pixel of it is resampled or lost
    np.testing.assert_allclose(geometry.shifts, [[0, 0], [3.5, -1], [0, 0], [0, 0]])
    x, y = geometry.warp(1, 10.0, 12.0, 0.0)  # a point at infinity
    assert (x, y) == (13.5, 11.0)
    back = geometry.seen_from(1)
    assert back.center == (34.5, 22.0) and back.warp(0, 13.5, 11.0, 0.0) == (10.0, 12.0)
    assert np.isclose(rectification.maps[2][0][23, 40], 31 + 1.2 * 9)
    assert np.isclose(rectification.maps[3][1][20, 40], 20.5)  # half a row: resampled onto the reference's rows
    assert rectify(rig, 1).geometry.center == (34.5, 22.0)


def test_differing_resolutions():
    rig = crooked_rig(3)
    large = replace(
        rig.cameras[1],
        resolution=(480, 360),
        intrinsics=(600.0, 600.0, 240.0, 180.0),
        distortion="none",
        model="pinhole",
        distortion_coeffs=(),
    )
    rectification = rectify(Rig((rig.cameras[0], large, rig.cameras[2])))
    assert rectification.geometry.size == (240, 180)
    assert rectification.image(1, np.zeros((360, 480, 3), np.uint8)).shape == (180, 240, 3)
    assert rectification.masks_to_input(1, np.zeros((180, 240), np.uint8), None).shape == (360, 480)
    assert np.nanmax(rectification.maps[1][0]) > 450


def smooth_image(width: int, height: int) -> np.ndarray:
    noise = np.random.default_rng(7).uniform(0, 255, (height, width)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
@pytest.mark.parametrize("k", [0, 2])
def test_images_are_sampled_where_the_maps_say(interpolation, k):
    rectification = rectify(crooked_rig(3))
    image = smooth_image(240, 180)
    map_x, map_y = rectification.maps[k]
    rectified = rectification.image(k, image, interpolation)
    assert rectified.shape == (180, 240) and rectified.dtype == np.uint8
    ys, xs = np.nonzero(~np.isnan(map_x))
    picked = np.random.default_rng(0).choice(len(ys), 500)
    ys, xs = ys[picked], xs[picked]
    expected = cv2.remap(
        image.astype(np.float32),
        map_x[ys, xs],
        map_y[ys, xs],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).ravel()
    difference = abs(rectified[ys, xs] - expected)
    assert difference.max() < 5 and difference.mean() < 1
    colour = rectification.image(k, np.dstack([image] * 3), interpolation)
    np.testing.assert_array_equal(colour[..., 1], rectified)


def test_dynamic_tells_certainty_from_no_ray():
    rectification = rectify(crooked_rig(3))
    for k in range(3):
        nowhere = np.isnan(rectification.maps[k][0])
        assert nowhere.any()
        for level, expected in ((255, MAX_DYNAMIC), (254, 254), (128, 128), (0, 0)):
            dynamic = rectification.dynamic(k, np.full((180, 240), level, np.uint8))
            assert dynamic.dtype == np.uint8 and dynamic.shape == (180, 240)
            assert (dynamic[~nowhere] == expected).all() and (dynamic[nowhere] == NO_RAY).all()
        np.testing.assert_array_equal(rectification.dynamic(k, None), np.where(nowhere, NO_RAY, 0))


def test_masks_return_to_where_they_came_from():
    rectification = rectify(crooked_rig(5), 2)
    for k in range(5):
        mask = np.zeros((180, 240), np.uint8)
        cv2.circle(mask, (120, 90), 40, 255, -1)
        back = rectification.masks_to_input(k, rectification.dynamic(k, mask), mask)
        assert back.shape == mask.shape and back.dtype == np.uint8
        away_from_edge = cv2.dilate(mask, np.ones((5, 5))) == cv2.erode(mask, np.ones((5, 5)))
        assert (abs(back.astype(int) - mask)[away_from_edge] <= 1).all()
        # Half way at the edge: nothing has moved.
        assert abs(int((back > 127).sum()) - int((mask > 127).sum())) < 60


def test_pixels_the_rectified_view_does_not_reach_keep_their_own_value():
    rectification = rectify(crooked_rig(5))
    kept = 0
    for k in range(5):
        back = rectification.masks_to_input(k, np.zeros((180, 240), np.uint8), np.full((180, 240), 77, np.uint8))
        assert set(np.unique(back)) <= {0, 77} and back[90, 120] == 0
        kept += int((back == 77).sum())
        unreached = back == 77
        none = rectification.masks_to_input(k, np.full((180, 240), 255, np.uint8), None)
        np.testing.assert_array_equal(none == 0, unreached)
    assert 0 < kept < 0.1 * 5 * 240 * 180


def test_little_of_a_moderate_lens_is_lost_and_resolution_is_kept():
    rectification = rectify(crooked_rig(5))
    assert 0.75 * 300 < rectification.geometry.focal[0] <= 1.03 * 304
    assert rectification.geometry.focal[0] == rectification.geometry.focal[1]
    assert np.mean([np.isnan(m[0]).mean() for m in rectification.maps]) < 0.1


def test_a_fisheye_keeps_a_sensible_central_field():
    made = tuple(camera(k, turn(0, 0.02 * k, 0), [0.2 * k, 0, 0], ("ds", "none", ()), focal=60.0) for k in range(2))
    rectification = rectify(Rig(made))
    half_field = np.degrees(np.arctan(120 / rectification.geometry.focal[0]))
    assert 50 < half_field < 65  # the lens itself sees beyond 90 degrees
    assert not np.isnan(rectification.maps[0][0][90, 20:220]).any()
    x, y, d, points = scene(rectification, np.random.default_rng(1))
    truth = rectified_pixels(Rig(made), rectification, 1, points)
    np.testing.assert_allclose(np.stack(rectification.geometry.warp(1, x, y, d), axis=-1), truth, atol=1e-3)


def test_row_offset_is_what_the_warp_carries():
    linear = Rig.linear(3, focal=100.0, spacing=0.1, size=(64, 48))
    poses = [c.cam_from_rig.copy() for c in linear.cameras]
    poses[1][1, 3] = -0.02  # 2 cm below the line of the other two
    rig = Rig(tuple(replace(c, cam_from_rig=p) for c, p in zip(linear.cameras, poses, strict=True)))
    rectification = rectify(rig)
    assert np.isclose(rectification.row_offset_px(2.0), 100 * 0.02 / 2, rtol=1e-3)
    assert np.isclose(rectification.row_offset_px(4.0), 100 * 0.02 / 4, rtol=1e-3)


def test_a_far_from_linear_array_warns(caplog):
    made = tuple(camera(k, np.eye(3), [0.1 * k, 0.1 * (k % 2), 0]) for k in range(4))
    with caplog.at_level(logging.WARNING, "seepast"):
        rectify(Rig(made))
    assert "far from linear" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, "seepast"):
        rectify(crooked_rig(5))
    assert not caplog.text


def test_arrays_that_do_not_see_the_same_way_are_refused():
    sideways = Rig(tuple(camera(k, turn(0, a, 0), [0.1 * k, 0, 0]) for k, a in enumerate([0.0, 0.0, 1.6])))
    with pytest.raises(RigError, match=r"do not see the same way: .* cam0 0, cam1 0, cam2 92"):
        rectify(sideways)
    opposite = Rig(tuple(camera(k, turn(0, np.pi * k, 0), [0.1 * k, 0, 0]) for k in range(2)))
    with pytest.raises(RigError, match="do not see the same way"):
        rectify(opposite)
    behind = Rig(tuple(camera(k, np.eye(3), [0.01 * k, 0, 0.1 * k]) for k in range(2)))
    with pytest.raises(RigError, match=r"lined up along their viewing direction .* 6 degrees off cam0"):
        rectify(behind)


def test_wrong_sizes_and_cameras_are_refused():
    rectification = rectify(crooked_rig(3))
    for call in (
        lambda: rectification.image(1, np.zeros((240, 180), np.uint8)),
        lambda: rectification.dynamic(1, np.zeros((180, 241), np.uint8)),
        lambda: rectification.masks_to_input(1, np.zeros((180, 240), np.uint8), np.zeros((9, 9), np.uint8)),
    ):
        with pytest.raises(InputError, match=r"of cam1 is .* calibrated at 240x180"):
            call()
    with pytest.raises(RigError, match="no camera 'cam7'"):
        rectify(crooked_rig(3), "cam7")


def test_maps_are_made_once_per_rig_and_reference_and_go_with_the_rig():
    rig = crooked_rig(3)
    assert rectify(rig, 1) is rectify(rig, "cam1")
    assert rectify(rig, 1) is not rectify(rig, 0)
    assert rectify(crooked_rig(3), 1) is not rectify(rig, 1)
    gone = weakref.ref(rectify(rig, 1))
    del rig
    gc.collect()
    assert gone() is None


def plane_views(rig: Rig, rectification, depth: float = 2.0) -> list[np.ndarray]:
    """Raw images of a textured plane parallel to the rectified reference view, ray-cast per camera."""
    texture = smooth_image(800, 800)
    texture = cv2.addWeighted(texture, 0.6, cv2.resize(smooth_image(400, 400), (800, 800)), 0.4, 0)
    reference = rectification.geometry.reference
    y, x = np.mgrid[:180, :240].astype(np.float64)
    images = []
    for k, cam in enumerate(rig.cameras):
        rays = cam.unproject(np.stack([x, y], axis=-1)) @ rectification.rotation_from_cam[k].T
        center = (cam.center - rig.cameras[reference].center) @ (
            rectification.rotation_from_cam[reference] @ rig.cameras[reference].rotation
        ).T
        hit = center + rays * ((depth - center[2]) / rays[..., 2])[..., None]
        u = (hit[..., :2] * 250 + 350).astype(np.float32)
        images.append(cv2.remap(texture, u[..., 0].copy(), u[..., 1].copy(), cv2.INTER_LINEAR))
    return images


def test_measured_rows_agree_with_the_calibration_and_betray_a_wrong_one():
    rig = crooked_rig(4, tilt=(0.02, -0.03, 0.05))
    rectification = rectify(rig)
    raw = plane_views(rig, rectification)
    views = [rectification.image(k, image) for k, image in enumerate(raw)]
    assert measured_row_error(views, rectification.geometry) < 0.1
    coloured = [cv2.cvtColor(v, cv2.COLOR_GRAY2BGR) for v in views]
    assert measured_row_error(coloured, rectification.geometry) < 0.1
    bumped = rig.cameras[2].cam_from_rig.copy()
    bumped[:3, :3] = turn(0.01, 0, 0) @ bumped[:3, :3]  # 3 px at this focal length
    wrong = rectify(Rig((*rig.cameras[:2], replace(rig.cameras[2], cam_from_rig=bumped), rig.cameras[3])))
    views = [wrong.image(k, image) for k, image in enumerate(raw)]
    assert measured_row_error(views, wrong.geometry) > 1


def test_measured_rows_of_a_blank_image_are_unknown():
    rig = Rig.linear(2, focal=100.0, spacing=0.1, size=(64, 48))
    assert np.isnan(measured_row_error([np.zeros((48, 64), np.uint8)] * 2, rectify(rig).geometry))


def every_pixel(mapped, size: tuple[int, int]) -> np.ndarray:
    """What `dense` promises to be close to: float32[2, H, W]."""
    x, y = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    return np.moveaxis(mapped(np.stack([x, y], axis=-1)), -1, 0).astype(np.float32)


@pytest.mark.parametrize("k", range(4))
def test_maps_through_a_few_hundred_points_are_the_maps_of_every_pixel(k):
    """Each kind of lens, into the camera and back, by the polynomial and not by the way out of it."""
    own, rotation = crooked_rig(4).cameras[k], turn(0.02, -0.03, 0.01)

    def through(pixels: np.ndarray) -> np.ndarray:
        plane = (pixels - [119.5, 89.5]) / 280
        return own.project(np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1) @ rotation)

    def back(pixels: np.ndarray) -> np.ndarray:
        rays = own.unproject(pixels) @ rotation.T
        return rays[..., :2] / rays[..., 2:] * 280 + [119.5, 89.5]

    for mapped in (through, back):
        made = pixel_maps._interpolated(mapped, (240, 180))
        assert made is not None
        np.testing.assert_allclose(made, every_pixel(mapped, (240, 180)), atol=3e-5)
        np.testing.assert_array_equal(pixel_maps.dense(mapped, (240, 180)), made)


def test_maps_that_no_polynomial_follows_are_made_pixel_by_pixel():
    def kinked(pixels: np.ndarray) -> np.ndarray:
        return abs(pixels - [77.7, 55.5])

    def ends(pixels: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(pixels - [100, 90], axis=-1, keepdims=True) < 120, pixels + 0.25, np.nan)

    def spiked(pixels: np.ndarray) -> np.ndarray:  # between the nodes only the checked places can see it
        return pixels + 0.01 * np.sin(pixels * np.pi / 2)

    for mapped in (kinked, ends, spiked):
        np.testing.assert_array_equal(pixel_maps.dense(mapped, (240, 180)), every_pixel(mapped, (240, 180)))


def textured(rig: Rig, seed: int = 3) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """An image and a mask of noise for every camera."""
    rng = np.random.default_rng(seed)
    sizes = [camera.resolution[::-1] for camera in rig.cameras]
    images = [cv2.GaussianBlur(rng.integers(0, 256, (*size, 3), np.uint8), (0, 0), 1.5) for size in sizes]
    return images, [rng.integers(0, 256, size, np.uint8) for size in sizes]


def test_a_frame_is_the_same_for_any_number_of_threads():
    rig = crooked_rig(5)
    rectification, (images, masks) = rectify(rig, 1), textured(rig)
    frames = [rectified_frame(rectification, images, masks, threads=threads) for threads in (1, 2, 5, 0)]
    for frame in frames:
        for k in range(5):
            view = rectification.image(k, images[k])
            np.testing.assert_array_equal(frame.colour[k], view)
            np.testing.assert_array_equal(frame.grey[k], cv2.cvtColor(view, cv2.COLOR_BGR2GRAY))
            np.testing.assert_array_equal(frame.dynamic[k], rectification.dynamic(k, masks[k]))
    back = [input_masks(rectification, frames[0].dynamic, masks, threads) for threads in (1, 2, 5, 0)]
    for found in back[1:]:
        np.testing.assert_array_equal(found, back[0])


def test_the_interpolation_is_an_option_and_linear_is_not_cubic():
    rig = crooked_rig(3)
    rectification, (images, masks) = rectify(rig), textured(rig)
    cubic, linear = (rectified_frame(rectification, images, masks, kind) for kind in ("cubic", "linear"))
    for k in range(3):
        view = rectification.image(k, images[k], "linear")
        np.testing.assert_array_equal(linear.colour[k], view)
        np.testing.assert_array_equal(linear.grey[k], cv2.cvtColor(view, cv2.COLOR_BGR2GRAY))
    assert (cubic.colour != linear.colour).any()
    np.testing.assert_array_equal(cubic.dynamic, linear.dynamic)
    assert Options().rectify.interpolation == "cubic"
    assert Options().updated({"rectify.interpolation": "linear"}).rectify.interpolation == "linear"
    with pytest.raises(OptionsError, match=r"rectify\.interpolation: 'lanczos' is none of cubic, linear"):
        Options().updated({"rectify.interpolation": "lanczos"})


def test_a_failing_view_is_told_from_whatever_thread():
    rig = crooked_rig(4)
    rectification, (images, masks) = rectify(rig), textured(rig)
    images[3] = images[3][:-1]
    with pytest.raises(InputError, match="image of cam3 is 240x179"):
        rectified_frame(rectification, images, masks, threads=3)
