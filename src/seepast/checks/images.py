"""Checks of the images against the calibration and each other: rows, brightness, time stamps."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..datasets import Dropped
from ..geometry import ArrayGeometry
from ..matching import Matches
from ..rectify import MIN_MATCHES
from .lines import Line, line, verdict_of, worst

GOOD_ROWS_PX, BAD_ROWS_PX = 0.5, 1.0
GOOD_GAIN, BAD_GAIN = 0.05, 0.15  # |log| of a ratio of grey levels
DARK, BRIGHT = 16, 240  # grey levels whose ratios mean something
SPEED = 1.0  # m/s of a robot, or of a person

Pairs = Sequence[Matches]


def measured_rows(frames: Sequence[Pairs], names: Sequence[str]) -> Line:
    """Median |dy| over all pairs and frames; the pair that is off most is named, and those that hardly match.

    See matching.Matches.
    """
    errors = [np.concatenate([pairs[i].row_error for pairs in frames]) for i in range(len(frames[0]))]
    merged = np.concatenate(errors)
    if len(merged) < MIN_MATCHES:
        few = f"only {len(merged)} matches between neighbours"
        return line("rows, measured", few, "unknown", "look at the images: dark, blurred, or not of one scene?")
    median = float(np.median(abs(merged)))
    pairs = {f"{names[m.first]}-{names[m.second]}": e for m, e in zip(frames[0], errors, strict=True)}
    offsets = {pair: float(np.median(e)) if len(e) else float("nan") for pair, e in pairs.items()}
    off = {pair: float(np.median(abs(e))) for pair, e in pairs.items() if len(e) >= MIN_MATCHES}
    most = max(off, key=lambda pair: off[pair], default="")
    lost = [pair for pair in pairs if pair not in off]
    verdicts = [verdict_of(v, GOOD_ROWS_PX, BAD_ROWS_PX) for v in (median, *off.values())]
    mend = []
    if worst(verdicts) != "good":
        mend.append(f"{most} does not fit the calibration: was a camera moved, or are they triggered apart? "
                    "Calibrate again")  # fmt: skip
    if lost:
        verdicts.append("doubtful")
        mend.append(f"hardly a match in {', '.join(lost)}: dark, blurred, or not of one scene?")
    return line(
        "rows, measured",
        f"{median:.2f} px off in the median of {len(merged)} matches"
        + (f", most in {most}: {off[most]:.2f} px" if most else ""),
        worst(verdicts),
        "; ".join(mend),
        px=median,
        matches=len(merged),
        pairs_px=off,
        pairs_offset_px=offsets,
    )


def gains(views: Sequence[np.ndarray], pairs: Pairs, geometry: ArrayGeometry) -> np.ndarray:
    """How much brighter each camera is than the reference: float64 [K, C] ratios of grey levels, C colours.

    views  K uint8 [H, W] or [H, W, C] rectified views; pairs: their neighbour_matches

    Between neighbours: the median over the matches of the ratio of 5x5 means, where both lie in DARK .. BRIGHT;
    then multiplied along the line from the reference. The median bears wrong matches and highlights. NaN from
    where a pair has too few matches on.
    """
    means = [np.atleast_3d(cv2.blur(view, (5, 5)).astype(np.float32)) for view in views]
    steps = [_log_ratio(means[m.first], means[m.second], m) for m in pairs]
    order = [pairs[0].first, *(m.second for m in pairs)]
    at = order.index(geometry.reference)
    logs = np.empty((len(views), means[0].shape[2]))
    logs[order] = _from(np.array(steps), at)
    return np.exp(logs)


def _from(steps: np.ndarray, at: int) -> np.ndarray:
    """Sums of steps [K - 1, C] leftwards and rightwards from `at`, so that a NaN spoils only what is beyond it."""
    right = np.cumsum(steps[at:], axis=0)
    left = -np.cumsum(steps[:at][::-1], axis=0)[::-1]
    return np.concatenate([left, np.zeros((1, steps.shape[1])), right])


def _log_ratio(first: np.ndarray, second: np.ndarray, matches: Matches) -> np.ndarray:
    """float64[C]: median of log(second / first)."""
    if not len(matches):
        return np.full(first.shape[2], np.nan)
    a, b = _at(first, matches.x, matches.y), _at(second, matches.x2, matches.y2)
    ratios = []
    for channel in range(a.shape[1]):
        both = np.stack([a[:, channel], b[:, channel]])
        usable = ((both >= DARK) & (both <= BRIGHT)).all(axis=0)
        enough = usable.sum() >= MIN_MATCHES // 2
        ratios.append(float(np.median(np.log(both[1] / np.maximum(both[0], 1))[usable])) if enough else np.nan)
    return np.array(ratios)


def _at(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """float32[N, C] of [H, W, C] at float pixels, bilinearly."""
    sampled = cv2.remap(image, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(len(x), image.shape[2])


def gain_line(measured: np.ndarray, names: Sequence[str], reference: int) -> Line:
    """`measured`: float64 [K, C] of `gains`."""
    logs = np.log(measured)
    grey = logs.mean(axis=1)
    tint = logs - grey[:, None]
    known = ~np.isnan(grey)
    if known.sum() < 2:
        return line("gain", "too few matches to compare cameras", "unknown", "see rows, measured")
    spread = float(np.ptp(grey[known]))
    colour = float(abs(tint[known]).max())
    each = ", ".join(f"{n} {np.exp(g):.2f}" if g == g else f"{n} ?" for n, g in zip(names, grey, strict=True))
    return line(
        "gain",
        f"grey levels of matched points, {names[reference]} = 1: {each}"
        + (f"; colours differ by {100 * colour:.0f} %" if measured.shape[1] > 1 else ""),
        worst([verdict_of(spread, GOOD_GAIN, BAD_GAIN), verdict_of(colour, GOOD_GAIN, BAD_GAIN)]),
        "lock exposure time, gain and white balance to the same values in all cameras",
        ratio={n: float(np.exp(g)) for n, g in zip(names, grey, strict=True)},
        spread=spread,
        colour=colour,
    )


def clipped(images: Sequence[np.ndarray]) -> np.ndarray:
    """float64 [K, 2]: shares of pixels with a channel at 254 or more, and with all channels at 1 or less."""
    shares = [
        (float((np.atleast_3d(i).max(axis=2) >= 254).mean()), float((np.atleast_3d(i).max(axis=2) <= 1).mean()))
        for i in images
    ]
    return np.array(shares)


def exposure_line(shares: np.ndarray, names: Sequence[str]) -> Line:
    """`shares`: float64 [K, 2] of `clipped`, mean over the frames."""
    white, black = (names[int(k)] for k in shares.argmax(axis=0))
    most_white, most_black = (float(v) for v in shares.max(axis=0))
    return line(
        "exposure",
        f"at most {100 * most_white:.1f} % white ({white}) and {100 * most_black:.1f} % black ({black})",
        verdict_of(max(most_white, most_black), 0.05, 0.3),
        "nothing can be matched where pixels are clipped: change the exposure in all cameras alike",
        white=shares[:, 0].tolist(),
        black=shares[:, 1].tolist(),
    )


def skew_line(times: np.ndarray, names: Sequence[str], geometry: ArrayGeometry, near: float) -> Line:
    """`times`: float64 [frames, K] seconds, empty where the recording has no time stamps of single cameras."""
    if not len(times):
        return line(
            "time-stamp skew",
            "the recording does not say when each camera exposed",
            "unknown",
            "make sure that the cameras share one trigger: whoever moves is elsewhere in every view otherwise",
        )
    spans = np.ptp(times, axis=1)
    typical, largest = float(np.median(spans)), float(spans.max())
    late = np.median(times - times.mean(axis=1, keepdims=True), axis=0)
    k = int(abs(late).argmax())
    moved = geometry.focal[0] * SPEED * typical / near
    return line(
        "time-stamp skew",
        f"{1000 * typical:.2f} ms in the median, {1000 * largest:.2f} ms at most, {names[k]} {1000 * late[k]:+.2f} ms; "
        f"{moved:.1f} px for {SPEED:g} m/s at {near:g} m",
        verdict_of(moved, 0.5, 2.0),
        f"trigger all cameras from one source ({names[k]} is off most), or group frames by a smaller tolerance",
        median_ms=1000 * typical,
        max_ms=1000 * largest,
        moved_px=moved,
        late_ms=(1000 * late).tolist(),
    )


def dropped_lines(dropped: Sequence[Dropped] | None, kept: int) -> list[Line]:
    """How many images belong to no frame, beside `kept` that do; no line for readers that drop none (None)."""
    if dropped is None:
        return []
    lost = sum(part.images for part in dropped)
    share = lost / (lost + kept)
    return [
        line(
            "dropped images",
            f"{lost} of {lost + kept}" + "".join(f"; {part}" for part in dropped),
            verdict_of(share, 0.02, 0.2),
            "trigger the cameras together, set one clock and record at a rate that the disk bears; or see --tolerance",
            images=lost,
            share=share,
            reasons={part.reason: part.images for part in dropped},
        )
    ]
