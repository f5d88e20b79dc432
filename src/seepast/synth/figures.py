"""People: articulated bodies of rounded limbs that walk to and fro across the array's field of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import textures
from .mesh import PERSON, Mesh, join, limb, moved, yaw
from .textures import Texture, texture

STRIDE = 1.5  # metres walked per cycle of the two legs, by a figure of HEIGHT
HEIGHT = 1.75


@dataclass(frozen=True)
class Figure:
    """One person: x = middle + reach * sin(rate * t + phase), depth z, on the floor at y = floor; m and s."""

    number: int
    first_texture: int  # shirt, trousers, skin, hair, shoes follow one another in the scene's textures
    size: float  # 1 = 1.75 m tall
    middle: float
    reach: float
    rate: float
    phase: float
    z: float
    floor: float

    def mesh(self, t: float) -> Mesh:
        """The body at time t, in world coordinates."""
        x = self.middle + self.reach * np.sin(self.rate * t + self.phase)
        velocity = self.reach * self.rate * np.cos(self.rate * t + self.phase)
        walked = x / (STRIDE * self.size) * 2 * np.pi * np.sign(velocity)
        body = _body(self.number, self.first_texture, walked + self.phase)
        aside = np.pi / 2 * velocity / (abs(velocity) + 0.15 * self.size)
        facing = aside if self.number % 2 else np.pi - aside  # turns round by the back or the front
        lowest = self.size * float(body.vertices[:, 1].max())
        return moved(body, yaw(facing), (x, self.floor - lowest, self.z), self.size)


def wardrobe(rng: np.random.Generator, size: int = 256, texel: float = 0.002) -> list[Texture]:
    """Five textures of one figure: shirt, trousers, skin, hair, shoes; texel in metres."""
    shirt = rng.uniform(50, 200, 3)
    skin = np.array([120, 150, 200]) * rng.uniform(0.5, 1.1)
    hair = np.array([0.6, 0.8, 1.0]) * rng.uniform(20, 80)
    pictures = (
        textures.cloth(rng, size, shirt, str(rng.choice(["plain", "stripes", "checks"]))),
        textures.cloth(rng, size, rng.uniform(25, 110) * np.array([1.2, 1.0, 0.9]), "plain"),
        textures.plain(rng, size, skin) + 3 * textures.fractal(rng, size, 0.8)[..., None],
        textures.plain(rng, size, hair) + 8 * textures.fractal(rng, size, 0.7, 6)[..., None],
        textures.rough(rng, size, rng.uniform(20, 60, 3)) * 0.7,
    )
    return [texture(picture, texel) for picture in pictures]


def _body(number: int, first_texture: int, phase: float) -> Mesh:
    """A walking body of HEIGHT, facing +z, hips over the origin; y points down."""
    shirt, trousers, skin, hair, shoes = range(first_texture, first_texture + 5)
    part = PERSON * (1 + number)
    hip, shoulder = np.array([0, -0.95, 0]), np.array([0, -1.42, 0.02])
    solids = [
        limb(hip, _by(hip, 0, -0.1, 0), (0.17, 0.15), trousers, part + 1, flatten=0.72),
        limb(_by(hip, 0, -0.14, 0), _by(shoulder, 0, 0.1, 0), (0.155, 0.18), shirt, part + 2, flatten=0.64),
        limb(
            _by(shoulder, -0.15, 0.02, 0),
            _by(shoulder, 0.15, 0.02, 0),
            (0.075, 0.075),
            shirt,
            part + 2,
            side=(0, 1, 0),
        ),
        limb(shoulder, _by(shoulder, 0, -0.12, 0.01), (0.06, 0.055), skin, part + 3),
        *_head(_by(shoulder, 0, -0.22, 0.03), skin, hair, part + 4),
    ]
    for side, swing in ((-1.0, phase), (1.0, phase + np.pi)):
        solids += _leg(_by(hip, 0.09 * side, 0.04, 0), swing, (trousers, shoes), part + (6 if side < 0 else 8))
        solids += _arm(
            _by(shoulder, 0.205 * side, 0.03, 0),
            swing + np.pi,
            side,
            (shirt, skin),
            part + (10 if side < 0 else 12),
        )
    return join(solids)


def _head(at: np.ndarray, skin: int, hair: int, part: int) -> list[Mesh]:
    eyes = [
        limb(_by(at, x, -0.02, 0.07), _by(at, x, -0.02, 0.071), (0.013, 0.013), hair, part) for x in (-0.032, 0.032)
    ]
    return [
        limb(_by(at, 0, -0.035, 0), _by(at, 0, 0.04, 0.012), (0.086, 0.07), skin, part),
        limb(_by(at, 0, -0.05, -0.022), _by(at, 0, -0.02, -0.035), (0.094, 0.085), hair, part + 1),
        limb(_by(at, 0, -0.01, 0.078), _by(at, 0, 0.02, 0.09), (0.01, 0.015), skin, part),
        *eyes,
    ]


def _leg(at: np.ndarray, phase: float, look: tuple[int, int], part: int) -> list[Mesh]:
    swing = 0.45 * np.sin(phase)
    bend = 0.12 + 0.55 * max(0.0, np.cos(phase)) ** 2
    knee = at + 0.43 * _sagittal(swing)
    ankle = knee + 0.41 * _sagittal(swing - bend)
    toe = ankle + 0.15 * _sagittal(swing - bend + np.pi / 2)
    return [
        limb(at, knee, (0.092, 0.064), look[0], part),
        limb(knee, ankle, (0.062, 0.045), look[0], part),
        limb(_by(ankle, 0, 0.02, -0.02), _by(toe, 0, 0.035, 0), (0.045, 0.036), look[1], part + 1, flatten=0.9),
    ]


def _arm(at: np.ndarray, phase: float, side: float, look: tuple[int, int], part: int) -> list[Mesh]:
    swing = 0.4 * np.sin(phase)
    out = np.array([0.12 * side, 0, 0])
    elbow = at + 0.29 * _sagittal(swing) + 0.29 * out
    wrist = elbow + 0.25 * _sagittal(swing + 0.35 + 0.2 * np.sin(phase)) + 0.1 * out
    hand = wrist + 0.09 * _sagittal(swing + 0.5)
    return [
        limb(at, elbow, (0.062, 0.048), look[0], part),
        limb(elbow, wrist, (0.046, 0.034), look[0], part),
        limb(wrist, hand, (0.034, 0.036), look[1], part + 1, flatten=0.7),
    ]


def _by(point: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    """The point shifted: x to the figure's left, y down, z forward."""
    return point + np.array([x, y, z])


def _sagittal(angle: float) -> np.ndarray:
    """Unit vector `angle` radians forward of straight down."""
    return np.array([0.0, np.cos(angle), np.sin(angle)])


def people(
    rng: np.random.Generator,
    count: int,
    depth: tuple[float, float],
    tangent: float,
    scale: float,
    floor: float,
    first_texture: int,
) -> list[Figure]:
    """`count` figures in the depth range (m), spread over a field of view of half-width `tangent` * depth.

    The bodies' own thickness and the rig's sway stay inside the range; `scale` is the size of the world.
    """
    margin = min(0.4 * scale, 0.3 * (depth[1] - depth[0]))
    near, far = depth[0] + margin, depth[1] - margin
    slots = rng.permutation(count)
    figures = []
    for i in range(count):
        z = near + (far - near) * (slots[i] + rng.uniform(0.15, 0.85)) / count
        across = (i + 0.5) / count * 2 - 1
        figures.append(
            Figure(
                number=i,
                first_texture=first_texture + 5 * i,
                size=scale * rng.uniform(0.92, 1.06),
                middle=0.7 * tangent * z * across,
                reach=tangent * z * rng.uniform(0.2, 0.4),
                rate=rng.uniform(0.7, 1.2),
                phase=rng.uniform(0, 2 * np.pi),
                z=z,
                floor=floor,
            )
        )
    return figures
