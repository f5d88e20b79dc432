"""The static world: a furnished room in front of the array, and the world as a whole with its people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import textures
from .figures import Figure, people, wardrobe
from .mesh import Mesh, box, join, limb, moved, yaw
from .textures import Texture, texture

EYE = 1.5  # metres from the floor to the array, in a world of scale 1
CEILING = 1.35  # metres from the array up to the ceiling
TILE = 5.12  # metres after which a texture comes again, in a world of scale 1
SLAB = 0.5  # thickness of walls: they overlap, so that no ray slips through a corner


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to see. World: x right, y down, z forward, metres; the array is near the origin.

    static    the room; figures: who walks in it
    textures  what Mesh.texture counts
    objects   part numbers of the furniture (what a network may take for a person)
    scale     size of the world: 1 = people 1.75 m tall
    """

    static: Mesh
    figures: tuple[Figure, ...]
    textures: tuple[Texture, ...]
    objects: tuple[int, ...]
    scale: float


def build_scene(
    rng: np.random.Generator,
    *,
    figures: int,
    figure_depth: tuple[float, float],
    background_depth: tuple[float, float],
    tangent: float,
    scale: float,
    width: int,
) -> Scene:
    """A room whose furniture and far wall lie in `background_depth` metres, with people in `figure_depth`.

    tangent   half the array's horizontal field of view, as x/z
    width     of the images in px: how fine the textures need be
    """
    bank: list[Texture] = []
    fine = 1 << int(np.clip(np.ceil(np.log2(1.2 * width)), 8, 11))
    room = _Room(rng, bank, background_depth, tangent, scale, fine)
    static = join(room.build())
    crew = people(rng, figures, figure_depth, tangent, scale, EYE * scale, len(bank))
    for _ in crew:
        bank += wardrobe(rng, texel=0.002 * scale)
    return Scene(static, tuple(crew), tuple(bank), tuple(room.objects), scale)


class _Room:
    """Builds the solids of one room; every solid gets a part number and its own stretch of texture."""

    def __init__(self, rng, bank: list[Texture], depth: tuple[float, float], tangent: float, scale: float, size: int):
        self.rng, self.bank, self.tangent, self.scale = rng, bank, tangent, scale
        self.near, self.far = depth
        self.parts = 0
        self.objects: list[int] = []
        hue = lambda low, high: rng.uniform(low, high) * rng.uniform(0.75, 1.0, 3)  # noqa: E731
        brown, red = np.array([0.5, 0.75, 1.0]), np.array([0.55, 0.7, 1.0])
        self.paint = self._texture(textures.plain(rng, size, hue(160, 215)))
        self.paper = self._texture(textures.wallpaper(rng, size, hue(150, 210)))
        self.brick = self._texture(textures.bricks(rng, size, red * rng.uniform(120, 170)))
        self.floor = self._texture(textures.planks(rng, size, brown * rng.uniform(110, 170)))
        self.wood = [self._texture(textures.planks(rng, size // 2, brown * v), 0.3) for v in (90, 150)]
        self.rough = [self._texture(textures.rough(rng, size // 2, hue(60, 200)), 0.5) for _ in range(4)]
        self.leaf = self._texture(textures.rough(rng, size // 4, np.array([45, 110, 70])), 0.25)
        self.posters = [self._texture(textures.poster(rng, size // 4), 0.2) for _ in range(5)]
        self.metal = self._texture(textures.plain(rng, size // 4, hue(60, 200)), 0.25)

    def _texture(self, picture: np.ndarray, extent: float = 1.0) -> int:
        self.bank.append(texture(picture, TILE * extent * self.scale / len(picture)))
        return len(self.bank) - 1

    def _box(self, center, size, look: int, part: int) -> Mesh:
        return box(center, size, look, part, self.rng.uniform(0, 50, 2) * self.scale)

    def _part(self) -> int:
        self.parts += 1
        return self.parts

    def build(self) -> list[Mesh]:
        solids = self._shell()
        solids += self._pictures()
        solids += self._shelves()
        count = 10
        for i in rng_order(self.rng, count):
            solids += self._piece((i + self.rng.uniform(0.2, 0.8)) / count * 2 - 1)
        return solids

    def _shell(self) -> list[Mesh]:
        """Floor, ceiling, four walls: the far one papered, one side brick, the other plain."""
        s, half = self.scale, self.half_width
        top, bottom, back, depth = -CEILING * s, EYE * s, -3 * s, self.far + 3 * s
        t = SLAB * s
        middle = (self.far + back) / 2
        sides = [self.paint, self.brick] if self.rng.random() < 0.5 else [self.brick, self.paint]
        height = bottom - top + 2 * t
        return [
            self._box((0, bottom + t / 2, middle), (2 * half + 2 * t, t, depth + 2 * t), self.floor, self._part()),
            self._box((0, top - t / 2, middle), (2 * half + 2 * t, t, depth + 2 * t), self.paint, self._part()),
            self._box(
                (-half - t / 2, (top + bottom) / 2, middle),
                (t, height, depth + 2 * t),
                sides[0],
                self._part(),
            ),
            self._box((half + t / 2, (top + bottom) / 2, middle), (t, height, depth + 2 * t), sides[1], self._part()),
            self._box((0, (top + bottom) / 2, self.far + t / 2), (2 * half, height, t), self.paper, self._part()),
            self._box((0, (top + bottom) / 2, back - t / 2), (2 * half, height, t), self.paint, self._part()),
        ]

    @property
    def half_width(self) -> float:
        """Side walls come into view at just under half the background's depth."""
        return max(self.tangent * (self.near + 0.45 * (self.far - self.near)), 1.6 * self.scale)

    def _pictures(self) -> list[Mesh]:
        """Posters and a beam that stand out of the walls, each by its own thickness."""
        s, rng, half = self.scale, self.rng, self.half_width
        solids = []
        for i in range(4):
            width, height = rng.uniform(0.5, 1.1, 2) * s
            x = ((i + rng.uniform(0.25, 0.75)) / 2 - 1) * (half - 0.5 * s)
            at = (x, rng.uniform(-0.7, -0.1) * s, self.far - 0.02 * s)
            solids.append(self._box(at, (width, height, 0.06 * s), int(rng.choice(self.posters)), self._part()))
        for side in (-1, 1):
            for z in np.linspace(self.near + 0.5 * (self.far - self.near), self.far - 0.8 * s, 3):
                size = (0.06 * s, rng.uniform(0.5, 1.0) * s, rng.uniform(0.6, 1.2) * s)
                at = (side * (half - 0.02 * s), rng.uniform(-0.6, 0) * s, z)
                solids.append(self._box(at, size, int(rng.choice(self.posters)), self._part()))
        for z in np.linspace(self.near, self.far, 5)[1:-1]:
            at = (0, (-CEILING + 0.08) * s, z)
            solids.append(self._box(at, (2 * half, 0.16 * s, 0.2 * s), self.wood[0], self._part()))
        return solids

    def _shelves(self) -> list[Mesh]:
        """A bookcase against the far wall."""
        s, rng = self.scale, self.rng
        width, depth, height = 1.8 * s, 0.35 * s, 2.0 * s
        x, z, bottom = rng.uniform(-0.5, 0.5) * self.half_width, self.far - 0.2 * s, EYE * s
        part = self._part()
        self.objects.append(part)
        solids = [
            self._box(
                (x, bottom - height / 2, z + depth / 2 - 0.02 * s),
                (width, height, 0.04 * s),
                self.wood[0],
                part,
            )
        ]
        for edge in (-1, 1):
            at = (x + edge * width / 2, bottom - height / 2, z)
            solids.append(self._box(at, (0.04 * s, height, depth), self.wood[0], part))
        for level in range(6):
            y = bottom - 0.05 * s - level * 0.38 * s
            solids.append(self._box((x, y, z), (width, 0.03 * s, depth), self.wood[0], part))
            left = x - width / 2 + 0.03 * s
            while level < 5 and left < x + width / 2 - 0.15 * s:
                thick, tall, deep = rng.uniform((0.03, 0.2, 0.18), (0.1, 0.32, 0.28)) * s
                look = int(rng.choice([*self.rough, *self.posters, self.metal]))
                if rng.random() < 0.85:
                    solids.append(self._box((left + thick / 2, y - tall / 2, z), (thick, tall, deep), look, part))
                left += thick + 0.004 * s
        return solids

    def _piece(self, across: float) -> list[Mesh]:
        """One piece of furniture at `across` -1..1 of the field of view, somewhere in the depth range."""
        s, rng = self.scale, self.rng
        z = rng.uniform(self.near + 0.6 * s, max(self.far - 0.8 * s, self.near + 0.7 * s))
        x = float(np.clip(across * self.tangent * z, -self.half_width + 0.4 * s, self.half_width - 0.4 * s))
        part = self._part()
        self.objects.append(part)
        make = (self._cabinet, self._table, self._column, self._panel, self._plant, self._boxes)[part % 6]
        turn = rng.uniform(-0.7, 0.7)
        return [moved(solid, yaw(turn), (x, EYE * s, z)) for solid in make(part)]

    def _cabinet(self, part: int) -> list[Mesh]:
        s, rng = self.scale, self.rng
        w, h, d = rng.uniform((0.5, 0.7, 0.35), (1.0, 1.5, 0.5)) * s
        look = int(rng.choice([*self.wood, *self.rough, self.metal]))
        solids = [self._box((0, -h / 2, 0), (w, h, d), look, part)]
        for i in range(3):
            at = (0, -h * (i + 0.5) / 3, -d / 2 - 0.01 * s)
            solids.append(
                self._box(at, (w * 0.88, h * 0.28, 0.03 * s), int(rng.choice([*self.rough, self.wood[1]])), part)
            )
        return solids

    def _table(self, part: int) -> list[Mesh]:
        s, rng = self.scale, self.rng
        w, h, d = rng.uniform((0.9, 0.7, 0.6), (1.4, 0.8, 0.8)) * s
        top = self._box((0, -h, 0), (w, 0.05 * s, d), self.wood[1], part)
        legs = [
            self._box(
                (x * (w / 2 - 0.05 * s), -h / 2, z * (d / 2 - 0.05 * s)),
                (0.06 * s, h, 0.06 * s),
                self.wood[0],
                part,
            )
            for x in (-1, 1)
            for z in (-1, 1)
        ]
        vase = limb(
            (0, -h - 0.3 * s, 0),
            (0, -h - 0.08 * s, 0),
            (0.06 * s, 0.1 * s),
            int(rng.choice(self.posters)),
            part,
        )
        case = self._box(
            (0.3 * s, -h - 0.14 * s, 0.05 * s),
            (0.3 * s, 0.24 * s, 0.25 * s),
            int(rng.choice(self.rough)),
            part,
        )
        return [top, *legs, vase, case]

    def _column(self, part: int) -> list[Mesh]:
        s, rng = self.scale, self.rng
        radius = rng.uniform(0.13, 0.22) * s
        look = int(rng.choice([*self.rough, self.brick]))
        bottom, top = (0, 0.01 * s, 0), (0, -(EYE + CEILING) * s - 0.01 * s, 0)
        offset = rng.uniform(0, 50, 2) * s
        return [limb(bottom, top, (radius, radius), look, part, rounded=False, offset=offset, segments=40)]

    def _panel(self, part: int) -> list[Mesh]:
        """A free-standing screen: one plain, one textured half."""
        s, rng = self.scale, self.rng
        w, h = rng.uniform((0.6, 1.3), (1.0, 1.9)) * s
        return [
            self._box((-w / 4, -h / 2, 0), (w / 2, h, 0.05 * s), self.metal, part),
            self._box((w / 4, -h / 2, 0.02 * s), (w / 2, h, 0.05 * s), int(rng.choice(self.rough)), part),
        ]

    def _plant(self, part: int) -> list[Mesh]:
        s, rng = self.scale, self.rng
        pot = int(rng.choice(self.rough))
        solids = [limb((0, 0, 0), (0, -0.4 * s, 0), (0.15 * s, 0.2 * s), pot, part, rounded=False)]
        for _ in range(14):
            turn, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.3)
            tip = np.array([np.cos(turn) * np.cos(rise), -np.sin(rise), np.sin(turn) * np.cos(rise)])
            end = np.array([0, -0.42, 0]) + tip * rng.uniform(0.4, 0.9)
            side = (-np.sin(turn), 0, np.cos(turn))
            offset = rng.uniform(0, 50, 2) * s
            start = np.array([0, -0.38, 0])
            solids.append(
                limb(
                    start * s,
                    end * s,
                    (0.02 * s, 0.06 * s),
                    self.leaf,
                    part,
                    flatten=0.15,
                    side=side,
                    offset=offset,
                )
            )
        return solids

    def _boxes(self, part: int) -> list[Mesh]:
        """A pile of crates."""
        s, rng = self.scale, self.rng
        solids, y = [], 0.0
        for _ in range(int(rng.integers(2, 5))):
            w, h, d = rng.uniform((0.3, 0.22, 0.3), (0.6, 0.45, 0.55)) * s
            look = int(rng.choice([*self.wood, *self.rough, *self.posters]))
            crate = self._box((0, -h / 2, 0), (w, h, d), look, part)
            solids.append(moved(crate, yaw(rng.uniform(-0.5, 0.5)), (rng.uniform(-0.06, 0.06) * s, y, 0)))
            y -= h
        return solids


def rng_order(rng: np.random.Generator, count: int) -> list[int]:
    """0..count-1 in a drawn order, so that kinds of furniture fall on other places in every room."""
    return [int(i) for i in rng.permutation(count)]
