"""Confidence: what the evidence bytes hold, that P is sane, and that it is about right on scenes made here."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from arrays import Scene, array, make_scene
from seepast import backends, confidence
from seepast.confidence import COARSE_VIEWS, PAPER, VIEWS
from seepast.frames import Frame
from seepast.many import UNITS
from seepast.multiview import see_past
from seepast.options import Options
from seepast.pipeline import Clock
from seepast.pipeline import see_past as see_past_paper

D = 12 * UNITS  # px over the array, in 32nds


def flat_views(cameras: int = 3, size: tuple[int, int] = (48, 24)):
    """An array before one fronto-parallel wall: geometry, disparities [K, H, W], static [K, H, W]."""
    shape = (cameras, size[1], size[0])
    return array(cameras, size), np.full(shape, D, np.uint16), np.ones(shape, bool)


def evidence_of(geometry, found, static, backend: str = "cpu") -> np.ndarray:
    stages = backends.multiview(backends.get(backend))
    d = found[geometry.reference]
    shown, _, close = stages.labels(d, found, static, geometry, round(1.5 * UNITS))
    return stages.evidence(d, static[geometry.reference], close, shown)


def parts(evidence: np.ndarray) -> tuple[np.ndarray, ...]:
    """own, close, loose, flatness."""
    return evidence >> 7, evidence >> 5 & 3, evidence >> 3 & 3, evidence & 7


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_views_that_agree_are_counted_by_how_closely(backend):
    geometry, found, static = flat_views()
    found[2] += UNITS  # the last camera is off by 1 px
    own, close, loose, flat = parts(evidence_of(geometry, found, static, backend)[8:-8, 20:-8])
    assert (own == 1).all() and (close == 1).all() and (loose == 1).all() and (flat == 7).all()


def test_rays_on_people_and_off_the_view_confirm_nothing():
    geometry, found, static = flat_views()
    static[0], static[1, :, :20] = False, False
    own, close, loose, _ = parts(evidence_of(geometry, found, static))
    assert (own == 0).all() and (loose == 0).all()
    x = np.arange(48)
    middle, last = (x - 6 >= 20), (x - 12 >= 0)  # where the rays of cameras 1 and 2 land
    assert (close == (middle.astype(int) + last)[None]).all()


def test_what_no_camera_sees_has_confidence_zero_and_all_else_has_not():
    geometry, found, static = flat_views()
    static[0] = False
    evidence = evidence_of(geometry, found, static)
    stages = backends.multiview(backends.get("cpu"))
    shown, _, _ = stages.labels(found[0], found, static, geometry, round(1.5 * UNITS))
    p = confidence.probability(evidence, VIEWS)
    assert p.shape == shown.shape and p.dtype == np.float32
    assert (shown == 0).any() and ((p == 0) == (shown == 0)).all() and p.max() < 1


def test_flatness_falls_near_a_step_and_reaches_four_pixels():
    nothing = np.zeros((20, 40), np.uint8)
    d = np.full(nothing.shape, D, np.uint16)
    d[:, 20:] += 2 * UNITS
    flat = parts(confidence.packed(nothing, nothing, nothing, d))[3]
    assert (flat[:, :16] == 7).all() and (flat[:, 24:] == 7).all() and (flat[:, 16:24] == 1).all()
    d[:, 20:] += 20 * UNITS
    assert (parts(confidence.packed(nothing, nothing, nothing, d))[3][:, 16:24] == 0).all()


def test_many_views_count_as_three():
    many, d = np.full((4, 4), 15, np.uint8), np.full((4, 4), D, np.uint16)
    assert (confidence.packed(np.ones_like(many), many, many, d) == 255).all()


def test_evidence_of_the_papers_labels():
    labels = np.array([[0b00000, 0b00100, 0b00111, 0b11111, 0b11011]], np.uint16)
    own, close, loose, _ = parts(confidence.of_labels(np.full(labels.shape, 12, np.float32), labels, reference=2))
    assert own.tolist() == [[0, 1, 1, 1, 0]] and close.tolist() == [[0, 0, 2, 3, 3]] and not loose.any()


def test_rays_are_counted_in_all_sixteen_bits():
    labels = np.arange(1 << 16, dtype=np.uint16).reshape(256, 256)
    assert confidence.ray_count(labels).ravel().tolist() == [bin(i).count("1") for i in range(1 << 16)]


@pytest.mark.parametrize("calibration", [PAPER, VIEWS, COARSE_VIEWS])
def test_confidence_never_falls_with_agreement_or_flatness(calibration):
    p = calibration.table.reshape(2, 4, 4, 8)
    assert p.dtype == np.float32 and p.min() >= 0 and p.max() < 1 and (p[0, 0, 0] == 0).all()
    for axis in (1, 2, 3):
        assert (np.diff(p, axis=axis) >= 0).all()
    own = calibration.support[1]
    assert own[3][0] > own[0][0] + 1 and calibration.flat[7] > calibration.flat[0] + 1, "log-odds"


def hard_scene(seed: int) -> Scene:
    return make_scene(size=(160, 96), surface="step", noise=14, colour=True, seed=seed)


def views_confidence(scene: Scene, options: Options) -> tuple[np.ndarray, np.ndarray]:
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    stages = backends.multiview(backends.get("cpu"))
    with patch.object(stages, "labels", wraps=stages.labels) as labels:
        found, _ = see_past(frame, scene.geometry, options, stages, False, Clock())
    d, _, static, geometry, *_ = labels.call_args.args
    _, _, close = stages.labels(*labels.call_args.args)
    evidence = stages.evidence(d, static[geometry.reference], close, found["labels"])
    return confidence.probability(evidence, VIEWS), found["disparity"]


def paper_confidence(scene: Scene, options: Options) -> tuple[np.ndarray, np.ndarray]:
    frame = Frame(scene.colour, scene.grey, scene.dynamic)
    found, _ = see_past_paper(frame, scene.geometry, options, backends.get("cpu"), False, Clock())
    evidence = confidence.of_labels(found["disparity"], found["labels"], scene.geometry.reference)
    return confidence.probability(evidence, PAPER), found["disparity"]


@pytest.mark.parametrize(
    ("preset", "method", "bound"), [("accurate", views_confidence, 0.12), ("paper", paper_confidence, 0.3)]
)
def test_confidence_is_about_the_share_of_right_pixels(preset, method, bound):
    options = Options.preset(preset).updated({"range.max_disparity": 60})
    p, right = [], []
    for seed in range(2):
        scene = hard_scene(seed)
        c, disparity = method(scene, options)
        seen = c > 0
        p.append(c[seen])
        right.append((np.abs(disparity - scene.disparity) <= 1)[seen])
    c, ok = np.concatenate(p), np.concatenate(right)
    assert abs(c.mean() - ok.mean()) < bound
    assert c[ok].mean() > c[~ok].mean() + 0.05
