"""Topics of a bag that carry video, one frame of H.264, H.265, VP9 or AV1 per message.

That is foxglove_msgs/CompressedVideo and ffmpeg_image_transport_msgs/FFMPEGPacket. Frames hold what has changed since
the one before, so they are decoded in order, from the key frame before the one that is wanted. Needs the extra h264,
which is PyAV.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..extras import require
from .bag_file import Entry

CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "av1"}  # part of a name -> decoder
_START = b"\0\0\1"  # of a NAL unit (Annex B)


def is_key(message: Any) -> bool:
    """Whether decoding can begin with this frame; only H.264 (IDR) and H.265 (IRAP) are looked into."""
    data, codec = message.data.tobytes(), _codec(message)
    if codec == "h264":
        return any(kind & 31 == 5 for kind in _nal_bytes(data))
    return codec == "hevc" and any(16 <= (kind >> 1) & 63 <= 23 for kind in _nal_bytes(data))


def _format(message: Any) -> str:
    """ "h264" of a CompressedVideo; of an FFMPEGPacket also "libx264" or "h264_nvenc;yuv420p;bgr8;bgr8"."""
    return str(message.format if hasattr(message, "format") else message.encoding)


def _codec(message: Any) -> str | None:
    name = _format(message).partition(";")[0].lower()
    return next((codec for part, codec in CODECS.items() if part in name), None)


def _nal_bytes(data: bytes) -> Iterator[int]:
    """The first byte of every NAL unit."""
    at = data.find(_START)
    while 0 <= at < len(data) - len(_START):
        yield data[at + len(_START)]
        at = data.find(_START, at + len(_START))


class VideoTopic:
    """The decoder of one topic.

    entries  all its messages in the order in which they were recorded
    keys     which of them decoding can begin with
    """

    def __init__(self, entries: Sequence[Entry], keys: Sequence[bool]):
        self._av = require("av", "h264", "decoding the video topics of bags")
        self._entries, self._place = entries, {entry: n for n, entry in enumerate(entries)}
        known = [n for n, key in enumerate(keys) if key] or [0]
        self._begins = np.array(known)
        self._next = 0
        self._image: np.ndarray | None = None
        self._decoder: Any = None

    def missing(self, wanted: Entry) -> Sequence[Entry]:
        """What must go through `feed` before, in this order; `wanted` itself comes last. Empty if it was fed last."""
        place = self._place[wanted]
        if self._image is not None and place == self._next - 1:
            return []
        earlier = self._begins[self._begins <= place]
        begin = int(earlier[-1]) if earlier.size else 0
        if not (self._decoder is not None and begin <= self._next <= place):
            self._next, self._decoder, self._image = begin, None, None
        return self._entries[self._next : place + 1]

    def feed(self, where: str, message: Any) -> None:
        """Decode the next message. Raises DatasetError, beginning with `where`."""
        if self._decoder is None:
            self._decoder = self._opened(where, message)
        try:
            data = message.data.tobytes()
            frames = self._decoder.decode(self._av.Packet(data)) if data else []  # no data would end the stream
        except self._av.FFmpegError as error:
            self._decoder = None
            raise DatasetError(f"{where}: cannot be decoded ({error.strerror or error}); {_MEND}") from error
        self._next += 1
        self._image = _pixels(frames[0]) if len(frames) == 1 and not frames[0].is_corrupt else None

    def image(self, where: str) -> np.ndarray:
        """uint8 [h, w, 3] BGR, or [h, w] of grey video, of the message that was fed last. Raises DatasetError."""
        if self._image is None:
            raise DatasetError(
                f"{where}: gives no whole picture: frames before it are lost, or it has B-frames or parts of frames; "
                f"{_MEND}"
            )
        return self._image

    def _opened(self, where: str, message: Any) -> Any:
        codec = _codec(message)
        if codec is None:
            raise DatasetError(f"{where}: video format {_format(message)!r} is not known; record H.264, or images")
        decoder = self._av.CodecContext.create(codec, "r")
        decoder.thread_type = "SLICE"  # threads by frames would hold pictures back
        decoder.flags |= self._av.codec.context.Flags.low_delay
        return decoder


_MEND = "cut it out of the bag, or record sensor_msgs/Image or CompressedImage"


def _pixels(frame: Any) -> np.ndarray:
    return np.ascontiguousarray(frame.to_ndarray(format="gray" if frame.format.name.startswith("gray") else "bgr24"))
