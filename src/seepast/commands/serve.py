"""seepast serve: the static scene of a running system."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..errors import OptionsError
from .console import Json, say
from .run import assignments
from .segmenting import Classes, SegmenterName, opened_segmenter

if TYPE_CHECKING:
    from ..live.figures import Report
    from ..live.server import Inputs
    from ..rig import Rig
    from ..settings import Plan

Optional = Parameter(negative=(), show_default=False)


def serve(
    *,
    rig: Path,
    topics: Annotated[str | None, Optional] = None,
    masks: Annotated[str | None, Optional] = None,
    segmenter: SegmenterName = None,
    classes: Classes = None,
    tolerance: Annotated[float | None, Optional] = None,
    bits: Annotated[int | None, Optional] = None,
    settings: Annotated[Path | None, Optional] = None,
    preset: Annotated[str | None, Optional] = None,
    reference: Annotated[str | None, Optional] = None,
    backend: Annotated[Literal["auto", "cpu", "cuda", "reference"] | None, Optional] = None,
    dynamic_only: Annotated[bool | None, Parameter(show_default=False)] = None,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=(), show_default=False)] = None,
    threads: Annotated[int | None, Optional] = None,
    namespace: str = "/seepast",
    transport: Literal["auto", "rclpy", "dds"] = "auto",
    qos: Literal["best-effort", "reliable"] = "best-effort",
    queue: int = 1,
    every: float = 10.0,
    seconds: Annotated[float | None, Optional] = None,
    json_: Json = False,
) -> int:
    """Publish the static scene of a running ROS 2 system, live.

    Takes its synchronized images, until Ctrl-C or SIGTERM.

    For example

      seepast serve --rig rig.yaml --segmenter onnx:pphumanseg --preset paper
      seepast serve --rig rig.yaml --masks topics:/{}/mask --topics '/{}/image_raw'
      seepast serve --rig rig.yaml --masks none --topics '/{}/image_raw/compressed'
      ROS_DOMAIN_ID=7 seepast serve --rig rig.yaml --masks none --transport dds

    Publishes, below /seepast: background/image_rect, depth/image_rect (32FC1,
    NaN unknown), camera_info beside both, coverage/image_rect and
    masks/CAMERA/image. Instants that come while one is worked on wait in a short
    queue; the oldest are dropped. Every 10 s stderr tells rates, drops and latency.
    Ctrl-C or SIGTERM ends it, with the figures of the whole and exit code 0.

    With a ROS 2 installation it is an rclpy node; without one CycloneDDS speaks
    to ROS 2: pip install 'seepast[dds]'. CYCLONEDDS_URI configures its network.

    Parameters
    ----------
    rig
        Kalibr camchain file of the array.
    topics
        Image topics in the order of the rig's cameras: A,B,C, or one with {} for the camera's name; if not given, the
        rostopic of each camera in the rig. Those that end in /compressed carry CompressedImage.
    masks
        topics:A,B,C or topics:/{}/mask, mono8, 255 * P(dynamic), stamped as their images; or none: nothing is
        dynamic. Or give --segmenter.
    tolerance
        Seconds that header stamps of one instant may be apart; 0.005 if not given.
    bits
        How many of their bits images of 16 (mono16, bgr16) fill; 16 if not given.
    settings
        File of settings as of `seepast run`; flags of the command line win over it.
    preset
        accurate (default), fast or paper; see `seepast run`.
    reference
        The camera whose view is reconstructed (default: cam0).
    backend
        auto (default) takes the fastest that works here.
    dynamic_only
        Synthesise only what people hide; all else keeps its own pixels.
    set_
        One option, stage.field=value; may be repeated.
    threads
        As many as there are cores, if not given.
    namespace
        Goes before the topics that are published.
    transport
        auto: rclpy where it can be imported, else dds, which is CycloneDDS.
    qos
        How to subscribe. best-effort gets on with every publisher; reliable asks for lost messages again.
    queue
        Instants that may wait. With 1 the newest is always next.
    every
        Seconds between two lines of figures on stderr.
    seconds
        End after that long.
    """
    from ..live.server import Server
    from ..live.transport import open_transport
    from ..rig import Rig
    from ..sequence import Settings

    plan = _planned(locals())
    array = Rig.from_kalibr(rig)
    inputs = _inputs(array, plan)
    method = Settings(plan.options, plan.reference, plan.backend, plan.dynamic_only, plan.threads)
    network = opened_segmenter(plan.segmenter, plan.classes, plan.masks, plan.threads)
    carrier = open_transport(transport, reliable=qos == "reliable")
    with contextlib.closing(carrier), _stopping() as stop:
        server = Server(array, method, carrier, inputs, segmenter=network, namespace=namespace, room=queue)
        _say(f"{carrier.name}: waiting for {', '.join([*inputs.images, *inputs.masks])}")
        report = server.run(stop, seconds=seconds, every=every, on_report=_say)
    say(str(report), report.as_dict(), json_)
    return 0


def _planned(arguments: Mapping[str, Any]) -> Plan:
    """What `seepast run` would make of these arguments; there is no dataset."""
    from ..settings import FLAGS, FileSettings, planned, read_settings

    file = read_settings(arguments["settings"]) if arguments["settings"] else FileSettings()
    flags = {name: arguments[name] for name in FLAGS if name in arguments}
    return planned({**flags, "dataset": Path()}, assignments(arguments["set_"] or []), file)


def _inputs(rig: Rig, plan: Plan) -> Inputs:
    """The topics that a plan names. Raises OptionsError, DatasetError."""
    from ..datasets import NO_MASKS
    from ..datasets.grouping import nanoseconds
    from ..datasets.topics import MASK_TOPICS, listed, topics_of
    from ..live.server import Inputs

    masks, of_masks = plan.masks, list[str]()
    if masks is None and plan.segmenter is None:
        raise OptionsError(
            f"serve: say where the masks come from: --segmenter onnx:MODEL.onnx, --masks '{MASK_TOPICS}/{{}}/mask', or "
            f"--masks {NO_MASKS} if nothing is dynamic"
        )
    if masks not in (None, NO_MASKS) and not masks.startswith(MASK_TOPICS):
        raise OptionsError(
            f"--masks {masks}: live masks are messages; write {MASK_TOPICS}TOPIC,TOPIC,... or {NO_MASKS}"
        )
    if masks is not None and masks != NO_MASKS:
        of_masks = listed(masks.removeprefix(MASK_TOPICS), rig.cameras, f"--masks {MASK_TOPICS}")
    images = topics_of(rig.cameras, plan.topics, plan.rig or Path())
    return Inputs(images, of_masks, nanoseconds(plan.tolerance), plan.bits)


def _say(report: Report | str) -> None:
    print(f"seepast: {report}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _stopping() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; the second does what it would have done."""
    stop, before = threading.Event(), dict[int, Any]()

    def on_signal(number: int, _: Any) -> None:
        stop.set()
        signal.signal(number, before[number])

    try:
        for number in (int(signal.SIGINT), int(signal.SIGTERM)):
            before[number] = signal.signal(number, on_signal)
    except ValueError:  # not in the main thread: somebody else handles signals
        pass
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
