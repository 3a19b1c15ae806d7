"""Emulate devices that start, stop or set their rate on request and confirm nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

from tacpipe.sensors import ati_netft, contactile, icub_skin, justfloat, optoforce, robotiq, teraranger
from tacpipe.testing.dialogues import Device


@dataclass
class Board(Device):
    """An emulated board that streams between the commands ``start`` and ``stop``."""

    start: bytes = b""
    stop: bytes = b""

    def hear(self, data: bytes) -> list[bytes]:
        """Start or stop the stream, according to the last command of the host. There are no replies."""
        self.heard += data
        started = self.heard.rfind(self.start) if self.start else -1
        stopped = self.heard.rfind(self.stop) if self.stop else -1
        if started != stopped:
            self.streaming = started > stopped
            del self.heard[: max(started + len(self.start), stopped + len(self.stop))]
        return []


class IcubBoard(Device):
    """An emulated board."""

    def __init__(self, sensor: icub_skin.IcubSkin) -> None:
        super().__init__(streaming=False)
        self.sensor = sensor

    def hear(self, data: bytes) -> list[bytes]:
        """Process CAN frames of the host, which set the rate and start or stop the stream. There are no replies."""
        self.heard += data
        while len(self.heard) >= icub_skin.CAN:
            message = bytes(self.heard[: icub_skin.CAN])
            del self.heard[: icub_skin.CAN]
            if int.from_bytes(message[:4], "little") != icub_skin.POLLING << 8 | self.sensor.board:
                continue
            if message[icub_skin.DATA] == icub_skin.TRANSMIT and not self.sensor.old:
                self.streaming = message[icub_skin.DATA + 1] == 0
            elif message[icub_skin.DATA] == icub_skin.BOARD and message[icub_skin.DATA + 2]:
                self.rate_hz = 1000 / message[icub_skin.DATA + 2]
            elif message[icub_skin.DATA] == icub_skin.OLD_TIMING and self.sensor.old:
                self.streaming = True
        return []


class Evo(Device):
    """An emulated sensor. It sends frames only in binary mode; text mode is not emulated."""

    binary = False
    started = False

    def hear(self, data: bytes) -> list[bytes]:
        """Process commands of the host: the stream runs after it was started with binary frames. There are no replies."""
        self.heard += data
        while (start := self.heard.find(0x00)) >= 0 and len(self.heard) >= start + 4:
            size = 4 if self.heard[start + 1] == teraranger.BINARY[1] else 5
            if len(self.heard) < start + size:
                break
            message = bytes(self.heard[start : start + size])
            if message not in (teraranger.BINARY, teraranger.START, teraranger.STOP):
                del self.heard[: start + 1]
                continue
            del self.heard[: start + size]
            self.binary = self.binary or message == teraranger.BINARY
            self.started = message == teraranger.START if message != teraranger.BINARY else self.started
            self.streaming = self.binary and self.started
        return []


class ContactileController(Device):
    """An emulated controller, which receives lines of text and does not answer."""

    def hear(self, data: bytes) -> list[bytes]:
        """Process commands of the host, of which only the rate has an effect. There are no replies."""
        self.heard += data
        while (stop := self.heard.find(b"\n")) >= 0:
            line = bytes(self.heard[:stop])
            del self.heard[: stop + 1]
            if line[:1] == b"f" and line[1:].isdigit() and int(line[1:]) in contactile.RATES:
                self.rate_hz = float(line[1:])
        return []


INFO = b"bridge info get\r\n"


@dataclass
class Bridge(Device):
    """An emulated fulai, whose commands are lines of text."""

    model: str = ""

    def hear(self, data: bytes) -> list[bytes]:
        """Process lines of the host: start and stop the stream, or return the reply with the model."""
        self.heard += data
        replies = []
        while (stop := self.heard.find(b"\n")) >= 0:
            command = bytes(self.heard[: stop + 1]).strip()
            del self.heard[: stop + 1]
            if command in (justfloat.ON.strip(), justfloat.OFF.strip()):
                self.streaming = command == justfloat.ON.strip()
            elif command == INFO.strip():
                hardware = self.model.removeprefix("fulai-")
                replies.append(f"OK BRIDGE MODEL=FULAI FW=1.0 HW=V{hardware} PROTOCOL=VOFA HAND=LEFT\r\n".encode())
        return replies


class Daq(Device):
    """An emulated DAQ: it streams at the rate that was set last, and not after a stop."""

    def hear(self, data: bytes) -> list[bytes]:
        """Process configurations of the host, which set the rate or stop the stream. There are no replies."""
        self.heard += data
        while (start := self.heard.find(optoforce.CONFIGURE)) >= 0 and len(self.heard) >= start + 9:
            message = bytes(self.heard[start : start + 9])
            del self.heard[: start + 9]
            if optoforce.with_sum(message[:7]) == message:
                rates = {speed: rate for rate, speed in optoforce.SPEEDS.items()}
                self.streaming, self.rate_hz = message[4] != optoforce.STOP, rates.get(message[4])
        return []


STARTS = (1, ati_netft.START, 3)  # 1 is for newer boxes; 3 buffers records if the box is configured to


class Box(Device):
    """An emulated box: it streams without limit, or sends the requested number of records."""

    requested = 0

    def hear(self, data: bytes) -> list[bytes]:
        """Start or stop sending on request; other packets are ignored. There are no replies."""
        if len(data) != ati_netft.REQUEST.size:
            return []
        magic, command, count = ati_netft.REQUEST.unpack(data)
        if magic == ati_netft.MAGIC and command in STARTS:
            self.streaming, self.requested = count == 0, self.requested + count
        elif magic == ati_netft.MAGIC and command == ati_netft.STOP:
            self.streaming, self.requested = False, 0
        return []

    def polled(self) -> int:
        requested, self.requested = self.requested, 0
        return requested


@dataclass
class Fingertips(Device):
    """Emulated fingertips: they report their version, send a packet on request, or stream with a period."""

    requests: int = 0
    version: bytes = field(default=b"\x01\x00\x00")

    def hear(self, data: bytes) -> list[bytes]:
        """Process packets of the host, which set the rate or request packets, and return the replies."""
        self.heard += data
        replies = []
        while (start := self.heard.find(robotiq.START)) >= 0 and len(self.heard) >= start + robotiq.HEADER:
            size = robotiq.HEADER + self.heard[start + 3]
            if len(self.heard) < start + size:
                break
            message = bytes(self.heard[start : start + size])
            del self.heard[: start + size]
            if message[2] in (robotiq.SYNCHRONOUS, robotiq.ASYNCHRONOUS) and size == robotiq.HEADER + 1:
                self.streaming = message[4] > 0
                self.rate_hz = 1000 / message[4] if message[4] else None
            elif message[2] == robotiq.READ:
                self.requests += 1
            elif message[2] == robotiq.VERSION:
                replies.append(robotiq.command(robotiq.VERSION, self.version))
        return replies

    def polled(self) -> int:
        requests, self.requests = self.requests, 0
        return requests
