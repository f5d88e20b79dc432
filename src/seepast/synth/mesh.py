"""Triangle meshes with surface coordinates: the two solids that every room and figure is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world metres (x right, y down, z forward).

    vertices  float32[V, 3];  normals float32[V, 3] unit, outwards;  uv float32[V, 2] metres along the surface
    faces     int32[F, 3] vertex indices
    texture   int32[F] index into the scene's textures
    part      int32[F] identity of the thing that the triangle belongs to; people's parts are >= PERSON
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    texture: np.ndarray
    part: np.ndarray


PERSON = 1000  # part = PERSON * (1 + figure) + limb for people, the object's own number below that


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several; raises InputError if there are none."""
    if not meshes:
        raise InputError("meshes: none given; a scene needs at least one solid")
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces + start for m, start in zip(meshes, starts, strict=True)]
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        normals=np.concatenate([m.normals for m in meshes]),
        uv=np.concatenate([m.uv for m in meshes]),
        faces=np.concatenate(faces).astype(np.int32),
        texture=np.concatenate([m.texture for m in meshes]),
        part=np.concatenate([m.part for m in meshes]),
    )


def moved(mesh: Mesh, rotation: np.ndarray, translation, scale: float = 1.0) -> Mesh:
    """The mesh scaled, then turned by `rotation` (3x3), then shifted by `translation` (3,)."""
    vertices = (scale * mesh.vertices @ rotation.T + np.asarray(translation)).astype(np.float32)
    normals = (mesh.normals @ rotation.T).astype(np.float32)
    uv = (scale * mesh.uv).astype(np.float32)
    return Mesh(vertices, normals, uv, mesh.faces, mesh.texture, mesh.part)


def yaw(angle: float) -> np.ndarray:
    """Rotation about the vertical (y) axis; a positive angle turns z towards x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def box(center, size, texture: int, part: int, offset=(0.0, 0.0)) -> Mesh:
    """Axis-aligned box; `offset` (2,) shifts its surface coordinates, so that no two look alike."""
    center, half = np.asarray(center, float), np.asarray(size, float) / 2
    vertices, normals, uv = [], [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        if axis == 0:
            a, b = 2, 1  # the second surface coordinate runs down the sides
        for side in (-1.0, 1.0):
            normal = np.eye(3)[axis] * side
            for p, q in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = normal * half + np.eye(3)[a] * p * half[a] + np.eye(3)[b] * q * half[b]
                vertices.append(center + corner)
                normals.append(normal)
                uv.append((corner[a] + offset[0] + 1.7 * axis, corner[b] + offset[1] + 0.9 * side))
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([quad + 4 * i for i in range(6)])
    return _mesh(vertices, normals, uv, faces, texture, part)


def limb(
    start,
    end,
    radii: tuple[float, float],
    texture: int,
    part: int,
    *,
    flatten: float = 1.0,
    rounded: bool = True,
    side=(1.0, 0.0, 0.0),
    offset=(0.0, 0.0),
    segments: int = 20,
) -> Mesh:
    """Surface of revolution from `start` (3,) to `end` (3,), `radii` at its two ends.

    Rounded ends make a capsule (an ellipsoid when start and end are close), square ones a column. Across the
    direction `side` it has the full radius, at right angles to it `flatten` times that.
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    across = np.asarray(side, float) - along * np.dot(side, along)
    across /= np.linalg.norm(across)
    third = np.cross(along, across)
    height, radius, tilt = _profile(length, radii, rounded)
    turn = np.linspace(0, 2 * np.pi, segments + 1)  # the seam is doubled: surface coordinates may not wrap there
    ring = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * third * flatten
    out = np.cos(turn)[:, None] * across * flatten + np.sin(turn)[:, None] * third
    vertices = start + height[:, None, None] * along + radius[:, None, None] * ring
    normals = np.cos(tilt)[:, None, None] * out + np.sin(tilt)[:, None, None] * along
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    u = np.broadcast_to(turn * max(radii) + offset[0], (len(height), segments + 1))
    v = np.broadcast_to((height + offset[1])[:, None], u.shape)
    i, j = np.mgrid[0 : len(height) - 1, 0:segments]
    p = (i * (segments + 1) + j).ravel()
    q = p + segments + 1
    faces = np.concatenate([np.stack([p, q, p + 1], 1), np.stack([q, q + 1, p + 1], 1)])
    return _mesh(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.stack([u, v], -1).reshape(-1, 2),
        faces,
        texture,
        part,
    )


def _profile(length: float, radii: tuple[float, float], rounded: bool) -> tuple[np.ndarray, ...]:
    """Height along the axis, radius, and tilt of the normal towards the axis (radians) of each ring."""
    a, b = radii
    if not rounded:
        flat = np.pi / 2
        return (
            np.array([0, 0, length, length]),
            np.array([1e-4, a, b, 1e-4]),
            np.array([-flat, 0, 0, flat]),
        )
    cap = np.linspace(0.02, np.pi / 2, 6)
    height = np.concatenate([-a * np.cos(cap), (length + b * np.cos(cap))[::-1]])
    radius = np.concatenate([a * np.sin(cap), (b * np.sin(cap))[::-1]])
    return height, radius, np.concatenate([cap - np.pi / 2, (np.pi / 2 - cap)[::-1]])


def _mesh(vertices, normals, uv, faces, texture: int, part: int) -> Mesh:
    return Mesh(
        np.asarray(vertices, np.float32),
        np.asarray(normals, np.float32),
        np.asarray(uv, np.float32),
        np.asarray(faces, np.int32),
        np.full(len(faces), texture, np.int32),
        np.full(len(faces), part, np.int32),
    )
