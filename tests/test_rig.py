"""Kalibr files as people have them, and the ones that must be refused."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from seepast.errors import OutputError, RigError, SeepastError
from seepast.rig import Camera, Rig, proper_pose

NESTED = """\
%YAML:1.0
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.21, 0.24,
    0.0004, 0.0009]
  distortion_model: radtan
  intrinsics: [889.5, 890.1, 372.5, 281.3]
  resolution: [720, 540]
  rostopic: /camera_array/cam0/image_raw
cam1:
  T_cn_cnm1:
    - [0.0, -1.0, 0.0, -0.165]
    - [1.0, 0.0, 0.0, 0.002]
    - [0.0, 0.0, 1.0, 0.001]
    - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.03, 0.5, -7.6, 41.7]
  distortion_model: equidistant
  intrinsics: [891.5, 892.0, 381.5, 273.9]
  resolution: [720, 540]
"""

PLAIN = """\
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [500.0, 500.0, 320.0, 240.0]
  resolution: [640, 480]
"""
STEP = "  T_cn_cnm1: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
TWO = "cam0:\n" + PLAIN + "cam1:\n" + PLAIN + STEP.format(x=-0.1)


def rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    made = np.eye(3)
    made[i, i] = made[j, j] = c
    made[i, j], made[j, i] = -s, s
    return made


def pose(axis: int, angle: float, translation: tuple[float, float, float]) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3] = rotation(axis, angle)
    made[:3, 3] = translation
    return made


def rows(matrix: np.ndarray) -> str:
    return "".join(f"    - {row}\n" for row in matrix.tolist())


@pytest.fixture
def load(tmp_path):
    def load(text: str) -> Rig:
        path = tmp_path / "rig.yaml"
        path.write_text(text, encoding="utf-8")
        return Rig.from_kalibr(path)

    return load


def test_nested_chain_with_opencv_first_line(load):
    rig = load(NESTED)
    cam0, cam1 = rig.cameras
    assert [c.name for c in rig.cameras] == ["cam0", "cam1"] and len(rig) == 2
    assert cam0.intrinsics == (889.5, 890.1, 372.5, 281.3)
    assert cam0.distortion_coeffs == (-0.21, 0.24, 0.0004, 0.0009)
    assert (cam0.distortion, cam1.distortion) == ("radtan", "equidistant")
    assert cam0.resolution == (720, 540)
    assert (cam0.topic, cam1.topic) == ("/camera_array/cam0/image_raw", None)
    np.testing.assert_array_equal(cam0.cam_from_rig, np.eye(4))
    # T_cn_cnm1 maps a point of cam0 into cam1; its inverse's translation is cam1's centre.
    point = cam1.cam_from_rig @ [1, 2, 3, 1]
    np.testing.assert_allclose(point, [-2 - 0.165, 1 + 0.002, 3.001, 1])
    np.testing.assert_allclose(cam1.center, [-0.002, -0.165, -0.001])
    np.testing.assert_allclose(rig.centers[1], cam1.center)


def test_a_chain_of_three_accumulates(load):
    first, second = pose(1, 0.3, (-0.2, 0.01, 0)), pose(0, -0.2, (-0.3, 0, 0.02))
    text = "cam0:\n" + PLAIN
    for n, step in ((1, first), (2, second)):
        text += f"cam{n}:\n{PLAIN}  T_cn_cnm1:\n{rows(step)}"
    rig = load(text)
    np.testing.assert_allclose(rig.cameras[2].cam_from_rig, second @ first, atol=1e-14)


def test_cameras_come_by_number_not_by_place_in_the_file(load):
    text = "".join(
        f"cam{n}:\n{PLAIN}{STEP.format(x=-0.1 * (n + 1)) if n else ''}" for n in (10, 2, *range(2), *range(3, 10))
    )
    rig = load(text)
    assert [c.name for c in rig.cameras] == [f"cam{n}" for n in range(11)]
    np.testing.assert_allclose(rig.centers[10, 0], sum(0.1 * (n + 1) for n in range(1, 11)))


@pytest.mark.parametrize("style", ["T_cam_imu nested", "T_imu_cam nested", "T_cam_imu flat", "T_imu_cam :", "3 rows"])
def test_poses_relative_to_an_imu(load, style):
    imu0, imu1 = pose(0, 1.2, (0.3, -0.1, 0.05)), pose(0, 1.15, (0.1, -0.1, 0.04))
    inverse = style.startswith("T_imu_cam")
    key = style.split(" ")[0] + (" :" if style.endswith(":") else ":")
    text = ""
    for n, cam_from_imu in enumerate((imu0, imu1)):
        matrix = np.linalg.inv(cam_from_imu) if inverse else cam_from_imu
        if style == "3 rows":
            key, matrix = "T_cam_imu:", matrix[:3]
        body = f" {matrix.ravel().tolist()}\n" if style.endswith("flat") else "\n" + rows(matrix)
        text += f"cam{n}:\n  {key}{body}{PLAIN}"
    rig = load(text + "T_imu_body: [1, 0, 0, 0]\n")
    np.testing.assert_allclose(rig.cameras[1].cam_from_rig, imu1 @ np.linalg.inv(imu0), atol=1e-12)


def test_the_chain_is_preferred_to_the_imu(load):
    imu = "  T_cam_imu:\n" + rows(pose(2, 0.5, (7, 8, 9)))
    rig = load("cam0:\n" + PLAIN + imu + "cam1:\n" + PLAIN + imu + STEP.format(x=-0.25))
    np.testing.assert_allclose(rig.centers[1], [0.25, 0, 0])


def test_camera_underscore_keys_are_cameras(load):
    rig = load("camera_numbers: 2\n" + TWO.replace("cam0:", "camera_0:").replace("cam1:", "camera_1:"))
    assert [c.name for c in rig.cameras] == ["cam0", "cam1"]


def test_hand_written_yaml_is_mended(load):
    text = TWO.replace("[1, 0, 0, -0.1", "[1, 0, 0, -1e-1").replace("camera_model: ", "camera_model:\t")
    text = "\ufeff%YAML:1.0\n---\n" + text.replace("resolution: [", "resolution :[")
    rig = load(text)
    np.testing.assert_allclose(rig.centers[1], [0.1, 0, 0])
    opencv = "{rows: 4, cols: 4, dt: d, data: [1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}"
    rig = load("cam0:\n" + PLAIN + "cam1:\n" + PLAIN + "  T_cn_cnm1: !!opencv-matrix " + opencv)
    np.testing.assert_allclose(rig.centers[1], [0.1, 0, 0])


def test_loose_rotations_become_the_nearest_proper_ones(load, caplog):
    matrix = [[1, 0, 0, -0.2], [0, 0.766, -0.6428, 0], [0, 0.6428, 0.766, 0], [0, 0, 0, 1]]
    loose = f"  T_cn_cnm1: {matrix}\n"
    rig = load("cam0:\n" + PLAIN + "cam1:\n" + PLAIN + loose)
    made = rig.cameras[1].rotation
    np.testing.assert_allclose(made @ made.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(made, rotation(0, np.arctan2(0.6428, 0.766)), atol=1e-12)
    np.testing.assert_array_equal(rig.cameras[1].cam_from_rig[:3, 3], [-0.2, 0, 0])
    with caplog.at_level(logging.WARNING, "seepast"):
        proper_pose(np.diag([1.0, 1.001, 1, 1]), "x")
    assert "orthonormal only to 0.002" in caplog.text


def test_writing_and_reading_gives_the_same_rig(load, tmp_path):
    text = "cam0:\n" + PLAIN
    for n in range(1, 5):
        text += f"cam{n}:\n{PLAIN}  T_cn_cnm1:\n{rows(pose(n % 3, 0.01 * n, (-0.165, 1e-5 * n, 0.002)))}"
    for rig in (load(NESTED), load(text), Rig.linear(16, focal=400, spacing=0.07, size=(641, 479))):
        path = tmp_path / "written.yaml"
        rig.to_kalibr(path)
        again = Rig.from_kalibr(path)
        assert len(again) == len(rig)
        for a, b in zip(rig.cameras, again.cameras, strict=True):
            assert (a.name, a.model, a.distortion, a.resolution) == (
                b.name,
                b.model,
                b.distortion,
                b.resolution,
            )
            assert (a.intrinsics, a.distortion_coeffs) == (b.intrinsics, b.distortion_coeffs)
            assert a.topic is None or a.topic == b.topic
            np.testing.assert_allclose(a.cam_from_rig, b.cam_from_rig, atol=1e-14)


def test_a_written_file_is_plain_yaml_for_other_readers(tmp_path):
    import yaml

    Rig.linear(3, focal=400, spacing=1e-5 / 3 + 0.1, size=(64, 48)).to_kalibr(tmp_path / "rig.yaml")
    content = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert np.array(content["cam2"]["T_cn_cnm1"]).shape == (4, 4)
    assert np.array(content["cam2"]["T_cn_cnm1"]).dtype == np.float64
    assert content["cam1"]["resolution"] == [64, 48]


def test_writing_where_nothing_can_be_written(tmp_path):
    with pytest.raises(OutputError, match="missing"):
        Rig.linear(2, focal=400, spacing=0.1, size=(64, 48)).to_kalibr(tmp_path / "missing" / "rig.yaml")


def test_linear():
    rig = Rig.linear(5, focal=889.0, spacing=0.165, size=(720, 540))
    np.testing.assert_allclose(rig.centers, [[0.165 * k, 0, 0] for k in range(5)])
    assert rig.cameras[3].intrinsics == (889.0, 889.0, 359.5, 269.5)
    assert rig.cameras[4].name == "cam4" and rig.cameras[4].undistorted
    # A point 2 m away moves left by f * b / Z from each camera to the next.
    point = np.array([0.1, 0.2, 2.0, 1.0])
    x = [c.project((c.cam_from_rig @ point)[:3])[0] for c in rig.cameras]
    np.testing.assert_allclose(np.diff(x), -889 * 0.165 / 2)
    assert Rig.linear(2, focal=1, spacing=1, size=(4, 4), center=(1, 2)).cameras[0].intrinsics[2:] == (1, 2)


def test_index():
    rig = Rig.linear(3, focal=400, spacing=0.1, size=(64, 48))
    assert [rig.index(c) for c in (0, 2, "cam1", "2", np.int64(1))] == [0, 2, 1, 2, 1]
    for wrong in (3, -1, "cam3", "7", "left", True):
        with pytest.raises(RigError, match="it has cam0, cam1, cam2"):
            rig.index(wrong)


def test_poses_are_re_expressed_in_cam0s_frame():
    def camera(name: str, cam_from_world: np.ndarray) -> Camera:
        return Camera(name, "pinhole", "none", (500, 500, 320, 240), (), (640, 480), cam_from_world)

    a, b = pose(1, 0.4, (1, 2, 3)), pose(1, 0.5, (1.2, 2, 3))
    rig = Rig((camera("cam0", a), camera("cam1", b)))
    np.testing.assert_array_equal(rig.cameras[0].cam_from_rig, np.eye(4))
    np.testing.assert_allclose(rig.cameras[1].cam_from_rig, b @ np.linalg.inv(a), atol=1e-12)


BAD = {
    "no extrinsics": ("camera_0:\n" + PLAIN + "camera_1:\n" + PLAIN, "has no extrinsics"),
    "extrinsics of one missing": (TWO + "cam2:\n" + PLAIN, "cam2 has no extrinsics"),
    "one camera": ("cam0:\n" + PLAIN, "2 to 16 cameras, this one has 1"),
    "17 cameras": (
        "cam0:\n" + PLAIN + "".join(f"cam{n}:\n{PLAIN}{STEP.format(x=-1)}" for n in range(1, 17)),
        "2 to 16 cameras, this one has 17",
    ),
    "a gap": (TWO.replace("cam1:", "cam2:"), "without gaps, not cam0, cam2"),
    "same place": (TWO.replace("-0.1,", "-1e-9,"), "cam0 and cam1 are in the same place"),
    "same key twice": (TWO.replace("cam1:", "cam0:"), "'cam0' is given twice"),
    "same number twice": (TWO.replace("cam1:", "camera_0:"), "second camera 0"),
    "same parameter twice": (TWO + STEP.format(x=-2), "'T_cn_cnm1' is given twice"),
    "rotation": (
        TWO.replace("[1, 0, 0, -0.1", "[1.01, 0, 0, -0.1"),
        r"cam1: T_cn_cnm1 is not orthonormal.* 0\.0201",
    ),
    "mirrored": (TWO.replace("[1, 0, 0, -0.1", "[-1, 0, 0, -0.1"), "cam1: T_cn_cnm1 is a mirror image"),
    "transposed": (
        TWO.replace("-0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0", "0, 0, 1, 0, 0, 0, 0, 1, 0, -0.1, 0"),
        "looks transposed",
    ),
    "15 numbers": (TWO.replace("-0.1, 0,", "-0.1,"), r"16 numbers \(4 rows of 4\), not 15"),
    "NaN pose": (TWO.replace("-0.1,", ".nan,"), "cam1: T_cn_cnm1 holds NaN"),
    "NaN focal": (TWO.replace("[500.0", "[nan"), "cam0: intrinsics or distortion_coeffs hold NaN"),
    "zero focal": (TWO.replace("[500.0", "[0.0"), "cam0: focal lengths .* singular"),
    "text": (TWO.replace("[500.0", "[many"), "cam0: intrinsics: 'many' is not a number"),
    "no list": (TWO.replace("[500.0, 500.0, 320.0, 240.0]", "500"), "must be a list of numbers"),
    "no intrinsics": (TWO.replace("intrinsics", "intrinsic"), "cam0: 'intrinsics' is missing"),
    "no resolution": (TWO.replace("resolution", "size"), "cam0: 'resolution' is missing"),
    "no model": (TWO.replace("camera_model", "model"), "cam0: 'camera_model' is missing"),
    "no distortion": (
        TWO.replace("distortion_model: none", "").replace("[]", "[0.1, 0, 0, 0]"),
        "cam0: 'distortion_model' is missing",
    ),
    "resolution": (TWO.replace("[640, 480]", "[640, 0]"), "cam0: resolution .* positive"),
    "resolution of nan": (TWO.replace("[640, 480]", "[640, nan]"), "cam0: resolution .* positive"),
    "resolution of three": (TWO.replace("[640, 480]", "[640, 480, 3]"), "must be 2 numbers, not 3"),
    "eucm": (TWO.replace("pinhole", "eucm"), "camera_model 'eucm' is not supported"),
    "fov": (TWO.replace("none", "fov"), "distortion_model 'fov' is not supported"),
    "empty": ("", "no 'cam0:', 'cam1:'"),
    "another file": ("image_width: 640\ncamera_matrix: {rows: 3}\n", "but image_width, camera_matrix"),
    "empty camera": ("cam0:\ncam1:\n", "'cam0' holds no parameters"),
    "broken yaml": (TWO + "cam2: [1, 2", "is not YAML"),
}


@pytest.mark.parametrize(("text", "said"), BAD.values(), ids=BAD.keys())
def test_bad_files_are_refused_precisely(load, tmp_path, text, said):
    with pytest.raises(RigError, match=rf"(?s)rig\.yaml: .*{said}") as caught:
        load(text)
    assert isinstance(caught.value, SeepastError)


def test_unreadable_files(tmp_path):
    with pytest.raises(RigError, match=r"nowhere\.yaml: there is no such file"):
        Rig.from_kalibr(tmp_path / "nowhere.yaml")
    with pytest.raises(RigError, match="cannot be read"):
        Rig.from_kalibr(tmp_path)
    (tmp_path / "image.yaml").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(RigError, match="cannot be read as text"):
        Rig.from_kalibr(tmp_path / "image.yaml")


def test_duplicate_names():
    def camera(x: float) -> Camera:
        return Camera("cam0", "pinhole", "none", (500, 500, 320, 240), (), (640, 480), pose(0, 0, (x, 0, 0)))

    with pytest.raises(RigError, match="2 cameras are named 'cam0'"):
        Rig((camera(0), camera(1)))
