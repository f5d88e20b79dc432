"""Every number a user may turn: one small frozen dataclass per stage, each field with its unit and range.

    options = Options.preset("paper").updated({"disparity.beta": 0.01})

`Options.flat()` is what run.json holds; `updated(flat)` brings it back.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from .errors import OptionsError


def option(default: Any, unit: str, low: float | None, high: float | None, doc: str) -> Any:
    """A dataclass field with the unit, inclusive range and meaning that messages and documentation show."""
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "doc": doc})


def choice(default: str, choices: tuple[str, ...], doc: str) -> Any:
    """The same for one of several words."""
    return field(default=default, metadata={"unit": "", "low": None, "high": None, "choices": choices, "doc": doc})


@dataclass(frozen=True)
class StageOptions:
    """Base of the per-stage options: checks every field's type and range on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(type(self).__name__, f, getattr(self, f.name)))


def _checked(owner: str, f: dataclasses.Field, value: Any) -> Any:
    kind: Any = type(f.default)
    name = f"{owner.removesuffix('Options').lower()}.{f.name}"
    if kind is bool:
        if isinstance(value, str) and value.lower() in ("true", "false", "1", "0", "yes", "no", "on", "off"):
            value = value.lower() in ("true", "1", "yes", "on")
        if not isinstance(value, bool):
            raise OptionsError(f"option {name}: {value!r} is neither true nor false")
        return value
    if kind is str:
        if value not in f.metadata["choices"]:
            raise OptionsError(f"option {name}: {value!r} is none of {', '.join(f.metadata['choices'])}")
        return value
    try:
        number = kind(value)
        if kind is int and float(value) != number:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise OptionsError(
            f"option {name}: {value!r} is not {'a whole number' if kind is int else 'a number'}"
        ) from None
    low, high = f.metadata["low"], f.metadata["high"]
    if not ((low is None or number >= low) and (high is None or number <= high)):  # also refuses NaN
        raise OptionsError(f"option {name}: {number} is outside {low} .. {high} {f.metadata['unit']}".rstrip())
    return number


@dataclass(frozen=True)
class RangeOptions(StageOptions):
    """The disparities that are searched, px over the full array."""

    min_disparity: float = option(0.0, "px", 0, 4096, "farthest surface searched for")
    max_disparity: float = option(0.0, "px", 0, 4096, "nearest surface searched for; 0 = 0.45 x the image width")
    step: float = option(0.5, "px", 0.125, 4, "spacing of the candidate disparities")


@dataclass(frozen=True)
class RectifyOptions(StageOptions):
    """How images become rectified views (stage "rectify"); masks are always sampled linearly."""

    interpolation: str = choice("cubic", ("cubic", "linear"), "linear is faster, and blurs a little")


@dataclass(frozen=True)
class SupportOptions(StageOptions):
    """Sparse sure matches (stage "support")."""

    grid: int = option(5, "px", 1, 64, "spacing of the points that are tried")
    texture: int = option(25, "grey levels", 0, 4096, "least sum of |gradient| over a descriptor")
    uniqueness: float = option(0.85, "", 0, 1, "best cost / best cost elsewhere must be below this")
    max_cost: float = option(28.0, "grey levels", 0, 255, "largest mean |difference| of matched gradients")
    left_right: int = option(0, "px", 0, 16, "largest disagreement of the match back, px between the neighbours")
    window: int = option(25, "px", 1, 512, "half width of the square in which points must agree")
    similar: float = option(5.0, "px", 0, 64, "disparities closer than this agree")
    min_agreeing: int = option(2, "points", 0, 1000, "points with fewer agreeing neighbours are dropped")


@dataclass(frozen=True)
class PriorOptions(StageOptions):
    """Piecewise planar prior over the Delaunay triangulation (stage "prior")."""

    gamma: float = option(0.005, "", 1e-9, 100, "uniform part of p(d|T,x)")
    sigma: float = option(2.0, "px", 0.05, 64, "spread of the Gaussian part around the plane mean mu")
    radius: float = option(3.0, "px", 0, 256, "candidates reach this far around mu")
    max_step: float = option(8.0, "px", 0, 4096, "triangles whose corners differ more bridge a depth edge, not a plane")
    neighbour_radius: float = option(0.5, "px", 0, 64, "and this far around every support point of the 3x3 cells")


@dataclass(frozen=True)
class DisparityOptions(StageOptions):
    """M-step (stage "disparity")."""

    beta: float = option(0.03, "1 / grey level^2", 0, 10, "weight of the descriptor variance")
    median_passes: int = option(5, "passes", 0, 20, "5x5 medians of the disparity")
    lone_variance: float = option(200.0, "grey level^2", 0, 1e6, "stands for the variance that a lone ray lacks")
    unseen_variance: float = option(400.0, "grey level^2", 0, 1e6, "the same where no ray is static")


@dataclass(frozen=True)
class SegmentationOptions(StageOptions):
    """Labels from the static prior, and the E-step (stage "segmentation")."""

    threshold: float = option(0.7, "", 0, 1, "a ray starts as static where its prior P(static) is at least this")
    beta: float = option(0.00015, "1 / grey level^2", 0, 10, "weight of the descriptor variance")
    floor: float = option(0.02, "", 1e-6, 0.5, "the prior is never surer than this, so evidence can overrule it")
    outlier_cost: float = option(0.0, "nats", 0, 100, "extra cost of calling a ray dynamic")
    max_rounds: int = option(2, "rounds", 1, 20, "EM rounds at most; it stops when the labels stand still")


@dataclass(frozen=True)
class RefocusOptions(StageOptions):
    """The picture (stage "refocus")."""

    keep_reference: bool = option(True, "", None, None, "static reference pixels keep their own colour")
    median: bool = option(True, "", None, None, "preset paper: 3x3 median over what was synthesised")


@dataclass(frozen=True)
class MultiviewOptions(StageOptions):
    """The many-view method (multiview.py): every camera is a reference once, then they vote."""

    enabled: bool = option(False, "", None, None, "this method instead of the paper's stages")
    balance: float = option(
        0.01, "", 0, 10, "cameras whose gain differs by more from the wanted one's are matched to it"
    )
    rounds: int = option(2, "rounds", 1, 4, "per level; 1: no votes between the views before the wanted one's own")
    threshold: float = option(0.5, "", 0, 1, "a pixel is static where its prior P(static) is at least this")
    range_scale: int = option(4, "", 1, 8, "views are reduced this often to find the range of disparities")
    coarsest: int = option(
        2, "", 1, 16, "views are first matched reduced this often, then at `finer` times that size and so on"
    )
    finer: int = option(2, "", 2, 16, "how many times as wide the next level is")
    window: float = option(2.0, "px", 0.5, 64, "then around what the coarser level found, that far either way")
    spread: int = option(4, "px", 0, 16, "and of its neighbours that near: thin things are easily missed there")
    half_rows: bool = option(
        False, "", None, None, "disparities are looked for on views whose rows are averaged two by two"
    )
    fine_views: bool = option(
        True,
        "",
        None,
        None,
        "on finer levels the other views are matched everywhere; else only around what people hide",
    )
    around: int = option(16, "px", 0, 256, "and that far beside it; so it is where other views are heard a second time")
    witnesses: int = option(
        15, "views", 1, 15, "so many of those that see what people hide, the nearest, are asked of it on finer levels"
    )
    paths: int = option(4, "", 4, 8, "of semi-global matching: 8, or 4 without diagonals")
    apart: int = option(
        15,
        "",
        1,
        15,
        "what views other than the wanted one do not see is matched between cameras that near in their order",
    )
    colour_cap: int = option(33, "", 0, 100, "a pair's mean colour step costs no more; the census is 96 at most")
    few_cost: int = option(40, "", 0, 100, "of the census where fewer than 8 neighbours are static in both rays")
    lone_cost: int = option(25, "", 0, 250, "cost where only one static ray exists")
    unseen_cost: int = option(30, "", 0, 250, "cost where none exists")
    small_penalty: int = option(8, "", 0, 200, "P1, one candidate's step between neighbouring pixels")
    large_penalty: float = option(150.0, "", 0, 1000, "P2, more than that, divided by 1 + colour step / 10")
    least_penalty: float = option(20.0, "", 0, 1000, "P2 is never less")
    dynamic_penalty: int = option(60, "", 0, 1000, "P2 where either pixel is dynamic")
    final_small_penalty: int = option(4, "", 0, 200, "P1 of the wanted view's last pass")
    final_large_penalty: float = option(40.0, "", 0, 1000, "P2 of the last pass")
    final_least_penalty: float = option(15.0, "", 0, 1000, "its least")
    final_dynamic_penalty: int = option(40, "", 0, 1000, "its P2 where either pixel is dynamic")
    tolerance: float = option(1.0, "px", 0.1, 4, "disparities of two views that differ by no more agree")
    lone_confidence: float = option(0.7, "", 0, 1, "of a disparity that no other view confirms or denies")
    doubtful_confidence: float = option(0.15, "", 0, 1, "where another view sees farther")
    planes: bool = option(True, "", None, None, "unconfirmed disparities are read from the plane of sure ones around")
    vote_base: float = option(40.0, "", 0, 60, "energy of a candidate without votes")
    vote_gain: float = option(20.0, "", 0, 30, "taken off per vote for it, put on per view that sees through it; tens")
    vote_hide: float = option(50.0, "", 0, 60, "put on behind a supported candidate, where the view is blind; tens")
    vote_volume: float = option(0.5, "", 0, 1, "weight of the matching cost beside the votes")
    label_tolerance: float = option(1.5, "px", 0.1, 16, "a ray shows the surface if its view's disparity is this near")
    camera_falloff: float = option(4.0, "", 0, 16, "colours weigh 1 / distance^this of their cameras")
    edge_weight: float = option(0.02, "", 0, 1, "weight of colours within 2 px of a mask")


@dataclass(frozen=True)
class PeopleOptions(StageOptions):
    """Masks refined from all views (people.py). Lattice px: of the object-level steps' sampling."""

    enabled: bool = option(True, "", None, None, "the many-view method refines the masks before it uses them")
    surface_width: int = option(500, "px", 32, 4096, "surfaces are found on views halved until they are no wider")
    first_width: int = option(250, "px", 32, 4096, "but first on views of no more, which is enough for exact masks")
    working_width: int = option(400, "px", 32, 4096, "object-level steps look at about that many pixels of a row")
    same_surface: float = option(2.0, "px", 0, 64, "views whose disparities differ by less see the same surface")
    trusted: float = option(
        0.45, "reduced px", 0, 16, "masks whose outlines differ by less between views are taken as they are"
    )
    cell_width: float = option(0.09, "x width", 0.01, 1, "size of an object's cell across")
    cell_height: float = option(0.5, "x height", 0.01, 1, "and down")
    cell_disparity: float = option(0.05, "x nearest", 0.005, 1, "and in disparity")
    cell_blur: float = option(0.8, "cells", 0, 4, "Gaussian by which cells lend to their neighbours")
    upright: float = option(0.5, "x nearest / height", 0, 100, "surfaces that change faster from row to row are floors")
    upright_reach: float = option(0.02, "x height", 0, 0.5, "rows up and down that this is measured over")
    least_share: float = option(0.35, "", 0.01, 1, "objects are compared with at least that share of P")
    least_area: float = option(0.003, "x area", 0, 1, "people that fill less of the views are not there")
    inner: int = option(4, "lattice px", 0, 64, "sure to be a person: that deep inside an object")
    outer: int = option(0, "lattice px", 0, 64, "sure to be static: that far outside")
    sure_said: float = option(1.5, "nats", -10, 10, "and only where the cameras' P says at least that")
    sure: float = option(2.0, "nats", 0, 9, "log-odds of sure pixels; three times that outside")
    unsure: float = option(0.0, "nats", -10, 10, "log-odds of pixels in between")
    said: float = option(0.25, "", 0, 10, "weight of what the cameras' P says")
    behind: float = option(2.0, "", 0, 10, "weight of how pixels differ from what other cameras see behind")
    local: float = option(10.0, "nats", 0, 20, "per unit of the label as a local linear function of colour")
    colour: float = option(1.2, "", 0, 3, "weight of the colours' log ratio")
    colour_doubt: float = option(8.0, "px", 0.01, 1e5, "as many more pixels of undecided label in every bin of colour")
    window: int = option(65, "lattice px", 5, 501, "side of the window of the local linear label")
    ridge: float = option(0.001, "", 1e-6, 1, "its regularisation, colours in 0..1")
    field: float = option(5.0, "nats", 0, 11, "cost of a label change between pixels of one colour")
    least_cost: float = option(0.1, "", 0, 1, "share of that which contrast cannot lower")
    contrast: float = option(5.0, "grey levels", 0.5, 100, "colour step that tells surfaces apart")
    depth_step: float = option(2.0, "px", 0, 64, "step of the surface that ends a person")
    depth_cut: float = option(1.0, "", 0, 1, "what is left of the cost there")
    grow: bool = option(True, "", None, None, "people include the mixed pixels of their outline")
    belief_scale: float = option(3.0, "", 0.1, 100, "beliefs of the field are that much too sure")


@dataclass(frozen=True)
class Options:
    """All stages' options. Immutable; `updated` returns a changed copy."""

    range: RangeOptions = RangeOptions()
    rectify: RectifyOptions = RectifyOptions()
    support: SupportOptions = SupportOptions()
    prior: PriorOptions = PriorOptions()
    disparity: DisparityOptions = DisparityOptions()
    segmentation: SegmentationOptions = SegmentationOptions()
    refocus: RefocusOptions = RefocusOptions()
    multiview: MultiviewOptions = MultiviewOptions()
    people: PeopleOptions = PeopleOptions()

    @staticmethod
    def preset(name: str) -> Options:
        """The named preset, one of PRESETS. Raises OptionsError for another name."""
        if name not in PRESETS:
            raise OptionsError(f"preset {name!r} is unknown: choose one of {', '.join(PRESETS)}")
        return PRESETS[name]

    def updated(self, flat: Mapping[str, Any]) -> Options:
        """A copy with {"stage.field": value} applied; strings are converted. Raises OptionsError."""
        changed: dict[str, dict[str, Any]] = {}
        for key, value in flat.items():
            stage, _, name = key.partition(".")
            if name not in getattr(type(getattr(self, stage, None)), "__dataclass_fields__", {}):
                raise OptionsError(f"option {key!r} does not exist: {_nearest(key, self.flat())}")
            changed.setdefault(stage, {})[name] = value
        stages = {stage: dataclasses.replace(getattr(self, stage), **new) for stage, new in changed.items()}
        return dataclasses.replace(self, **stages)

    def flat(self) -> dict[str, Any]:
        """{"stage.field": value} of every option, in pipeline order."""
        return {f"{stage}.{k}": v for stage, group in dataclasses.asdict(self).items() for k, v in group.items()}


def _nearest(key: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(key, known, n=3, cutoff=0.4)
    return f"did you mean {' or '.join(close)}?" if close else f"options are {', '.join(known)}"


DEFAULT_PRESET = "accurate"
PRESETS: dict[str, Options] = {
    "paper": Options(),
    "fast": Options(
        rectify=RectifyOptions(interpolation="linear"),
        multiview=MultiviewOptions(
            enabled=True,
            coarsest=4,
            finer=4,
            half_rows=True,
            rounds=1,
            window=1.5,
            spread=2,
            fine_views=False,
            around=4,
            witnesses=2,
            apart=1,
            planes=False,
        ),
    ),
    "accurate": Options(multiview=MultiviewOptions(enabled=True)),
}
