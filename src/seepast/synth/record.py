"""Array recordings with truth: cast the world through every camera of a rig and write FORMAT's folders.

The truth lives in the rectified reference view, the pixel grid of everything that seepast puts out:

* background   the static world alone, noise-free, with the reference camera's gain: a method that keeps the
               reference's own pixels is judged by noise alone, one that blends cameras must mind their gains;
* disparity    of the surface under each pixel's centre;
* seen_by      bit k where that surface point lies inside camera k's image, no nearer surface hides it, and
               the pixel of camera k that it falls on is not masked; uint16 for more than eight cameras;
* hidden       255 where a person hides the pixel, 64 where the reference camera has no ray, else 0.

A masked pixel is one of which any ray meets a person, so that true masks contain the mixed pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import InputError, OutputError
from ..export import atomic
from ..export.folder import camera_yaml
from ..geometry import ArrayGeometry
from ..rectify import rectify
from ..rig import Rig
from . import masks as segmenters
from .render import embree, is_person
from .room import build_scene
from .views import INTERVAL, Frame, Recorder

NEAR_SHARE = 0.205  # disparity of the background's near end / image width
DEPTH_RATIO, FIGURE_RATIO = 3.0, 0.375  # the background's far end and the nearest person, over its near end
MAX_TANGENT = 1.2


@dataclass(frozen=True)
class Depths:
    """Metres along the rig's optical axis from the middle of its path; scale 1 = people 1.75 m tall."""

    figures: tuple[float, float]
    background: tuple[float, float]
    scale: float


def depths(
    geometry: ArrayGeometry,
    figure_depth: tuple[float, float] | None = None,
    background_depth: tuple[float, float] | None = None,
) -> Depths:
    """The depths asked for, in a world of life size; else a world scaled to what the array resolves.

    Unasked, the background begins where the disparity is a fifth of the image's width and ends three times as
    far, and people stand between 3/8 of its near end and there: 4..12 m and 1.5..4 m for an array of five
    720x540 cameras 0.165 m apart. Raises InputError for a range that is empty or not positive.
    """
    for name, given in (("figure_depth", figure_depth), ("background_depth", background_depth)):
        if given is not None and not 0 < given[0] < given[1] < np.inf:
            raise InputError(f"{name}: {given[0]:g} .. {given[1]:g} m is no range; give MIN MAX with 0 < MIN < MAX")
    near = float(f"{geometry.focal_baseline / (NEAR_SHARE * geometry.size[0]):.2g}")
    life_size = figure_depth is not None or background_depth is not None
    if background_depth is None:
        near = max(near, figure_depth[1]) if figure_depth else near
        background_depth = (near, DEPTH_RATIO * near)
    if figure_depth is None:
        figure_depth = (FIGURE_RATIO * background_depth[0], background_depth[0])
    return Depths(figure_depth, background_depth, 1.0 if life_size else near / 4)


def generate(
    out: str | Path,
    rig: Rig | str | Path,
    *,
    frames: int = 10,
    seed: int = 0,
    reference: int | str = 0,
    masks: str = "exact",
    figures: int = 2,
    figure_depth: tuple[float, float] | None = None,
    background_depth: tuple[float, float] | None = None,
    noise: float = 1.5,
    gain: float = 0.03,
    color: bool = True,
    samples: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a recording with truth into the new folder `out`, laid out as FORMAT.md says; returns it.

    rig           the array, or a Kalibr file
    frames        number of instants, 0.2 s apart; stamps are 000000, 000001, ...
    seed          the same seed and arguments give the same files
    reference     the camera whose rectified view the truth lives in
    masks         "exact", "good", "network" or "poor" into masks/; "all": each into masks_<kind>/; "none"
    figures       number of people
    figure_depth, background_depth   (near, far) metres; see `depths`. Floor and side walls may come nearer.
    noise         standard deviation of the sensor noise at mid-grey, grey levels
    gain          cameras' gains differ from 1 by at most this
    color         BGR images, else grey
    samples       each pixel is the mean of samples x samples rays
    progress      called with (frames done, frames in all)

    truth/poses.txt holds TUM lines "stamp tx ty tz qx qy qz qw", world_from_cam0. Every file appears whole or
    not at all. Raises OutputError where `out` holds something or cannot be written, InputError for arguments
    out of range, RigError, and MissingExtraError without embreex.
    """
    embree()
    rig = rig if isinstance(rig, Rig) else Rig.from_kalibr(rig)
    _check(frames, seed, masks, figures, noise, gain, samples)
    index = rig.index(reference)
    rectification = rectify(rig, index)
    geometry = rectification.geometry
    world = depths(geometry, figure_depth, background_depth)
    scene = build_scene(
        np.random.default_rng([seed, 0]),
        figures=figures,
        figure_depth=world.figures,
        background_depth=world.background,
        tangent=_tangent(geometry),
        scale=world.scale,
        width=geometry.size[0],
    )
    recorder = Recorder(rig, index, scene, rectification, seed=seed, samples=samples)
    folder = _fresh(Path(out))
    stamps = [f"{i:06d}" for i in range(frames)]
    names = [f"cam{k}" for k in range(len(rig.cameras))]
    rig.to_kalibr(folder / "rig.yaml")
    atomic.write_bytes(folder / "truth" / "camera.yaml", camera_yaml(geometry, names).encode())
    poses = [recorder.world_from_rig(i) for i in range(frames)]
    atomic.write_bytes(folder / "truth" / "poses.txt", _tum(stamps, poses).encode())
    sensor = Sensor(seed, len(names), noise, gain, color)
    for i, stamp in enumerate(stamps):
        frame = recorder.frame(i)
        _write(folder, stamp, names, frame, sensor, i, index)
        _write_masks(folder, stamp, names, frame, masks, scene.objects, (seed, i))
        if progress:
            progress(i + 1, frames)
    return folder


@dataclass(frozen=True)
class Sensor:
    """What turns colours into 8-bit images: a gain per camera, shot and read noise, rounding."""

    seed: int
    cameras: int
    noise: float
    gain: float
    color: bool

    def gains(self) -> np.ndarray:
        """float64[K] factors, 1 within +-gain."""
        return 1 + self.gain * np.random.default_rng([self.seed, 5]).uniform(-1, 1, self.cameras)

    def image(self, colors: np.ndarray, camera: int, frame: int | None) -> np.ndarray:
        """uint8[H, W, 3] BGR or [H, W] grey; no noise for frame None."""
        image = colors * np.float32(self.gains()[camera])
        image = image if self.color else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if frame is not None:
            rng = np.random.default_rng([self.seed, 6, frame, camera])
            deviation = self.noise * np.sqrt(0.5 + np.clip(image, 0, 255) / 255)
            image = image + deviation * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _write(folder: Path, stamp: str, names: Sequence[str], frame: Frame, sensor: Sensor, number: int, reference: int):
    truth = folder / "truth"
    atomic.write_png(truth / "background" / f"{stamp}.png", sensor.image(frame.background, reference, None))
    atomic.write_pfm(truth / "disparity" / f"{stamp}.pfm", frame.disparity)
    atomic.write_png(truth / "seen_by" / f"{stamp}.png", frame.seen_by)
    atomic.write_png(truth / "hidden" / f"{stamp}.png", frame.hidden)
    for k, name in enumerate(names):
        exact = np.where(is_person(frame.parts[k]), 255, 0).astype(np.uint8)
        atomic.write_png(truth / "masks" / name / f"{stamp}.png", exact)
        atomic.write_png(folder / name / f"{stamp}.png", sensor.image(frame.images[k], k, number))


def _write_masks(folder: Path, stamp: str, names, frame: Frame, masks: str, objects, seeds: tuple[int, int]) -> None:
    kinds = {"none": (), "all": segmenters.KINDS}.get(masks, (masks,))
    for kind in kinds:
        into = folder / ("masks" if len(kinds) == 1 else f"masks_{kind}")
        for k, name in enumerate(names):
            mask = segmenters.imperfect(kind, frame.parts[k], objects, (*seeds, k))
            atomic.write_png(into / name / f"{stamp}.png", mask)


def _tum(stamps: Sequence[str], poses: Sequence[np.ndarray]) -> str:
    lines = [
        "# world_from_cam0: stamp tx ty tz qx qy qz qw (TUM). World: x right, y down, z forward, metres.",
        f"# Stamps are the images' names; frames are {INTERVAL} s apart.",
    ]
    for stamp, pose in zip(stamps, poses, strict=True):
        numbers = [*pose[:3, 3], *_quaternion(pose[:3, :3])]
        lines.append(" ".join([stamp, *(f"{v:.9f}" for v in numbers)]))
    return "\n".join(lines) + "\n"


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(x, y, z, w), w >= 0: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (2000)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return q if q[3] >= 0 else -q


def _tangent(geometry: ArrayGeometry) -> float:
    width, cx = geometry.size[0], geometry.center[0]
    return min(max(cx, width - 1 - cx) / geometry.focal[0], MAX_TANGENT)


def _check(frames: int, seed: int, masks: str, figures: int, noise: float, gain: float, samples: int) -> None:
    kinds = (*segmenters.KINDS, "all", "none")
    if masks not in kinds:
        raise InputError(f"masks: there is no kind '{masks}'; choose one of {', '.join(kinds)}")
    for name, value, low, high in (
        ("frames", frames, 1, 999_999),
        ("seed", seed, 0, 2**63),
        ("figures", figures, 0, 50),
        ("noise", noise, 0, 64),
        ("gain", gain, 0, 0.9),
        ("samples", samples, 1, 8),
    ):
        if not low <= value <= high:
            raise InputError(f"{name}: {value} is outside {low} .. {high}")


def _fresh(out: Path) -> Path:
    """The folder `out`, made if need be. Raises OutputError where it holds something or cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        held = next(out.iterdir(), None)
    except (FileExistsError, NotADirectoryError):
        raise OutputError(f"{out}: is a file; name a folder that is new or empty") from None
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be made ({error.strerror or error}); name a folder you may write to"
        ) from None
    if held is not None:
        raise OutputError(f"{out}: is not empty (it holds {held.name}); name a folder that is new or empty")
    return out
