"""Checks of the rig alone: is it a line, and what can a line like this see?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry import ArrayGeometry
from ..rectify import Rectification
from .lines import Line, line, verdict_of
from .seeing import aperture, unseen_share, widest_seen_past

PERSON = 0.5  # metres: an adult across the shoulders
PRECISION = 0.5  # px over the array: what a disparity is off by
SEARCHED = 0.45  # of the width: the largest disparity searched unless range.max_disparity says another
SENSIBLE_STEP = 0.1  # px between neighbours: a surface must move by this at least to be told from infinity


def array_lines(
    rectification: Rectification, names: Sequence[str], depths: tuple[float, float], background: float, known: str
) -> list[Line]:
    """All of this module's checks. `known` says in words where the background's distance comes from."""
    geometry = rectification.geometry
    return [
        predicted_rows(rectification),
        linearity(rectification, names, depths[0]),
        spacing(geometry, names),
        disparities(geometry, depths),
        resolution(geometry, depths),
        person(geometry, depths[0], background, known),
    ]


def predicted_rows(rectification: Rectification) -> Line:
    error = rectification.row_error_px
    return line(
        "rows, predicted",
        f"{error:.2g} px between the maps and the calibration's own projection",
        verdict_of(error, 0.05, 0.2),
        "the lens model is beyond what it was fitted to: calibrate with targets out to the image corners",
        px=error,
    )


def off_line(positions: np.ndarray) -> np.ndarray:
    """float64[K] metres of every centre, float64[K, 3], from the least-squares line through them all."""
    centered = positions - positions.mean(axis=0)
    direction = np.linalg.svd(centered, full_matrices=False)[2][0]
    return np.linalg.norm(centered - (centered @ direction)[:, None] * direction, axis=1)


def linearity(rectification: Rectification, names: Sequence[str], near: float) -> Line:
    off = off_line(rectification.geometry.positions)
    length = aperture(rectification.geometry.positions[:, 0])
    share, k = float(off.max() / length), int(off.argmax())
    rows = rectification.row_offset_px(near)
    return line(
        "linearity",
        f"{names[k]} is {1000 * off[k]:.1f} mm ({100 * share:.1f} % of the array) off the line; "
        f"{rows:.1f} rows at {near:g} m, which are carried",
        verdict_of(share, 0.02, 0.1),
        f"move {names[k]} onto the line of the others and calibrate again; hidden background is found along it only",
        off_line_m=off.tolist(),
        share=share,
        rows_px=rows,
    )


def spacing(geometry: ArrayGeometry, names: Sequence[str]) -> Line:
    along = geometry.positions[:, 0]
    gaps = np.diff(np.sort(along))
    order = " ".join(names[k] for k in np.argsort(along))
    uneven = float(gaps.max() / gaps.min())
    return line(
        "baselines",
        f"{order}: {', '.join(f'{gap:.3f}' for gap in gaps)} m apart, {aperture(along):.3f} m in all, "
        f"{geometry.baseline:.3f} m from {names[geometry.reference]}",
        verdict_of(uneven, 2.0, 5.0),
        "cameras close together hardly add anything: space them evenly",
        gaps_m=gaps.tolist(),
        aperture_m=aperture(along),
        baseline_m=geometry.baseline,
    )


def disparities(geometry: ArrayGeometry, depths: tuple[float, float]) -> Line:
    """Both ends of the range must be told apart: the near end found, the far end from infinity."""
    near, far = (geometry.focal_baseline / depth for depth in depths)
    searched = SEARCHED * geometry.size[0] + float(abs(geometry.shifts[:, 0]).max())
    step = far * float(np.diff(np.sort(geometry.positions[:, 0])).mean()) / geometry.baseline
    mend = []
    if near > searched:
        mend.append(f"nothing nearer than {geometry.focal_baseline / searched:.2f} m is searched for by itself: "
                    f"--set range.max_disparity={np.ceil(near):.0f}")  # fmt: skip
    if step < SENSIBLE_STEP:
        mend.append(f"{depths[1]:g} m is as good as infinitely far: a longer lens or a wider array")
    return line(
        "disparity range",
        f"{far:.1f} px at {depths[1]:g} m to {near:.1f} px at {depths[0]:g} m over the array, {step:.2f} px between "
        f"neighbours at least; searched up to {searched:.0f} px",
        "doubtful" if mend else "good",
        "; ".join(mend),
        near_px=near,
        far_px=far,
        searched_px=searched,
        far_neighbour_px=step,
    )


def depth_step(geometry: ArrayGeometry, depth: float) -> float:
    """Metres that PRECISION px of disparity are at `depth`: dZ = Z^2 / (f B) dd."""
    return PRECISION * depth**2 / geometry.focal_baseline


def _length(metres: float) -> str:
    for unit, least in (("m", 1.0), ("cm", 0.01)):
        if metres >= least:
            return f"{metres / least:.2g} {unit}" if metres < 10 * least else f"{metres / least:.0f} {unit}"
    return f"{1000 * metres:.2g} mm"


def resolution(geometry: ArrayGeometry, depths: tuple[float, float]) -> Line:
    steps = [depth_step(geometry, depth) for depth in depths]
    return line(
        "depth resolution",
        ", ".join(f"{_length(step)} at {depth:g} m" for depth, step in zip(depths, steps, strict=True))
        + f" (for {PRECISION:g} px of disparity)",
        verdict_of(steps[1] / depths[1], 0.1, 0.3),
        f"at {depths[1]:g} m half a pixel is {100 * steps[1] / depths[1]:.0f} % of the depth: a longer lens, a wider "
        "array, or --depths that end nearer if nothing lies there",
        near_m=steps[0],
        far_m=steps[1],
    )


def person_depths(near: float, background: float) -> list[float]:
    """A handful of depths of people from `near` to the background, evenly apart in disparity."""
    ends = np.linspace(1 / near, 1 / background, 6)[:-1]
    return [float(1 / end) for end in ends]


def person(geometry: ArrayGeometry, near: float, background: float, known: str) -> Line:
    """Judged by somebody PERSON wide half-way to the background; derivation in seeing.py."""
    along = geometry.positions[:, 0]
    half = background / 2
    unseen = unseen_share(along, PERSON, half, background)
    table = {round(z, 2): widest_seen_past(along, z, background) for z in person_depths(min(near, half), background)}
    two = {z: widest_seen_past(along, z, background, 2) for z in table}
    widths = ", ".join(f"{width:.2f} m at {z:g} m" for z, width in table.items())
    return line(
        "seen past whole",
        f"before a background {background:.1f} m away ({known}) people as wide as {widths}; of one {PERSON:g} m wide "
        f"at {half:.1f} m, {100 * unseen:.0f} % stays unseen",
        verdict_of(unseen, 0.05, 0.9),
        f"widen the array ({2 * PERSON:.1f} m sees past anybody up to half-way), or keep people near it and far from "
        "the background; what no camera sees has coverage 0",
        background_m=background,
        widest_m={f"{z:g}": width for z, width in table.items()},
        widest_for_two_m={f"{z:g}": width for z, width in two.items()},
        unseen_share_half_way=unseen,
    )
