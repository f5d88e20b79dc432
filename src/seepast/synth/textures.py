"""Procedural textures: tileable pictures with detail at every scale, kept as a pyramid for anti-aliasing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, eq=False)
class Texture:
    """A square tileable picture: levels uint8[n, n, 3] BGR, each half the one before; texel in metres."""

    levels: tuple[np.ndarray, ...]
    texel: float


def texture(picture: np.ndarray, texel: float) -> Texture:
    """A texture of a picture float[n, n, 3], 0..255 BGR, n a power of two, texels `texel` metres wide."""
    levels = [np.clip(picture, 0, 255).astype(np.float32)]
    while levels[-1].shape[0] > 8:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return Texture(tuple(np.rint(level).astype(np.uint8) for level in levels), texel)


def fractal(rng: np.random.Generator, size: int, exponent: float = 1.0, stretch: float = 1.0) -> np.ndarray:
    """Tileable noise float32[size, size] of amplitude spectrum 1/f^exponent, mean 0, deviation 1.

    `stretch` > 1 draws it out along x (wood grain).
    """
    fy = np.fft.fftfreq(size)[:, None] * size
    fx = np.fft.rfftfreq(size)[None, :] * size * stretch
    frequency = np.hypot(fx, fy)
    frequency[0, 0] = 1
    amplitude = 1 / np.maximum(frequency, 2) ** exponent
    amplitude[0, 0] = 0
    spectrum = amplitude * np.exp(2j * np.pi * rng.random(amplitude.shape))
    noise = np.fft.irfft2(spectrum, s=(size, size))
    return (noise / noise.std()).astype(np.float32)


def _tinted(color, *layers: np.ndarray) -> np.ndarray:
    """`color` (3,) BGR plus grey layers [n, n] or coloured ones [n, n, 3], float32[n, n, 3]."""
    picture = np.zeros((*layers[0].shape[:2], 3), np.float32) + np.asarray(color, np.float32)
    for layer in layers:
        picture = picture + (layer if layer.ndim == 3 else layer[..., None])
    return picture


def _detail(rng: np.random.Generator, size: int, amount: float) -> np.ndarray:
    """Coloured broadband detail: strong at low, fair at high frequencies, and a few dark specks."""
    grey = 0.75 * fractal(rng, size, 1.1) + 0.65 * fractal(rng, size, 0.45)
    hue = np.stack([fractal(rng, size, 1.2) for _ in range(3)], -1)
    return amount * (grey[..., None] + 0.22 * hue)


def plain(rng: np.random.Generator, size: int, color) -> np.ndarray:
    """Painted plaster: nearly nothing to match on."""
    return _tinted(color, 2.5 * fractal(rng, size, 1.5), 0.6 * fractal(rng, size, 0.3))


def rough(rng: np.random.Generator, size: int, color) -> np.ndarray:
    """Stone, cork, carpet: broadband detail."""
    return _tinted(color, _detail(rng, size, 22))


def wallpaper(rng: np.random.Generator, size: int, color) -> np.ndarray:
    """Flowers strewn over paper: no two alike, none in a row."""
    picture = _tinted(color, _detail(rng, size, 9)).astype(np.float32)
    for _ in range(700):
        x, y = (int(v) for v in rng.integers(0, size, 2))
        radius = max(int(size * rng.uniform(0.003, 0.012)), 1)
        ink = tuple(float(v) for v in np.asarray(color) * rng.uniform(0.35, 1.1) * rng.uniform(0.6, 1.1, 3))
        petals = int(rng.integers(2, 7))
        for turn in rng.uniform(0, 2 * np.pi, petals):
            at = (int(x + radius * np.cos(turn)), int(y + radius * np.sin(turn)))
            for dx in (-size, 0, size):
                for dy in (-size, 0, size):
                    cv2.circle(picture, (at[0] + dx, at[1] + dy), radius, ink, -1, cv2.LINE_AA)
    return picture


def planks(rng: np.random.Generator, size: int, color, count: int = 16) -> np.ndarray:
    """Wooden boards along x, each of its own shade, with grain and joints."""
    grain = 16 * fractal(rng, size, 0.8, stretch=8) + 5 * fractal(rng, size, 0.4)
    picture = _tinted(color, grain)
    width = size // count
    for row in range(count):
        board = picture[row * width : (row + 1) * width]
        joint = int(rng.integers(0, size))
        for part in (board[:, :joint], board[:, joint:]):
            part += rng.normal(0, 14)
        board[:2] *= 0.45
        board[:, joint : joint + 2] *= 0.5
    return picture


def bricks(rng: np.random.Generator, size: int, color, rows: int = 32) -> np.ndarray:
    """Bricks in running bond, each of its own shade, with pale mortar."""
    picture = _tinted(color, _detail(rng, size, 9))
    height, width = size // rows, 2 * size // rows
    for row in range(rows):
        for column in range(size // width):
            x0 = column * width + (row % 2) * width // 2
            columns = np.arange(x0, x0 + width) % size
            picture[row * height : (row + 1) * height, columns] += rng.normal(0, 20)
            picture[row * height : (row + 1) * height, columns[:2]] = 150
        picture[row * height : row * height + 2] = 150
    return picture + 4 * fractal(rng, size, 0.5)[..., None]


def poster(rng: np.random.Generator, size: int) -> np.ndarray:
    """A loud picture of overlapping shapes and lines."""
    picture = np.zeros((size, size, 3), np.float32) + rng.uniform(60, 220, 3).astype(np.float32)
    for _ in range(60):
        ink = tuple(float(v) for v in 0.55 * rng.uniform(10, 245, 3) + 0.45 * rng.uniform(10, 245))
        a, b = (tuple(int(v) for v in rng.integers(0, size, 2)) for _ in range(2))
        kind = int(rng.integers(3))
        if kind == 0:
            cv2.circle(picture, a, int(rng.integers(size // 40, size // 8)), ink, -1, cv2.LINE_AA)
        elif kind == 1:
            reach = int(rng.integers(size // 30, size // 6))
            cv2.rectangle(picture, a, (a[0] + reach, a[1] + reach // 2), ink, -1)
        else:
            cv2.line(picture, a, b, ink, int(rng.integers(1, size // 60 + 2)), cv2.LINE_AA)
    return picture + _detail(rng, size, 7)


def cloth(rng: np.random.Generator, size: int, color, pattern: str) -> np.ndarray:
    """Weave with folds: 'plain', 'stripes' or 'checks'."""
    weave = 7 * fractal(rng, size, 0.3) + 9 * fractal(rng, size, 1.3)
    picture = _tinted(color, weave)
    band = (np.arange(size) * 8 // size) % 2 * 1.0
    ink = rng.uniform(-70, 70, 3)
    if pattern in ("stripes", "checks"):
        picture += band[:, None, None] * ink
    if pattern == "checks":
        picture += band[None, :, None] * ink[::-1]
    return picture
