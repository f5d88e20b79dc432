"""Reading recordings from folders, and every way in which such a folder can be wrong."""

from __future__ import annotations

import logging
import shutil
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings import SIZE, save, write_recording
from seepast.datasets import NO_MASKS, READERS, find_datasets, open_dataset
from seepast.datasets.png import read_png8
from seepast.errors import DatasetError, RigError

WIDTH, HEIGHT = SIZE


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "rec", stamps=("000000", "000001"))


def refused(path: Path, *words: str, masks: str | None = None) -> None:
    """Opening or reading the recording raises a DatasetError whose text holds all the words."""
    with pytest.raises(DatasetError) as caught:
        list(open_dataset(path, masks=masks))
    for word in words:
        assert word in str(caught.value)


def test_images_and_masks_come_as_they_lie_in_the_files(recording: Path) -> None:
    dataset = open_dataset(recording)
    assert (dataset.name, dataset.stamps) == ("rec", ("000000", "000001"))
    frames = list(dataset)
    assert [frame.stamp for frame in frames] == ["000000", "000001"]
    for frame in frames:
        assert frame.masks is not None
        for k in range(3):
            there = cv2.imread(str(recording / f"cam{k}" / f"{frame.stamp}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(frame.images[k], there)
            assert frame.images[k].shape == (HEIGHT, WIDTH, 3)
            assert frame.masks[k].shape == (HEIGHT, WIDTH) and set(np.unique(frame.masks[k])) == {0, 255}


def test_grey_stays_grey(tmp_path: Path) -> None:
    frame = next(iter(open_dataset(write_recording(tmp_path / "grey", color=False))))
    assert {image.shape for image in frame.images} == {(HEIGHT, WIDTH)}


def test_frames_are_decoded_only_when_asked_for(recording: Path) -> None:
    truncate(recording / "cam2" / "000001.png")
    frames = iter(open_dataset(recording))
    assert next(frames).stamp == "000000"
    with pytest.raises(DatasetError, match="000001"):
        next(frames)


def test_cameras_come_in_the_order_of_the_rig_beyond_ten(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "many", cameras=11)
    save(path / "cam10" / "000000.png", np.full((HEIGHT, WIDTH, 3), 77, np.uint8))
    frame = next(iter(open_dataset(path)))
    assert (frame.images[10] == 77).all() and not (frame.images[2] == 77).all()


def test_another_folder_of_masks_or_none(recording: Path, tmp_path: Path) -> None:
    for base in (recording, tmp_path / "elsewhere"):
        shutil.copytree(recording / "masks", base / "masks_net")
    save(recording / "masks_net" / "cam0" / "000000.png", np.full((HEIGHT, WIDTH), 9, np.uint8))
    relative = open_dataset(recording, masks="masks_net").frame("000000")
    absolute = open_dataset(recording, masks=str(tmp_path / "elsewhere" / "masks_net")).frame("000000")
    assert relative.masks is not None and (relative.masks[0] == 9).all()
    assert absolute.masks is not None and (absolute.masks[0] != 9).all()
    assert open_dataset(recording, masks=NO_MASKS).frame("000000").masks is None


def test_no_masks_is_refused_with_the_way_out(recording: Path) -> None:
    (recording / "masks").rename(recording / "masks_good")
    refused(recording, "masks_good", "--masks none", "--masks FOLDER")
    refused(recording, "masks_bad", masks="masks_bad")


def test_a_folder_of_recordings(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_recording(tmp_path / name)
    (tmp_path / "notes").mkdir()
    assert find_datasets(tmp_path) == [tmp_path / "a", tmp_path / "b"]
    assert find_datasets(tmp_path / "a") == [tmp_path / "a"]
    for nothing in (tmp_path / "notes", tmp_path / "not-there"):
        with pytest.raises(DatasetError, match=nothing.name):
            find_datasets(nothing)
        with pytest.raises(DatasetError, match=nothing.name):
            open_dataset(nothing)
    assert next(iter(READERS)) == "folder", "the reader that is asked last"


def test_a_broken_calibration_is_a_rig_error(recording: Path) -> None:
    (recording / "rig.yaml").write_text("cam0: [not, a, camera]\n")
    with pytest.raises(RigError, match=r"rig\.yaml"):
        open_dataset(recording)


def test_camera_missing_in_the_folder(recording: Path) -> None:
    shutil.rmtree(recording / "cam1")
    refused(recording, "cam1", "rig.yaml")


def test_camera_missing_in_the_rig(recording: Path) -> None:
    shutil.copytree(recording / "cam2", recording / "cam3")
    refused(recording, "cam3", "rig.yaml")


def test_camera_without_images_says_what_is_there_instead(recording: Path) -> None:
    for file in (recording / "cam1").iterdir():
        file.rename(file.with_suffix(".jpg"))
    refused(recording, "cam1", ".jpg", "convert")


def test_frames_of_one_camera_only_are_skipped_with_one_warning(
    recording: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for stamp in ("000002", "000003"):
        shutil.copy(recording / "cam0" / "000000.png", recording / "cam0" / f"{stamp}.png")
    (recording / "cam2" / "000001.png").unlink()
    with caplog.at_level(logging.WARNING, "seepast"):
        dataset = open_dataset(recording)
    assert dataset.stamps == ("000000",)
    assert len(caplog.records) == 1
    assert "3 of 4" in caplog.text and "000001" in caplog.text and "cam2" in caplog.text


def test_no_common_frame_is_refused(recording: Path) -> None:
    for k in range(3):
        for n in range(2):
            (recording / f"cam{k}" / f"00000{n}.png").rename(recording / f"cam{k}" / f"{n}_{k}.png")
    refused(recording, "cam0, cam1, cam2", "share one name")


def test_image_of_another_size_than_the_rig(recording: Path) -> None:
    save(recording / "cam1" / "000001.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    refused(recording, "cam1/000001.png", f"{WIDTH + 1}x{HEIGHT}", f"{WIDTH}x{HEIGHT}")


def truncate(path: Path, keep: float = 0.6) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])


@pytest.mark.parametrize("keep", [0.0, 0.01, 0.5, 0.9, 0.995])
def test_truncated_png(recording: Path, keep: float) -> None:
    truncate(recording / "cam1" / "000000.png", keep)
    refused(recording, "cam1/000000.png")


def test_png_cut_exactly_before_its_end_marker(recording: Path) -> None:
    path = recording / "cam1" / "000000.png"
    path.write_bytes(path.read_bytes()[:-12])
    refused(recording, "cam1/000000.png", "truncated PNG")


def test_damaged_png(recording: Path) -> None:
    path = recording / "cam1" / "000000.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    refused(recording, "cam1/000000.png", "wrong checksum")


def test_file_that_is_no_png(recording: Path) -> None:
    (recording / "cam0" / "000000.png").write_text("hello")
    refused(recording, "cam0/000000.png", "not a PNG")


def test_alpha_image(recording: Path) -> None:
    save(recording / "cam0" / "000000.png", np.zeros((HEIGHT, WIDTH, 4), np.uint8))
    refused(recording, "cam0/000000.png", "alpha channel")


def test_grey_image_with_alpha(recording: Path) -> None:
    header = WIDTH.to_bytes(4, "big") + HEIGHT.to_bytes(4, "big") + bytes([8, 4, 0, 0, 0])
    rows = zlib.compress(bytes(HEIGHT * (1 + 2 * WIDTH)))
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    (recording / "cam0" / "000000.png").write_bytes(data)
    refused(recording, "cam0/000000.png", "alpha channel")


def chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return len(content).to_bytes(4, "big") + kind + content + checksum.to_bytes(4, "big")


def test_grey_and_color_mixed(recording: Path) -> None:
    save(recording / "cam2" / "000000.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    refused(recording, "000000", "grey in cam2", "colour in cam0, cam1")


def test_mask_missing_for_a_frame_is_said_on_opening(recording: Path) -> None:
    (recording / "masks" / "cam2" / "000001.png").unlink()
    with pytest.raises(DatasetError, match=r"masks/cam2/000001\.png.*missing"):
        open_dataset(recording)


def test_masks_missing_for_a_camera(recording: Path) -> None:
    shutil.rmtree(recording / "masks" / "cam1")
    refused(recording, "masks/cam1")


def test_mask_of_the_wrong_size(recording: Path) -> None:
    save(recording / "masks" / "cam0" / "000000.png", np.zeros((HEIGHT - 1, WIDTH), np.uint8))
    refused(recording, "masks/cam0/000000.png", f"{WIDTH}x{HEIGHT - 1}")


@pytest.mark.parametrize(
    ("mask", "word"),
    [(np.zeros((HEIGHT, WIDTH), np.uint16), "16 bits"), (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "grey")],
)
def test_mask_of_the_wrong_type(recording: Path, mask: np.ndarray, word: str) -> None:
    save(recording / "masks" / "cam0" / "000000.png", mask)
    refused(recording, "masks/cam0/000000.png", word)


def test_masks_of_zeros_and_ones_draw_one_warning(recording: Path, caplog: pytest.LogCaptureFixture) -> None:
    for stamp in ("000000", "000001"):
        save(recording / "masks" / "cam0" / f"{stamp}.png", np.eye(HEIGHT, WIDTH, dtype=np.uint8))
    with caplog.at_level(logging.WARNING, "seepast"):
        list(open_dataset(recording))
    assert len(caplog.records) == 1 and "255" in caplog.text


def test_one_bit_png_reads_as_black_and_white(tmp_path: Path) -> None:
    path = tmp_path / "bits.png"
    bits = np.zeros((9, 10), np.uint8)
    bits[2:5, 3:7] = 255
    assert cv2.imwrite(str(path), bits, [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert path.read_bytes()[24] == 1  # bit depth of IHDR
    np.testing.assert_array_equal(read_png8(path), bits)
