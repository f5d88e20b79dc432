"""The transport that needs no ROS 2: CycloneDDS, speaking the types and topics of ROS 2. Needs the extra dds."""

from __future__ import annotations

import logging
import os
import threading
from contextlib import suppress
from typing import Any

from cyclonedds.core import DDSException, InstanceState, Policy, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from ..errors import TransportError
from .dds_types import TYPES, sample
from .messages import Message
from .transport import DEPTH, Deliver, Publish

log = logging.getLogger("seepast")

MILLISECOND = 10**6  # ns
PATIENCE = 100 * MILLISECOND  # for a subscriber that does not keep up
# An instant of five images of 720x540 is 6 MB; CycloneDDS's own 1 MB lost four of five such instants at 20 Hz
BUFFERS = "<CycloneDDS><Domain><Internal><SocketReceiveBufferSize max='64MB'/></Internal></Domain></CycloneDDS>"
LOOK_UP = 100 * MILLISECOND  # how long the thread waits before it looks whether it should end

# ROS 2's types are final and sent as plain CDR; a writer that offered XCDR2 would not match
_COMMON = (Policy.Durability.Volatile, Policy.DataRepresentation(use_cdrv0_representation=True))


class DdsTransport:
    """See Transport. domain: as ROS_DOMAIN_ID. CYCLONEDDS_URI configures the network as for ROS 2 on CycloneDDS."""

    name = "CycloneDDS"

    def __init__(self, domain: int, reliable: bool = False):
        self._domain = _configured(domain)
        try:
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise TransportError(
                f"CycloneDDS cannot join ROS domain {domain} ({error.msg}): look at CYCLONEDDS_URI, and whether the "
                "network interface that it names is up"
            ) from error
        reliability = Policy.Reliability.Reliable(PATIENCE) if reliable else Policy.Reliability.BestEffort
        self._in = Qos(reliability, Policy.History.KeepLast(DEPTH), *_COMMON)
        self._out = Qos(Policy.Reliability.Reliable(PATIENCE), Policy.History.KeepLast(1), *_COMMON)
        self._readers: list[tuple[DataReader[Any], Deliver]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._take, name="seepast dds", daemon=True)

    def subscribe(self, topic: str, kind: type, deliver: Deliver) -> None:
        reader = DataReader(self._participant, self._topic(topic, kind), self._in)
        self._readers.append((reader, deliver))

    def advertise(self, topic: str, kind: type) -> Publish:
        writer = DataWriter(self._participant, self._topic(topic, kind), self._out)

        def publish(message: Message) -> bool:
            try:
                writer.write(sample(message))
            except DDSException as error:
                if error.code == DDSException.DDS_RETCODE_TIMEOUT:
                    return False
                raise TransportError(f"{topic}: cannot be published ({error}); start again") from error
            return True

        return publish

    def _topic(self, topic: str, kind: type) -> Topic[Any]:
        try:
            return Topic(self._participant, dds_topic(topic), TYPES[kind])
        except DDSException as error:
            raise TransportError(
                f"{topic}: is no topic name ({error.msg}); write it as /cam0/image_raw, of letters, digits, _ and /"
            ) from error

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        with suppress(RuntimeError):  # never started
            self._thread.join()
        self._readers.clear()

    def _take(self) -> None:
        """Wait for messages on all topics and hand them on, until `close`."""
        waiting = WaitSet(self._participant)
        for reader, _ in self._readers:
            waiting.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.Any))
        try:
            while not self._stop.is_set():
                if waiting.wait(LOOK_UP):
                    self._hand_on()
        except Exception as error:  # in a thread nobody else would tell
            log.error("%s: takes no more messages (%s: %s); start again", self.name, type(error).__name__, error)

    def _hand_on(self) -> None:
        for reader, deliver in self._readers:
            for message in reader.take(DEPTH):
                if isinstance(message, tuple(TYPES)):
                    deliver(message)


def _configured(domain: int) -> Domain | None:
    """The domain with room for an instant of large images; CYCLONEDDS_URI comes behind this and so wins."""
    wanted = ",".join(filter(None, (BUFFERS, os.environ.get("CYCLONEDDS_URI"))))
    try:
        return Domain(domain, wanted)
    except DDSException:  # this process has it already, or CYCLONEDDS_URI is wrong, which the participant will tell
        return None


def dds_topic(topic: str) -> str:
    """ROS 2's topics have the prefix rt in DDS."""
    return f"rt/{topic.strip('/')}"
