"""Is the confidence right? Of the pixels with confidence c, what share is within 1 px of the truth?

    make bench-calibration DATA=folder [PRESETS=paper,...] [MASKS=masks_exact,...] [WRITE=benchmarks/RESULTS.md]
    python benchmarks/calibration.py DATA --fit FOLDER ...    the numbers of src/seepast/confidence.py anew

All that is needed of a frame is how often each of the 256 evidence bytes occurs and how often it was right, so counts
are kept with --keep and fitted or tabled again in a moment. Recordings of FITTED_ON are left out of the tables.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from unittest.mock import patch

import numpy as np

from common import machine, markdown_table, preset_names, replace_section
from quality import mask_kinds, truth_camera, with_truth
from seepast import backends, confidence
from seepast.confidence import Calibration
from seepast.datasets import open_dataset
from seepast.errors import SeepastError
from seepast.evaluate import Truth, read_truth
from seepast.export.atomic import write_json
from seepast.options import Options
from seepast.pipeline import Reconstructor

# Recordings that the numbers in confidence.py were fitted on, left out of the tables: half of the real scenes, and what
# `seepast synth --masks all` made with the calibration of a five-camera rig: seed1, seed2, authors_near11 (seed 11, two
# frames) with --figure-depth 1.5 4 --background-depth 4 12, authors_far12 with --seed 12 --figures 3, two frames.
FITTED_ON = ("2001_venus", "2006_Aloe", "2006_Bowling1", "2006_Flowerpots", "2006_Midd1", "2006_Rocks1",
             "seed1", "seed2", "authors_near11", "authors_far12")  # fmt: skip
BINS = 10
GUESSES = 8  # the lowest evidence bytes: no camera sees the pixel, confidence 0
REGIONS = ("visible", "hidden")  # by a person, from the reference camera

Counts = np.ndarray  # int64 [2 regions, 2 (pixels, right ones), 256 evidence bytes]
Kept = dict[str, dict[str, Counts]]  # "preset/masks" -> "recording/stamp" -> counts


def main() -> None:
    arguments = _arguments()
    kept = _read(arguments.keep)
    recordings = with_truth(arguments.data)
    fitted_on = FITTED_ON
    training = [path for folder in arguments.fit for path in with_truth(folder)]
    if training:
        fitted_on = tuple(path.name for path in training)
    for preset in arguments.presets:
        for kind in arguments.masks or mask_kinds(recordings):
            collect([*training, *recordings], kind, preset, kept, arguments.keep)
    asked = tuple(path.name for path in recordings)
    parts = [report(preset, kept, fitted_on, asked, bool(training)) for preset in arguments.presets]
    print("\n\n".join(parts))
    if arguments.write:
        command = f"make bench-calibration DATA={arguments.data.resolve().name} PRESETS={','.join(arguments.presets)}"
        replace_section(arguments.write, arguments.section, "\n\n".join([f"`{command}`\n\nOn {machine()}.", *parts]))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording with truth/, or a folder of such recordings")
    parser.add_argument("--presets", type=preset_names, default="", help="comma-separated; default: all")
    parser.add_argument("--masks", type=lambda text: [m for m in text.split(",") if m], help="default: every masks*")
    parser.add_argument("--fit", type=Path, nargs="+", default=[], metavar="FOLDER", help="recordings to fit on")
    parser.add_argument("--keep", type=Path, metavar="COUNTS.json", help="counts are read from there and added")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="put the tables into a section of this file")
    parser.add_argument("--section", default="calibration", help="<!-- calibration:begin --> .. (default: calibration)")
    return parser.parse_args()


# ------------------------------------------------------------------------------------------------- counting


def collect(recordings: Iterable[Path], kind: str, preset: str, kept: Kept, file: Path | None) -> None:
    """Counts of every frame of the recordings into `kept`, those that are not there yet."""
    mine = kept.setdefault(f"{preset}/{kind}", {})
    for path in recordings:
        if not (path / kind).is_dir() or any(name.startswith(f"{path.name}/") for name in mine):
            continue
        dataset, reference = open_dataset(path, masks=kind), truth_camera(path)
        run = Reconstructor(dataset.rig, options=Options.preset(preset), reference=reference)
        for stamp in dataset.stamps:
            frame = dataset.frame(stamp)
            truth = read_truth(path, stamp, reference)
            mine[f"{path.name}/{stamp}"] = counted(*evidence_and_disparity(run, frame.images, frame.masks), truth)
        if file:
            write_json(file, {key: {n: c.tolist() for n, c in of.items()} for key, of in kept.items()})


def _read(file: Path | None) -> Kept:
    if not (file and file.is_file()):
        return {}
    stored = json.loads(file.read_text(encoding="utf-8"))
    return {key: {name: np.array(counts) for name, counts in of.items()} for key, of in stored.items()}


def evidence_and_disparity(run: Reconstructor, images, masks) -> tuple[np.ndarray, np.ndarray]:
    """Evidence bytes uint8 [H, W] and disparity float32 [H, W] px of one instant."""
    if not run.options.multiview.enabled:
        result = run(images, masks)
        return confidence.of_labels(result.disparity, result.labels, run.reference), result.disparity
    stages = backends.multiview(run.backend)
    with patch.object(stages, "labels", wraps=stages.labels) as labels:
        result = run(images, masks)
    d, _, static, geometry, *_ = labels.call_args.args
    shown, _, close = stages.labels(*labels.call_args.args)
    return stages.evidence(d, static[geometry.reference], close, shown), result.disparity


def counted(evidence: np.ndarray, disparity: np.ndarray, truth: Truth) -> Counts:
    right = np.abs(disparity.astype(float) - truth.disparity) <= 1
    regions = (truth.visible, truth.hidden)
    return np.array([[np.bincount(evidence[at & ok], minlength=256) for ok in (True, right)] for at in regions])


# ------------------------------------------------------------------------------------------------- fitting


def fitted(scenes: list[Counts]) -> Calibration:
    """The Calibration of the greatest likelihood, every scene with equal weight; steps of P by close and loose views
    and by flatness are never negative. A little prior of 20 pixels in 100,000 keeps rare bytes near 1/2."""
    from scipy.optimize import minimize

    totals = [counts.sum(0) for counts in scenes]
    shares = sum(t[:, GUESSES:] * (1e5 / max(t[0, GUESSES:].sum(), 1)) for t in totals) / len(totals)
    pixels, right = shares
    design = _design()[GUESSES:]

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        odds = design @ w
        value = (pixels * np.logaddexp(0, odds) - right * odds).sum() + 10 * (w**2).sum() / len(w)
        return value, design.T @ (pixels / (1 + np.exp(-odds)) - right) + 20 * w / len(w)

    bounds = [(None, None)] * 2 + [(0, None)] * (design.shape[1] - 2)
    w = minimize(loss, np.zeros(design.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x
    odds = (_design() @ w).reshape(2, 4, 4, 8)
    flat = odds[0, 0, 0] - odds[0, 0, 0, 0]
    return Calibration(_nested(odds[..., 0]), _nested(flat))


def _design() -> np.ndarray:
    """float64 [256, 21]: a base with and without own view, steps up with close and loose views for each, and with
    flatness."""
    own, close, loose, flat = (a.ravel() for a in np.mgrid[:2, :4, :4, :8])
    columns = [own == 0, own == 1]
    for o in (0, 1):
        columns += [(own == o) & (count >= n) for count in (close, loose) for n in (1, 2, 3)]
    columns += [flat >= n for n in range(1, 8)]
    return np.stack(columns, axis=1).astype(np.float64)


def _nested(values: np.ndarray):
    """As tuples of tuples of numbers with two decimals."""
    if values.ndim == 0:
        return round(float(values), 2) + 0.0
    return tuple(_nested(part) for part in values)


def cross_validated(frames: dict[str, Counts]) -> list[tuple[Counts, Calibration]]:
    """Every recording's frames with what was fitted on the other recordings."""
    scenes = sorted({name.partition("/")[0] for name in frames})
    out = []
    for scene in scenes:
        others = [c for name, c in frames.items() if name.partition("/")[0] != scene]
        calibration = fitted(others)
        out += [(c, calibration) for name, c in frames.items() if name.partition("/")[0] == scene]
    return out


# ------------------------------------------------------------------------------------------------- reporting

FIGURES = ("frames", "mean c", "right", "ECE", "AUC", "AUSE", "unseen", "of them right")
Pairs = list[tuple[Counts, Calibration]]


def report(preset: str, kept: Kept, fitted_on: tuple[str, ...], asked: tuple[str, ...], fit: bool) -> str:
    """Markdown: the reliability of a preset for every kind of masks, on the recordings `asked` for that it was not
    fitted on; with `fit`, the new numbers first."""
    kinds = {key.partition("/")[2]: frames for key, frames in kept.items() if key.partition("/")[0] == preset}
    calibration = confidence.calibration(Options.preset(preset))
    parts = [f"### {preset}: confidence against truth"]
    if fit:
        known = {f"{name}/{kind}": c for kind, of in kinds.items() for name, c in of.items() if _is(name, fitted_on)}
        calibration = fitted(list(known.values()))
        checked = zip(FIGURES, figures(cross_validated(known)), strict=True)
        parts += [f"```python\n{calibration}\n```"]
        parts += ["Cross-validated by scene: " + ", ".join(f"{name} {value}" for name, value in checked)]
    others = {
        kind: {n: c for n, c in of.items() if _is(n, asked) and not _is(n, fitted_on)} for kind, of in kinds.items()
    }
    return "\n\n".join([*parts, *tables({kind: of for kind, of in others.items() if of}, calibration)])


def _is(frame: str, recordings: tuple[str, ...]) -> bool:
    return frame.partition("/")[0] in recordings


def tables(kinds: dict[str, dict[str, Counts]], calibration: Calibration) -> list[str]:
    """Markdown: figures by masks and region, reliability by masks, figures scene by scene."""
    if not kinds:
        return ["No recording is left that the numbers were not fitted on."]
    summary, scenes, columns = [], [], {}
    for kind, frames in kinds.items():
        pairs = [(counts, calibration) for counts in frames.values()]
        summary.append([kind, *figures(pairs)])
        for i, region in enumerate(REGIONS):
            summary.append([f"{kind}, {region}", *figures([(counts[[i]], calibration) for counts, _ in pairs])])
        scenes += [[f"{kind}: {name}", *figures([(counts, calibration)])] for name, counts in sorted(frames.items())]
        columns[kind] = reliability(pairs)
    tenths = [f"{i / BINS:.1f} .. {(i + 1) / BINS:.1f}" for i in range(BINS)]
    rows = [[tenth, *cells] for tenth, *cells in zip(tenths, *columns.values(), strict=True)]
    return [
        markdown_table(["", *FIGURES], summary),
        "Mean confidence / share of right pixels (pixels) in every tenth of confidence:",
        markdown_table(["confidence", *columns], rows),
        "<details><summary>scene by scene</summary>",
        markdown_table(["", *FIGURES], scenes),
        "</details>",
    ]


def figures(pairs: Pairs) -> list[str]:
    """FIGURES of all pixels together: ECE as by `expected_error`, AUC that a right pixel has a higher confidence than a
    wrong one, AUSE the area between the sparsification curve and the best possible one."""
    p, pixels, right = _sorted(pairs)
    unseen = sum(c[:, :, :GUESSES].sum((0, 2)) for c, _ in pairs)
    total = pixels.sum()
    return [
        str(len(pairs)),
        f"{(p * pixels).sum() / total:.3f}",
        f"{right.sum() / total:.3f}",
        f"{expected_error(p, pixels, right):.3f}",
        f"{area_under_curve(pixels, right):.3f}",
        f"{sparsification_error(pixels, right):.3f}",
        f"{100 * unseen[0] / (total + unseen[0]):.2f} %",
        f"{100 * unseen[1] / max(unseen[0], 1):.0f} %",
    ]


def _sorted(pairs: Pairs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Confidence, pixels and right ones of everything seen, least confidence first."""
    seen = [np.stack([calibration.table, *counts.sum(0)])[:, GUESSES:] for counts, calibration in pairs]
    p, pixels, right = np.concatenate(seen, axis=1)
    order = np.argsort(p, kind="stable")
    return p[order], pixels[order], right[order]


def expected_error(p: np.ndarray, pixels: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error: mean over pixels of |mean c - share of right ones| of their tenth."""
    tenths = [np.bincount(_tenth(p), weights, BINS) for weights in (p * pixels, right)]
    return float(np.abs(tenths[0] - tenths[1]).sum() / pixels.sum())


def area_under_curve(pixels: np.ndarray, right: np.ndarray) -> float:
    """P(a right pixel stands after a wrong one), rows of equal confidence counted apart in their order."""
    wrong = pixels - right
    before = np.cumsum(wrong) - wrong / 2
    return float((right * before).sum() / max(right.sum() * wrong.sum(), 1))


def sparsification_error(pixels: np.ndarray, right: np.ndarray) -> float:
    """Mean, over how much is thrown away, of the share of wrong pixels left, least sure thrown away first, above that
    of an oracle that throws wrong ones away first."""
    total, wrong = pixels.sum(), (pixels - right).sum()
    thrown = np.linspace(0, 0.99, 100)
    at = np.concatenate([[0], np.cumsum(pixels)]) / total
    gone = np.concatenate([[0], np.cumsum(pixels - right)])
    left = (wrong - np.interp(thrown, at, gone)) / (total * (1 - thrown))
    best = np.maximum(wrong - thrown * total, 0) / (total * (1 - thrown))
    return float((left - best).mean())


def _tenth(p: np.ndarray) -> np.ndarray:
    return np.minimum((BINS * p).astype(int), BINS - 1)


def reliability(pairs: Pairs) -> list[str]:
    """Of every tenth of confidence: "mean confidence / share of right pixels (pixels)"."""
    p, pixels, right = _sorted(pairs)
    cells = []
    for i in range(BINS):
        of = _tenth(p) == i
        n = pixels[of].sum()
        cells.append(f"{(p * pixels)[of].sum() / n:.3f} / {right[of].sum() / n:.3f} ({n:.0f})" if n else "-")
    return cells


if __name__ == "__main__":
    try:
        main()
    except SeepastError as error:
        raise SystemExit(str(error)) from None
