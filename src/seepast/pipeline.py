"""The method on one screen: `see_past` calls one function per stage, in order, of whichever backend was chosen.

`Reconstructor` prepares what does not change from frame to frame (rectification maps, tables) and checks input;
`reconstruct` is the one-call form.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from . import backends, confidence, multiview
from .ahead import ahead
from .candidates import EIGHTHS, DisparityGrid
from .errors import DeviceError
from .evidence import UNCHANGED
from .frames import Frame, check_frame
from .geometry import ArrayGeometry
from .options import DEFAULT_PRESET, Options
from .rectify import rectify
from .result import Result
from .rig import Rig

log = logging.getLogger("seepast")

STAGES = (
    "rectify",
    "describe",
    "support",
    "prior",
    "disparity",
    "segmentation",
    "masks",
    "refocus",
    "confidence",
)  # of see_past


def see_past(
    frame: Frame,
    geometry: ArrayGeometry,
    options: Options,
    backend: ModuleType,
    dynamic_only: bool,
    clock: Clock,
) -> tuple[dict[str, np.ndarray], int]:
    """One instant of rectified views -> static scene, labels and refined masks (all in rectified pixels).

    Symbols: x reference pixel, d disparity, S^k static label of ray k, mu(x) the prior's plane mean.
    """
    grid = DisparityGrid.of(options.range, geometry.size[0])
    # S^k of every camera's own pixels, at first by thresholding the static prior S_P = 1 - P(dynamic)
    initial = static = frame.dynamic <= 254 * (1 - options.segmentation.threshold)

    # What is estimated: every reference pixel, or those that it does not see itself
    wanted = ~static[geometry.reference] if dynamic_only else np.ones_like(static[0])

    with clock("describe"):  # f(x): 3x3 Sobel responses, sampled 16 times around the pixel
        features = backend.describe(frame.grey)
    with clock("support"):  # sparse sure matches on static pixels, of all cameras, in the reference view
        near = backend.neighbourhood(wanted) if dynamic_only else None
        points = backend.support(features, static, geometry, grid, options.support, near)
    with clock("prior"):  # p(d|T,x) ~ gamma + exp(-(d - mu)^2 / 2 sigma^2), mu on the Delaunay planes
        prior = backend.prior(points, static.shape[1:], grid, options.prior)

    # EM until the labels stand still; after the first round only what changed is done again, which gives the same.
    redo, changed, rounds, still = wanted, np.zeros_like(static), 0, False
    raw, d = np.zeros_like(wanted, np.float32), np.full_like(wanted, -1, np.float32)
    labels, posterior = np.zeros_like(wanted, np.uint16), np.full_like(frame.dynamic, UNCHANGED)
    while not still and rounds < options.segmentation.max_rounds:
        with clock("disparity"):  # M-step: argmin_d beta Var_S(f(x^1) .. f(x^K)) - log p(d|T,x)
            if rounds:
                redo = backend.affected(changed, geometry, prior, grid, wanted, options)
            found = backend.disparity(features, static, geometry, prior, grid, redo, options)
            raw = np.where(redo, found, raw) if rounds else found
            before, d = d, backend.smooth(raw, prior, wanted, options.disparity)
        with clock("segmentation"):  # E-step: argmin_S beta Var_S - sum_k log p(S^k|S_P^k)
            redo = wanted & (d != before)
            found = backend.segmentation(features, frame.dynamic, geometry, d, redo, options)
            if rounds:
                found = np.where(redo, found[0], labels), np.where(redo, found[1], posterior)
            labels, posterior = found
        with clock("masks"):  # labels of (reference pixel, camera) pairs -> each camera's own pixels
            dynamic, refined = backend.masks(labels, posterior, geometry, d, wanted, frame.dynamic, initial)
            changed, static = refined != static, refined
        rounds, still = rounds + 1, not changed.any()

    keep = static[geometry.reference]  # the reference sees these itself
    if dynamic_only:  # the rest was not estimated: its own ray, and no disparity
        labels = np.where(wanted, labels, np.uint16(1 << geometry.reference))
        keep = keep | ~wanted
    with clock("refocus"):  # I* = sum_k S^k I_k(x^k) / sum_k S^k, 3x3 median
        kept = keep if options.refocus.keep_reference else ~wanted
        surface = np.where(wanted, d, prior.mean.astype(np.float32) / EIGHTHS)  # around the rest, to fill from
        background, coverage = backend.refocus(frame.colour, labels, geometry, surface, kept, options.refocus)
    with clock("confidence"):  # P(|d - truth| <= 1 px)
        sure = backend.probability(backend.evidence(d, labels, geometry.reference), confidence.PAPER.table)
    if dynamic_only:
        sure[~wanted] = 0
    return {
        "background": background,
        "disparity": d,
        "confidence": sure,
        "coverage": coverage,
        "labels": labels,
        "dynamic": dynamic,
    }, rounds


class Clock:
    """Milliseconds per stage, added up over the rounds; a stage within another one counts for itself alone."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._within = 0.0

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start, outer, self._within = time.perf_counter(), self._within, 0.0
        yield
        passed = 1e3 * (time.perf_counter() - start)
        self.milliseconds[stage] = self.milliseconds.get(stage, 0.0) + passed - self._within
        self._within = outer + passed


Images = Sequence[Any]  # of one instant: see Reconstructor.__call__
Masks = Sequence[Any] | None


@dataclass(frozen=True, eq=False)
class _Prepared:
    """One instant, checked and rectified by `backend`, once the mark `ready` has passed; images and masks as they came
    in, uint8."""

    backend: ModuleType
    frame: Frame
    images: list[np.ndarray]
    masks: list[np.ndarray]
    clock: Clock
    ready: Any


@dataclass(frozen=True, eq=False)
class _Started:
    """One instant, reconstructed once `found` returns: the arrays of a Result."""

    prepared: _Prepared
    found: Callable[[], dict[str, Any]]
    rounds: int


class Reconstructor:
    """Recovers the static scene frame by frame; keeps what frames share.

    rig           the calibrated array (2 .. 16 cameras)
    options       Options, default Options.preset(DEFAULT_PRESET)
    reference     camera whose view is reconstructed, by number or name
    backend       "auto", "cpu", "cuda" or "reference". "auto" is "cuda" where a GPU works, and turns to "cpu", with a
                  warning, when it stops working
    dynamic_only  estimate only pixels that a person hides from the reference. Disparity and depth are then 0
                  (unknown) and coverage 1 (the reference's own ray) everywhere else. Faster: what cannot lie behind
                  a person is not looked at (preset "paper": the prior rests on the support points around those pixels)
    threads       of the cpu backend and of rectification; 0 = all cores. The result does not depend on it
    on_device     results stay in the backend's arrays: on the GPU with "cuda" (CuPy's, for anything that takes DLPack
                  or __cuda_array_interface__; complete, whatever the stream)

    Raises RigError, OptionsError, BackendError. Calling it: see `__call__`.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        options: Options | None = None,
        reference: int | str = 0,
        backend: str = "auto",
        dynamic_only: bool = False,
        threads: int = 0,
        on_device: bool = False,
    ):
        self.rig = rig
        self.options = options or Options.preset(DEFAULT_PRESET)
        self.reference = rig.index(reference)
        self.rectification = rectify(rig, self.reference)
        self.backend = backends.get(backend)
        self.dynamic_only = dynamic_only
        self.threads = threads
        self.on_device = on_device
        self._may_change = backend == "auto"
        self._spare: deque[Frame] = deque(maxlen=4)  # of earlier instants, to be written over
        DisparityGrid.of(self.options.range, self.rectification.geometry.size[0])  # an empty range fails here

    def __call__(self, images: Images, masks: Masks) -> Result:
        """One instant: K images uint8 [h, w] or [h, w, 3] BGR; K masks uint8 255 * P(dynamic), bool, or floats 0..1.

        masks None: nothing is dynamic. With the backend "cuda" both may be on the GPU already: objects with
        __cuda_array_interface__ or DLPack. Raises InputError, and DeviceError where a GPU fails.
        """
        return self._finished(self._started(self._prepared(images, masks)))

    def stream(self, frames: Iterable[tuple[Images, Masks]]) -> Generator[Result, None, None]:
        """Results of many instants, in order and the same as one by one, but faster.

        frames yields (images, masks) as `__call__` takes them. While one frame is reconstructed, by whoever asks
        for its result, the next is being rectified and the one after it fetched from `frames`, each in a thread.
        What `frames` or the checks raise is raised when the result of that frame is asked for. At most five frames
        are held beforehand; on a GPU one more is reconstructed while the result of the one before is on its way back.
        Closing the generator, or letting go of it, ends the threads, and closes `frames` if that is a generator too.
        """
        with closing(ahead(self._prepared_all(frames))) as prepared:
            waiting: _Started | None = None
            try:
                for one in prepared:
                    started = self._started(one)
                    if waiting is not None:
                        before, waiting = waiting, None
                        yield self._finished(before)
                    if started.prepared.backend.QUEUES:
                        waiting = started
                    else:
                        yield self._finished(started)
            except Exception:
                if waiting is not None:
                    yield self._finished(waiting)
                raise
            if waiting is not None:
                yield self._finished(waiting)

    def _prepared_all(self, frames: Iterable[tuple[Images, Masks]]) -> Generator[_Prepared, None, None]:
        with closing(ahead(frames)) as fetched:
            for images, masks in fetched:
                yield self._prepared(images, masks)

    def _prepared(self, images: Images, masks: Masks) -> _Prepared:
        checked, priors = check_frame(self.rig, images, masks, self.backend.received)
        try:
            return self._rectified(checked, priors)
        except DeviceError as error:
            self._give_up(error)
        return self._rectified(*(list(map(backends.on_host, given)) for given in (checked, priors)))

    def _rectified(self, images: list[np.ndarray], masks: list[np.ndarray]) -> _Prepared:
        clock, backend = Clock(), self.backend
        kind = self.options.rectify.interpolation
        with clock("rectify"), backend.faults():
            given = backend.mark()  # images that are on a device already are made in the caller's lane
            with backend.lane("rectify"):
                backend.after(given)
                spare = self._spare_frame()
                grey = not self.options.multiview.enabled
                frame = backend.rectified_frame(self.rectification, images, masks, kind, self.threads, spare, grey=grey)
                return _Prepared(backend, frame, images, masks, clock, backend.mark())

    def _give_up(self, error: DeviceError) -> None:
        """The cpu backend takes over from a device; `error` where the user leaves no choice."""
        if not self._may_change:
            raise error
        if self.backend.QUEUES:
            log.warning("%s; going on with --backend cpu", error)
            self.backend = backends.get("cpu")

    def _spare_frame(self) -> Frame | None:
        try:
            return self._spare.pop()
        except IndexError:  # never a look before: several threads may ask
            return None

    def _started(self, prepared: _Prepared) -> _Started:
        if prepared.backend is self.backend:
            try:
                with self.backend.faults(), self.backend.lane("reconstruct"):
                    return self._reconstructed(prepared)
            except DeviceError as error:
                self._give_up(error)
        images, masks = (list(map(backends.on_host, given)) for given in (prepared.images, prepared.masks))
        return self._reconstructed(self._rectified(images, masks))

    def _reconstructed(self, prepared: _Prepared) -> _Started:
        clock, geometry, backend = prepared.clock, self.rectification.geometry, prepared.backend
        backend.after(prepared.ready)
        backends.set_threads(backend, self.threads)
        method, stages = see_past, backend
        if self.options.multiview.enabled:
            method, stages = multiview.see_past, backends.multiview(backend)
        found, rounds = method(prepared.frame, geometry, self.options, stages, self.dynamic_only, clock)
        with clock("rectify"):
            dynamic = found.pop("dynamic")
            if dynamic is prepared.frame.dynamic:  # as they came in
                masks = tuple(mask.copy() for mask in prepared.masks)
            else:
                masks = backend.input_masks(self.rectification, dynamic, prepared.masks, self.threads)
        background = found["background"]
        if np.may_share_memory(background, prepared.frame.colour):
            background = background.copy()
        found["background"] = background if prepared.images[0].ndim == 3 else background[..., 0]
        found["depth"] = backend.depth(found["disparity"], geometry)
        return _Started(prepared, backend.fetched({**found, "masks": masks}, self.on_device), rounds)

    def _finished(self, started: _Started) -> Result:
        prepared = started.prepared
        try:
            with prepared.backend.faults():
                found = started.found()
        except DeviceError as error:
            self._give_up(error)
            return self._finished(self._started(prepared))
        if not prepared.backend.QUEUES:
            self._spare.append(prepared.frame)
        return Result(
            **found,
            geometry=self.rectification.geometry,
            timings=prepared.clock.milliseconds,
            rounds=started.rounds,
            options=self.options,
            backend=prepared.backend.__name__.rpartition(".")[2],
        )


def reconstruct(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray] | None,
    rig: Rig,
    *,
    options: Options | None = None,
    reference: int | str = 0,
    backend: str = "auto",
    dynamic_only: bool = False,
) -> Result:
    """See past the people in one instant of a camera array. Arguments and errors: `Reconstructor`."""
    run = Reconstructor(rig, options=options, reference=reference, backend=backend, dynamic_only=dynamic_only)
    return run(images, masks)


def stream(
    frames: Iterable[tuple[Images, Masks]],
    rig: Rig,
    *,
    options: Options | None = None,
    reference: int | str = 0,
    backend: str = "auto",
    dynamic_only: bool = False,
    threads: int = 0,
) -> Generator[Result, None, None]:
    """See past the people in many instants of a camera array; `frames` and results as of `Reconstructor.stream`."""
    run = Reconstructor(
        rig, options=options, reference=reference, backend=backend, dynamic_only=dynamic_only, threads=threads
    )
    return run.stream(frames)
