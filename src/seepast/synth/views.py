"""What each camera sees of one instant, and the truth in the rectified reference view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..rectify import NO_RAY, Rectification
from ..rig import Camera, Rig, inverse_pose
from .mesh import join, moved, yaw
from .render import MISS, Caster, Light, is_person, sample_grid, shade
from .room import CEILING, Scene
from .textures import Texture

INTERVAL = 0.2  # seconds between frames
OUTSIDE, HIDDEN = 64, 255
CLEARANCE = 2e-4  # share of a point's distance that a surface before it must keep to count as hiding it
BORDER = 0.01  # px outside the outermost pixel centres that still count as inside an image


@dataclass(frozen=True, eq=False)
class View:
    """One image to cast, in the rig frame.

    size (width, height) px;  center float64[3];  rays float32[samples^2, H*W, 3]
    footprint   width of one ray's beam at distance 1
    """

    size: tuple[int, int]
    center: np.ndarray
    rays: np.ndarray
    footprint: float

    def cast(self, caster: Caster, textures: Sequence[Texture], light: Light | None):
        """(colours float32[H, W, 3], parts int32[H, W]); without a light None for the colours.

        A pixel of which any ray meets a person is that person's part.
        """
        colors = np.zeros((self.rays.shape[1], 3), np.float32)
        parts = np.full(self.rays.shape[1], MISS, np.int32)
        for rays in self.rays:
            hits = caster.cast(self.center, rays)
            parts = np.maximum(parts, caster.parts(hits))
            if light is not None:
                colors += shade(caster.mesh, hits, textures, light, self.footprint, self.center, rays)
        height = self.size[1]
        image = None if light is None else (colors / len(self.rays)).reshape(height, -1, 3)
        return image, parts.reshape(height, -1)


def camera_view(camera: Camera, samples: int) -> View:
    """The camera's own image, through its own lens."""
    rays = camera.unproject(sample_grid(camera.resolution, samples)).reshape(samples**2, -1, 3)
    rays = np.nan_to_num(rays @ camera.rotation, nan=0)  # where the lens sends no ray the image stays black
    center = camera.center
    middle = np.array(camera.resolution) / 2
    step = camera.unproject(np.stack([middle, middle + np.array([1.0, 0.0])]))
    return View(
        camera.resolution,
        center,
        rays.astype(np.float32),
        float(np.linalg.norm(step[1] - step[0])) / samples,
    )


def rectified_view(rig: Rig, rectification: Rectification, samples: int) -> View:
    """The rectified reference camera; its rays have z = 1 in its frame: distances along them are depths."""
    geometry = rectification.geometry
    pixels = sample_grid(geometry.size, samples)
    rays = (pixels - geometry.center) / geometry.focal
    rays = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1).reshape(samples**2, -1, 3)
    reference = geometry.reference
    rect_from_rig = rectification.rotation_from_cam[reference] @ rig.cameras[reference].rotation
    rays = (rays @ rect_from_rig).astype(np.float32)
    return View(geometry.size, rig.cameras[reference].center, rays, 1 / geometry.focal[0] / samples)


class Recorder:
    """Casts the frames of one recording; see `generate` for the arguments."""

    def __init__(
        self, rig: Rig, reference: int, scene: Scene, rectification: Rectification, *, seed: int, samples: int
    ):
        self.rig, self.reference, self.scene, self.seed = rig, reference, scene, seed
        self.rectification, self.geometry = rectification, rectification.geometry
        self.views = [camera_view(camera, samples) for camera in rig.cameras]
        self.truth_view = rectified_view(rig, rectification, samples)
        self.center_view = rectified_view(rig, rectification, 1)
        self.lamps = _lamps(scene)
        self._sway = np.random.default_rng([seed, 7]).uniform(0, 2 * np.pi, 5)

    def world_from_rig(self, frame: int) -> np.ndarray:
        """float64[4, 4]: the array sways a little to the side, forward, up and in all angles, smoothly."""
        t = frame * INTERVAL
        rates = np.array([0.5, 0.37, 0.9, 0.43, 0.61])
        wave = np.sin(rates * t + self._sway)
        scale = self.scene.scale
        rotation = yaw(0.05 * wave[3]) @ _tilt(0.012 * wave[4], 0.01 * wave[2])
        rect_from_rig = self.rectification.rotation_from_cam[self.reference] @ (
            self.rig.cameras[self.reference].rotation
        )
        middle = np.mean([camera.center for camera in self.rig.cameras], axis=0)
        pose = np.eye(4)
        pose[:3, :3] = rotation @ rect_from_rig
        pose[:3, 3] = np.array([0.3, 0.03, 0.15]) * scale * wave[[0, 2, 1]] - pose[:3, :3] @ middle
        return pose

    def frame(self, number: int) -> Frame:
        """Cast one instant. The world is moved before the array, which is cheaper than turning all rays."""
        rig_from_world = inverse_pose(self.world_from_rig(number))
        rotation, translation = rig_from_world[:3, :3], rig_from_world[:3, 3]
        room = moved(self.scene.static, rotation, translation)
        people = [moved(figure.mesh(number * INTERVAL), rotation, translation) for figure in self.scene.figures]
        light = replace(self.lamps, positions=self.lamps.positions @ rotation.T + translation)
        static, everything = Caster(room), Caster(join([room, *people]))
        shots = [view.cast(everything, self.scene.textures, light) for view in self.views]
        dynamic = [is_person(parts) for _, parts in shots]
        rays = self.center_view.rays[0]
        depth = static.cast(self.center_view.center, rays).distance.astype(float)
        points = self.center_view.center + depth[:, None] * rays
        shape = self.geometry.size[::-1]
        return Frame(
            images=[image for image, _ in shots],
            parts=[parts for _, parts in shots],
            background=self.truth_view.cast(static, self.scene.textures, light)[0],
            disparity=(self.geometry.focal_baseline / depth).astype(np.float32).reshape(shape),
            seen_by=self._seen_by(points, everything, dynamic).reshape(shape),
            hidden=self._hidden(everything, dynamic),
        )

    def _seen_by(self, points: np.ndarray, everything: Caster, dynamic: Sequence[np.ndarray]) -> np.ndarray:
        """Bit k: camera k sees the static point (N, 3), rig frame."""
        labels = np.zeros(len(points), np.uint16)
        for k, camera in enumerate(self.rig.cameras):
            pixel = camera.project(points @ camera.rotation.T + camera.cam_from_rig[:3, 3])
            last = np.array(camera.resolution) - 1
            inside = np.all((pixel >= -BORDER) & (pixel <= last + BORDER), axis=1)
            free = everything.cast(camera.center, points - camera.center).distance >= 1 - CLEARANCE
            x, y = np.rint(np.where(inside[..., None], pixel, 0)).astype(int).T
            free &= ~dynamic[k][y, x]
            labels |= np.uint16(1 << k) * (inside & free)
        return labels if len(self.rig.cameras) > 8 else labels.astype(np.uint8)

    def _hidden(self, everything: Caster, dynamic: Sequence[np.ndarray]) -> np.ndarray:
        """uint8[H, W]: HIDDEN, OUTSIDE or 0, in the rectified reference view."""
        if self.rectification.maps[self.reference] is None:
            return np.where(dynamic[self.reference], HIDDEN, 0).astype(np.uint8)
        _, parts = self.truth_view.cast(everything, (), None)
        outside = self.rectification.dynamic(self.reference, None) == NO_RAY
        return np.where(outside, OUTSIDE, np.where(is_person(parts), HIDDEN, 0)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Frame:
    """One instant before the sensors.

    images, parts   per camera: float32[h, w, 3] BGR 0..255, int32[h, w] Mesh.part
    background      float32[H, W, 3];  disparity float32[H, W] px
    seen_by         uint8 or uint16[H, W];  hidden uint8[H, W]
    """

    images: list[np.ndarray]
    parts: list[np.ndarray]
    background: np.ndarray
    disparity: np.ndarray
    seen_by: np.ndarray
    hidden: np.ndarray


def _tilt(pitch: float, roll: float) -> np.ndarray:
    """Rotation about x by pitch after one about z by roll, radians."""
    return cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]


def _lamps(scene: Scene) -> Light:
    """Three lamps in a row under the ceiling, one on the array's side to light what faces it."""
    s = scene.scale
    room = scene.static.vertices
    high, deep = -0.8 * CEILING * s, float(room[:, 2].max())
    at = [(0.8 * s, high, 0.0), (-0.3 * deep, high, 0.45 * deep), (0.25 * deep, high, 0.75 * deep)]
    return Light(np.array(at), reach=6 * s)
