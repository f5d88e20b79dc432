"""Small rectified arrays whose truth is known: a textured background, and a nearer box that stands for a person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from seepast.evidence import NATS, prior_costs
from seepast.geometry import ArrayGeometry
from seepast.rectify import NO_RAY

FOCAL, SPACING = 120.0, 0.1
FAR, NEAR = 12.0, 44.0  # px over the array: the background's disparity, and the person's
MARGIN = 80  # px of texture around the reference's view


@dataclass(frozen=True, eq=False)
class Scene:
    """K rectified views and their truth, in the reference view unless it says otherwise.

    views       uint8 [K, H, W] or [K, H, W, 3]
    dynamic     uint8 [K, H, W], 254ths of P(dynamic), NO_RAY outside a view
    person      bool [K, H, W]: where the person is in every camera
    disparity   float32 [H, W] of the background
    background  the reference's view without the person
    """

    geometry: ArrayGeometry
    views: np.ndarray
    dynamic: np.ndarray
    person: np.ndarray
    disparity: np.ndarray
    background: np.ndarray

    @property
    def grey(self) -> np.ndarray:
        if self.views.ndim == 3:
            return self.views
        return np.stack([cv2.cvtColor(view, cv2.COLOR_BGR2GRAY) for view in self.views])

    @property
    def colour(self) -> np.ndarray:
        """Views with a channel axis: uint8 [K, H, W, C]."""
        return self.views if self.views.ndim == 4 else self.views[..., None].copy()

    @property
    def masks(self) -> list[np.ndarray]:
        """What a user gives: K uint8 masks, 255 * P(dynamic)."""
        return [np.round(np.minimum(view, 254) * (255 / 254)).astype(np.uint8) for view in self.dynamic]

    def seen_by(self) -> np.ndarray:
        """How many cameras see the background of every reference pixel: int [H, W]."""
        height, width = self.disparity.shape
        y, x = np.mgrid[:height, :width]
        seen = np.zeros((height, width), int)
        for k, person in enumerate(self.person):
            u, v = (np.rint(p).astype(int) for p in self.geometry.warp(k, x, y, self.disparity))
            there = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            there[there] = ~person[v[there], u[there]]
            seen += there
        return seen


def array(
    cameras: int, size: tuple[int, int], *, reference: int = 0, residual: bool = False, seed: int = 0
) -> ArrayGeometry:
    """A straight array, or with `residual` one off its line, whose views have principal points of their own."""
    positions = np.zeros((cameras, 3))
    positions[:, 0] = SPACING * np.arange(cameras)
    shifts = np.zeros((cameras, 2))
    width, height = size
    center = ((width - 1) / 2, (height - 1) / 2)
    if residual:
        rng = np.random.default_rng(seed)
        positions[:, 1] = rng.uniform(-0.01, 0.01, cameras)
        positions[:, 2] = rng.uniform(-0.03, 0.03, cameras)
        center = (width / 2 - 0.37, height / 2 + 1.21)
        shifts = np.stack([rng.uniform(-2, 2, cameras), rng.integers(-1, 2, cameras)], axis=1)
    focal = (FOCAL, 1.02 * FOCAL if residual else FOCAL)
    positions, shifts = positions - positions[reference], shifts - shifts[reference]
    return ArrayGeometry(focal, center, size, positions, reference, shifts=shifts)


def texture(size: tuple[int, int], rng: np.random.Generator, blur: float = 1.0) -> np.ndarray:
    """Random colours of full contrast, uint8 [H, W, 3], smooth enough to be sampled between pixels."""
    noise = rng.integers(0, 256, (size[1], size[0], 3), np.uint8).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    return cv2.normalize(smooth, None, 10, 245, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]  # reference pixels (x, y) -> disparity


def slanted(geometry: ArrayGeometry, far: float = FAR) -> Surface:
    cx, cy = geometry.center
    return lambda x, y: far + 0.06 * (x - cx) + 0.04 * (y - cy)


def unwarped(geometry: ArrayGeometry, camera: int, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """The reference pixels (x, y) whose point on the surface `camera` sees at each of its own pixels."""
    width, height = geometry.size
    (cx, cy), (ax, ay, az, sx, sy) = geometry.center, geometry.offsets[camera].astype(float)
    v, u = np.mgrid[:height, :width].astype(float)
    u, v = u - sx, v - sy
    x, y = u, v
    for _ in range(20):  # a fixed point, since d depends on x; it contracts for gentle slopes
        d = surface(x, y)
        x, y = cx + (u - cx) * (1 - d * az) + d * ax, cy + (v - cy) * (1 - d * az) + d * ay
    return x, y


def painted(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The texture at reference pixels (x, y)."""
    at = [(p + MARGIN).astype(np.float32) for p in (x, y)]
    return cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def make_scene(
    cameras: int = 5,
    size: tuple[int, int] = (96, 64),
    *,
    reference: int = 0,
    surface: str = "plane",
    masks: str = "exact",
    colour: bool = False,
    residual: bool = False,
    no_ray: int = 0,
    noise: float = 0.0,
    person: bool = True,
    seed: int = 0,
) -> Scene:
    """Renders the array by warping random textures.

    surface  "plane", "slanted", or "step": the right third of the view is a static thing at twice the disparity
    masks    "exact", "soft" (blurred, unsure inside), "all" (everything dynamic), "none"
    no_ray   columns at the left of every camera but the reference that have no source pixel
    """
    rng = np.random.default_rng(seed)
    geometry = array(cameras, size, reference=reference, residual=residual, seed=seed)
    width, height = size
    room = (width + 2 * MARGIN, height + 2 * MARGIN)
    walls = {FAR: texture(room, rng), 2 * FAR: texture(room, rng)}
    clothes = texture(room, rng)
    edge = 2 * width / 3
    left, right, top, bottom = 0.4 * width, 0.4 * width + 13, 0.25 * height, 0.75 * height
    if reference == cameras - 1:  # keep the person in the other cameras' views, which look from the left
        left, right = left - 8, right - 8
    views, people, truth, clean = [], [], np.zeros(0), np.zeros(0)
    for k in range(cameras):
        shape: Surface = slanted(geometry) if surface == "slanted" else lambda x, y: np.full_like(x, FAR)
        x, y = unwarped(geometry, k, shape)
        view, d = painted(walls[FAR], x, y), shape(x, y)
        if surface == "step":
            x, y = unwarped(geometry, k, lambda x, y: np.full_like(x, 2 * FAR))
            thing = x >= edge
            view = np.where(thing[..., None], painted(walls[2 * FAR], x, y), view)
            d = np.where(thing, 2 * FAR, d)
        if k == reference:
            truth, clean = d.astype(np.float32), view
        x, y = unwarped(geometry, k, lambda x, y: np.full_like(x, NEAR))
        box = (x >= left) & (x < right) & (y >= top) & (y < bottom) & person
        view = np.where(box[..., None], painted(clothes, x, y), view)
        noisy = view + rng.normal(0, noise, view.shape) if noise else view
        views.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        people.append(box)
    dynamic = masks_of(np.stack(people), masks)
    for k in range(cameras):
        if k != reference:
            dynamic[k, :, :no_ray] = NO_RAY
    stack, keep_colour = np.stack(views), slice(None) if colour else 0
    return Scene(geometry, stack[..., keep_colour].copy(), dynamic, np.stack(people), truth, clean[..., keep_colour])


def masks_of(person: np.ndarray, kind: str) -> np.ndarray:
    """uint8 [K, H, W], 254ths of P(dynamic)."""
    exact = np.where(person, 254, 0).astype(np.uint8)
    if kind == "soft":
        return np.stack([cv2.GaussianBlur(m, (0, 0), 3) // 4 * 3 + 20 for m in exact])
    return {"exact": exact, "all": np.full_like(exact, 254), "none": np.zeros_like(exact)}[kind]


def noise_scene(
    cameras: int, size: tuple[int, int], *, reference: int = 0, residual: bool = True, seed: int = 0
) -> Scene:
    """Images and masks of pure noise: nothing matches, everything happens."""
    rng = np.random.default_rng(seed)
    geometry = array(cameras, size, reference=reference, residual=residual, seed=seed)
    shape = (cameras, size[1], size[0])
    views = rng.integers(0, 256, shape, np.uint8)
    dynamic = rng.integers(0, 256, shape, np.uint8)  # 255 is NO_RAY
    dynamic[rng.random(shape) < 0.5] = 0
    person = (dynamic >= 128) & (dynamic != NO_RAY)
    return Scene(geometry, views, dynamic, person, np.full(shape[1:], FAR, np.float32), views[reference])


def all_label_energies(f, exists, p, options) -> np.ndarray:
    """reference.label_energies by doubling instead of set by set: fast enough for the 65536 sets of 16 cameras."""
    K, shape = len(f), np.asarray(p[0]).shape
    costs = prior_costs(options.segmentation).astype(np.int64)
    f, p = np.stack(f).reshape(K, -1, f[0].shape[-1]), np.minimum(np.stack(p), 254).reshape(K, -1)
    exists = np.stack(exists).reshape(K, -1)
    spread, prior = np.zeros((f.shape[1], 1), np.int64), np.zeros((f.shape[1], 1), np.int64)
    for k in range(K):
        to_set = np.zeros((f.shape[1], 1), np.int64)  # sum of |f_k - f_j|^2 over j in the set
        for j in range(k):
            far = ((f[k] - f[j]) ** 2).sum(-1).astype(np.int64)[:, None]
            to_set = np.concatenate([to_set, to_set + far], axis=1)
        dynamic, static = (np.where(exists[k], costs[s][p[k]], miss)[:, None] for s, miss in ((0, 0), (1, 1 << 40)))
        spread = np.concatenate([spread, spread + to_set], axis=1)
        prior = np.concatenate([prior + dynamic, prior + static], axis=1)
    n = np.array([bin(s).count("1") for s in range(1 << K)])
    variance = np.where(n > 1, spread * (1 / np.maximum(n, 1) ** 2), options.disparity.lone_variance)
    return (NATS * options.segmentation.beta * variance + prior).reshape(*shape, 1 << K)
