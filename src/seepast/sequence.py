"""One recording in, one output folder out: what `seepast run` does for each dataset."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from . import __version__, backends
from .ahead import Behind
from .datasets import NO_MASKS, Dataset
from .export import FolderWriter, Run
from .options import Options
from .pipeline import Images, Masks, Reconstructor
from .rectify import rectify
from .rig import Rig
from .segment import SegmentedDataset

log = logging.getLogger("seepast")


@dataclass(frozen=True)
class Settings:
    """How to run; see `reconstruct` for each. reference is a camera's name or index.

    said  how the recording was opened (settings.Plan.said), kept in run.json so that the run can be repeated
    """

    options: Options
    reference: int | str = 0
    backend: str = "auto"
    dynamic_only: bool = False
    threads: int = 0
    overwrite: bool = False
    said: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Summary:
    """What became of one recording.

    frames          finished frames in `out`; computed: those of this run, the others were there before
    milliseconds    median per frame of each stage, and "total", their sum: frames overlap, so less passes
    coverage_share  mean share of the pixels that some camera saw; None if nothing was computed yet
    """

    name: str
    out: str
    frames: int
    computed: int
    milliseconds: dict[str, float]
    coverage_share: float | None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def process(
    dataset: Dataset, out: str | Path, settings: Settings, *, on_frame: Callable[[], None] = lambda: None
) -> Summary:
    """Reconstruct every frame of `dataset` that `out` does not hold yet.

    Reading, rectifying, reconstructing and writing of successive frames overlap (each in a thread, a few frames
    held); `dataset` is read from one thread, which is not the one that opened it. `on_frame` is called after every
    frame, finished ones included. Raises SeepastError; what was finished before stays, and an equal later call goes
    on from there.
    """
    reference = dataset.rig.index(settings.reference)
    run = describe_run(dataset, settings)
    reconstructor = Reconstructor(
        dataset.rig,
        options=settings.options,
        reference=reference,
        backend=settings.backend,  # with auto the CPU takes over from a GPU that fails
        dynamic_only=settings.dynamic_only,
        threads=settings.threads,
    )
    computed, blind = 0, []
    names = [camera.name for camera in dataset.rig.cameras]
    rotation = rectify(dataset.rig, reference).rotation_from_cam[reference]
    with FolderWriter(out, run, names, rotation=rotation, overwrite=settings.overwrite) as writer:
        missing = {stamp for stamp in dataset.stamps if not writer.done(stamp)}
        timings: dict[str, Mapping[str, float]] = {}
        frames = _decoded(dataset, missing, timings)
        with Behind(writer.write) as write, closing(reconstructor.stream(frames)) as results:
            for stamp in dataset.stamps:
                if stamp in missing:
                    result = next(results)
                    result = replace(result, timings={**timings.pop(stamp), **result.timings})
                    write(stamp, result, sum(result.timings.values()))
                    computed += 1
                    if not result.coverage.any():
                        blind.append(stamp)
                on_frame()
    if blind:
        log.warning(
            "%s: no camera sees anything static in %d frames (%s first); do the masks say 255 for static?",
            dataset.path, len(blind), blind[0],
        )  # fmt: skip
    figures = writer.summary()
    return Summary(
        dataset.name,
        str(out),
        figures["frames"],
        computed,
        figures["milliseconds"],
        figures["coverage_share"],
    )


def _decoded(
    dataset: Dataset, wanted: Container[str], timings: dict[str, Mapping[str, float]]
) -> Iterator[tuple[Images, Masks]]:
    """Images and masks of the `wanted` frames in order; what making them took goes to `timings`."""
    for stamp in dataset.stamps:
        if stamp in wanted:
            frame = dataset.frame(stamp)
            timings[stamp] = frame.timings
            yield frame.images, frame.masks


def describe_run(dataset: Dataset, settings: Settings) -> Run:
    """What determines the output of `process`, for run.json and for going on with an earlier run."""
    run = Run(
        seepast=__version__,
        dataset=str(dataset.path.resolve()),
        masks=NO_MASKS if dataset.masks is None else str(dataset.masks.resolve()),
        rig=_digest(dataset.rig),
        reference=dataset.rig.cameras[dataset.rig.index(settings.reference)].name,
        backend=backends.get(settings.backend).__name__.rpartition(".")[2],
        dynamic_only=settings.dynamic_only,
        options=settings.options.flat(),
        segmenter=dataset.segmenter.describe() if isinstance(dataset, SegmentedDataset) else None,
        reading=getattr(dataset, "reading", None),
    )
    return replace(run, settings=_repeating(run, settings.said))


def _repeating(run: Run, said: Mapping[str, Any]) -> dict[str, Any]:
    """The flags (settings.FLAGS) that, with the options of `run`, make `seepast run` do the same again."""
    flags: dict[str, Any] = {"dataset": run.dataset, "reference": run.reference, "backend": run.backend}
    flags["dynamic_only"] = run.dynamic_only
    if run.segmenter is None:
        flags["masks"] = _masks_of(run)
    elif run.segmenter["kind"] == "onnx":
        flags["segmenter"] = f"onnx:{run.segmenter['model']}:{run.segmenter['preset']}"
    return {**flags, **(run.reading or {}), **said}


def _masks_of(run: Run) -> str:
    """--masks of a run: its folder relative to the recording where it lies in it, so that it holds for others, too."""
    if run.masks.startswith(f"{run.dataset}#"):
        return f"topics:{run.masks.removeprefix(f'{run.dataset}#')}"
    masks = Path(run.masks)
    return str(masks.relative_to(run.dataset)) if masks.is_relative_to(run.dataset) else run.masks


def _digest(rig: Rig) -> str:
    cameras = [
        (c.name, c.model, c.distortion, list(c.intrinsics), list(c.distortion_coeffs), list(c.resolution),
         c.cam_from_rig.tolist())
        for c in rig.cameras
    ]  # fmt: skip
    return hashlib.sha256(repr(cameras).encode()).hexdigest()[:16]
