"""Read and write CAN buses through python-can. Each entry is one frame of 13 bytes."""

from __future__ import annotations

import contextlib
import re
import struct
import termios
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError, UsageError
from tacpipe.io.files import listed
from tacpipe.links import ports
from tacpipe.links.link import Arrivals, Arrived, OpenLink
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    import can

KINDS = ("socketcan", "slcan", "virtual")
FRAME = struct.Struct("<IB8s")  # identifier, number of data bytes, data bytes padded with zeros
EXTENDED = 1 << 31  # flag of an identifier with 29 bits
SEND_S = 1.0
INTERFACES = Path("/sys/class/net")
CAN_TYPE = "280"  # ARPHRD_CAN of <linux/if_arp.h>
DIGIT = "[0-9A-Fa-f]"
SLCAN_FRAME = re.compile(
    rf"(?P<kind>[tdb][0-7]{DIGIT}{{2}}|[TxDB][01]{DIGIT}{{7}})(?P<length>{DIGIT})(?P<data>(?:{DIGIT}{{2}})*)"
)
SLCAN_REPLY = re.compile(
    rf"|[zZA]|F{DIGIT}{{2}}|[VvN]{DIGIT}{{4}}|(?:r[0-7]{DIGIT}{{2}}|R[01]{DIGIT}{{7}})[0-8]{DIGIT}*"
)


def open_can(target: str, sensor: Sensor, name: str) -> CanLink:
    """Open the bus ``KIND:CHANNEL`` or ``KIND:CHANNEL@BITRATE``.

    Raises `UsageError` for an invalid address, and `DeviceError` if the interface is missing, down, or not permitted.
    """
    kind, channel, bitrate = parse_bus(target)
    with extras.explain_missing(name):
        import can
    if kind == "slcan":
        ports.refuse_missing(channel, name)
    damaged: Arrived = []
    try:
        if kind == "slcan":
            bus = _open_slcan(channel, bitrate, damaged)
        else:
            bus = can.Bus(interface=kind, channel=channel, ignore_config=True)
    except (can.CanError, OSError, ValueError) as error:
        raise _open_error(error, kind, channel, bitrate, name) from error
    return CanLink(name, bus, damaged)


def _open_slcan(channel: str, bitrate: int | None, damaged: Arrived) -> can.BusABC:
    """Return an open slcan adapter that adds damaged lines to ``damaged`` as (UTC in ns, bytes).

    For some damaged lines python-can raises an error; others it drops, or reads as shorter frames.
    """
    from can import CanOperationError
    from can.interfaces.slcan import slcanBus

    class CheckedBus(slcanBus):
        def _read(self, timeout: float | None) -> str | None:
            try:
                line = super()._read(timeout)
            except CanOperationError as error:
                if not isinstance(error.__cause__, UnicodeDecodeError):
                    raise
                damaged.append((time.time_ns(), _make_size_invalid(error.__cause__.object)))
                self._buffer.clear()
                return None
            if line and not is_slcan_line(line[:-1]):
                damaged.append((time.time_ns(), _make_size_invalid(line.encode())))
                return None
            return line

    return CheckedBus(channel, bitrate=bitrate)


def is_slcan_line(line: str) -> bool:
    """Return whether an adapter may send this line. ``line`` has no line end.

    >>> [is_slcan_line(line) for line in ("t1232AABB", "t1232AAB", "t1232AA", "z")]
    [True, False, False, True]
    """
    frame = SLCAN_FRAME.fullmatch(line)
    if frame is None:
        return SLCAN_REPLY.fullmatch(line) is not None
    length = int(frame["length"], 16)
    return (length <= 8 or frame["kind"][0] in "dDbB") and len(frame["data"]) >= 2 * min(length, 8)


def _make_size_invalid(line: bytes) -> bytes:
    """Return a damaged line, shortened if necessary so that its size is not a multiple of the frame size."""
    return line if len(line) % FRAME.size else line[:-1]


def parse_bus(target: str) -> tuple[str, str, int | None]:
    """Return the kind, channel and bit rate of a CAN bus from its address. The bit rate is None if the address has none.

    Raises `UsageError` for an invalid address.

    >>> parse_bus("slcan:/dev/ttyACM0@1000000"), parse_bus("socketcan:can0")
    (('slcan', '/dev/ttyACM0', 1000000), ('socketcan', 'can0', None))
    """
    kind, _, channel_text = target.partition(":")
    channel, at, bitrate = channel_text.partition("@")
    if kind not in KINDS or not channel or (at and not bitrate.isdigit()):
        raise UsageError(
            f"can:{target} is not a CAN bus; write can:KIND:CHANNEL or can:KIND:CHANNEL@BITRATE with one of the "
            f"kinds {', '.join(KINDS)}."
        )
    return kind, channel, (int(bitrate) if at else None)


def _open_error(error: Exception, kind: str, channel: str, bitrate: int | None, name: str) -> DeviceError:
    """Return the error for a bus that cannot be opened, with advice for its kind."""
    if kind == "slcan":
        cause = error if isinstance(error, OSError) else error.__cause__ or error.__context__
        return ports.open_error(cause if isinstance(cause, OSError) else OSError(str(error)), channel, name)
    interfaces = [path.name for path in listed(INTERFACES) if _hardware_type(path) == CAN_TYPE]
    if kind == "socketcan" and channel not in interfaces:
        return DeviceError(
            f"{name}: there is no CAN interface {channel}; there {'are' if len(interfaces) > 1 else 'is'} "
            f"{', '.join(interfaces) or 'none'}. Plug the adapter in, or correct the transport."
        )
    advice = f"Run `sudo ip link set {channel} up type can bitrate {bitrate or 1_000_000}`."
    return DeviceError(f"{name}: {channel} cannot be opened: {error}. {advice}")


def _hardware_type(interface: Path) -> str:
    try:
        return (interface / "type").read_text().strip()
    except OSError:
        return ""


class CanLink(OpenLink):
    """An open CAN bus."""

    packets = True

    def __init__(self, name: str, bus: can.BusABC, damaged: Arrived) -> None:
        super().__init__(name)
        self.bus = bus
        self._damaged = damaged  # damaged lines; the framer counts them as lost bytes
        self._arrivals = Arrivals()

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the frames that arrived within ``timeout_s``, and damaged lines.

        Raises `LinkLostError` without the adapter.
        """
        import can

        entries: Arrived = []
        try:
            message = self.bus.recv(timeout_s)
            while message is not None:
                entries += self._take_damaged_lines()
                if not message.is_error_frame and not message.is_remote_frame and len(message.data) <= 8:
                    self._arrivals.read_clocks()
                    entries.append((self._arrivals.to_monotonic(int(message.timestamp * 1e9)), pack_frame(message)))
                message = self.bus.recv(0)
            entries += self._take_damaged_lines()
        except (can.CanError, OSError, ValueError) as error:
            if not entries:
                raise self.lost(str(error)) from error
        return entries

    def _take_damaged_lines(self) -> Arrived:
        """Return the damaged lines since the last call, with their arrivals."""
        lines, self._damaged[:] = list(self._damaged), []
        if lines:
            self._arrivals.read_clocks()
        return [(self._arrivals.to_monotonic(utc_ns), line) for utc_ns, line in lines]

    def _send(self, data: bytes) -> None:
        """Send the frames in ``data``. Raises `LinkLostError` if the bus fails."""
        import can

        try:
            for message in unpack_frames(data):
                self.bus.send(message, timeout=SEND_S)
        except (can.CanError, OSError, ValueError) as error:
            raise self.lost(str(error)) from error

    def _release(self) -> None:
        """Close the bus, and the serial port of an adapter that was unplugged."""
        import can

        try:
            self.bus.shutdown()
        except (can.CanError, OSError, ValueError, termios.error):  # an unplugged adapter does not reply
            port = getattr(self.bus, "serialPortOrig", None)  # slcan leaves its serial port open after such an error
            if port is not None:
                with contextlib.suppress(OSError):
                    port.close()


def pack_frame(message: can.Message) -> bytes:
    """Encode a CAN frame as 13 bytes."""
    identifier = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
    return FRAME.pack(identifier, len(message.data), bytes(message.data))


def unpack_frames(data: bytes) -> list[can.Message]:
    """Return the CAN frames in ``data``, 13 bytes per frame."""
    import can

    return [
        can.Message(
            arbitration_id=identifier & ~EXTENDED, is_extended_id=bool(identifier & EXTENDED), data=payload[:count]
        )
        for identifier, count, payload in FRAME.iter_unpack(data)
    ]
