"""The live path itself: messages of one instant in, messages of its static scene out."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..datasets.eight_bits import EightBits
from ..datasets.ros_images import decode_message
from ..errors import DatasetError, InputError, OptionsError
from ..pipeline import Reconstructor
from ..result import Result
from ..rig import Rig
from ..segment import Segmenter
from ..sequence import Settings
from .figures import Figures, Report
from .grouper import AnyImage, Grouper
from .latest import Latest
from .messages import CameraInfo, Image, Message, camera_info, image_kind, image_message
from .transport import Publish, Transport

log = logging.getLogger("seepast")

LOOK_UP = 0.2  # seconds: how long `run` waits for a frame before it looks whether it should end
QUIET = 5.0  # seconds without a frame until it is told what is missing

OnReport = Callable[[Report], None]


@dataclass(frozen=True)
class Inputs:
    """What is subscribed to.

    images: a topic per camera, in the rig's order; masks: likewise, or none; tolerance: ns within an instant; bits: as
    OpenOptions has it, for images of 16.
    """

    images: Sequence[str]
    masks: Sequence[str] = ()
    tolerance: int = 5_000_000
    bits: int | None = None


@dataclass(frozen=True, eq=False)
class _Instant:
    """images, masks: K messages each (masks may be none); arrived: time.monotonic() of the last of them."""

    images: tuple[AnyImage, ...]
    masks: tuple[AnyImage, ...]
    arrived: float


class Server:
    """Reconstructs whatever instants `transport` brings, the newest first, and publishes the results:

        NAMESPACE/background/image_rect    bgr8 (mono8 of grey cameras), with camera_info beside it
        NAMESPACE/depth/image_rect         32FC1 metres, NaN where unknown or seen by no camera, with camera_info
        NAMESPACE/coverage/image_rect      mono8: how many cameras saw the pixel; 0 = a guess
        NAMESPACE/masks/<camera>/image     mono8, 255 * refined P(dynamic)

    A mask has stamp and frame_id of its camera's image; all else has those of the reference camera's, with _rect
    appended to frame_id where the view is rotated against the camera.

    rig, settings  what `seepast run` would take (overwrite means nothing here)
    segmenter      makes the masks where `inputs` has no topics for them; None: nothing is dynamic
    room           instants that may wait while one is reconstructed; more of them, and the oldest is dropped

    Raises SeepastError for what cannot work. An instant that cannot be used is counted, and told once per reason.
    """

    def __init__(
        self,
        rig: Rig,
        settings: Settings,
        transport: Transport,
        inputs: Inputs,
        *,
        segmenter: Segmenter | None = None,
        namespace: str = "/seepast",
        room: int = 1,
    ):
        if room < 1:
            raise OptionsError(f"--queue {room}: at least one instant must be able to wait; give 1 or more")
        self.rig, self._inputs, self._segmenter, self._transport = rig, inputs, segmenter, transport
        self._reconstructor = Reconstructor(
            rig,
            options=settings.options,
            reference=settings.reference,
            backend=settings.backend,
            dynamic_only=settings.dynamic_only,
            threads=settings.threads,
        )
        self._grouper = Grouper([*inputs.images, *inputs.masks], inputs.tolerance)
        self._latest: Latest[_Instant] = Latest(room)
        self._deep = EightBits(inputs.bits)
        self._heard: Counter[str] = Counter()
        self._told: set[str] = set()
        self._total, self._recent = Figures(), Figures()
        self._subscribe()
        self._publishers = self._advertise(namespace.strip("/"))

    def run(
        self,
        stop: threading.Event,
        *,
        seconds: float | None = None,
        every: float = 10.0,
        on_report: OnReport = lambda report: None,
    ) -> Report:
        """Serve until `stop` is set or `seconds` have passed; `on_report` every so many seconds. The whole's report.

        Starts the transport; who made it closes it.
        """
        if not every > 0:
            raise OptionsError(f"--every {every}: give seconds between reports, more than 0")
        self._total, self._recent, seen = Figures(), Figures(), _Seen()
        end = np.inf if seconds is None else time.monotonic() + seconds
        self._transport.start()
        while not stop.is_set() and time.monotonic() < end:
            instant = self._latest.get(min(LOOK_UP, every))
            if instant is not None:
                self._serve(instant)
            if time.monotonic() - self._recent.since >= every:
                on_report(self._report_recent(seen))
            self._tell_silence()
        return self._total.report(self._latest.displaced, self._grouper.dropped)

    def _subscribe(self) -> None:
        for stream, topic in enumerate(self._grouper.names):
            self._transport.subscribe(topic, image_kind(topic), partial(self._arrived, stream))

    def _advertise(self, namespace: str) -> dict[str, Publish]:
        kinds: dict[str, type] = {f"masks/{camera.name}/image": Image for camera in self.rig.cameras}
        kinds |= {f"{what}/image_rect": Image for what in ("background", "depth", "coverage")}
        kinds |= {f"{what}/camera_info": CameraInfo for what in ("background", "depth")}
        return {
            name: self._transport.advertise(f"/{namespace}/{name}".replace("//", "/"), kinds[name]) for name in kinds
        }

    def _arrived(self, stream: int, message: AnyImage) -> None:
        """In the transport's thread."""
        self._heard[self._grouper.names[stream]] += 1
        for figures in (self._total, self._recent):
            figures.images += 1
        for complete in self._grouper.add(stream, message):
            cameras = len(self.rig)
            for figures in (self._total, self._recent):
                figures.frames += 1
            self._latest.put(_Instant(complete[:cameras], complete[cameras:], time.monotonic()))

    def _serve(self, instant: _Instant) -> None:
        try:
            images = self._decoded(instant.images, "", self._deep)
            masks: Sequence[np.ndarray] | None = None
            if self._segmenter is not None:
                masks = self._segmenter(images)
            elif instant.masks:
                masks = self._decoded(instant.masks, ", its mask")
            result = self._reconstructor(images, masks)
        except (DatasetError, InputError) as error:
            self._unusable(str(error))
            return
        unsent = sum(not self._publishers[name](message) for name, message in self._outputs(instant, result))
        stamp = instant.images[self._reconstructor.reference].stamp
        latency, age = time.monotonic() - instant.arrived, time.time() - stamp / 1e9
        for figures in (self._total, self._recent):
            figures.unsent += unsent
            figures.out(latency, age)

    def _decoded(self, messages: Sequence[AnyImage], what: str, deep: EightBits | None = None) -> list[np.ndarray]:
        cameras = zip(self.rig.cameras, messages, strict=True)
        return [decode_message(f"{camera.name}{what}", message, deep) for camera, message in cameras]

    def _outputs(self, instant: _Instant, result: Result) -> list[tuple[str, Message]]:
        reference = self._reconstructor.reference
        header = instant.images[reference].stamp, self._frame_id(instant.images[reference])
        seen = (result.depth > 0) & (result.coverage > 0)
        info = camera_info(*header, result.geometry)
        return [
            ("background/image_rect", image_message(*header, result.background)),
            ("background/camera_info", info),
            ("depth/image_rect", image_message(*header, np.where(seen, result.depth, np.float32(np.nan)))),
            ("depth/camera_info", info),
            ("coverage/image_rect", image_message(*header, result.coverage)),
            *(
                (f"masks/{camera.name}/image", image_message(image.stamp, image.frame_id or camera.name, mask))
                for camera, image, mask in zip(self.rig.cameras, instant.images, result.masks, strict=True)
            ),
        ]

    def _frame_id(self, image: AnyImage) -> str:
        reference = self._reconstructor.reference
        turned = not np.array_equal(self._reconstructor.rectification.rotation_from_cam[reference], np.eye(3))
        return (image.frame_id or self.rig.cameras[reference].name) + ("_rect" if turned else "")

    def _unusable(self, reason: str) -> None:
        for figures in (self._total, self._recent):
            figures.unusable += 1
        if reason not in self._told and len(self._told) < 20:
            self._told.add(reason)
            log.warning("an instant is dropped: %s", reason)

    def _report_recent(self, seen: _Seen) -> Report:
        recent, self._recent = self._recent, Figures()
        return recent.report(*seen.since(self._latest.displaced, self._grouper.dropped))

    def _tell_silence(self) -> None:
        """One warning about topics on which nothing ever came."""
        silent = [topic for topic in self._grouper.names if not self._heard[topic]]
        if silent and "silence" not in self._told and time.monotonic() - self._total.since > QUIET:
            self._told.add("silence")
            log.warning(
                "nothing has come on %s: is it published (ros2 topic list), in this ROS_DOMAIN_ID, on this network?",
                ", ".join(silent),
            )


class _Seen:
    """Counts that only grow, as they were at the last report."""

    def __init__(self) -> None:
        self._displaced, self._dropped = 0, Counter[str]()

    def since(self, displaced: int, dropped: Mapping[str, int]) -> tuple[int, Mapping[str, int]]:
        now = Counter(dropped)
        new = displaced - self._displaced, now - self._dropped
        self._displaced, self._dropped = displaced, now
        return new
