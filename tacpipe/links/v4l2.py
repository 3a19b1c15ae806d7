"""Capture frames of a camera through the ioctls of Video for Linux (V4L2): the kernel stamps and numbers them.

MJPEG is not changed. YUYV is encoded as JPEG, with some loss. Structures are those of <linux/videodev2.h> on 64
bits.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.errors import DeviceError, UsageError
from tacpipe.io import files
from tacpipe.links import ports
from tacpipe.links.link import Arrived, DescriptorLink
from tacpipe.links.ports import Port
from tacpipe.plugins import extras
from tacpipe.sensors.camera import COUNTS, Frame, pack_frame, pack_settings
from tacpipe.sensors.sensor import Sensor
from tacpipe.video.encoding import ENCODED_BY, JPEG_QUALITY, JpegEncoder

DEVICES = Path("/dev")
SYSFS = Path("/sys/class/video4linux")
BUFFERS = 8  # frames buffered by the kernel: a third of a second at 25 frames per second
CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP = 1  # V4L2_MEMORY_MMAP
CAN_CAPTURE, CAN_STREAM, IS_TOUCH, HAS_DEVICE_CAPS = 0x1, 0x4000000, 0x10000000, 0x80000000
MONOTONIC, STAMP_KIND, DAMAGED = 0x2000, 0xE000, 0x40  # flags of a buffer
NEXT_CONTROL = 0x80000000
DISABLED, WRITE_ONLY = 0x1, 0x40  # flags of a control
NUMBER, SWITCH, MENU = 1, 2, 3  # types of controls that have a number as value
MANUAL_EXPOSURE = 1
FOURCC = {"mjpeg": b"MJPG", "yuyv": b"YUYV"}
EXPOSURE_AUTO, EXPOSURE, ZOOM = 0x9A0901, 0x9A0902, 0x9A090D
AUTO_WHITE_BALANCE, AUTO_GAIN, GAIN, WHITE_BALANCE = 0x98090C, 0x980912, 0x980913, 0x98091A
CONTROLS = {  # by option: its control, the automatic control that must be off, and the value for off
    "exposure": (EXPOSURE, EXPOSURE_AUTO, MANUAL_EXPOSURE),
    "gain": (GAIN, AUTO_GAIN, 0),
    "white_balance_k": (WHITE_BALANCE, AUTO_WHITE_BALANCE, 0),
    "led": (ZOOM, None, 0),  # a DIGIT controls its light by the zoom
}

BUFFER = struct.Struct("<IIIII4xqq16sIIQIIi4x")  # v4l2_buffer
FORMAT = struct.Struct("<I4x8I168x")  # v4l2_format with a v4l2_pix_format
RATE = struct.Struct("<I4I184x")  # v4l2_streamparm: time per frame as a fraction
CONTROL_QUERY = struct.Struct("<II32s5i8x")  # v4l2_queryctrl
CAPABILITY = struct.Struct("<16s32s32s3I12x")  # v4l2_capability
FORMAT_QUERY = struct.Struct("<III32s4s16x")  # v4l2_fmtdesc


def _request(direction: int, number: int, size: int) -> int:
    """Return the number of an ioctl of V4L2; ``direction`` is 1 to write, 2 to read, 3 for both."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP, ENUM_FMT = _request(2, 0, CAPABILITY.size), _request(3, 2, FORMAT_QUERY.size)
G_FMT, S_FMT = _request(3, 4, FORMAT.size), _request(3, 5, FORMAT.size)
REQBUFS, QUERYBUF, QBUF, DQBUF = (_request(3, number, size) for number, size in ((8, 20), (9, 88), (15, 88), (17, 88)))
STREAMON, STREAMOFF = _request(1, 18, 4), _request(1, 19, 4)
G_PARM, S_PARM = _request(3, 21, RATE.size), _request(3, 22, RATE.size)
G_CTRL, S_CTRL, QUERYCTRL = _request(3, 27, 8), _request(3, 28, 8), _request(3, 36, CONTROL_QUERY.size)


class V4l2Device:
    """An open V4L2 device."""

    def __init__(self, path: str) -> None:
        self.fileno = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def call(self, request: int, content: bytes) -> bytes:
        """Return a structure as the kernel filled it."""
        filled = bytearray(content)
        fcntl.ioctl(self.fileno, request, filled)
        return bytes(filled)

    def close(self) -> None:
        """Close the device."""
        os.close(self.fileno)

    @property
    def card(self) -> tuple[str, str, bool]:
        """The camera's name, its bus address, and whether it captures video in buffers. Raises ``OSError`` if it fails."""
        _, card, bus, _, all_nodes, this_node = CAPABILITY.unpack(self.call(QUERYCAP, bytes(CAPABILITY.size)))
        capabilities = this_node if all_nodes & HAS_DEVICE_CAPS else all_nodes
        captures = capabilities & (CAN_CAPTURE | CAN_STREAM | IS_TOUCH) == CAN_CAPTURE | CAN_STREAM
        return card.rstrip(b"\0").decode(errors="replace"), bus.rstrip(b"\0").decode(errors="replace"), captures

    def formats(self) -> list[str]:
        """Return the codes of the formats that the camera sends."""
        codes: list[str] = []
        with contextlib.suppress(OSError):
            while True:
                query = FORMAT_QUERY.pack(len(codes), CAPTURE, 0, b"", b"")
                codes.append(FORMAT_QUERY.unpack(self.call(ENUM_FMT, query))[4].decode(errors="replace"))
        return codes

    def controls(self) -> Iterator[tuple[int, str]]:
        """Yield the number and the name of each control that has a number as value."""
        control = NEXT_CONTROL
        with contextlib.suppress(OSError):
            while True:
                query = CONTROL_QUERY.pack(control, 0, b"", 0, 0, 0, 0, 0)
                number, kind, name, *_, flags = CONTROL_QUERY.unpack(self.call(QUERYCTRL, query))
                if kind in (NUMBER, SWITCH, MENU) and not flags & (DISABLED | WRITE_ONLY):
                    yield number, name.rstrip(b"\0").decode(errors="replace")
                control = number | NEXT_CONTROL

    def read_control(self, number: int) -> int:
        """Return the value of a control."""
        return int(struct.unpack("<Ii", self.call(G_CTRL, struct.pack("<Ii", number, 0)))[1])

    def write_control(self, number: int, value: int) -> None:
        """Set a control."""
        self.call(S_CTRL, struct.pack("<Ii", number, value))


def cameras() -> list[Port]:
    """Return the cameras of this computer that capture video."""
    ports = []
    for path in files.listed(SYSFS):
        with contextlib.suppress(OSError):
            device = V4l2Device(str(DEVICES / path.name))
            try:
                card, bus, captures = device.card
            finally:
                device.close()
            if captures:
                ports.append(Port(f"v4l2:{DEVICES / path.name}", "", f"{card} on {bus}", f"v4l2:{card}"))
    return ports


def open_v4l2(place: str, sensor: Sensor, name: str) -> V4l2Link:
    """Open the camera at a path such as ``/dev/video0``, or the camera with this name.

    Raises `DeviceError` if it is missing or busy, or does not support the settings of the rig file.
    """
    path = place if place.startswith("/") else _find_device(place, name)
    try:
        device = V4l2Device(path)
    except FileNotFoundError:
        raise DeviceError(f"{name}: there is no {path}; {_listed_cameras()}.") from None
    except PermissionError as error:
        raise DeviceError(
            f"{name}: {path} may not be opened; add yourself to the group video, and log in again."
        ) from error
    except OSError as error:
        raise DeviceError(f"{name}: {path} cannot be opened: {error.strerror}.") from error
    try:
        return V4l2Link(name, device, _set_up(device, sensor, name))
    except OSError as error:
        device.close()
        raise DeviceError(f"{name}: {_refusal(path, error)}") from error
    except BaseException:
        device.close()
        raise


def _find_device(place: str, name: str) -> str:
    """Return the path of the only camera with a name. Raises `DeviceError` if none or several have it."""
    paths = [port.address.removeprefix("v4l2:") for port in cameras() if port.persistent_path == f"v4l2:{place}"]
    if len(paths) != 1:
        described = "no camera has" if not paths else f"{', '.join(paths)} have"
        raise DeviceError(f"{name}: {described} the name {place}; {_listed_cameras()}. Give a path if names are equal.")
    return paths[0]


def _listed_cameras() -> str:
    """Return the cameras as the end of a sentence."""
    listed = [str(port) for port in cameras()]
    return f"there are {'; '.join(listed)}" if listed else "no camera is connected"


def _refusal(path: str, error: OSError) -> str:
    """Return why a camera did not start, with advice."""
    if error.errno == errno.EBUSY:
        return f"{path} is in use by {ports.describe_holders(ports.holders_of_file(path))}; end it."
    if error.errno in (errno.ENOTTY, errno.EINVAL):
        return f"{path} is no camera that captures video ({error.strerror}); {_listed_cameras()}."
    return f"{path} does not start: {error.strerror}. Unplug the camera and plug it in again."


@dataclass(frozen=True)
class Capture:
    """The format in which a camera sends, as the kernel reported it, and its controls."""

    encoding: str
    width_px: int
    height_px: int
    rate_hz: float
    read_back: str  # controls with their values

    def settings(self) -> dict[str, str | float]:
        """Return the values for the sensor's options."""
        return {
            "rate_hz": self.rate_hz,
            "encoding": self.encoding,
            "stamps": "kernel",
            "read_back": self.read_back,
        }


def _set_up(device: V4l2Device, sensor: Any, name: str) -> Capture:
    """Set format, rate and controls from the sensor's options, and return the values that the camera chose.

    Raises `DeviceError` if the camera refuses format or size, `UsageError` if it refuses a control, and ``OSError`` if it
    fails.
    """
    if not device.card[2]:
        raise OSError(errno.ENOTTY, "it does not capture video")
    encoding = getattr(sensor, "encoding", "mjpeg")
    if not hasattr(sensor, "encoding") and FOURCC["mjpeg"].decode() not in device.formats():  # a probe has no options
        encoding = "yuyv"
    requested_px = getattr(sensor, "width_px", 0), getattr(sensor, "height_px", 0)
    _, width, height, *_ = FORMAT.unpack(device.call(G_FMT, FORMAT.pack(CAPTURE, *[0] * 8)))
    code = int.from_bytes(FOURCC[encoding], "little")
    requested = FORMAT.pack(CAPTURE, requested_px[0] or width, requested_px[1] or height, code, 1, 0, 0, 0, 0)
    _, width, height, actual_code, *_ = FORMAT.unpack(device.call(S_FMT, requested))
    if actual_code != code:
        raise DeviceError(
            f"{name}: the camera does not send {encoding}; it sends {', '.join(device.formats())}. Set encoding to mjpeg "
            f"for MJPG, or to yuyv for YUYV."
        )
    if requested_px[0] and requested_px != (width, height):
        raise DeviceError(
            f"{name}: the camera sends {width} x {height} pixels instead of {requested_px[0]} x {requested_px[1]}. Set "
            f"width_px and height_px to a size that it has."
        )
    requested_hz = getattr(sensor, "rate_hz", 0.0)
    if requested_hz:
        device.call(S_PARM, RATE.pack(CAPTURE, 0, 0, 1000, round(requested_hz * 1000)))
    numerator, denominator = RATE.unpack(device.call(G_PARM, bytes([CAPTURE]) + bytes(RATE.size - 1)))[3:]
    return Capture(
        encoding,
        width,
        height,
        round(denominator / numerator, 6) if numerator else 0.0,
        _set_controls(device, sensor, encoding),
    )


def _set_controls(device: V4l2Device, sensor: Any, encoding: str) -> str:
    """Set the controls in the sensor's options, and return all controls with the values that were read back.

    Raises `UsageError` if a control cannot be set.
    """
    requested: dict[int, int] = {}
    for option, (control, automatic_control, off_value) in CONTROLS.items():
        value = getattr(sensor, option, None)
        if value is None:
            continue
        if automatic_control is not None:
            with contextlib.suppress(OSError):  # many cameras do not have the automatic control
                device.write_control(automatic_control, off_value)
        try:
            device.write_control(control, value)
        except OSError as error:
            raise UsageError(
                f"camera: {option} cannot be set to {value} ({error.strerror}); the controls of this camera are "
                f"{', '.join(name for _, name in device.controls())}."
            ) from error
        requested[control] = value
    described = []
    for control, name in device.controls():
        with contextlib.suppress(OSError):
            value = device.read_control(control)
            differs = f" ({requested[control]} requested)" if requested.get(control, value) != value else ""
            described.append(f"{name}={value}{differs}")
    loss = (
        f"; encoded from YUYV as JPEG 4:2:2 with quantizer {JPEG_QUALITY}, which loses some detail"
        if encoding == "yuyv"
        else ""
    )
    return ", ".join(described) + loss


class V4l2Link(DescriptorLink):
    """A camera that captures. Each entry is the settings or a frame, as `tacpipe.sensors.camera` packs them."""

    packets = True

    def __init__(self, name: str, device: V4l2Device, capture: Capture) -> None:
        """Start to capture into buffers of the kernel, after the settings as the first entry."""
        self.device, self.capture = device, capture
        self._encoder = None
        if capture.encoding == "yuyv":
            self._encoder = JpegEncoder(capture.width_px, capture.height_px, "yuvj422p")
        count, *_ = struct.unpack("<5I", device.call(REQBUFS, struct.pack("<5I", BUFFERS, CAPTURE, MMAP, 0, 0)))
        self._memory = [self._map_buffer(index) for index in range(count)]
        for index in range(count):
            self._queue(index)
        device.call(STREAMON, struct.pack("<i", CAPTURE))
        self._pending: Arrived = [(time.monotonic_ns(), pack_settings(capture.settings()))]
        self._last_ns = 0
        super().__init__(name, device.fileno)

    @property
    def kernel_stamped(self) -> bool:
        """True: the kernel stamps each frame."""
        return True

    def _receive(self, timeout_s: float) -> Arrived:
        pending, self._pending = self._pending, []
        return pending or super()._receive(timeout_s)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the frames in filled buffers, and queue the buffers again. Raises `LinkLostError` without the camera."""
        entries: Arrived = []
        for _ in range(BUFFERS):  # bounded, because frames can arrive as fast as they are encoded
            try:
                filled = BUFFER.unpack(self.device.call(DQBUF, self._buffer(0)))
            except BlockingIOError:
                return entries
            except OSError as error:
                if error.errno == errno.EIO:  # the kernel lost a frame, which the next number shows
                    return entries
                raise self.lost("it was unplugged" if error.errno == errno.ENODEV else str(error.strerror)) from error
            entries.append(self._entry(filled))
            self._queue(filled[0])
        return entries

    def _entry(self, filled: tuple[Any, ...]) -> tuple[int, bytes]:
        """Return the arrival of a filled buffer in ns and its frame."""
        index, _, size, flags, _, seconds, microseconds, _, number, *_ = filled
        now_us = time.monotonic_ns() // 1000
        t_us = min(seconds * 1_000_000 + microseconds, now_us) if flags & STAMP_KIND == MONOTONIC else now_us
        t_ns = max(t_us * 1000, self._last_ns + 1000)
        self._last_ns = t_ns
        content = self._memory[index][:size]
        if self._encoder is not None and not flags & DAMAGED:
            content = self._encode(content)
        return t_ns, pack_frame(Frame(number % COUNTS, t_ns // 1000, 0, content))

    def _encode(self, content: bytes) -> bytes:
        """Return raw pixels as JPEG; an incomplete frame unchanged."""
        with extras.explain_missing(ENCODED_BY):
            import av

        size_px = self.capture.height_px, self.capture.width_px
        if len(content) < 2 * size_px[0] * size_px[1] or self._encoder is None:
            return content  # a part of a frame, which is counted as a loss
        pixels = np.frombuffer(content, np.uint8, 2 * size_px[0] * size_px[1]).reshape(*size_px, 2)
        return self._encoder.encode(av.VideoFrame.from_ndarray(pixels, format="yuyv422"))

    def _map_buffer(self, index: int) -> mmap.mmap:
        described = BUFFER.unpack(self.device.call(QUERYBUF, self._buffer(index)))
        offset, length = described[10] & 0xFFFFFFFF, described[11]
        return mmap.mmap(self.device.fileno, length, offset=offset)

    def _buffer(self, index: int) -> bytes:
        return BUFFER.pack(index, CAPTURE, 0, 0, 0, 0, 0, b"", 0, MMAP, 0, 0, 0, 0)

    def _queue(self, index: int) -> None:
        self.device.call(QBUF, self._buffer(index))

    def _release(self) -> None:
        """Stop the capture, and close buffers and device."""
        super()._release()
        with contextlib.suppress(OSError):  # the camera was unplugged
            self.device.call(STREAMOFF, struct.pack("<i", CAPTURE))
        for memory in self._memory:
            memory.close()
        self.device.close()
