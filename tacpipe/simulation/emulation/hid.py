"""A USB HID device that umockdev plays to hosts which are started with it: the kernel needs no device and no driver.

Hosts run as ``UMOCKDEV_DIR=… umockdev-wrapper PROGRAM``; the folder stands in FOLDER/hid/root. All devices of an emulator
are in one folder. A report is written at once, but two that a slow host left lying come as one, and an unplugged device
falls silent without its host being informed: the mock has neither the kernel's queue nor its hang-up.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from tacpipe.errors import DeviceError
from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults, hid_server

SYSTEM_PYTHON = "/usr/bin/python3"
RAW = "06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0"  # 64 bytes in and out, as Teensy's RawHID
SIX_AXES = (  # six 16-bit axes in report 1, three in report 2, 32 buttons in report 3, as a SpaceMouse's
    "0501 0908 a101 a100 8501 16a2fe 265e01 7510 9506 0930 0931 0932 0933 0934 0935 8102 c0 "
    "a100 8502 16a2fe 265e01 7510 9503 0933 0934 0935 8102 c0 a102 8503 0509 1901 2920 1500 2501 7501 9520 8102 c0 c0"
)
DESCRIPTORS = {"256f:c635": SIX_AXES}  # report descriptors of devices that are not raw HID
_servers: dict[Path, Server] = {}


class Server:
    """The one umockdev of an emulator's folder, with its devices."""

    def __init__(self, folder: Path) -> None:
        if shutil.which("umockdev-wrapper") is None or not Path(SYSTEM_PYTHON).exists():
            raise DeviceError(
                "HID devices are emulated by umockdev, which is not installed. Install umockdev, gir1.2-umockdev-1.0 and "
                "python3-gi, or leave the hid streams out."
            )
        self.process = subprocess.Popen(
            ["umockdev-wrapper", SYSTEM_PYTHON, hid_server.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.root = self.line().decode()
        if not self.root:
            assert self.process.stderr is not None
            message = self.process.stderr.read().decode().strip().splitlines()[-1:]
            raise DeviceError(
                f"umockdev did not start ({' '.join(message)}). Install gir1.2-umockdev-1.0 and python3-gi."
            )
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "root").write_text(f"{self.root}\n", encoding="utf-8")
        self.devices: list[Hid] = []
        self._pending = b""

    def line(self) -> bytes:
        """Return the next line that the server states, waiting for it."""
        assert self.process.stdout is not None
        line = b""
        while not line.endswith(b"\n"):
            piece = os.read(self.process.stdout.fileno(), 1)
            if not piece:
                return b""
            line += piece
        return line.strip()

    def send(self, command: str) -> None:
        """Give the server a command."""
        assert self.process.stdin is not None
        self.process.stdin.write(command.encode() + b"\n")
        self.process.stdin.flush()

    def heard(self) -> None:
        """Hand each device what hosts wrote to it."""
        assert self.process.stdout is not None
        data = os.read(self.process.stdout.fileno(), 65_536)
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            number, _, report = line.decode().partition(" ")
            self.devices[int(number)].reports.append(bytes.fromhex(report))

    def close(self) -> None:
        """End the server."""
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        self.process.terminate()
        self.process.wait()


class Host:
    """Whoever has the device open; the mock does not state."""

    fault = byte_faults.SOUND

    def __init__(self, endpoint: Hid) -> None:
        self.endpoint, self.device = endpoint, endpoint.sensor.device()
        self.pending_frames = 0

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a report."""
        for piece in pieces:
            self.endpoint.server.send(f"send {self.endpoint.number} {piece.hex()}")
        return [len(piece) for piece in pieces]


class Hid:
    """A HID device."""

    def __init__(self, sensor: Sensor, address: Address, folder: Path) -> None:
        if folder not in _servers:
            _servers[folder] = Server(folder)
        self.sensor, self.address, self._folder = sensor, address, folder
        self.server = _servers[folder]
        self.number = len(self.server.devices)
        self.server.devices.append(self)
        self.reports: list[bytes] = []
        usb_id = address.place.partition("?")[0] if ":" in address.place else (*sensor.usb_ids, "16c0:0486")[0]
        vendor, _, product = usb_id.lower().partition(":")
        descriptor = bytes.fromhex(DESCRIPTORS.get(usb_id.lower(), RAW)).hex()
        self.server.send(f"add {self.number} {vendor} {product} {descriptor} {type(sensor).__name__}")
        self.server.line()
        self._away = False
        self.peers = [Host(self)]

    def descriptors(self) -> list[int]:
        """Return where the server states what hosts wrote, of the first device alone."""
        assert self.server.process.stdout is not None
        return [self.server.process.stdout.fileno()] if self.number == 0 else []

    def ready(self, descriptor: int) -> list[tuple[Host, bytes]]:
        """Take what hosts wrote, for all devices."""
        self.server.heard()
        return self.look()

    def look(self) -> list[tuple[Host, bytes]]:
        """Return what hosts wrote to this one: reports, behind a number that is 0 where there is none."""
        reports, self.reports = self.reports, []
        return [(self.peers[0], report.removeprefix(b"\0")) for report in reports if not self._away]

    def unplug(self) -> None:
        """Fall silent."""
        self._away, self.peers = True, []

    def replug(self) -> None:
        """Begin anew."""
        self._away, self.peers = False, [Host(self)]

    def close(self) -> None:
        """End, and the server with the last device."""
        if _servers.get(self._folder) is self.server:
            del _servers[self._folder]
            self.server.close()
