"""seepast run: the static scene of every frame of one recording, or of a folder of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..errors import DatasetError, InputError, OptionsError, RigError
from .console import EXIT_ERROR, Json, count, progress, say, say_error
from .segmenting import Classes, SegmenterName, opened_recording, opened_segmenter
from .source import GUESSED, Source
from .watching import UNSEEN, Viewing

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..sequence import Settings, Summary
    from ..settings import Plan

Optional = Parameter(negative=(), show_default=False)
Flag = Annotated[bool, Optional]
Masks = Annotated[
    str | None,
    Parameter(
        help="Folder of masks in the dataset (default: masks); 'none': no masks; in ROS bags also topics:A,B,C.",
        show_default=False,
    ),
]


def run(
    dataset: Annotated[Path | None, Optional] = None,
    /,
    *,
    out: Path,
    settings: Annotated[Path | None, Optional] = None,
    masks: Masks = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    preset: Annotated[str | None, Optional] = None,
    reference: Annotated[str | None, Optional] = None,
    backend: Annotated[Literal["auto", "cpu", "cuda", "reference"] | None, Optional] = None,
    dynamic_only: Annotated[bool | None, Parameter(show_default=False)] = None,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=(), show_default=False)] = None,
    threads: Annotated[int | None, Optional] = None,
    overwrite: Flag = False,
    json_: Json = False,
    source: Source = GUESSED,
    viewing: Viewing = UNSEEN,
) -> int:
    """Reconstruct the static scene of every frame of a recording.

    For example

      seepast run recording --out out
      seepast run recording --out out --preset paper --set range.max_disparity=150
      seepast run recording --out out --settings settings.yaml
      seepast run --settings out/run.json --out again

    A run that was interrupted goes on where it stopped when the same command is given again. run.json of the output
    holds all settings; as --settings it repeats the run.

    Parameters
    ----------
    dataset
        Folder with rig.yaml, cam0/ cam1/ ... and masks/; or a ROS bag, an EuRoC folder, videos cam0.mp4 ..., a
        Middlebury folder; or a folder of such: each goes to OUT/<its name>. If not given, that of --settings.
    out
        Output folder: background/ disparity/ depth/ coverage/ masks/ camera.yaml run.json.
    settings
        YAML file of flags (reference: cam2) and options (range: {max_disparity: 150}), or the run.json of an earlier
        run; flags of the command line win over it.
    preset
        accurate (default): every camera a reference, then they vote; the best pictures. fast: the same, coarser
        where nobody is hidden. paper: the stages of Kaveti et al. 2020.
    reference
        The camera whose view is reconstructed (default: cam0).
    backend
        auto (default) takes the fastest that works here; reference is the readable NumPy one.
    dynamic_only
        Synthesise only what people hide; all else keeps its own pixels. Faster.
    set_
        One option, stage.field=value; may be repeated.
    threads
        As many as there are cores, if not given.
    overwrite
        Replace the output of an earlier, different run.
    """
    from ..settings import FileSettings, planned, read_settings

    given = {
        "dataset": dataset,
        "masks": masks,
        "segmenter": segmenter,
        "classes": classes,
        **vars(source),
        "preset": preset,
        "reference": reference,
        "backend": backend,
        "dynamic_only": dynamic_only,
        "threads": threads,
    }
    plan = planned(given, assignments(set_ or []), read_settings(settings) if settings else FileSettings())
    return run_all(plan, out, overwrite, json_, viewing, same_segmenter=segmenter is None and masks is None)


def run_all(plan: Plan, out: Path, overwrite: bool, as_json: bool, viewing: Viewing, same_segmenter: bool) -> int:
    """Run every recording of a plan and print a line for each; the exit code.

    same_segmenter  what is repeated was not told to take other masks
    """
    from ..datasets import NO_MASKS
    from ..sequence import Settings, process

    network = opened_segmenter(plan.segmenter, plan.classes, plan.masks, plan.threads)
    source = Source(plan.reader, plan.rig, plan.topics, plan.tolerance, plan.bits)
    masks = NO_MASKS if network else plan.masks
    paths = source.find(plan.dataset)
    failed = 0
    with viewing.watch(len(paths), overwrite) as watched:
        for path in paths:
            target = out if paths == [plan.dataset] else out / (path.stem if path.is_file() else path.name)
            try:
                recording = opened_recording(source, path, masks, network)
                said = _said(plan, recording, path)
                settings = Settings(
                    plan.options, plan.reference, plan.backend, plan.dynamic_only, plan.threads, overwrite, said
                )
                _warn_of_changes(plan, recording, settings, same_segmenter)
                again = partial(_again, source, path, masks, recording)
                with (
                    progress(recording.name, len(recording.stamps)) as advance,
                    watched.run(recording.name, target, again, advance) as on_frame,
                ):
                    summary = process(recording, target, settings, on_frame=on_frame)
            except (DatasetError, RigError, InputError) as error:  # the other recordings may still be good
                if len(paths) == 1:
                    raise
                failed += 1
                say_error(error)
                continue
            say(summary_line(summary), summary.as_dict(), as_json)
        watched.wait()
    return EXIT_ERROR if failed else 0


def _again(source: Source, path: Path, masks: str | None, recording: Dataset) -> Dataset:
    """What is run, opened once more for who looks on."""
    from ..segment import SegmentedDataset

    inner = source.open(path, masks)
    return recording.beside(inner) if isinstance(recording, SegmentedDataset) else inner


def _said(plan: Plan, recording: Dataset, path: Path) -> dict[str, Any]:
    from ..datasets import guess_reader

    reading = getattr(recording, "reading", None) or {}
    return {"reader": reading.get("reader") or guess_reader(path), **plan.said()}


def _warn_of_changes(plan: Plan, recording: Dataset, settings: Settings, same_segmenter: bool) -> None:
    """Tell why what a run.json repeats will not be equal, where that is known beforehand."""
    import logging

    from ..export.folder import changes_since
    from ..sequence import describe_run

    if plan.earlier is not None:
        changes = changes_since(plan.earlier, describe_run(recording, settings), segmenter=same_segmenter)
        if changes:
            logging.getLogger("seepast").warning("%s: not the same any more: %s", plan.run_file, "; ".join(changes))


def assignments(words: Sequence[str]) -> dict[str, str]:
    """["stage.field=value", ...] as a dict. Raises OptionsError."""
    pairs: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise OptionsError(f"--set {word}: write it as stage.field=value, for instance --set disparity.beta=0.01")
        pairs[name.strip()] = value.strip()
    return pairs


def summary_line(summary: Summary) -> str:
    """One line for people about a recording that was run."""
    before = summary.frames - summary.computed
    frames = count(summary.frames, "frame") + (f" ({before} from before)" if before else "")
    total = summary.milliseconds.get("total")
    speed = "not timed" if total is None else f"{total:.0f} ms per frame"
    share = summary.coverage_share
    covered = "coverage unknown" if share is None else f"coverage {100 * share:.1f} %"
    return f"{summary.name}: {frames}, {speed}, {covered}, {summary.out}"
