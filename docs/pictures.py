"""The pictures of "How it works", made by the code itself from the sample inside the package.

python docs/pictures.py FOLDER
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import seepast
from seepast import backends, multiview, pipeline
from seepast.backends import reference as readable
from seepast.candidates import EIGHTHS
from seepast.datasets import open_dataset
from seepast.demo import SAMPLE, contact_sheet, paint_coverage, paint_disparity
from seepast.epipolar import ROW_HEIGHT, draw, epipolar_image
from seepast.export.atomic import write_png
from seepast.focal import refocus_at
from seepast.frames import Frame, rectified_frame
from seepast.rectify import rectify

SHOWN = ("cam0", "cam2", "cam4")
EPI_ROW = 135


@dataclass(frozen=True, eq=False)
class Sample:
    """The one instant that all pictures are of."""

    rig: seepast.Rig
    images: Sequence[np.ndarray]
    masks: Sequence[np.ndarray]

    @staticmethod
    def read() -> Sample:
        recording = open_dataset(SAMPLE)
        frame = recording.frame(recording.stamps[0])
        assert frame.masks is not None
        return Sample(recording.rig, frame.images, frame.masks)

    @property
    def names(self) -> list[str]:
        return [camera.name for camera in self.rig.cameras]

    def rectified(self) -> Frame:
        return rectified_frame(rectify(self.rig, 0), self.images, self.masks)


@functools.cache
def static(sample: Sample, name: str) -> seepast.Result:
    """The static scene as camera `name` sees it."""
    return seepast.reconstruct(sample.images, sample.masks, sample.rig, reference=name)


class Kept:
    """A backend module that also keeps what some of its stage functions return: `results[name]`, a list."""

    def __init__(self, module: Any, *names: str):
        self._module, self.results = module, {name: [] for name in names}

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._module, name)
        if name not in self.results:
            return value

        def keeping(*arguments: Any, **named: Any) -> Any:
            result = value(*arguments, **named)
            self.results[name].append(result)
            return result

        return keeping


def make(folder: Path) -> list[Path]:
    """Write all pictures to `folder`; their paths."""
    sample = Sample.read()
    made: dict[str, np.ndarray] = {}
    for draw_some in (inputs, surfaces_and_people, views, votes, baselines, paper):
        made |= draw_some(sample)
    paths = [folder / f"{name}.png" for name in made]
    for path, picture in zip(paths, made.values(), strict=True):
        write_png(path, picture)
    return paths


def inputs(sample: Sample) -> dict[str, np.ndarray]:
    """The five images with their masks; and a row of all of them over each other."""
    tinted = {name: tint(i, m > 127) for name, i, m in zip(sample.names, sample.images, sample.masks, strict=True)}
    frame, geometry = sample.rectified(), rectify(sample.rig, 0).geometry
    epi = epipolar_image(list(frame.colour), geometry, EPI_ROW, frame.dynamic, 0.0)
    drawn = draw(epi, frame.colour[0], EPI_ROW, sample.names, ROW_HEIGHT * len(sample.names), "nearest")
    return {"input": contact_sheet(tinted, columns=3), "epi": drawn}


def surfaces_and_people(sample: Sample) -> dict[str, np.ndarray]:
    """What the cameras see, people included; the masks before and after they were held against each other."""
    unmasked = seepast.Options.preset("accurate").updated({"people.enabled": False})
    seen = {
        f"{name} sees": seepast.reconstruct(sample.images, None, sample.rig, options=unmasked, reference=name).disparity
        for name in SHOWN
    }
    refined = static(sample, "cam0").masks
    before = {f"{name}, given": grey(sample.masks[sample.rig.index(name)]) for name in SHOWN}
    after = {f"{name}, refined": grey(refined[sample.rig.index(name)]) for name in SHOWN}
    painted = {name: paint_disparity(disparity) for name, disparity in seen.items()}
    return {"surfaces": contact_sheet(painted, columns=3), "people": contact_sheet(before | after, columns=3)}


def views(sample: Sample) -> dict[str, np.ndarray]:
    """The static scene with every camera as the reference."""
    found = {name: static(sample, name) for name in SHOWN}
    pictures = {f"{name}, static": result.background for name, result in found.items()}
    disparities = {f"{name}, disparity": paint_disparity(result.disparity) for name, result in found.items()}
    return {"views": contact_sheet(disparities | pictures, columns=3)}


def votes(sample: Sample) -> dict[str, np.ndarray]:
    """The many-view method's last steps: how sure views are, the disparity voted for, how many rays show it."""
    options = seepast.Options.preset("accurate")
    many = Kept(backends.multiview(backends.get("cpu")), "graded_of_views")
    geometry = rectify(sample.rig, 0).geometry
    found, _ = multiview.see_past(sample.rectified(), geometry, options, many, False, pipeline.Clock())
    size = geometry.size
    sure = cv2.resize(many.results["graded_of_views"][1][0][0], size, interpolation=cv2.INTER_NEAREST)
    return {
        "votes": contact_sheet(
            {
                "how sure cam0 is of itself": grey(sure * (255 // max(int(sure.max()), 1))),
                "disparity after the votes": paint_disparity(found["disparity"]),
                "coverage: rays, red = none": paint_coverage(found["coverage"], len(sample.rig)),
                "what cam0 saw": sample.images[0],
                "the static scene": found["background"],
                "where it was put together": tint(found["background"], found["dynamic"][0] > 127, (80, 200, 80)),
            },
            columns=3,
        )
    }


def baselines(sample: Sample) -> dict[str, np.ndarray]:
    """Plain synthetic aperture refocusing beside refocusing on the scene's own surface."""
    frame, geometry = sample.rectified(), rectify(sample.rig, 0).geometry
    found = static(sample, "cam0").disparity
    plane = float(np.percentile(found, 10))  # the wall
    ways: dict[str, Callable[[], np.ndarray]] = {
        "mean, focused on the wall": lambda: refocus_at(list(frame.colour), geometry, plane),
        "static rays only": lambda: refocus_at(list(frame.colour), geometry, plane, frame.dynamic),
        "on the scene's surface": lambda: refocus_at(list(frame.colour), geometry, found, frame.dynamic),
    }
    return {"refocus": contact_sheet({name: way() for name, way in ways.items()}, columns=3)}


def paper(sample: Sample) -> dict[str, np.ndarray]:
    """Every stage of the paper's method."""
    frame, geometry = sample.rectified(), rectify(sample.rig, 0).geometry
    stages = Kept(backends.get("cpu"), "support", "prior", "disparity", "smooth", "segmentation", "masks", "refocus")
    options = seepast.Options.preset("paper")
    found, _ = pipeline.see_past(frame, geometry, options, stages, False, pipeline.Clock())
    results = stages.results
    gradients = np.abs(readable.describe(frame.grey[:1])[0].astype(np.int16))
    labels = results["segmentation"][0][0]
    refined = results["masks"][-1][0]
    at = sample.rig.index("cam2")
    panels = {
        "describe: across": grey(np.clip(4 * gradients[0], 0, 255).astype(np.uint8)),
        "describe: down": grey(np.clip(4 * gradients[1], 0, 255).astype(np.uint8)),
        "support": points(frame.grey[0], results["support"][0]),
        "prior: mean of the planes": paint_disparity(results["prior"][0].mean.astype(np.float32) / EIGHTHS),
        "disparity, first round": paint_disparity(results["disparity"][0]),
        "smoothed, last round": paint_disparity(results["smooth"][-1]),
        "segmentation: static rays": paint_coverage(rays(labels), len(sample.rig)),
        "masks: cam2, refined": grey(np.where(refined[at] > 254, 0, refined[at]).astype(np.uint8)),
        "refocus": found["background"],
    }
    return {"paper": contact_sheet(panels, columns=3)}


def rays(labels: np.ndarray) -> np.ndarray:
    """uint8 [H, W]: number of set bits of uint16 [H, W]."""
    return sum((labels >> bit & 1).astype(np.uint8) for bit in range(16))


def grey(values: np.ndarray) -> np.ndarray:
    """uint8 [H, W] as uint8 [H, W, 3]."""
    return cv2.cvtColor(values, cv2.COLOR_GRAY2BGR)


def tint(image: np.ndarray, where: np.ndarray, colour: tuple[int, int, int] = (60, 60, 220)) -> np.ndarray:
    """`image` with a colour mixed in where bool [H, W] is true."""
    tinted = image.copy()
    tinted[where] = (0.4 * image[where] + 0.6 * np.array(colour)).astype(np.uint8)
    return tinted


def points(image: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Support points float32 [N, 3] (x, y, d) as dots on a grey image, in the colours of disparities."""
    dots = np.zeros(image.shape, np.float32)
    x, y = support[:, 0].astype(int), support[:, 1].astype(int)
    dots[y, x] = support[:, 2]
    large = cv2.dilate(dots, np.ones((3, 3), np.uint8))
    return np.where((large > 0)[..., None], paint_disparity(large), grey(image // 2 + 100))


if __name__ == "__main__":
    for written in make(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/made")):
        print(written)
