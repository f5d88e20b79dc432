"""The report's pictures, drawn from what was measured: uint8 BGR [H, W, 3] images, and SVG texts of the array."""

from __future__ import annotations

from html import escape

import cv2
import numpy as np

from ..check import Report
from ..focal import DYNAMIC
from ..rectify import NO_RAY
from .array import person_depths
from .images import BAD_ROWS_PX, GOOD_ROWS_PX
from .seeing import widest_seen_past

GREEN, YELLOW, RED, BLUE = (80, 175, 60), (0, 200, 240), (50, 50, 230), (220, 120, 30)
ROWS = 9  # lines drawn across the views
VIEW_WIDTH = 420  # px of one camera's picture
PLOT = (520, 260)  # px of a drawing


def views_with_rows(report: Report) -> np.ndarray:
    """All rectified views side by side under one set of rows: what one row shows must be the same in all."""
    views = [_shown(view) for view in report.first.views]
    strip = np.hstack(views)
    for row in np.linspace(0, strip.shape[0] - 1, ROWS + 2).astype(int)[1:-1]:
        cv2.line(strip, (0, int(row)), (strip.shape[1], int(row)), YELLOW, 1)
    return strip


def row_errors(report: Report) -> np.ndarray:
    """Matches with the next view in every view: green within GOOD_ROWS_PX, yellow, red beyond BAD_ROWS_PX."""
    drawn = []
    for matches in report.first.matches:
        view = _shown(_bgr(report.first.views[matches.first]) // 2)
        scale = view.shape[1] / report.geometry.size[0]
        for x, y, error in zip(matches.x, matches.y, abs(matches.row_error), strict=True):
            colour = GREEN if error <= GOOD_ROWS_PX else YELLOW if error <= BAD_ROWS_PX else RED
            cv2.circle(view, (round(scale * float(x)), round(scale * float(y))), 2, colour, -1, cv2.LINE_AA)
        drawn.append(view)
    return np.hstack(drawn)


def masks_over_views(report: Report) -> np.ndarray | None:
    """What the masks call dynamic, in red over every view."""
    dynamic = report.first.dynamic
    if dynamic is None:
        return None
    tinted = []
    for view, p in zip(report.first.views, dynamic, strict=True):
        weight = np.where(p == NO_RAY, 0, p / 254 * 0.65)[..., None]
        tinted.append(_shown((_bgr(view) * (1 - weight) + np.array(RED) * weight).astype(np.uint8)))
    return np.hstack(tinted)


def hidden_pixels(report: Report) -> np.ndarray | None:
    """The reference: hidden pixels green where two cameras see behind, yellow for one, red for none."""
    behind = report.first.hidden
    if behind is None or report.first.dynamic is None:
        return None
    reference = report.geometry.reference
    picture = _bgr(report.first.views[reference]) // 2
    colours = np.array([RED, YELLOW, GREEN], np.uint8)[np.minimum(behind.seen, 2)]
    for dy in range(behind.step):
        for dx in range(behind.step):
            y = np.minimum(behind.y + dy, picture.shape[0] - 1)
            x = np.minimum(behind.x + dx, picture.shape[1] - 1)
            inside = _dynamic(report.first.dynamic[reference])[y, x]
            picture[y[inside], x[inside]] = colours[inside]
    return _shown(picture)


def _dynamic(p: np.ndarray) -> np.ndarray:
    return (p >= DYNAMIC) & (p != NO_RAY)


def _bgr(view: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(view, cv2.COLOR_GRAY2BGR) if view.ndim == 2 else view.copy()


def _shown(view: np.ndarray) -> np.ndarray:
    view = _bgr(view)
    scale = min(1.0, VIEW_WIDTH / view.shape[1])
    return cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


# -------------------------------------------------------------------------------------------------- drawings


def array_plan(report: Report) -> str:
    """SVG: the camera centres from above and from behind, what is off the line drawn ten times as large."""
    positions = report.geometry.positions
    left, length = positions[:, 0].min(), float(np.ptp(positions[:, 0]))
    width, height = PLOT[0], 150
    px = 40 + (positions[:, 0] - left) / length * (width - 80)
    parts = []
    for label, column, base in (("from above (depth)", 2, 45), ("from behind (height)", 1, 115)):
        off = base + np.clip(10 * positions[:, column] * (-1 if column == 2 else 1) / length * (width - 80), -25, 25)
        parts.append(f'<line x1="30" x2="{width - 30}" y1="{base}" y2="{base}" stroke="#bbb"/>')
        parts.append(f'<text x="30" y="{base - 28}">{label}</text>')
        for x, y, name in zip(px, off, report.cameras, strict=True):
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5"/>')
            parts.append(f'<text x="{x:.1f}" y="{y + 18:.1f}" text-anchor="middle">{escape(name)}</text>')
    return _svg(width, height, parts)


def width_plot(report: Report) -> str:
    """SVG: the widest person of whose background one camera, or two, see every point, by the person's depth."""
    along, far = report.geometry.positions[:, 0], report.background
    near = person_depths(min(report.depths[0], far / 2), far)[0]
    depths = np.linspace(near, far, 60)
    curves = {
        "one camera sees all behind": [widest_seen_past(along, z, far) for z in depths],
        "two cameras do": [widest_seen_past(along, z, far, 2) for z in depths],
    }
    return _plot(depths, curves, "depth of the person, m", "width, m")


def disparity_plot(report: Report) -> str:
    """SVG: disparity over the array by depth."""
    near, far = report.depths
    depths = 1 / np.linspace(1 / near, 1 / far, 80)
    curve = {"disparity over the array": list(report.geometry.focal_baseline / depths)}
    return _plot(depths, curve, "depth, m", "px")


def _plot(x: np.ndarray, curves: dict[str, list[float]], x_label: str, y_label: str) -> str:
    width, height = PLOT
    top = max(max(values) for values in curves.values()) or 1.0
    colours = ("#1e78dc", "#e0622a")

    def place(a: float, b: float) -> tuple[float, float]:
        return 60 + (a - x[0]) / (x[-1] - x[0]) * (width - 80), height - 40 - b / top * (height - 70)

    parts = [f'<text x="{width / 2}" y="{height - 6}" text-anchor="middle">{x_label}</text>']
    parts.append(f'<text x="8" y="18">{y_label}</text>')
    for part in np.linspace(0, 1, 5):
        a, b = place(x[0] + part * (x[-1] - x[0]), part * top)
        parts.append(
            f'<text x="{a:.0f}" y="{height - 24}" text-anchor="middle">{x[0] + part * (x[-1] - x[0]):.3g}</text>'
        )
        parts.append(f'<text x="54" y="{b + 4:.0f}" text-anchor="end">{part * top:.3g}</text>')
        parts.append(f'<line x1="60" x2="{width - 20}" y1="{b:.1f}" y2="{b:.1f}" stroke="#ddd"/>')
    for i, (label, values) in enumerate(curves.items()):
        points = " ".join("{:.1f},{:.1f}".format(*place(a, b)) for a, b in zip(x, values, strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colours[i]}" stroke-width="2"/>')
        parts.append(f'<text x="{width - 24}" y="{20 + 16 * i}" text-anchor="end" fill="{colours[i]}">{label}</text>')
    return _svg(width, height, parts)


def _svg(width: int, height: int, parts: list[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">{"".join(parts)}</svg>'
    )
