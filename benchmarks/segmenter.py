"""A segmenter beside masks in files: how far apart, how right, how long.

    .venv/bin/python benchmarks/segmenter.py DATA onnx:net.onnx[:preset] [--masks masks_network] [--classes person]

off: mean of abs difference, in 255ths; IoU at P >= 0.5, with those files and with truth/masks; ms: median per instant.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from common import machine, markdown_table
from seepast.datasets import Frame, find_datasets, open_dataset
from seepast.segment import Segmenter, open_segmenter


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("segmenter")
    parser.add_argument("--masks", default="masks")
    parser.add_argument("--classes", type=lambda text: text.split(","))
    arguments = parser.parse_args()
    segmenter = open_segmenter(arguments.segmenter, arguments.classes)
    rows = {}
    for path in find_datasets(arguments.data):
        frames = [
            compare(frame, segmenter, path / "truth" / "masks") for frame in open_dataset(path, masks=arguments.masks)
        ]
        rows[path.name] = np.mean(frames, axis=0)
    rows["mean"] = np.mean(list(rows.values()), axis=0)
    cells = [[name, *(f"{v:.{d}f}" for v, d in zip(row, (3, 4, 4, 0), strict=True))] for name, row in rows.items()]
    print(markdown_table(("recording", "off", f"IoU {arguments.masks}", "IoU truth", "ms"), cells))
    print(f"\n{machine()}; {dict(segmenter.describe())}")


def compare(frame: Frame, segmenter: Segmenter, truth: Path) -> tuple[float, float, float, float]:
    """off, IoU with the frame's own masks, IoU with the truth (NaN where there is none), milliseconds."""
    assert frame.masks is not None
    segmenter(frame.images)  # the first run of a network is slower
    start = time.perf_counter()
    masks = [np.asarray(mask) for mask in segmenter(frame.images)]
    ms = 1e3 * (time.perf_counter() - start)
    off = np.mean([np.abs(a.astype(int) - b).mean() for a, b in zip(masks, frame.masks, strict=True)])
    exact = [cv2.imread(str(truth / f"cam{k}" / f"{frame.stamp}.png"), cv2.IMREAD_GRAYSCALE) for k in range(len(masks))]
    return float(off), _iou(masks, frame.masks), float("nan") if exact[0] is None else _iou(masks, exact), ms


def _iou(masks, others) -> float:
    pairs = [(a >= 128, b >= 128) for a, b in zip(masks, others, strict=True)]
    return float(np.mean([(a & b).sum() / max((a | b).sum(), 1) for a, b in pairs]))


if __name__ == "__main__":
    main()
