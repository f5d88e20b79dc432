"""Ray casting with Embree: rays in, surface points, colours and identities out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..errors import MissingExtraError
from .mesh import PERSON, Mesh
from .textures import Texture

CHUNK = 1 << 18  # rays shaded at a time: keeps the intermediate arrays in the cache
MISS = -1  # identity of a ray that leaves the world or that no lens sends out


@dataclass(frozen=True, eq=False)
class Hits:
    """First surfaces along N rays.

    distance  float32[N] in units of the ray's own length (inf: nothing there)
    face      int32[N] index into the caster's mesh, -1: nothing there
    u, v      float32[N] barycentric coordinates of the face's second and third corner
    """

    distance: np.ndarray
    face: np.ndarray
    u: np.ndarray
    v: np.ndarray


class Caster:
    """A mesh ready to be hit by rays. Raises MissingExtraError without the package embreex."""

    def __init__(self, mesh: Mesh):
        scene_module, triangle_mesh = embree()
        self.mesh = mesh
        self._part_or_miss = np.append(mesh.part, MISS).astype(np.int32)
        self._scene = scene_module.EmbreeScene()
        triangle_mesh(self._scene, np.ascontiguousarray(mesh.vertices[mesh.faces], np.float32))

    def cast(self, origin: np.ndarray, rays: np.ndarray) -> Hits:
        """First hits from `origin` (3,) along `rays` float[N, 3] of any length; one of length 0 hits nothing.

        NaN hits nothing either, but Embree visits the whole scene to find that out.
        """
        rays = np.ascontiguousarray(rays, np.float32)
        origins = np.empty_like(rays)
        origins[:] = origin
        found = self._scene.run(origins, rays, output=1)
        distance = np.where(found["primID"] < 0, np.float32(np.inf), found["tfar"])
        return Hits(distance, found["primID"], found["u"], found["v"])

    def parts(self, hits: Hits) -> np.ndarray:
        """int32[N] Mesh.part of what was hit, MISS where nothing was."""
        return self._part_or_miss[hits.face]  # face -1 is the last entry


def embree() -> tuple[Any, Any]:
    """The two modules of embreex that are needed; raises MissingExtraError without them."""
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError as error:
        raise MissingExtraError("embreex", "synth", "seepast synth") from error
    return rtcore_scene, TriangleMesh


@dataclass(frozen=True, eq=False)
class Light:
    """Lamps: positions float[L, 3] metres, the strength of each, plus what comes from everywhere."""

    positions: np.ndarray
    strength: float = 0.55
    ambient: float = 0.5
    reach: float = 6.0  # metres at which a lamp has lost half its strength


def shade(
    mesh: Mesh,
    hits: Hits,
    textures: Sequence[Texture],
    light: Light,
    footprint: float,
    origin: np.ndarray,
    rays: np.ndarray,
) -> np.ndarray:
    """Matt colours float32[N, 3], 0..255 BGR: the same from wherever a point is seen. Nothing hit: black.

    footprint  width of one ray's beam at distance 1, in radians: picks the level of the texture
    origin     (3,) and rays float32[N, 3]: what was cast
    """
    colors = np.zeros((len(hits.face), 3), np.float32)
    for start in range(0, len(colors), CHUNK):
        part = slice(start, start + CHUNK)
        face = hits.face[part]
        hit = np.flatnonzero(face >= 0)
        if hit.size:
            some = Hits(hits.distance[part][hit], face[hit], hits.u[part][hit], hits.v[part][hit])
            colors[start + hit] = _shade(mesh, some, textures, light, footprint, origin, rays[part][hit])
    return colors


def _shade(mesh: Mesh, hits: Hits, textures, light: Light, footprint: float, origin, rays) -> np.ndarray:
    corners = mesh.faces[hits.face]
    weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
    normal, uv = (
        sum(weights[:, c, None] * values[corners[:, c]] for c in range(3)) for values in (mesh.normals, mesh.uv)
    )
    point = np.asarray(origin, np.float32) + hits.distance[:, None] * rays
    length = np.sqrt(np.einsum("nd,nd->n", rays, rays))
    slant = np.abs(np.einsum("nd,nd->n", normal, rays)) / length
    beam = footprint * hits.distance * length / np.sqrt(np.maximum(slant, 0.05))
    colors = _lookup(uv, mesh.texture[hits.face], beam, textures)
    return colors * _brightness(point, normal, light)[:, None]


def _brightness(point: np.ndarray, normal: np.ndarray, light: Light) -> np.ndarray:
    total = np.full(len(point), light.ambient, np.float32)
    for lamp in np.asarray(light.positions, np.float32):
        to = lamp - point
        square = np.einsum("nd,nd->n", to, to)
        facing = np.maximum(np.einsum("nd,nd->n", to, normal), 0) / np.sqrt(square)
        total += light.strength * facing / (1 + square / light.reach**2)
    return total


def _lookup(uv: np.ndarray, which: np.ndarray, beam: np.ndarray, textures: Sequence[Texture]) -> np.ndarray:
    """Texture colours float32[N, 3] at uv (metres), blended between the two levels next to the beam."""
    colors = np.empty((len(uv), 3), np.float32)
    for index in np.unique(which):
        texture = textures[index]
        mine = np.flatnonzero(which == index)
        level = np.log2(np.maximum(beam[mine] / texture.texel, 1)).astype(np.float32)
        level = np.minimum(level, len(texture.levels) - 1.001)
        lower = level.astype(np.int32)
        for at in np.unique(lower):
            chosen = lower == at
            here = mine[chosen]
            rise = (level[chosen] - at)[:, None]
            texels = uv[here] / texture.texel
            fine = _sample(texture.levels[at], texels, at)
            colors[here] = fine + rise * (_sample(texture.levels[at + 1], texels, at + 1) - fine)
    return colors


def _sample(picture: np.ndarray, texels: np.ndarray, level: int) -> np.ndarray:
    """Bilinear colours float32[N, 3] of a tileable picture at full-size texels [N, 2], 0 = the corner."""
    position = (np.mod(texels / 2.0**level - 0.5, picture.shape[0])).astype(np.float32)
    width = 1024  # cv2.remap takes no more than 32767 in a row
    padded = np.zeros((-(-len(position) // width) * width, 2), np.float32)
    padded[: len(position)] = position
    maps = padded.reshape(-1, width, 2)
    out = cv2.remap(picture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return out.reshape(-1, 3)[: len(position)].astype(np.float32)


def sample_grid(size: tuple[int, int], samples: int) -> np.ndarray:
    """Pixel positions float64[samples^2, H, W, 2] of the rays of each pixel of a (width, height) image."""
    width, height = size
    inside = (np.arange(samples) + 0.5) / samples - 0.5
    y, x = np.mgrid[0:height, 0:width].astype(float)
    return np.stack([np.stack([x + dx, y + dy], axis=-1) for dy in inside for dx in inside])


def is_person(parts: np.ndarray) -> np.ndarray:
    """bool, same shape: the part numbers that belong to people."""
    return np.asarray(parts >= PERSON)
