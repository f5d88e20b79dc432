"""The report as one HTML page that needs nothing beside itself."""

from __future__ import annotations

import base64
from html import escape

import cv2
import numpy as np

from .. import __version__
from ..check import Report
from ..errors import OutputError
from . import pictures
from .screen import heading

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; width: 100% }
td, th { text-align: left; vertical-align: top; padding: .4rem .6rem; border-bottom: 1px solid #ddd }
figure { margin: 1.5rem 0 }
figcaption { color: #555; max-width: 60rem }
img { max-width: 100%; height: auto; border: 1px solid #ccc }
.v { font-weight: bold; border-radius: .3rem; padding: .1rem .5rem; color: #fff; white-space: nowrap }
.good { background: #2a8a4a }
.unknown { background: #6a7a8a }
.doubtful { background: #c78a00 }
.bad { background: #c0392b }
"""


def page(report: Report) -> str:
    """The whole page: the table of all checks, then what was seen in the first frame, then the array."""
    title = f"seepast check: {escape(report.name)}"
    rows = "".join(
        f"<tr><td>{escape(line.name)}</td><td>{_badge(line.verdict)}</td><td>{escape(line.value)}</td>"
        f"<td>{escape(line.remedy)}</td></tr>"
        for line in report.lines
    )
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f"<h1>{title} {_badge(report.verdict)}</h1><p>{'<br>'.join(map(escape, heading(report).splitlines()))}</p>"
        f"<table><tr><th>check</th><th>verdict</th><th>value</th><th>remedy</th></tr>{rows}</table>"
        f"<h2>Frame {escape(report.first.stamp)}</h2>{_images(report)}<h2>The array</h2>{_drawings(report)}"
        f"<p>seepast {__version__}</p></body></html>\n"
    )


def _badge(verdict: str) -> str:
    return f'<span class="v {verdict}">{verdict}</span>'


def _images(report: Report) -> str:
    shown = [
        (pictures.views_with_rows(report), "The rectified views: whatever lies on a line must do so in all of them."),
        (
            pictures.row_errors(report),
            "Matches with the next camera, by their row error: green good, yellow doubtful, red bad.",
        ),
        (pictures.masks_over_views(report), "What the masks call dynamic, in red."),
        (
            pictures.hidden_pixels(report),
            "Behind the people: green is seen by two or more other cameras, yellow by one, red by none.",
        ),
    ]
    return "".join(_figure(_embedded(image), caption) for image, caption in shown if image is not None)


def _drawings(report: Report) -> str:
    drawn = [
        (pictures.array_plan(report), "Camera centres; offsets from the line ten times as large."),
        (
            pictures.width_plot(report),
            f"How wide a person can be without hiding anything {report.background:.1f} m away from all cameras.",
        ),
        (pictures.disparity_plot(report), "Disparity over the whole array."),
    ]
    return "".join(_figure(svg, caption) for svg, caption in drawn)


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def _embedded(image: np.ndarray) -> str:
    encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    if not encoded:
        raise OutputError(f"picture of shape {image.shape} cannot be encoded as JPEG")
    return f'<img src="data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}" alt="">'
