"""16-bit images in: the rule, in every reader, and on the live path."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from recordings import SIZE, save, write_recording
from seepast import cli
from seepast.datasets import open_dataset
from seepast.datasets.eight_bits import EightBits
from seepast.datasets.ros_images import decode_message
from seepast.errors import DatasetError, OptionsError
from seepast.rig import Rig

WIDTH, HEIGHT = SIZE
START = 1_700_000_000_000_000_000


def deep_picture(bits: int = 16, channels: int = 3, seed: int = 0) -> np.ndarray:
    shape = (HEIGHT, WIDTH, 3)[: 3 if channels == 3 else 2]
    return np.random.default_rng(seed).integers(0, 2**bits, shape, np.uint16)


def scaled(image: np.ndarray, bits: int = 16) -> np.ndarray:
    """The rule as the documentation says it."""
    return np.minimum(np.floor(255 * (image / (2.0**bits - 1)) + 0.5), 255).astype(np.uint8)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_every_value_is_rounded_to_its_nearest_grey_level(bits: int) -> None:
    values = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    found = EightBits(bits)("x", values)
    np.testing.assert_array_equal(found, scaled(values, bits))
    assert found.dtype == np.uint8 and found[0, 0] == 0 and found.flat[2**bits - 1] == 255 == found[-1, -1]


@pytest.mark.parametrize("bits", [7, 17, 0, -1])
def test_bits_that_cannot_be(bits: int) -> None:
    with pytest.raises(OptionsError, match=f"--bits {bits}: .* 8 to 16"):
        EightBits(bits)


def test_dark_images_are_told_once_and_only_where_nobody_said_bits(caplog: pytest.LogCaptureFixture) -> None:
    dark = np.full((4, 4), 4095, np.uint16)
    with caplog.at_level(logging.WARNING, "seepast"):
        for bits in (None, 12):
            convert = EightBits(bits)
            convert("a.png", dark)
            convert("b.png", dark)
        EightBits()("bright.png", np.full((4, 4), 2**15, np.uint16))
    assert [record.message for record in caplog.records] == [
        "a.png: has 16 bits and fills 12 of them, so it comes out dark; if the cameras give 12 bits, say --bits 12"
    ]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("bits", [None, 12])
def test_folders(bits: int | None, channels: int, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "rec")
    pictures = [deep_picture(bits or 16, channels, seed=k) for k in range(3)]
    for k, image in enumerate(pictures):
        save(path / f"cam{k}" / "000000.png", image)
    frame = open_dataset(path, bits=bits).frame("000000")
    for image, expected in zip(frame.images, pictures, strict=True):
        np.testing.assert_array_equal(image, scaled(expected, bits or 16))


def test_masks_of_16_bits_are_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "rec")
    save(path / "masks" / "cam1" / "000000.png", np.zeros((HEIGHT, WIDTH), np.uint16))
    with pytest.raises(DatasetError, match=r"masks/cam1/000000\.png: 16 bits"):
        open_dataset(path).frame("000000")


def test_euroc_and_middlebury(tmp_path: Path) -> None:
    Rig.linear(2, focal=48.0, spacing=0.1, size=SIZE).to_kalibr(tmp_path / "rig.yaml")
    euroc, views = tmp_path / "euroc", tmp_path / "views"
    for k in range(2):
        save(euroc / "mav0" / f"cam{k}" / "data" / f"{START}.png", deep_picture(12, 1, k))
        save(views / f"view{k}.png", deep_picture(12, 3, k))
    ppm = tmp_path / "ppm"
    for k in range(2):
        save(ppm / f"im{k}.ppm", deep_picture(12, 3, k))
    rig = tmp_path / "rig.yaml"
    grey = open_dataset(euroc, masks="none", rig=rig, bits=12).frame(str(START)).images
    np.testing.assert_array_equal(grey[1], scaled(deep_picture(12, 1, 1), 12))
    for path in (views, ppm):
        colour = open_dataset(path, rig=rig, bits=12).frame("000000").images
        np.testing.assert_array_equal(colour[1], scaled(deep_picture(12, 3, 1), 12))


@pytest.mark.parametrize(
    ("encoding", "channels"), [("mono16", 1), ("16UC1", 1), ("bgr16", 3), ("rgb16", 3), ("16UC3", 3), ("png", 3)]
)
def test_bags(encoding: str, channels: int, tmp_path: Path) -> None:
    bags = pytest.importorskip("bags", reason="needs rosbags")
    picture = deep_picture(16, channels)
    sent = picture[..., ::-1] if encoding == "rgb16" else picture
    Rig.linear(2, focal=48.0, spacing=0.1, size=SIZE).to_kalibr(tmp_path / "rig.yaml")
    padding = 0 if encoding == "png" else 6
    shots = {f"/cam{k}/image_raw": [bags.Shot(START, sent, encoding, padding=padding)] for k in range(2)}
    dataset = open_dataset(bags.write_bag(tmp_path / "walk", "mcap", shots), masks="none")
    np.testing.assert_array_equal(dataset.frame(str(START)).images[1], scaled(picture))


def message(pixels: np.ndarray, encoding: str, big: bool = False) -> SimpleNamespace:
    data = np.frombuffer(pixels.astype(">u2" if big else "<u2").tobytes(), np.uint8)
    height, width = pixels.shape[:2]
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=data.size // height, data=data, is_bigendian=int(big)
    )


def test_big_endian_bayer_and_alpha_messages() -> None:
    grey = deep_picture(16, 1)
    np.testing.assert_array_equal(decode_message("x", message(grey, "mono16", True), EightBits()), scaled(grey))
    mosaic = np.empty((HEIGHT, WIDTH), np.uint16)
    for n, level in enumerate((10_000, 20_000, 20_000, 50_000)):  # blue, green, green, red
        mosaic[n // 2 :: 2, n % 2 :: 2] = level
    flat = decode_message("x", message(mosaic, "bayer_bggr16"), EightBits())[4:-4, 4:-4].reshape(-1, 3)
    assert (flat == scaled(np.array([10_000, 20_000, 50_000]))).all()
    alpha = np.dstack([deep_picture(), deep_picture(channels=1)])
    np.testing.assert_array_equal(
        decode_message("x", message(alpha, "bgra16"), EightBits()), scaled(np.ascontiguousarray(alpha[..., :3]))
    )
    with pytest.raises(DatasetError, match="x: encoding mono16 has 16 bits; a mask is mono8"):
        decode_message("x", message(grey, "mono16"))
    short = message(grey, "mono16")
    short.step = 2 * WIDTH - 1
    with pytest.raises(DatasetError, match="too few"):
        decode_message("x", short, EightBits())


def test_the_command_line_takes_bits_and_a_run_is_repeated_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_recording(tmp_path / "rec", color=False)
    for k in range(3):
        image = cv2.imread(str(path / f"cam{k}" / "000000.png"), cv2.IMREAD_UNCHANGED)
        save(path / f"cam{k}" / "000000.png", ((image.astype(int) * 4095 + 127) // 255).astype(np.uint16))
    quick = ["--preset", "paper", "--set", "range.max_disparity=12"]
    assert cli.main(["run", str(path), "--out", str(tmp_path / "a"), "--bits", "12", *quick]) == 0
    assert "dark" not in capsys.readouterr().err
    ran = json.loads((tmp_path / "a" / "run.json").read_text())
    assert ran["settings"]["bits"] == 12 and ran["reading"] == {"reader": "folder", "bits": 12}
    assert cli.main(["run", "--settings", str(tmp_path / "a" / "run.json"), "--out", str(tmp_path / "b")]) == 0
    for kind in ("background/000000.png", "disparity/000000.pfm"):
        assert (tmp_path / "a" / kind).read_bytes() == (tmp_path / "b" / kind).read_bytes()
    assert cli.main(["run", str(path), "--out", str(tmp_path / "a"), *quick]) == 2, "other bits are another run"
    eight = write_recording(tmp_path / "eight", color=False)
    assert cli.main(["run", str(eight), "--out", str(tmp_path / "c"), *quick]) == 0
    background = "background/000000.png"
    assert (tmp_path / "a" / background).read_bytes() == (tmp_path / "c" / background).read_bytes()
