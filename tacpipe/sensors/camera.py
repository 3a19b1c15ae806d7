"""Cameras, such as those behind a gel. Each frame is a JPEG image, stored as received.

The links (`tacpipe.links.v4l2`, `tacpipe.links.mjpeg`) return packets that start with `HEAD`. A `SETTINGS` packet
contains the settings that the camera reported when it was opened, as JSON; it is stored in the spool and is not a
sample. A `FRAME` packet contains one image. A frame that is not a complete JPEG image of the expected size is a loss.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Chunks, Framer
from tacpipe.sensors.sensor import Options, Samples, Sensor
from tacpipe.video.encoding import jpeg_format
from tacpipe.video.images import read_shape

MAGIC = b"TPCF"
FRAME, SETTINGS = b"F", b"S"
HEAD = struct.Struct("<4scxxxIIqq")  # magic, kind, size of the content, number, stamp in us, device's time in ns
COUNTS = 1 << 32  # modulus of the number of a frame
STATED = ("rate_hz", "stamps", "read_back", "encoding")  # options that a settings packet can contain
Stamps = Literal["", "kernel", "server", "arrival"]


class Frame(NamedTuple):
    """One image as a link returns it."""

    number: int  # modulo `COUNTS`; 0 if frames are not numbered
    t_us: int  # on the monotonic clock of this computer
    t_device_ns: int  # on the device's clock; 0 if unknown
    content: bytes


def pack_frame(frame: Frame) -> bytes:
    """Return the packet of a frame."""
    head = HEAD.pack(MAGIC, FRAME, len(frame.content), frame.number, frame.t_us, frame.t_device_ns)
    return head + frame.content


def pack_settings(settings: Mapping[str, Any]) -> bytes:
    """Return the packet for the settings that a camera reported."""
    content = json.dumps(settings).encode()
    return HEAD.pack(MAGIC, SETTINGS, len(content), 0, 0, 0) + content


def unpack_frame(packet: bytes) -> Frame | None:
    """Return the frame of a packet, or None for any other packet."""
    if packet[: len(MAGIC) + 1] != MAGIC + FRAME or len(packet) < HEAD.size:
        return None
    _, _, size, number, t_us, t_device_ns = HEAD.unpack_from(packet)
    return Frame(number, t_us, t_device_ns, packet[HEAD.size :]) if len(packet) == HEAD.size + size else None


def unpack_settings(packet: bytes) -> dict[str, Any] | None:
    """Return the reported settings in a packet, or None for any other packet."""
    if packet[: len(MAGIC) + 1] != MAGIC + SETTINGS:
        return None
    try:
        settings = json.loads(packet[HEAD.size :])
    except ValueError:
        return None
    return settings if isinstance(settings, dict) else None


def options(data: Chunks) -> list[Options]:
    """Return a list with the options that a camera's packets report, or an empty list if they contain no valid frame."""
    packets = data.packets()
    settings = next((values for values in map(unpack_settings, packets) if values is not None), {})
    frames = filter(None, map(unpack_frame, packets))
    shape = next((shape for shape in (read_shape(frame.content) for frame in frames) if shape is not None), None)
    if shape is None:
        return []
    reported: dict[str, Any] = {name: settings[name] for name in STATED if name in settings}
    return [{**shape._asdict(), **reported}]


@dataclass(frozen=True)
class Camera(Sensor):
    """A camera. If size, pixel format or stamps are omitted, `tacpipe acquire` asks the camera."""

    summary: ClassVar[str] = "Cameras behind a gel (GelSight, DIGIT) and others: MJPEG through V4L2 or over HTTP."
    links: ClassVar[tuple[str, ...]] = ("v4l2", "mjpeg")
    guesses: ClassVar[Mapping[str, str]] = {
        "width_px": "as the camera sends now",
        "height_px": "as the camera sends now",
    }

    width_px: int = 0  # width of a frame; 0: the camera's current setting
    height_px: int = 0  # height of a frame; 0: the camera's current setting
    rate_hz: float = 0.0  # frames per second; 0: the current setting of a V4L2 camera, unknown for HTTP
    encoding: Literal["mjpeg", "yuyv"] = "mjpeg"  # format from the camera; yuyv is encoded as JPEG, with some loss
    exposure: int | None = None  # exposure time in 100 us; none: the camera's current setting
    gain: int | None = None  # gain in the camera's units; none: the camera's current setting
    white_balance_k: int | None = None  # colour temperature in kelvin; none: the camera's current setting
    led: int | None = None  # brightness of a DIGIT's light, 0 to 15, or 256 r + 16 g + b; none: unchanged
    pixel_format: str = ""  # FFmpeg's name of the pixel format; comes from the camera
    stamps: Stamps = ""  # clock of the stamps and whether frames are numbered; comes from the camera
    read_back: str = ""  # controls as the camera reported them when it was opened; comes from the camera

    def __post_init__(self) -> None:
        if not (self.width_px >= 0 <= self.height_px and 0 <= self.rate_hz < float("inf")):
            raise UsageError(
                f"camera: {self.width_px} x {self.height_px} pixels at {self.rate_hz:g} Hz cannot be a video. Give "
                f"sizes and a rate of 0 or above."
            )

    @property
    def incomplete(self) -> bool:  # type: ignore[override]
        """True if the camera must still be queried for its format."""
        return not (self.width_px and self.height_px and self.pixel_format and self.stamps)

    @property
    def counter(self) -> int | None:  # type: ignore[override]
        """Modulus of the kernel's number of a frame; None if frames are not numbered."""
        return COUNTS if self.stamps == "kernel" else None

    def fields(self) -> list[pa.Field]:
        """Return ``packet``, ``pts``, ``dts`` and ``key_frame``."""
        rate_hz = Fraction(self.rate_hz).limit_denominator(1001) if self.rate_hz else None
        video_format = jpeg_format(self.width_px or 1, self.height_px or 1, rate_hz, self.pixel_format)
        packet, *clocks = video_format.fields()
        return [packet.with_metadata({**packet.metadata, b"unit": b"1"}), *clocks]

    def framer(self) -> Framer:
        """Return a framer that accepts settings and frames of the expected size."""
        return TextFramer(self._is_right)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return one sample per frame; settings packets are skipped."""
        images = [(row, frame) for row, packet in enumerate(frames) if (frame := unpack_frame(packet)) is not None]
        packets = np.empty((len(images), 1), object)
        packets[:, 0] = [frame.content for _, frame in images]
        t_us = np.array([frame.t_us for _, frame in images], np.int64)
        return Samples(
            (packets, np.column_stack([t_us, t_us]), np.ones((len(images), 1), bool)),
            np.array([frame.number for _, frame in images], np.int64) if self.counter else None,
            np.array([frame.t_device_ns for _, frame in images], np.int64) if self.stamps == "server" else None,
            rows=np.array([row for row, _ in images], np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the packets with these images."""
        packets, clocks, _ = samples.values
        counts = np.zeros(len(samples), np.int64) if samples.seq is None else samples.seq
        device_ns = np.zeros(len(samples), np.int64) if samples.t_device_ns is None else samples.t_device_ns
        return [
            pack_frame(Frame(int(number), int(t_us), int(t_device_ns), image))
            for number, t_us, t_device_ns, image in zip(counts, clocks[:, 0], device_ns, packets[:, 0], strict=True)
        ]

    def _is_right(self, packet: bytes) -> bool:
        """Return whether a packet is a report of settings or a frame of the declared size and format."""
        frame = unpack_frame(packet)
        if frame is None:
            return unpack_settings(packet) is not None
        shape = read_shape(frame.content)
        if shape is None or self.incomplete:
            return shape is not None
        return shape == (self.width_px, self.height_px, self.pixel_format)
