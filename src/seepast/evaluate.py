"""How right a reconstruction is, where the truth is known (FORMAT.md, truth/): the figures of COLUMNS.

psnr, ssim   background against the true image in dB, over the pixels that a person hides from the reference
             camera and at least one camera truly sees (ssim: mean of the SSIM map there); "psnr 1" where
             exactly one sees it (no match is possible there), "psnr 2+" where two or more do
bad1 hid     % of those pixels whose disparity is off by more than 1 px over the full array; "bad1 1" and
             "bad1 2+" likewise; unknown disparity counts as off
bad1 vis     the same over the pixels that no person hides from the reference camera
flag         % of the hidden pixels that NO camera sees and that are flagged so (coverage 0)
lost         % of the hidden pixels that some camera sees but that are flagged as unseen (coverage 0)
iou in, out  dynamic-mask intersection over union before and after, mean over cameras, at P >= 0.5

Of a Middlebury folder (datasets/middlebury.py) only the disparity of some views is true: "bad1 vis", and "bad1 hid"
where it has masks.

A figure without any pixel to count is NaN and left out of the mean.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from .datasets import NO_MASKS, OpenOptions
from .datasets.middlebury import MiddleburyDataset, is_middlebury_dataset
from .errors import DatasetError, MissingExtraError

COLUMNS = (
    *("psnr", "psnr 1", "psnr 2+", "ssim", "bad1 hid", "bad1 1", "bad1 2+", "bad1 vis", "flag", "lost"),
    *("iou in", "iou out"),
)
SHARES = ("ssim", "iou in", "iou out")  # 0..1, printed with a third decimal
MEAN = "MEAN"

Row = dict[str, float]


@dataclass(frozen=True, eq=False)
class Truth:
    """What is known of one stamp, in the rectified reference view [H, W].

    background  uint8 [H, W] or [H, W, 3]
    disparity   float32 px, 0 unknown
    seen_by     uint8 or uint16, bit k: camera k truly sees it
    hidden      bool: a person hides it from the reference camera
    visible     bool: nobody does; pixels without a ray of the reference camera are neither
    """

    background: np.ndarray
    disparity: np.ndarray
    seen_by: np.ndarray
    hidden: np.ndarray
    visible: np.ndarray


def evaluate(dataset: str | Path, out: str | Path, masks: str | None = "masks") -> dict[str, Row]:
    """One row of COLUMNS per stamp of `dataset`, and their MEAN (NaN left out).

    dataset   a recording with truth/, or a Middlebury folder with disp1 or the like, or a folder of such recordings
              (rows are then named after them, and `out` holds one output folder of the same name for each)
    out       what `seepast run` wrote for it
    masks     the folder of input masks inside the dataset, for "iou in" (NaN with None)

    Raises DatasetError where truth or output is missing, unreadable or of another size or reference camera,
    and MissingExtraError without scikit-image.
    """
    dataset, out = Path(dataset), Path(out)
    ssim_map = _ssim_map()
    rows: dict[str, Row] = {}
    for name, recording, output in _recordings(dataset, out):
        if not (recording / "truth").is_dir():
            rows[name or recording.resolve().name] = _score_middlebury(recording, output, masks)
            continue
        stamps = sorted(path.stem for path in (recording / "truth" / "background").glob("*.png"))
        if not stamps:
            raise DatasetError(f"{recording}/truth/background: holds no PNG; there is nothing to compare with")
        reference = _same_reference(recording, output)
        for stamp in stamps:
            row = name if name and len(stamps) == 1 else "/".join(filter(None, (name, stamp)))
            rows[row] = _score(recording, output, stamp, masks, reference, ssim_map)
    rows[MEAN] = {column: _mean([row[column] for row in rows.values()]) for column in COLUMNS}
    return rows


def table(rows: Mapping[str, Row]) -> str:
    """The rows as text, one line each, under a line of column names."""
    lines = [f"{'':18s}" + "".join(f"{column:>10s}" for column in COLUMNS)]
    for name, row in rows.items():
        cells = (f"{row[c]:10.3f}" if c in SHARES else f"{row[c]:10.2f}" for c in COLUMNS)
        lines.append(f"{name:18s}" + "".join(cells))
    return "\n".join(lines)


def read_truth(dataset: Path, stamp: str, reference: str = "cam0") -> Truth:
    """The truth of one stamp. Without truth/hidden/, the reference camera's exact mask says what is hidden (a
    rectified rig, whose images are the reference view). Raises DatasetError."""
    folder = dataset / "truth"
    disparity = _read(folder / "disparity" / f"{stamp}.pfm")
    hidden_file = folder / "hidden" / f"{stamp}.png"
    if not hidden_file.is_file():
        hidden_file = folder / "masks" / reference / f"{stamp}.png"
    hidden = _read(hidden_file)
    known = disparity > 0
    return Truth(
        background=_read(folder / "background" / f"{stamp}.png"),
        disparity=disparity,
        seen_by=_read(folder / "seen_by" / f"{stamp}.png"),
        hidden=(hidden > 127) & known,
        visible=(hidden == 0) & known,
    )


def _recordings(dataset: Path, out: Path) -> list[tuple[str, Path, Path]]:
    """(row name, recording, its output): one without a name, or one for each subfolder with truth/."""
    if _has_truth(dataset):
        return [("", dataset, out)]
    inner = sorted(filter(_has_truth, dataset.iterdir())) if dataset.is_dir() else []
    if not inner:
        raise DatasetError(
            f"{dataset}: has no truth/ folder, and no Middlebury views are there; only recordings with truth can be "
            "evaluated"
        )
    return [(path.name, path, out / path.name) for path in inner]


def _has_truth(path: Path) -> bool:
    return (path / "truth").is_dir() or is_middlebury_dataset(path)


def _score_middlebury(path: Path, out: Path, masks: str | None) -> Row:
    """What can be said where only the disparity of the reference view is true."""
    folder = masks if masks is not None and (path / masks).is_dir() else NO_MASKS
    dataset = MiddleburyDataset(path, OpenOptions(masks=folder))
    reference = _camera_name(out) or "cam0"
    if dataset.truth and reference not in dataset.truth:
        raise DatasetError(
            f"{out}: was reconstructed in the view of {reference}, but the true disparity of {path} is of "
            f"{' and '.join(dataset.truth)}; run again with --reference {dataset.truth[0]}"
        )
    truth = dataset.true_disparity(reference)
    disparity = _read(out / "disparity" / f"{dataset.stamps[0]}.pfm", like=truth)
    bad = ~(np.abs(disparity.astype(float) - truth) <= 1)
    given = dataset.frame(dataset.stamps[0]).masks
    mask = np.zeros(truth.shape, np.uint8) if given is None else given[dataset.rig.index(reference)]
    row = dict.fromkeys(COLUMNS, float("nan"))
    row["bad1 hid"] = 100 * _average(bad[(mask > 127) & (truth > 0)])
    row["bad1 vis"] = 100 * _average(bad[(mask == 0) & (truth > 0)])
    return row


def _same_reference(dataset: Path, out: Path) -> str:
    """Name of the reference camera; raises DatasetError where truth and output have different ones."""
    truth, made = (_camera_name(folder) for folder in (dataset / "truth", out))
    if made and made != (truth or "cam0"):
        raise DatasetError(
            f"{out}: was reconstructed in the view of {made}, but the truth of {dataset} is in that of "
            f"{truth or 'cam0'}; run again with --reference {truth or 'cam0'}"
        )
    return truth or "cam0"


def _camera_name(folder: Path) -> str | None:
    try:
        return str(yaml.safe_load((folder / "camera.yaml").read_text(encoding="utf-8"))["camera"])
    except FileNotFoundError:
        return None
    except (OSError, yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError):
        raise DatasetError(
            f"{folder / 'camera.yaml'}: names no 'camera'; it is not a view that seepast wrote"
        ) from None


def _score(
    dataset: Path,
    out: Path,
    stamp: str,
    masks: str | None,
    reference: str,
    ssim_map: Callable[..., np.ndarray],
) -> Row:
    truth = read_truth(dataset, stamp, reference)
    image = _read(out / "background" / f"{stamp}.png", like=truth.background)
    disparity = _read(out / "disparity" / f"{stamp}.pfm", like=truth.disparity)
    coverage = _read(out / "coverage" / f"{stamp}.png", like=truth.disparity)
    seen = _bits(truth.seen_by)
    some, never = truth.hidden & (seen > 0), truth.hidden & (seen == 0)
    one, more = truth.hidden & (seen == 1), truth.hidden & (seen >= 2)
    error = _over_channels((image.astype(float) - truth.background) ** 2)
    bad = ~(np.abs(disparity.astype(float) - truth.disparity) <= 1)  # so that NaN is bad
    before, after = _mask_iou(dataset, out, stamp, masks)
    values = (
        *(_psnr(error[where]) for where in (some, one, more)),
        _average(ssim_map(truth.background, image)[some]),
        *(100 * _average(bad[where]) for where in (some, one, more, truth.visible)),
        *(100 * _average(coverage[where] == 0) for where in (never, some)),
        *(before, after),
    )
    return dict(zip(COLUMNS, values, strict=True))


def _mask_iou(dataset: Path, out: Path, stamp: str, masks: str | None) -> tuple[float, float]:
    """Intersection over union with the truth of the input and of the refined masks, means over cameras."""
    before, after = [], []
    for folder in sorted((dataset / "truth" / "masks").iterdir()):
        name = Path(folder.name) / f"{stamp}.png"
        truth = _read(folder / f"{stamp}.png")
        after.append(_iou(_read(out / "masks" / name, like=truth), truth))
        if masks is not None:
            before.append(_iou(_read(dataset / masks / name, like=truth), truth))
    return _mean(before), _mean(after)


def _iou(probability: np.ndarray, truth: np.ndarray) -> float:
    one, other = probability >= 128, truth >= 128
    return float((one & other).sum() / max((one | other).sum(), 1))


def _psnr(squared_error: np.ndarray) -> float:
    """dB of 8-bit images from squared errors; 1e-9 stands for a perfect match."""
    if not squared_error.size:
        return float("nan")
    return float(10 * np.log10(255**2 / max(squared_error.mean(), 1e-9)))


def _average(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _mean(values: list[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _bits(labels: np.ndarray) -> np.ndarray:
    """Number of bits set, per pixel."""
    return sum(((labels >> k) & 1).astype(np.uint8) for k in range(8 * labels.itemsize))  # type: ignore[return-value]


def _over_channels(values: np.ndarray) -> np.ndarray:
    return values.mean(axis=-1) if values.ndim == 3 else values


def _ssim_map() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """SSIM per pixel [H, W] of two uint8 images, the mean of the channels (Wang et al. 2004)."""
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise MissingExtraError("scikit-image", "evaluate", "seepast evaluate") from error

    def compare(truth: np.ndarray, image: np.ndarray) -> np.ndarray:
        channels = 2 if truth.ndim == 3 else None
        return _over_channels(structural_similarity(truth, image, channel_axis=channels, full=True)[1])

    return compare


def _read(path: Path, like: np.ndarray | None = None) -> np.ndarray:
    """An image as it is stored. Raises DatasetError where there is none or its shape is not `like`'s."""
    if not path.is_file():
        raise DatasetError(f"{path}: is missing; the reconstruction (or the truth) is not complete")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"{path}: cannot be read as an image; write it again")
    if like is not None and image.shape != like.shape:
        made, true = ("x".join(map(str, shape)) for shape in (image.shape, like.shape))
        raise DatasetError(
            f"{path}: is {made} (rows x columns x channels), the truth is {true}; they do not belong together"
        )
    return image
