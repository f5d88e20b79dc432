"""How good the pictures are: every preset on every recording with truth, beside the baselines.

    make bench-quality DATA=folder [PRESETS=paper,...] [MASKS=masks_exact,...]
                       [WRITE=benchmarks/RESULTS.md [SECTION=quality]]

The columns are those of `seepast evaluate` (src/seepast/evaluate.py says what each means).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import yaml

from baselines import BASELINES, Picture, Scene
from common import machine, markdown_table, preset_names, replace_section
from seepast.datasets import Dataset, find_datasets, open_dataset
from seepast.demo import paint_coverage, paint_disparity
from seepast.errors import SeepastError
from seepast.evaluate import COLUMNS, MEAN, SHARES, Row, evaluate, read_truth
from seepast.export.atomic import write_pfm, write_png
from seepast.export.folder import CAMERA_FILE
from seepast.options import Options
from seepast.pipeline import Reconstructor

SHEETS = Path(__file__).parent / "out"
CELL_WIDTH = 220  # px, of one picture in a contact sheet
SHEET_COLUMNS = ("input", "ours", "truth", "|error| x4", "disparity", "coverage, red: none")
LOW_IS_GOOD = ("bad1 hid", "bad1 1", "bad1 2+", "bad1 vis", "lost")

Rows = dict[str, Row]  # scene -> figures


@dataclass
class Scores:
    """All methods on one kind of mask, and the contact-sheet rows of the presets."""

    rows: dict[str, Rows] = field(default_factory=dict)
    sheets: dict[str, list[np.ndarray]] = field(default_factory=dict)


def main() -> None:
    arguments = _arguments()
    recordings = with_truth(arguments.data)
    kinds = arguments.masks or mask_kinds(recordings)
    words = machine()
    parts = []
    for kind in kinds:
        scores = score(recordings, kind, {name: Options.preset(name) for name in arguments.presets})
        parts.append(report(kind, scores, arguments.presets))
        print(f"\n{parts[-1]}\n", flush=True)
        for preset, rows in scores.sheets.items():
            print(f"contact sheet: {write_sheet(f'{arguments.section}_{preset}_{kind}', rows)}")
    if arguments.write:
        command = f"make bench-quality DATA={arguments.data.resolve().name} PRESETS={','.join(arguments.presets)}"
        head = f"`{command} MASKS={','.join(kinds)}`\n\nOn {words}."
        replace_section(arguments.write, arguments.section, "\n\n".join([head, *parts]))
        print(f"written: {arguments.write}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording with truth/, or a folder of such recordings")
    parser.add_argument("--presets", type=preset_names, default="", help="comma-separated; default: all")
    parser.add_argument("--masks", type=lambda text: [m for m in text.split(",") if m], help="default: every masks*")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="put the tables into a section of this file")
    parser.add_argument("--section", default="quality", help="which one: <!-- quality:begin --> .. (default: quality)")
    return parser.parse_args()


def with_truth(data: Path) -> list[Path]:
    found = [path for path in find_datasets(data) if (path / "truth" / "background").is_dir()]
    if not found:
        raise SystemExit(f"{data}: holds no recording with truth/; `seepast synth` makes some")
    return found


def mask_kinds(recordings: Iterable[Path]) -> list[str]:
    """Names of the mask folders that any recording has."""
    return sorted({p.name for path in recordings for p in path.glob("masks*") if p.is_dir()})


def score(recordings: list[Path], kind: str, methods: Mapping[str, Options], baselines: bool = True) -> Scores:
    """Every method, and every baseline, on every recording that has masks of this kind."""
    scores = Scores()
    for path in recordings:
        if (path / kind).is_dir():
            print(f"{kind}: {path.name}", flush=True)
            with tempfile.TemporaryDirectory() as scratch:
                _score_recording(path, kind, methods, BASELINES if baselines else {}, Path(scratch), scores)
    if not scores.rows:
        raise SystemExit(f"no recording has masks called {kind}")
    return scores


def _score_recording(
    path: Path, kind: str, methods: Mapping[str, Options], baselines: Mapping, scratch: Path, scores: Scores
) -> None:
    dataset = open_dataset(path, masks=kind)
    reference = truth_camera(path)
    runs = {name: Reconstructor(dataset.rig, options=o, reference=reference) for name, o in methods.items()}
    for stamp in dataset.stamps:
        frame = dataset.frame(stamp)
        scene = _scene(dataset, stamp, reference, next(iter(runs.values())))
        for name, run in runs.items():
            result = run(frame.images, frame.masks)
            picture = Picture(result.background, result.disparity, result.coverage, result.masks)
            _write(scratch / name, stamp, picture, dataset)
            if stamp == dataset.stamps[0]:
                scores.sheets.setdefault(name, []).append(sheet_row(path.name, scene, picture))
        for name, (baseline, _) in baselines.items():
            _write(scratch / name, stamp, baseline(scene), dataset)
    for name in (*runs, *baselines):
        rows = evaluate(path, scratch / name, kind)
        del rows[MEAN]
        one = len(rows) == 1
        named = {path.name if one else f"{path.name}/{stamp}": _meaningful(name, row) for stamp, row in rows.items()}
        scores.rows.setdefault(name, {}).update(named)


def truth_camera(path: Path) -> str:
    """The camera in whose view the truth of a recording lives."""
    file = path / "truth" / CAMERA_FILE
    return str(yaml.safe_load(file.read_text(encoding="utf-8"))["camera"]) if file.is_file() else "cam0"


def _scene(dataset: Dataset, stamp: str, reference: str, run: Reconstructor) -> Scene:
    frame, rectification = dataset.frame(stamp), run.rectification
    assert frame.masks is not None
    return Scene(
        views=[rectification.image(k, image) for k, image in enumerate(frame.images)],
        dynamic=np.stack([rectification.dynamic(k, mask) for k, mask in enumerate(frame.masks)]),
        geometry=rectification.geometry,
        truth=read_truth(dataset.path, stamp, reference),
        masks=frame.masks,
    )


def _write(out: Path, stamp: str, picture: Picture, dataset: Dataset) -> None:
    """The part of FORMAT.md's output that `evaluate` reads."""
    write_png(out / "background" / f"{stamp}.png", picture.background)
    write_png(out / "coverage" / f"{stamp}.png", picture.coverage)
    write_pfm(out / "disparity" / f"{stamp}.pfm", picture.disparity)
    for camera, mask in zip(dataset.rig.cameras, picture.masks, strict=True):
        write_png(out / "masks" / camera.name / f"{stamp}.png", mask)


def _meaningful(method: str, row: Row) -> Row:
    """NaN in the columns that say nothing about a baseline."""
    columns = BASELINES[method][1] if method in BASELINES else COLUMNS
    return {column: value if column in columns else float("nan") for column, value in row.items()}


def mean(rows: Rows) -> Row:
    """Mean of every column over the scenes, NaN left out."""
    values = {c: [row[c] for row in rows.values() if not np.isnan(row[c])] for c in COLUMNS}
    return {column: float(np.mean(known)) if known else float("nan") for column, known in values.items()}


def worst(rows: Rows, column: str) -> str:
    """The scene of the worst figure of a column."""
    known = {scene: row[column] for scene, row in rows.items() if not np.isnan(row[column])}
    if not known:
        return "-"
    pick = max if column in LOW_IS_GOOD else min
    return pick(known, key=known.__getitem__)


def report(kind: str, scores: Scores, presets: list[str]) -> str:
    """Markdown: means, worst scenes, then scene by scene."""
    means = [[method, *_cells(mean(rows))] for method, rows in scores.rows.items()]
    parts = [f"### {kind}: means of {len(scores.rows[presets[0]])} frames", markdown_table(["", *COLUMNS], means)]
    bad = [[c, *(_worst_cell(scores.rows[preset], c) for preset in presets)] for c in COLUMNS]
    parts += ["Worst scenes:", markdown_table(["", *presets], bad)]
    parts.append(f"<details><summary>{kind}, scene by scene</summary>")
    for preset in presets:
        parts.append(
            markdown_table([preset, *COLUMNS], [[name, *_cells(row)] for name, row in scores.rows[preset].items()])
        )
    psnr = [
        [scene, *(_cell("psnr", rows[scene]["psnr"]) for rows in scores.rows.values())]
        for scene in scores.rows[presets[0]]
    ]
    parts += [markdown_table(["psnr", *scores.rows], psnr), "</details>"]
    return "\n\n".join(parts)


def _worst_cell(rows: Rows, column: str) -> str:
    scene = worst(rows, column)
    return scene if scene == "-" else f"{scene} ({_cell(column, rows[scene][column])})"


def _cells(row: Row) -> list[str]:
    return [_cell(column, row[column]) for column in COLUMNS]


def _cell(column: str, value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.3f}" if column in SHARES else f"{value:.2f}"


def sheet_row(name: str, scene: Scene, picture: Picture) -> np.ndarray:
    """uint8 [h, 6 * CELL_WIDTH, 3]: the pictures of SHEET_COLUMNS side by side."""
    truth = scene.truth.background
    error = np.minimum(4 * cv2.absdiff(picture.background, truth).astype(np.uint16), 255).astype(np.uint8)
    colour = [_colour(image) for image in (scene.reference, picture.background, truth, error)]
    painted = [paint_disparity(picture.disparity), paint_coverage(picture.coverage, scene.geometry.cameras)]
    height = round(CELL_WIDTH * truth.shape[0] / truth.shape[1])
    cells = [cv2.resize(cell, (CELL_WIDTH, height), interpolation=cv2.INTER_AREA) for cell in (*colour, *painted)]
    return _written(np.hstack(cells), name, (3, height - 5))


def _colour(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def _written(image: np.ndarray, text: str, at: tuple[int, int]) -> np.ndarray:
    put = partial(cv2.putText, text=text, org=at, fontFace=cv2.FONT_HERSHEY_SIMPLEX, fontScale=0.4)
    return put(put(image, color=(0, 0, 0), thickness=3), color=(255, 255, 255), thickness=1)


def write_sheet(name: str, rows: list[np.ndarray]) -> Path:
    """One PNG of all scenes' rows under the names of the columns; returns its path."""
    head = np.zeros((18, rows[0].shape[1], 3), np.uint8)
    for i, title in enumerate(SHEET_COLUMNS):
        head = _written(head, title, (i * CELL_WIDTH + 4, 13))
    path = SHEETS / f"{name}.png"
    write_png(path, np.vstack([head, *rows]))
    return path


if __name__ == "__main__":
    try:
        main()
    except SeepastError as error:
        raise SystemExit(str(error)) from None
