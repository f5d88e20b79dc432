"""Input for the speed benchmark, made in seconds: textured boxes before a wall and three people, seen by a
distorted and slightly twisted camera array, so that images and masks must really be rectified."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seepast.rig import Camera, Rig

BASELINE = 0.66  # metres from the first to the last camera
FOCAL = 0.8  # of the width
DISTORTION = (-0.22, 0.06, 3e-4, -2e-4)  # radtan
TWIST = np.radians(0.6)  # largest rotation of a camera about each axis
OFF_LINE = 1e-3  # metres that a camera stands off the line, at most
WALL = 18.0  # px of disparity over the array
# disparity px, then centre x, y and half width, half height as parts of the image
BOXES = (
    (27, 0.15, 0.40, 0.12, 0.20),
    (36, 0.55, 0.35, 0.16, 0.15),
    (52, 0.85, 0.70, 0.20, 0.12),
    (75, 0.30, 0.90, 0.25, 0.15),
)
PEOPLE = ((105, 0.40), (120, 0.66), (138, 0.90))  # disparity px, centre x as a part of the width
BODY = (0.60, 0.055, 0.27)  # centre y, half width, half height of an ellipse
HEAD = (0.24, 0.036, 0.07)
CONTRASTS = (0.4, 1.0, 0.2)  # of the surfaces in turn
TILE = 512  # px of the texture, which repeats


@dataclass(frozen=True, eq=False)
class Recording:
    """One instant: the rig, K images uint8 [h, w, 3], and K exact masks uint8 [h, w], 0 or 255."""

    rig: Rig
    images: list[np.ndarray]
    masks: list[np.ndarray]


def make(cameras: int = 5, size: tuple[int, int] = (720, 540), seed: int = 1) -> Recording:
    """The scene in any number of cameras and any size (width, height); disparities in px stay the same."""
    rng = np.random.default_rng(seed)
    rig = _rig(cameras, size, rng)
    texture = _texture(rng)
    seen = [_seen(camera, size, texture) for camera in rig.cameras]
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image, _ in seen]
    return Recording(rig, noisy, [mask for _, mask in seen])


def inexact(recording: Recording, seed: int = 2) -> Recording:
    """The same with masks as a network's: soft, and some pixels off, differently in every view."""
    rng = np.random.default_rng(seed)
    moves = (np.float32([[1, 0, dx], [0, 1, dy]]) for dx, dy in rng.integers(-6, 7, (len(recording.masks), 2)))
    moved = [cv2.warpAffine(m, by, m.shape[::-1]) for m, by in zip(recording.masks, moves, strict=True)]
    return Recording(recording.rig, recording.images, [cv2.GaussianBlur(mask, (0, 0), 4) for mask in moved])


def _rig(cameras: int, size: tuple[int, int], rng: np.random.Generator) -> Rig:
    intrinsics = (FOCAL * size[0], FOCAL * size[0], (size[0] - 1) / 2, (size[1] - 1) / 2)
    made = []
    for k in range(cameras):
        cam_from_rig = np.eye(4)
        if k:
            cam_from_rig[:3, :3] = cv2.Rodrigues(rng.uniform(-TWIST, TWIST, 3))[0]
            center = np.array([BASELINE * k / (cameras - 1), *rng.uniform(-OFF_LINE, OFF_LINE, 2)])
            cam_from_rig[:3, 3] = -cam_from_rig[:3, :3] @ center
        made.append(Camera(f"cam{k}", "pinhole", "radtan", intrinsics, DISTORTION, size, cam_from_rig))
    return Rig(tuple(made))


def _texture(rng: np.random.Generator) -> np.ndarray:
    """uint8 [TILE, TILE, 3]: noise of all scales."""
    total = np.zeros((TILE, TILE, 3), np.float32)
    for cells in (4, 16, 64, 256):
        noise = rng.uniform(-0.8, 0.8, (cells, cells, 1)) + rng.uniform(-0.2, 0.2, (cells, cells, 3))
        noise = noise.astype(np.float32)
        total += cv2.resize(noise, (TILE, TILE), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 50 * total, 0, 255).astype(np.uint8)


def _seen(camera: Camera, size: tuple[int, int], texture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image and mask of one camera: surfaces painted from far to near."""
    width, height = size
    rays = camera.unproject(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)) @ camera.rotation
    image = np.zeros((height, width, 3), np.uint8)
    mask = np.zeros((height, width), np.uint8)
    surfaces = (WALL, *(d for d, *_ in BOXES), *(d for d, _ in PEOPLE))
    for number, d in enumerate(surfaces):
        u, v = _on_plane(camera, rays, size, d)
        inside = _inside(number, u / width, v / height)
        contrast = CONTRASTS[number % len(CONTRASTS)]
        at = np.float32(u + 97 * number), np.float32(v + 61 * number)
        painted = cv2.remap(texture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        image[inside] = cv2.addWeighted(painted, contrast, painted, 0, 128 * (1 - contrast))[inside]
        mask[inside] = 255 * (number > len(BOXES))
    return image, mask


def _on_plane(
    camera: Camera, rays: np.ndarray, size: tuple[int, int], disparity: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays meet the plane of that disparity, in pixels of an ideal camera at the rig's origin."""
    depth = FOCAL * size[0] * BASELINE / disparity
    points = camera.center + rays * ((depth - camera.center[2]) / rays[..., 2])[..., None]
    scale = FOCAL * size[0] / depth
    return points[..., 0] * scale + (size[0] - 1) / 2, points[..., 1] * scale + (size[1] - 1) / 2


def _inside(number: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """bool: which points of its plane the wall (number 0), a box or a person covers; parts of the image's size."""
    if number == 0:
        return np.ones(x.shape, bool)
    if number <= len(BOXES):
        _, *middle, half_width, half_height = BOXES[number - 1]
        return (abs(x - middle[0]) < half_width) & (abs(y - middle[1]) < half_height)
    return _person(x - PEOPLE[number - 1 - len(BOXES)][1], y)


def _person(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """bool: inside the body or the head of somebody who stands at x = 0; parts of the image's size."""
    inside = [(x / half[0]) ** 2 + ((y - middle) / half[1]) ** 2 < 1 for middle, *half in (BODY, HEAD)]
    return inside[0] | inside[1]
