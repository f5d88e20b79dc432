"""What every idea is worth: preset `accurate` with one thing switched off at a time, on recordings with truth.

make bench-ablation DATA=folder [MASKS=masks_exact,masks_network] [WRITE=benchmarks/RESULTS.md]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from common import machine, markdown_table, replace_section
from quality import mean, score, with_truth
from seepast.errors import SeepastError
from seepast.evaluate import SHARES, Row
from seepast.options import Options

COLUMNS = ("psnr", "psnr 1", "psnr 2+", "bad1 hid", "bad1 1", "bad1 2+", "bad1 vis", "flag", "lost", "iou out")
SCENE = {
    "all on": {},
    "one level: the whole range at full size": {"multiview.coarsest": 1},
    "only the wanted view at full size": {"multiview.fine_views": False},
    "windows of 1 px": {"multiview.window": 1},
    "one round: the views do not hear each other": {"multiview.rounds": 1},
    "candidates a whole pixel apart": {"range.step": 1},
    "8 paths": {"multiview.paths": 8},
    "matching without colour": {"multiview.colour_cap": 0},
    "nearer candidates hide nothing": {"multiview.vote_hide": 0},
    "what one camera sees alone is doubted (.3)": {"multiview.lone_confidence": 0.3},
    "no planes": {"multiview.planes": False},
    "all cameras' colours count alike": {"multiview.camera_falloff": 0},
    "colours beside masks count in full": {"multiview.edge_weight": 1},
    "any static ray lends its colour": {"multiview.label_tolerance": 16},
}
MASKS = {
    "all on": {},
    "masks as given": {"people.enabled": False},
    "objects are not pooled in depth": {"people.cell_disparity": 1},
    "no local colour label": {"people.local": 0},
    "people's colours say nothing": {"people.colour": 0},
    "the cameras' own P says nothing more": {"people.said": 0},
    "no field: every pixel for itself": {"people.field": 0},
    "outlines not grown by the mixed pixel": {"people.grow": False},
}
GROUPS = {"the scene": SCENE, "the masks": MASKS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a recording with truth/, or a folder of such recordings")
    parser.add_argument("--masks", default="masks_exact,masks_network", help="of `the scene`, then of `the masks`")
    parser.add_argument("--preset", default="accurate")
    parser.add_argument("--write", type=Path, metavar="RESULTS.md", help="replace its section 'ablation'")
    arguments = parser.parse_args()
    kinds = arguments.masks.split(",")
    recordings, words = with_truth(arguments.data), machine()
    parts = []
    for (what, changes), kind in zip(GROUPS.items(), (kinds[0], kinds[-1]), strict=True):
        parts.append(f"### {what.capitalize()}, {kind}\n\n{table(recordings, kind, arguments.preset, changes)}")
        print(f"\n{parts[-1]}\n", flush=True)
    if arguments.write:
        command = f"`make bench-ablation DATA={arguments.data.resolve().name} MASKS={arguments.masks}`"
        replace_section(arguments.write, "ablation", "\n\n".join([f"{command}\n\nOn {words}.", *parts]))
        print(f"written: {arguments.write}")


def table(recordings: list[Path], kind: str, preset: str, changes: dict[str, dict]) -> str:
    """Markdown: mean figures of every change to the preset, alone."""
    options = Options.preset(preset)
    scores = score(recordings, kind, {name: options.updated(change) for name, change in changes.items()}, False)
    return markdown_table(["", *COLUMNS], [[name, *_cells(mean(rows))] for name, rows in scores.rows.items()])


def _cells(row: Row) -> list[str]:
    return [f"{row[column]:.3f}" if column in SHARES else f"{row[column]:.2f}" for column in COLUMNS]


if __name__ == "__main__":
    try:
        main()
    except SeepastError as error:
        raise SystemExit(str(error)) from None
