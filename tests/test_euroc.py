"""EuRoC / ASL folders in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from recordings import SIZE, save
from seepast.datasets import open_dataset
from seepast.datasets.euroc import EurocDataset
from seepast.errors import DatasetError, RigError
from seepast.rig import Rig, inverse_pose

START, PERIOD, MS = 1_403_636_579_763_555_584, 50_000_000, 1_000_000
# body_from_cam0 as such recordings have it: the camera is mounted turned
BODY_FROM_CAM0 = np.array([[0, -1, 0, 0.02], [1, 0, 0, -0.06], [0, 0, 1, 0.01], [0, 0, 0, 1.0]])


def picture(camera: int, frame: int) -> np.ndarray:
    return np.random.default_rng([camera, frame]).integers(0, 255, SIZE[::-1], np.uint8)


def times(camera: int) -> list[int]:
    return [START + n * PERIOD + camera * MS for n in range(4)]


def make(path: Path, *, sensor: bool = True, table: bool = True) -> Path:
    """Two cameras 0.11 m apart, 4 frames; cam1's clock is 1 ms late."""
    for k in range(2):
        camera = path / "mav0" / f"cam{k}"
        for n, time in enumerate(times(k)):
            save(camera / "data" / f"{time}.png", picture(k, n))
        if table:
            rows = "".join(f"{time},{time}.png\r\n" for time in times(k))
            (camera / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
        cam0_from_cam = np.eye(4)
        cam0_from_cam[0, 3] = 0.11 * k
        if sensor:
            entry = {
                "sensor_type": "camera",
                "T_BS": {"cols": 4, "rows": 4, "data": (BODY_FROM_CAM0 @ cam0_from_cam).reshape(-1).tolist()},
                "rate_hz": 20,
                "resolution": list(SIZE),
                "camera_model": "pinhole",
                "intrinsics": [48.0 + k, 48.5, 23.5, 17.5],
                "distortion_model": "radial-tangential",
                "distortion_coefficients": [-0.01, 0.002, 0.0, 0.0],
            }
            (camera / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(entry))
    return path


@pytest.mark.parametrize("named", ["", "mav0"])
def test_images_times_and_calibration(tmp_path: Path, named: str) -> None:
    dataset = open_dataset(make(tmp_path / "V1_01") / named, masks="none")
    assert isinstance(dataset, EurocDataset)
    assert list(dataset.stamps) == [str(time) for time in times(0)]
    np.testing.assert_array_equal(dataset.times, np.transpose([times(0), times(1)]))
    for n, frame in enumerate(dataset):
        for k in range(2):
            np.testing.assert_array_equal(frame.images[k], picture(k, n))
    np.testing.assert_allclose(dataset.rig.centers, [[0, 0, 0], [0.11, 0, 0]], atol=1e-12)
    camera = dataset.rig.cameras[1]
    assert camera.intrinsics == (49.0, 48.5, 23.5, 17.5) and camera.distortion == "radtan"
    assert camera.distortion_coeffs == (-0.01, 0.002, 0.0, 0.0)


def test_the_body_pose_is_body_from_camera(tmp_path: Path) -> None:
    path = make(tmp_path / "r")
    file = path / "mav0" / "cam1" / "sensor.yaml"
    entry = yaml.safe_load(file.read_text().removeprefix("%YAML:1.0\n"))
    turn = np.array([[0.8, 0, 0.6, 0.3], [0, 1, 0, 0], [-0.6, 0, 0.8, 0.2], [0, 0, 0, 1.0]])  # cam0_from_cam1
    entry["T_BS"]["data"] = (BODY_FROM_CAM0 @ turn).reshape(-1).tolist()
    file.write_text(yaml.safe_dump(entry))
    camera = open_dataset(path, masks="none").rig.cameras[1]
    np.testing.assert_allclose(camera.cam_from_rig, inverse_pose(turn), atol=1e-12)


def test_a_rig_file_goes_before_the_sensor_files(tmp_path: Path) -> None:
    path = make(tmp_path / "r", sensor=False)
    with pytest.raises(RigError, match=r"neither rig\.yaml nor cam0/sensor\.yaml"):
        open_dataset(path, masks="none")
    rig = Rig.linear(2, focal=50.0, spacing=0.2, size=SIZE)
    rig.to_kalibr(path / "mav0" / "rig.yaml")
    assert open_dataset(path, masks="none").rig.cameras[0].intrinsics[0] == 50.0
    Rig.linear(2, focal=60.0, spacing=0.2, size=SIZE).to_kalibr(tmp_path / "other.yaml")
    assert open_dataset(path, masks="none", rig=tmp_path / "other.yaml").rig.cameras[0].intrinsics[0] == 60.0


def test_lost_images_and_the_tolerance(tmp_path: Path) -> None:
    path = make(tmp_path / "r")
    (path / "mav0" / "cam1" / "data" / f"{times(1)[2]}.png").unlink()
    dataset = open_dataset(path, masks="none")
    assert list(dataset.stamps) == [str(times(0)[n]) for n in (0, 1, 3)]
    assert {str(d) for d in dataset.dropped} == {
        "1 image: cam1/data.csv lists it, but there is no such file",
        "1 image: cam1 has no image within 5 ms",
    }
    with pytest.raises(DatasetError, match="at no instant"):
        open_dataset(path, masks="none", tolerance=0.0009)


def test_without_a_table_the_names_are_the_times(tmp_path: Path) -> None:
    dataset = open_dataset(make(tmp_path / "r", table=False), masks="none")
    np.testing.assert_array_equal(dataset.frame(str(times(0)[3])).images[1], picture(1, 3))


def test_masks_by_stamp(tmp_path: Path) -> None:
    path = make(tmp_path / "r")
    for k in range(2):
        for n, time in enumerate(times(k)):
            save(path / "masks" / f"cam{k}" / f"{time}.png", np.full(SIZE[::-1], 10 * k + n, np.uint8))
    assert [[int(m[0, 0]) for m in f.masks or ()] for f in open_dataset(path)] == [[n, 10 + n] for n in range(4)]


@pytest.mark.parametrize(
    ("file", "text", "error", "problem"),
    [
        ("cam0/data.csv", "#t,f\nnoon,1.png\n", DatasetError, r"data\.csv: each line must be"),
        ("cam1/sensor.yaml", "T_BS: 3\n", RigError, r"cam1/sensor\.yaml: 'camera_model' is missing"),
        ("cam1/sensor.yaml", "[", RigError, r"cam1/sensor\.yaml: is not YAML"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, file: str, text: str, error: type[Exception], problem: str) -> None:
    path = make(tmp_path / "r")
    (path / "mav0" / file).write_text(text)
    with pytest.raises(error, match=problem):
        open_dataset(path, masks="none")


def test_numbers_that_are_none_are_rig_errors(tmp_path: Path) -> None:
    path = make(tmp_path / "r")
    file = path / "mav0" / "cam0" / "sensor.yaml"
    for old, new in (("- 48.0", "- wide"), ("distortion_coefficients:", "distortion_coefficients: 3\nnotes:")):
        whole = file.read_text()
        file.write_text(whole.replace(old, new))
        with pytest.raises(RigError, match=r"cam0/sensor\.yaml: a value is not a number"):
            open_dataset(path, masks="none")
        file.write_text(whole)
