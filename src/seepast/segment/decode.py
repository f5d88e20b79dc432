"""From what networks say to P(dynamic) in the pixels of the image: one function per shape of output.

All return float32 [h, w] in 0..1. Instances that overlap are joined by the largest P. Pixel centres lie at integer
coordinates; a network's cell i of n covers the n-th part of its input, so its centre is (i + 1/2) / n of the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..errors import ModelError
from .prepare import Placement, Size

MOST = 300  # objects in one image; more are noise
SAME_OBJECT = 0.7  # boxes of one class that overlap by more (intersection over union) are one object


@dataclass(frozen=True, eq=False)
class Detections:
    """n objects: boxes float [n, 4] x1 y1 x2 y2 in the network's input, labels int [n], scores float [n] in 0..1, and
    what their masks are made of, float [n, ...]."""

    boxes: np.ndarray
    labels: np.ndarray
    scores: np.ndarray
    masks: np.ndarray

    def __getitem__(self, which: np.ndarray) -> Detections:
        return Detections(self.boxes[which], self.labels[which], self.scores[which], self.masks[which])


# ------------------------------------------------------------------------------- one value for every pixel
def person_map(output: np.ndarray, placement: Placement, channels_last: bool) -> np.ndarray:
    """P(person) of one image from [h, w], [1, h, w] or, background first, [2, h, w] (or channels last).

    Two channels are turned into probabilities where they are not yet (softmax). Raises ModelError for anything else.
    """
    planes = _channels_first(output, channels_last, (1, 2))
    if planes.shape[0] not in (1, 2):
        raise ModelError(f"its output has {planes.shape[0]} channels where a map of people has 1 or 2")
    p = planes[0] if planes.shape[0] == 1 else probabilities(planes)[1]
    if not (p.min() >= -0.01 and p.max() <= 1.01):
        raise ModelError(
            f"its output goes from {p.min():.3g} to {p.max():.3g}, so it is no probability; export it with its sigmoid"
        )
    return _enlarged(p, placement)


def class_map(output: np.ndarray, placement: Placement, channels_last: bool, chosen: Sequence[int]) -> np.ndarray:
    """P(one of the chosen classes) of one image from logits or probabilities [C, h, w] (or channels last), or from
    whole-numbered labels [h, w] or [1, h, w]."""
    if output.dtype.kind in "iu":
        labels = output.reshape([n for n in output.shape if n != 1] if output.ndim == 3 else output.shape)
        return _enlarged(np.isin(labels, chosen).astype(np.float32), placement)
    planes = probabilities(_channels_first(output, channels_last))
    return _enlarged(planes[list(chosen)].sum(axis=0), placement)


def probabilities(planes: np.ndarray) -> np.ndarray:
    """float32 [C, h, w] that sums to 1 over C: the softmax, or `planes` where the network has taken it already."""
    planes = planes.astype(np.float32)
    if planes.min() >= -1e-3 and np.abs(planes.sum(axis=0) - 1).max() < 1e-2:
        return planes
    planes -= planes.max(axis=0)
    np.exp(planes, out=planes)
    planes /= planes.sum(axis=0)
    return planes


def _channels_first(output: np.ndarray, channels_last: bool, counts: tuple[int, ...] = ()) -> np.ndarray:
    """[C, h, w]; among `counts`, where given, lies C."""
    if output.ndim == 2:
        return output[None]
    if output.ndim != 3:
        raise ModelError(f"its output has {output.ndim + 1} axes; one with 3 or 4 is needed")
    if counts and (output.shape[-1] in counts) != (output.shape[0] in counts):
        channels_last = output.shape[-1] in counts
    return np.moveaxis(output, -1, 0) if channels_last else output


def _enlarged(p: np.ndarray, placement: Placement) -> np.ndarray:
    """float32 in the image's pixels; the map covers the whole image, stretched. Raises ModelError for NaN."""
    if not np.isfinite(p).all():
        raise ModelError("its output holds NaN or infinities; the file, or its number format, is at fault")
    return np.clip(cv2.resize(p.astype(np.float32), placement.size, interpolation=cv2.INTER_LINEAR), 0, 1)


# ------------------------------------------------------------------------------------------------ instances
def instances(found: Detections, placement: Placement, size: Size, chosen: Sequence[int], least: float) -> np.ndarray:
    """Mask R-CNN: found.masks float [n, 1, h, w] or [n, h, w], P of the object, over its box or over the whole input.

    size: (width, height) of the network's input; least: scores below do not count.
    """
    found = _wanted(found, chosen, least)
    p = np.zeros(placement.size[::-1], np.float32)
    whole = found.masks.shape[-2:] == size[::-1]  # pasted already, and a little beyond their boxes
    for box, mask in zip(found.boxes, found.masks, strict=True):
        cells = np.ascontiguousarray(mask.reshape(mask.shape[-2:]), np.float32)
        covers = np.array((0, 0, *size) if whole else box, float)
        _paint(p, cells, covers, covers, placement)
    return np.clip(p, 0, 1)


def prototypes(
    found: Detections,
    planes: np.ndarray,
    placement: Placement,
    size: Size,
    chosen: Sequence[int],
    least: float,
) -> np.ndarray:
    """YOLO with segments: found.masks float [n, M], weights of the prototypes `planes` [M, h, w] over the whole input.

    P = sigmoid of the weighted sum, inside the box. size, least: as in `instances`.
    """
    found = _wanted(found, chosen, least)
    p = np.zeros(placement.size[::-1], np.float32)
    covers = np.array((0, 0, *size), float)
    for box, weights in zip(found.boxes, found.masks, strict=True):
        cells = np.tensordot(weights.astype(np.float32), planes.astype(np.float32), axes=1)
        _paint(p, cells, covers, box, placement, logits=True)
    return p


def _wanted(found: Detections, chosen: Sequence[int], least: float) -> Detections:
    whole = np.isfinite(found.boxes).all(axis=1)
    return found[whole & np.isin(found.labels, chosen) & (found.scores >= least)]


def _paint(
    p: np.ndarray,
    cells: np.ndarray,
    covers: np.ndarray,
    box: np.ndarray,
    placement: Placement,
    logits: bool = False,
) -> None:
    """Raise p, float32 [h, w] of the image, to the bilinear values of `cells` at the pixels whose centres lie in `box`.

    cells: float32 [n, m] over the rectangle `covers`, beyond it (the logits of) P = 0. Boxes are x1 y1 x2 y2 in the
    network's input.
    """
    scale, offset = np.array(placement.scale), np.array(placement.offset)
    low, high = ((np.asarray(corner, float) - offset) / scale for corner in (box[:2], box[2:]))
    (x1, y1), (x2, y2) = (np.clip(np.ceil(c - 0.5), 0, placement.size).astype(int) for c in (low, high))
    if x2 <= x1 or y2 <= y1:
        return
    left, top, right, bottom = covers
    per_pixel = np.array([cells.shape[1] / (right - left), cells.shape[0] / (bottom - top)])  # cells per input pixel
    start = ((np.array([x1, y1]) + 0.5) * scale + offset - (left, top)) * per_pixel - 0.5
    along = scale * per_pixel
    values = cv2.warpAffine(
        cells,
        np.array([[along[0], 0, start[0]], [0, along[1], start[1]]]),
        (int(x2 - x1), int(y2 - y1)),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE if logits else cv2.BORDER_CONSTANT,
    )
    region = p[y1:y2, x1:x2]
    np.maximum(region, 1 / (1 + np.exp(-np.clip(values, -30, 30))) if logits else values, out=region)


# --------------------------------------------------------------------------------------- how YOLO lists objects
def yolo(rows: np.ndarray, weights: int) -> Detections:
    """YOLOv8, v9, 11: [4 + C + M, n]: centre x y, width, height, C scores, M weights. Raises ModelError."""
    centre, scores, masks = _split(rows.T, 4, weights)
    return distinct(_best(centre, scores, masks))


def yolov5(rows: np.ndarray, weights: int) -> Detections:
    """YOLOv5: [n, 5 + C + M]: centre x y, width, height, score of there being anything, C scores, M weights."""
    centre, scores, masks = _split(rows, 5, weights)
    return distinct(_best(centre, centre[:, 4:] * scores, masks))


def yolo_e2e(rows: np.ndarray, weights: int) -> Detections:
    """YOLO26 and exports with their own suppression: [n, 6 + M]: x1 y1 x2 y2, score, class, M weights."""
    if rows.shape[1] != 6 + weights:
        raise ModelError(f"its rows have {rows.shape[1]} numbers where 6 and {weights} weights are needed")
    return Detections(rows[:, :4], np.rint(rows[:, 5]).astype(int), rows[:, 4], rows[:, 6:])


ROWS = {"yolo": yolo, "yolov5": yolov5, "yolo-e2e": yolo_e2e}


def _split(rows: np.ndarray, head: int, weights: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    classes = rows.shape[1] - head - weights
    if classes < 1:
        raise ModelError(
            f"its rows have {rows.shape[1]} numbers, which leaves {classes} classes beside {head} and {weights} weights"
        )
    return rows[:, :head], rows[:, head : head + classes], rows[:, head + classes :]


def _best(centre: np.ndarray, scores: np.ndarray, masks: np.ndarray) -> Detections:
    half = centre[:, 2:4] / 2
    boxes = np.concatenate([centre[:, :2] - half, centre[:, :2] + half], axis=1)
    return Detections(boxes, scores.argmax(axis=1), scores.max(axis=1), masks)


def distinct(found: Detections, least: float = 0.05) -> Detections:
    """Of boxes of one class that overlap by more than SAME_OBJECT only the best (greedy non-maximum suppression), and
    the MOST best of all.

    least: scores below go first, so that thousands of nothings need not be compared.
    """
    found = found[np.flatnonzero(found.scores >= least)]
    order = np.argsort(-found.scores, kind="stable")
    kept: list[int] = []
    while order.size and len(kept) < MOST:
        first, rest = order[0], order[1:]
        kept.append(int(first))
        same = (found.labels[rest] == found.labels[first]) & (
            _overlap(found.boxes[first], found.boxes[rest]) > SAME_OBJECT
        )
        order = rest[~same]
    return found[np.array(kept, int)]


def _overlap(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    common = np.clip(high - low, 0, None).prod(axis=1)
    area = np.clip(box[2:] - box[:2], 0, None).prod()
    areas = np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1)
    return common / np.maximum(area + areas - common, 1e-9)
