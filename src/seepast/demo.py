"""The demonstration: the main job on a small sample inside the package, and a picture of what it did."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .datasets import open_dataset
from .datasets.png import read_png8
from .export.atomic import write_png
from .options import DEFAULT_PRESET, Options
from .sequence import Settings, Summary, process

SAMPLE = Path(__file__).parent / "demo_data"
PICTURE = "before_after.png"
_GAP, _LABEL = 6, 26  # px
_INK = (40, 40, 40)
_UNSEEN = (60, 60, 220)  # BGR of what no camera saw


@dataclass(frozen=True)
class Demo:
    """What the demonstration showed.

    picture       path of the before/after picture
    hidden_share  how much of the reference image a person hides
    seen_share    how much of that some other camera saw
    psnr          dB of that against the truth
    """

    picture: Path
    summary: Summary
    hidden_share: float
    seen_share: float
    psnr: float


def run_demo(out: str | Path, backend: str = "auto") -> Demo:
    """Reconstruct the sample into `out` and draw before and after beside each other."""
    out = Path(out)
    dataset = open_dataset(SAMPLE)
    settings = Settings(Options.preset(DEFAULT_PRESET), backend=backend, overwrite=True)
    summary = process(dataset, out / "sample", settings)
    stamp = dataset.stamps[0]
    frame = dataset.frame(stamp)
    assert frame.masks is not None
    before, mask = frame.images[0], frame.masks[0]
    after = read_png8(out / "sample" / "background" / f"{stamp}.png")
    coverage = read_png8(out / "sample" / "coverage" / f"{stamp}.png")
    truth = read_png8(SAMPLE / "truth" / "background" / f"{stamp}.png")
    hidden = read_png8(SAMPLE / "truth" / "hidden" / f"{stamp}.png") > 127
    pfm = str(out / "sample" / "disparity" / f"{stamp}.pfm")
    disparity = np.asarray(cv2.imread(pfm, cv2.IMREAD_UNCHANGED), np.float32)
    panels = {
        "before: what cam0 sees": before,
        "the static scene, from one instant": after,
        "truth": truth,
        "what the masks call dynamic": _tinted(before, mask > 127),
        "disparity of the static scene": paint_disparity(disparity),
        "coverage: cameras per pixel, red = none": paint_coverage(coverage, len(dataset.rig.cameras)),
    }
    write_png(out / PICTURE, contact_sheet(panels, columns=3))
    seen = hidden & (coverage > 0)
    error = np.mean((after[seen].astype(float) - truth[seen]) ** 2) if seen.any() else np.inf
    psnr = float(10 * np.log10(255**2 / max(error, 1e-9)))
    seen_share = float(seen.sum() / max(hidden.sum(), 1))
    return Demo(out / PICTURE, summary, float(hidden.mean()), seen_share, psnr)


def contact_sheet(panels: dict[str, np.ndarray], columns: int) -> np.ndarray:
    """uint8 [*, *, 3] BGR: images of one size in rows, each under its label."""
    labelled = [_labelled(label, image) for label, image in panels.items()]
    labelled += [np.full_like(labelled[0], 255)] * (-len(labelled) % columns)
    rows = [_joined(labelled[i : i + columns], axis=1) for i in range(0, len(labelled), columns)]
    return np.pad(_joined(rows, axis=0), ((_GAP, _GAP), (_GAP, _GAP), (0, 0)), constant_values=255)


def paint_disparity(disparity: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3]: far is blue, near is red, unknown (0) black."""
    known = disparity > 0
    if not known.any():
        return np.zeros((*disparity.shape, 3), np.uint8)
    low, high = np.percentile(disparity[known], (1, 99))
    scaled = np.clip((disparity - low) / max(high - low, 1e-6), 0, 1)
    painted = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    painted[~known] = 0
    return painted


def paint_coverage(coverage: np.ndarray, cameras: int) -> np.ndarray:
    """uint8 [H, W, 3]: the lighter, the more cameras; red where none saw the pixel."""
    grey = (60 + 195 * (np.minimum(coverage, cameras) / cameras)).astype(np.uint8)
    painted = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    painted[coverage == 0] = _UNSEEN
    return painted


def _tinted(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    tinted = image.copy()
    tinted[mask] = (0.4 * image[mask] + 0.6 * np.array(_UNSEEN)).astype(np.uint8)
    return tinted


def _labelled(label: str, image: np.ndarray) -> np.ndarray:
    strip = np.full((_LABEL, image.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, label, (2, _LABEL - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    return np.vstack([strip, image])


def _joined(images: list[np.ndarray], axis: int) -> np.ndarray:
    shape = list(images[0].shape)
    shape[axis] = _GAP
    gap = np.full(shape, 255, np.uint8)
    parts = [part for image in images for part in (gap, image)][1:]
    return np.concatenate(parts, axis=axis)
