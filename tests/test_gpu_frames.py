"""Whole frames of every preset on the backend `cuda`, its kernels run on the CPU: the very results of `cpu`."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np
import pytest

from arrays import Scene, make_scene, noise_scene
from cuda_on_cpu import StrictDevice
from cuda_on_cpu.strict import Array
from seepast import Options, Reconstructor, backends, multiview, pipeline
from seepast.backends import cuda
from seepast.errors import DeviceError, InputError, SeepastError
from seepast.frames import Frame
from seepast.gpu import device
from seepast.gpu.cuda_device import CudaDevice
from seepast.pipeline import Clock
from seepast.rig import Camera, Rig

SCENES = {
    "5 cameras": lambda: make_scene(5, (80, 34), surface="step", colour=True),
    "2, odd, grey": lambda: make_scene(2, (67, 33)),
    "3, middle, residual, soft": lambda: make_scene(3, (71, 35), reference=1, residual=True, masks="soft", colour=True),
    "all dynamic": lambda: make_scene(3, (66, 32), masks="all", colour=True),
    "16": lambda: make_scene(16, (65, 17), reference=3, residual=True),
    "nothing hidden": lambda: make_scene(3, (66, 32), masks="none", colour=True),
    "4, what is hidden only": lambda: make_scene(4, (69, 33), residual=True, colour=True),
}
PARTIAL = ("4, what is hidden only", "nothing hidden")
SMALL = {"range.max_disparity": 60, "range.step": 1, "support.texture": 20}


@pytest.fixture(autouse=True)
def strict() -> Iterator[StrictDevice]:
    with device.use(StrictDevice()) as found:
        yield found


def found_by(backend: str, scene: Scene, options: Options, dynamic_only: bool) -> dict[str, np.ndarray]:
    stages, method = backends.get(backend), pipeline.see_past
    arrays = [scene.colour, scene.grey, scene.dynamic]
    if backend == "cuda":
        arrays = [device.current().upload(array) for array in arrays]
    if options.multiview.enabled:
        stages, method = backends.multiview(stages), multiview.see_past
    found, rounds = method(Frame(*arrays), scene.geometry, options, stages, dynamic_only, Clock())
    return {**(cuda.download(found) if backend == "cuda" else found), "rounds": np.array(rounds)}


@pytest.mark.parametrize("preset", ["paper", "fast", "accurate"])
@pytest.mark.parametrize("name", SCENES)
def test_cuda_equals_cpu(name: str, preset: str) -> None:
    scene, options = SCENES[name](), Options.preset(preset).updated(SMALL)
    dynamic_only = name in PARTIAL
    expected, found = (found_by(backend, scene, options, dynamic_only) for backend in ("cpu", "cuda"))
    for key, value in expected.items():
        assert np.array_equal(value, found[key]) and value.dtype == found[key].dtype, key


@pytest.fixture
def gpu() -> Iterator[CudaDevice]:
    """The machine's own, whatever the others use."""
    try:
        found = CudaDevice()
    except SeepastError as error:
        pytest.skip(str(error))
    with device.use(found):
        yield found


LARGE = {
    **SCENES,
    "5, large": lambda: make_scene(5, (721, 403), surface="step", colour=True),
    "9, soft": lambda: make_scene(9, (333, 201), reference=4, residual=True, masks="soft", colour=True),
    **{f"{k} cameras": partial(make_scene, k, (97 + k, 41), residual=True) for k in range(2, 17)},
}


@pytest.mark.parametrize("preset", ["paper", "fast", "accurate"])
@pytest.mark.parametrize("name", LARGE)
def test_a_gpu_equals_cpu(gpu: CudaDevice, name: str, preset: str) -> None:
    scene, options = LARGE[name](), Options.preset(preset).updated(SMALL)
    for dynamic_only in (False, True):
        expected, found = (found_by(backend, scene, options, dynamic_only) for backend in ("cpu", "cuda"))
        for key, value in expected.items():
            assert np.array_equal(value, found[key]), key


@pytest.mark.parametrize("preset", ["fast", "accurate"])
def test_refined_masks_equal_cpu(preset: str) -> None:
    scene = noise_scene(3, (90, 40), seed=3)
    eager = {"people.trusted": 0, "people.least_area": 0, "people.surface_width": 64, "people.working_width": 64}
    options = Options.preset(preset).updated({**SMALL, **eager})
    expected, found = (found_by(backend, scene, options, False) for backend in ("cpu", "cuda"))
    assert (expected["dynamic"] != scene.dynamic).any()
    for key, value in expected.items():
        assert np.array_equal(value, found[key]), key


# ------------------------------------------------------------------------------------------ frames of a whole run


def instants(count: int = 3) -> tuple[Rig, list[tuple[list[np.ndarray], list[np.ndarray]]]]:
    """A rig that must be rectified, and random images with a box of a mask."""
    rng, cameras, frames = np.random.default_rng(5), [], []
    for k in range(3):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rng.uniform(-0.02, 0.02, 3))[0]
        pose[0, 3] = -0.1 * k
        lens = (-0.1, 0.02, 0.0, 0.0)
        cameras.append(Camera(f"cam{k}", "pinhole", "radtan", (70.0, 70.0, 33.0, 17.0), lens, (67, 35), pose))
    for _ in range(count):
        noise = [cv2.GaussianBlur(rng.integers(0, 256, (35, 67, 3), np.uint8), (0, 0), 1.5) for _ in cameras]
        masks = [np.zeros((35, 67), np.uint8) for _ in cameras]
        for k, mask in enumerate(masks):
            mask[8:30, 20 - 3 * k : 34 - 3 * k] = 255
        frames.append((noise, masks))
    return Rig(tuple(cameras)), frames


FAST = Options.preset("fast").updated(SMALL)
PARTS = ("background", "disparity", "depth", "confidence", "coverage", "labels")


def assert_same(result: pipeline.Result, expected: pipeline.Result) -> None:
    for part in PARTS:
        found = getattr(result, part)
        assert np.array_equal(found.host if isinstance(found, Array) else found, getattr(expected, part)), part
    for found, mask in zip(result.masks, expected.masks, strict=True):
        assert np.array_equal(found.host if isinstance(found, Array) else found, mask)


def test_a_stream_on_the_gpu_is_the_same_frame_by_frame() -> None:
    rig, frames = instants()
    expected = [Reconstructor(rig, options=FAST, backend="cpu")(*frame) for frame in frames]
    found = list(Reconstructor(rig, options=FAST, backend="cuda").stream(iter(frames)))
    assert [result.backend for result in found] == ["cuda"] * 3
    for result, of_cpu in zip(found, expected, strict=True):
        assert isinstance(result.background, np.ndarray)
        assert_same(result, of_cpu)


def test_a_bad_frame_is_reported_in_its_place() -> None:
    rig, frames = instants(2)
    results = Reconstructor(rig, options=FAST, backend="cuda").stream([frames[0], (frames[1][0][:1], None)])
    assert next(results).coverage.any()
    with pytest.raises(InputError, match="1 given"):
        next(results)


def test_arrays_come_from_the_gpu_and_stay_there() -> None:
    rig, [(images, masks)] = instants(1)

    class OfAnotherLibrary:
        """Memory of the device, as another library would hand it over."""

        def __init__(self, array: np.ndarray):
            self.host, self.__cuda_array_interface__ = array, {"version": 3}

    expected = Reconstructor(rig, options=FAST, backend="cpu")(images, masks)
    run = Reconstructor(rig, options=FAST, backend="cuda", on_device=True)
    for given in (masks, [mask > 127 for mask in masks], [mask / np.float32(255) for mask in masks]):
        result = run([OfAnotherLibrary(image) for image in images], [OfAnotherLibrary(mask) for mask in given])
        assert isinstance(result.disparity, Array) and isinstance(result.masks[0], Array)
        assert_same(result, expected)


class Failing(StrictDevice):
    """A GPU that is lost when a certain kernel is launched for the nth time."""

    def __init__(self, kernel: str, nth: int = 1):
        super().__init__()
        self.left = {kernel: nth}

    def launch(self, file: str, kernel: str, **how: object) -> None:
        self.left[kernel] = self.left.get(kernel, 0) - 1
        if self.left[kernel] == 0:
            raise DeviceError("the GPU stopped working (of a test)")
        super().launch(file, kernel, **how)


@pytest.mark.parametrize(("kernel", "nth"), [("rectify", 1), ("rectify", 2), ("blend", 1), ("blend", 2)])
def test_with_auto_the_cpu_takes_over_from_a_lost_gpu(kernel, nth, monkeypatch, caplog) -> None:
    rig, frames = instants()
    expected = [Reconstructor(rig, options=FAST, backend="cpu")(*frame) for frame in frames]
    monkeypatch.setattr(backends, "_fastest", lambda: "cuda")
    with device.use(Failing(kernel, nth)), caplog.at_level(logging.WARNING, "seepast"):
        found = list(Reconstructor(rig, options=FAST, backend="auto").stream(iter(frames)))
    for result, of_cpu in zip(found, expected, strict=True):
        assert_same(result, of_cpu)
    assert found[-1].backend == "cpu"
    assert [r.message for r in caplog.records] == ["the GPU stopped working (of a test); going on with --backend cpu"]


def test_without_auto_a_lost_gpu_is_an_error() -> None:
    rig, [frame] = instants(1)
    with device.use(Failing("blend")), pytest.raises(DeviceError, match="stopped working"):
        Reconstructor(rig, options=FAST, backend="cuda")(*frame)
