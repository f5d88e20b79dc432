"""Masks as segmenters make them: soft at the edges, blind to limbs, seeing people where furniture stands."""

from __future__ import annotations

import cv2
import numpy as np

from .mesh import PERSON

KINDS = ("exact", "good", "network", "poor")
WIDTH = 434  # image width in px that the pixel figures below are meant for; others scale


def imperfect(kind: str, parts: np.ndarray, objects: tuple[int, ...], seeds: tuple[int, int, int]) -> np.ndarray:
    """255 * P(dynamic) uint8[H, W] of one view.

    kind     exact: 255 on people, 0 elsewhere
             good: edges off by a few px and soft
             network: coarse and smooth; limbs missing and furniture taken for people, alike in all views
             poor: limbs missing, holes and false alarms, different in every view
    parts    int32[H, W] what each pixel shows (Mesh.part)
    objects  part numbers of the furniture
    seeds    (recording, frame, camera): what all frames, all views of a frame, and no two views share
    """
    if kind == "exact":
        return np.where(parts >= PERSON, 255, 0).astype(np.uint8)
    make = {"good": _good, "network": _network, "poor": _poor}[kind]
    probability = make(parts, objects, parts.shape[1] / WIDTH, seeds)
    return np.rint(255 * np.clip(probability, 0, 1)).astype(np.uint8)


def _good(parts: np.ndarray, objects, px: float, seeds) -> np.ndarray:
    rng = np.random.default_rng([*seeds, 1])
    shape = parts.shape
    off = rng.uniform(-2.5, 2.5) + 1.8 * _smooth_noise(rng, shape, 5 * px)
    edge = _inside(parts >= PERSON) + px * off
    sure = _sigmoid(edge / (0.9 * px))
    return 0.98 * sure - 0.04 * np.maximum(_smooth_noise(rng, shape, 6 * px), 0) * (2 * sure - 1)


def _network(parts: np.ndarray, objects, px: float, seeds) -> np.ndarray:
    recording, frame, _ = seeds
    always, now = np.random.default_rng([recording, 2]), np.random.default_rng([recording, frame, 2])
    rng = np.random.default_rng([*seeds, 2])
    person = _without(parts, _drawn_limbs(now, parts, 0.15)).astype(np.float32)
    for thing in always.choice(objects, min(2, len(objects)), replace=False) if objects else ():
        likeness = always.uniform(0.25, 0.8) + 0.1 * now.normal()
        person = np.maximum(person, likeness * (parts == thing))
    step = max(6 * px, 1)
    small = (max(int(parts.shape[1] / step), 2), max(int(parts.shape[0] / step), 2))
    coarse = cv2.resize(person, small, interpolation=cv2.INTER_AREA)
    coarse = cv2.GaussianBlur(coarse, (0, 0), 0.8) + 0.08 * _smooth_noise(rng, coarse.shape, 2.5)
    smooth = cv2.resize(coarse, parts.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return _sigmoid((smooth - 0.5 - 0.06 * rng.normal()) * 9)


def _poor(parts: np.ndarray, objects, px: float, seeds) -> np.ndarray:
    rng = np.random.default_rng([*seeds, 3])
    shape = parts.shape
    person = _without(parts, _drawn_limbs(rng, parts, 0.4))
    edge = _inside(person) + 4 * px * _smooth_noise(rng, shape, 8 * px) - 1.5 * px
    belief = _sigmoid(edge / (2 * px))
    spots = np.argwhere(person)
    for y, x in spots[rng.integers(0, len(spots), 4)] if len(spots) else ():
        belief *= 1 - _disc(shape, x, y, rng.uniform(5, 11) * px)
    for _ in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(0, shape[1]), rng.uniform(0, shape[0])
        belief = np.maximum(belief, rng.uniform(0.6, 1) * _disc(shape, x, y, rng.uniform(6, 16) * px))
    return belief + (0.15 - 0.3 * belief) * np.maximum(_smooth_noise(rng, shape, 6 * px), 0)


def _drawn_limbs(rng: np.random.Generator, parts: np.ndarray, chance: float) -> list[int]:
    """Limbs (never the trunk) that go unseen; drawn for all that could be there, so that views agree."""
    people = int(parts.max()) // PERSON
    limbs = [PERSON * figure + limb for figure in range(1, people + 1) for limb in range(4, 14)]
    return [limb for limb in limbs if rng.random() < chance]


def _without(parts: np.ndarray, missing: list[int]) -> np.ndarray:
    return (parts >= PERSON) & ~np.isin(parts, missing)


def _inside(mask: np.ndarray) -> np.ndarray:
    """Signed distance to the mask's edge in px, positive inside; a view without people is far outside."""
    if not mask.any():
        return np.full(mask.shape, -1e3, np.float32)
    inner = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    return inner - cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), max(sigma, 0.5))
    return noise / max(float(noise.std()), 1e-6)


def _disc(shape: tuple[int, ...], x: float, y: float, radius: float) -> np.ndarray:
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    return _sigmoid((radius - np.hypot(u - x, v - y)) / max(0.15 * radius, 0.3))


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -50, 50)))
