"""Rectification by the cuda backend, run on the CPU, against cv2.remap as frames.py calls it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from cuda_on_cpu import EmulatedDevice, StrictDevice
from cuda_on_cpu.memory import RUBBISH
from seepast import frames
from seepast.backends import cuda
from seepast.backends.cuda_rectify import cubic_weights
from seepast.frames import Frame
from seepast.gpu import device
from seepast.rectify import rectify
from seepast.rig import Camera, Rig
from test_rectify import crooked_rig

OPENCV_5 = int(cv2.__version__.split(".")[0]) >= 5


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


def straight_rig(bent: tuple[int, ...] = ()) -> Rig:
    """Three cameras that need no rectification but for those of `bent`, which have a lens; odd sizes."""
    made = []
    for k in range(3):
        pose = np.eye(4)
        pose[0, 3] = -0.1 * k
        lens = ("radtan", (-0.2, 0.05, 0.001, 0.0)) if k in bent else ("none", ())
        made.append(Camera(f"cam{k}", "pinhole", lens[0], (90.0, 90.0, 50.0, 36.0), lens[1], (101, 73), pose))
    return Rig(tuple(made))


def two_sizes() -> Rig:
    """The second camera has images of another size."""
    rig = crooked_rig(3)
    cameras = list(rig.cameras)
    cameras[1] = replace(cameras[1], resolution=(201, 151))
    return Rig(tuple(cameras))


RIGS = {
    "crooked": lambda: crooked_rig(2),
    "5 crooked": lambda: crooked_rig(5),
    "straight": straight_rig,
    "one bent": lambda: straight_rig((1,)),
    "reference bent": lambda: straight_rig((0,)),
    "two sizes": two_sizes,
}
every_rig = pytest.mark.parametrize("name", RIGS)


def pictures(rig: Rig, colour: bool, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    shapes = [camera.resolution[::-1] for camera in rig.cameras]
    images = [rng.integers(0, 256, (*shape, 3) if colour else shape, np.uint8) for shape in shapes]
    masks = [rng.integers(0, 256, shape, np.uint8) for shape in shapes]
    masks[-1][:] = 0
    return images, masks


def from_device(found: Callable[[StrictDevice], Any]) -> Any:
    """What `found` returns on a device of its own, downloaded."""
    used = StrictDevice()
    with device.use(used):
        result = found(used)
        if isinstance(result, Frame):
            return Frame(*(cuda.download(part) for part in (result.colour, result.grey, result.dynamic)))
        return cuda.download(result)


def assert_same(expected: np.ndarray, found: np.ndarray, exact: bool = True) -> None:
    assert expected.shape == found.shape
    assert expected.dtype == found.dtype
    if exact:
        assert np.array_equal(expected, found), f"{(expected != found).mean():.2%} differ"
    else:
        assert cv2.absdiff(expected, found).max() <= 1
        assert (expected != found).mean() < 0.005


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
@every_rig
def test_a_frame(name, colour, interpolation):
    rig = RIGS[name]()
    rectification = rectify(rig)
    images, masks = pictures(rig, colour)
    expected = frames.rectified_frame(rectification, images, masks, interpolation)
    found = from_device(lambda used: cuda.rectified_frame(rectification, images, masks, interpolation))
    bare = from_device(lambda used: cuda.rectified_frame(rectification, images, masks, interpolation, grey=False))
    exact = interpolation == "linear" or OPENCV_5
    for part in ("colour", "grey", "dynamic"):
        assert_same(getattr(expected, part), getattr(found, part), exact or part == "dynamic")
    assert_same(found.colour, bare.colour)
    assert_same(found.dynamic, bare.dynamic)
    if colour:  # what was not asked for is not written: the rubbish that new memory holds is still there
        assert (bare.grey == RUBBISH).all()


def cubic(image: np.ndarray, whole: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Kernel `rectify` with these maps on one grey image."""
    (height, width), nothing = fraction.shape, np.zeros(1, np.uint64)
    found, dynamic, no_ray = (np.zeros((height, width), np.uint8) for _ in range(3))
    device.current().launch(
        "rectify", "rectify", grid=(-(-width // 32), -(-height // 8), 1), block=(32, 8),
        args=[
            np.array([image.ctypes.data], np.uint64), nothing, np.array([image.shape[::-1]], np.int32),
            np.zeros(1, np.int32), whole, fraction, no_ray, cubic_weights(), np.int32(1), np.int32(0),
            np.int32(height), np.int32(width), np.int32(1), found, found, dynamic,
        ],
    )  # fmt: skip
    assert not dynamic.any()
    return found


@pytest.mark.skipif(not OPENCV_5, reason="OpenCV 4 rounds the weights of cubic interpolation")
def test_every_fraction_of_cubic_interpolation():
    """At all 32 x 32 fractions, on the image, at its border and off it."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (9, 11), np.uint8)
    fraction = np.arange(1024, dtype=np.uint16).repeat(64).reshape(256, 256)
    whole = np.stack([rng.integers(-3, 14, (256, 256)), rng.integers(-3, 12, (256, 256))], axis=-1).astype(np.int16)
    expected = cv2.remap(image, whole, fraction, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    assert_same(expected, cubic(image, whole, fraction))


# Pixels, and a fraction between those in their middle, whose sum ends so near a half that every rounding decides.
CLOSE_CALLS = (
    (212, (11, 178, 128, 144, 79, 45, 233, 197, 70, 3, 125, 26, 62, 184, 129, 104)),
    (975, (110, 79, 135, 104, 32, 221, 204, 14, 242, 148, 201, 40, 2, 207, 88, 73)),
    (242, (113, 82, 250, 194, 171, 214, 126, 119, 38, 67, 159, 48, 42, 0, 199, 162)),
    (458, (189, 132, 55, 24, 197, 217, 227, 196, 53, 43, 31, 180, 20, 146, 98, 249)),
)


@pytest.mark.skipif(not OPENCV_5, reason="OpenCV 4 rounds the weights of cubic interpolation")
@pytest.mark.parametrize("fraction, pixels", CLOSE_CALLS)
def test_roundings_of_cubic_interpolation(fraction, pixels):
    image, whole = np.array(pixels, np.uint8).reshape(4, 4), np.ones((2, 8, 2), np.int16)
    fractions = np.full((2, 8), fraction, np.uint16)
    expected = cv2.remap(image, whole, fractions, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    assert_same(expected, cubic(image, whole, fractions))


def test_grey_of_every_colour():
    """Cameras that pass through: what is left is cv2.cvtColor."""
    rig = straight_rig()
    levels = np.arange(256, dtype=np.uint8)
    some = np.stack(np.meshgrid(levels[::3], levels[::3], levels[1::2], indexing="ij"), axis=-1).reshape(-1, 3)
    some = np.resize(some, (len(some) // 7373 * 7373, 3)).reshape(-1, 73, 101, 3)
    for at in range(0, len(some) - 2, 3):
        images = list(some[at : at + 3])
        masks = [np.zeros((73, 101), np.uint8)] * 3
        found = cuda.rectified_frame(rectify(rig), images, masks)
        assert_same(np.stack([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]), found.grey)


@every_rig
def test_masks_on_their_way_back(name):
    rig = RIGS[name]()
    rectification = rectify(rig)
    _, masks = pictures(rig, colour=False, seed=2)
    width, height = rectification.geometry.size
    rng = np.random.default_rng(3)
    dynamic = rng.integers(0, 256, (len(masks), height, width), np.uint8)
    dynamic[:, ::3] = np.where(dynamic[:, ::3] < 128, 0, 255)
    expected = frames.input_masks(rectification, dynamic, masks)
    found = from_device(lambda used: cuda.input_masks(rectification, used.upload(dynamic), masks))
    assert len(expected) == len(found)
    for a, b in zip(expected, found, strict=True):
        assert_same(a, b)


def test_one_launch_each_and_maps_uploaded_once(emulated, monkeypatch):
    rig = crooked_rig(3)
    rectification = rectify(rig)
    images, masks = pictures(rig, colour=True)
    uploaded, upload = [], emulated.upload
    monkeypatch.setattr(emulated, "upload", lambda array: uploaded.append(array) or upload(array))
    frame = cuda.rectified_frame(rectification, images, masks)
    first = len(uploaded)
    cuda.rectified_frame(rectification, images, masks)
    cuda.input_masks(rectification, frame.dynamic, masks)
    assert emulated.launches == ["rectify.rectify"] * 2 + ["rectify.to_input"]
    assert sum(array.size > 1000 for array in uploaded[first:]) == 3 + 3 + 3  # images and masks, and no maps


def test_images_that_are_on_the_device_already():
    """Of a camera's driver, perhaps a part of something larger."""
    rig = crooked_rig(2)
    rectification = rectify(rig)
    images, masks = pictures(rig, colour=True)
    expected = frames.rectified_frame(rectification, images, masks)

    def found(used: StrictDevice) -> Frame:
        wide = [used.upload(np.concatenate([image, image], axis=1)) for image in images]
        parts = [image[:, : images[0].shape[1]] for image in wide]
        return cuda.rectified_frame(rectification, parts, [used.upload(mask) for mask in masks])

    assert_same(expected.colour, from_device(found).colour, OPENCV_5)
