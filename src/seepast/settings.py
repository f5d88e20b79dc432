"""Settings of a run: a YAML file, or the run.json of an earlier run, below the flags of the command line.

dataset: recording              # a flag of `seepast run` without its dashes, see FLAGS
preset: paper
range: {max_disparity: 150}     # a stage of options.py; or flat:
people.enabled: false
"""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from .errors import OptionsError
from .options import DEFAULT_PRESET, Options

STAGES = tuple(stage.name for stage in fields(Options))
_WORD, _WORDS, _NUMBER, _WHOLE, _TRUTH = "a word", "words", "a number", "a whole number", "true or false"
FLAGS = {
    "dataset": _WORD,
    "masks": _WORD,
    "segmenter": _WORD,
    "classes": _WORDS,
    "reader": _WORD,
    "rig": _WORD,
    "topics": _WORDS,
    "tolerance": _NUMBER,
    "bits": _WHOLE,
    "preset": _WORD,
    "reference": _WORD,
    "backend": _WORD,
    "dynamic_only": _TRUTH,
    "threads": _WHOLE,
}
OPENED = ("classes", "reader", "topics", "tolerance", "bits")  # how a recording was opened, in words and numbers
_TYPES: dict[str, tuple[type, ...]] = {
    _WORD: (str,),
    _WORDS: (str, list),
    _NUMBER: (int, float),
    _WHOLE: (int,),
    _TRUTH: (bool,),
}


@dataclass(frozen=True)
class FileSettings:
    """What a file says.

    path     the file, None if there is none
    flags    name in FLAGS -> value, those that are said only
    options  "stage.field" -> value, likewise
    run      the run.json that it is, None for a file that somebody wrote
    """

    path: Path | None = None
    flags: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    run: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Plan:
    """All that determines a run: one recording or a folder of them, how it is opened, and the method.

    The first eight are those of `open_dataset` and `open_segmenter`, classes separated by commas. run_file and
    earlier: name and content of the run.json that is repeated.
    """

    dataset: Path
    masks: str | None
    segmenter: str | None
    classes: str | None
    reader: str | None
    rig: Path | None
    topics: str | None
    tolerance: float | None
    bits: int | None
    options: Options
    reference: str = "cam0"
    backend: str = "auto"
    dynamic_only: bool = False
    threads: int = 0
    run_file: Path | None = None
    earlier: Mapping[str, Any] | None = None

    def said(self) -> dict[str, Any]:
        """What this says about opening the recording, as it is true in every working directory, for run.json."""
        said: dict[str, Any] = {name: getattr(self, name) for name in OPENED}
        said["rig"] = None if self.rig is None else str(self.rig.resolve())
        said["segmenter"] = None if self.segmenter is None else _anywhere(self.segmenter)
        return {name: value for name, value in said.items() if value is not None}


def planned(flags: Mapping[str, Any], options: Mapping[str, Any], file: FileSettings) -> Plan:
    """The plan of a command line over a file: what is said by both is what the command line says.

    flags    name in FLAGS -> value; None: not said
    options  "stage.field" -> value, over those of the file and of the preset

    Naming masks drops the file's segmenter, and the other way round. Raises OptionsError.
    """
    flags = {name: value for name, value in flags.items() if value is not None}
    hidden = {"segmenter", "classes"} if "masks" in flags else {"masks"} if "segmenter" in flags else set()
    merged = {name: value for name, value in file.flags.items() if name not in hidden} | flags
    if "preset" in flags and set(file.options) >= set(Options().flat()):
        raise OptionsError(f"--preset {flags['preset']}: {file.path} says every number; leave it out, or say --set")
    chosen = Options.preset(merged.pop("preset", DEFAULT_PRESET)).updated({**file.options, **options})
    if "dataset" not in merged:
        raise OptionsError("DATASET: say which recording to run, or name it in the file of --settings as dataset: PATH")
    plan: dict[str, Any] = {name: None for name in ("masks", "segmenter", *OPENED)}
    plan |= merged
    plan["dataset"], plan["rig"] = Path(merged["dataset"]), Path(merged["rig"]) if "rig" in merged else None
    return Plan(**plan, options=chosen, run_file=file.path if file.run else None, earlier=file.run)


def read_settings(path: Path) -> FileSettings:
    """Read a file of settings. Raises OptionsError naming the file, the key and the mend."""
    content = _content(path)
    run = content if "versions" in content else None
    if run and not isinstance(run.get("settings"), dict):
        raise OptionsError(f"{path}: does not hold the settings of its run; run again with this version of seepast")
    said = content if run is None else {**run["settings"], **run.get("options", {})}
    flags, options = {}, {}
    for key, value in said.items():
        name = str(key).replace("-", "_")
        if name in FLAGS:
            flags[name] = _flag(path, name, value)
        elif key in STAGES:
            options.update(_stage(path, key, value))
        else:
            options[str(key)] = value
    _check_options(path, options)
    return FileSettings(path, {name: value for name, value in flags.items() if value is not None}, options, run)


def _content(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text()
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except OSError as error:
        raise OptionsError(f"--settings {path}: cannot be read ({error.strerror or error}); name a file") from None
    except (yaml.YAMLError, ValueError) as error:
        where = " ".join(str(error).split())
        raise OptionsError(f"{path}: neither YAML nor the run.json of a run ({where}); mend it there") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise OptionsError(f"{path}: is a {type(content).__name__}; write settings as lines of 'name: value'")
    return content


def _flag(path: Path, name: str, value: Any) -> Any:
    kind = FLAGS[name]
    fits = isinstance(value, _TYPES[kind]) and (kind == _TRUTH or not isinstance(value, bool))
    if isinstance(value, list):
        fits, value = fits and all(isinstance(word, str | int) for word in value), ",".join(map(str, value))
    if not (fits or value is None):
        raise OptionsError(f"{path}: {name} is {value!r}; write {kind} there")
    return value


def _stage(path: Path, stage: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise OptionsError(
            f"{path}: {stage} is {value!r}; write it as {stage}: {{field: value}} or {stage}.field: value"
        )
    return {f"{stage}.{name}": number for name, number in value.items()}


def _check_options(path: Path, options: Mapping[str, Any]) -> None:
    known = [*FLAGS, *STAGES, *Options().flat()]
    for key in options:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=3, cutoff=0.6)
            mend = f"did you mean {' or '.join(close)}?" if close else "run.json of any run lists all options"
            raise OptionsError(f"{path}: there is no setting {key!r}; {mend}")
    try:
        Options().updated(options)
    except OptionsError as error:
        raise OptionsError(f"{path}: {error}") from None


def _anywhere(segmenter: str) -> str:
    """A segmenter's name with the file in it, if there is one, as an absolute path."""
    kind, colon, rest = segmenter.partition(":")
    head, tail = (kind + colon, rest) if kind == "onnx" else ("", segmenter)
    name, colon, last = tail.rpartition(":")
    if os.path.isfile(tail):
        return head + os.path.abspath(tail)
    return f"{head}{os.path.abspath(name)}:{last}" if colon and os.path.isfile(name) else segmenter
