"""Emulate USB HID devices with umockdev, without a kernel driver, for hosts that are started under it.

Hosts run as ``UMOCKDEV_DIR=… umockdev-wrapper PROGRAM``; FOLDER/hid/root contains that directory. All devices of an emulator
share one directory. umockdev has no queue and no hang-up: two reports that a slow host did not read are merged, and an
unplugged device is silent without notifying its host.
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
from tests.emulation import hid_server

SYSTEM_PYTHON = "/usr/bin/python3"
# 64 bytes in and out, like Teensy's RawHID
RAW = "06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0"
SIX_AXES = (  # six 16-bit axes in report 1, three in report 2, 32 buttons in report 3, like a SpaceMouse
    "0501 0908 a101 a100 8501 16a2fe 265e01 7510 9506 0930 0931 0932 0933 0934 0935 8102 c0 "
    "a100 8502 16a2fe 265e01 7510 9503 0933 0934 0935 8102 c0 a102 8503 0509 1901 2920 1500 2501 7501 9520 8102 c0 c0"
)
DESCRIPTORS = {"256f:c635": SIX_AXES}  # report descriptors of devices that are not raw HID
_servers: dict[Path, Server] = {}


class Server:
    """The umockdev process of an emulator's folder, with its devices."""

    def __init__(self, folder: Path) -> None:
        """Start the server. Raises `DeviceError` if umockdev is not installed or does not start."""
        if shutil.which("umockdev-wrapper") is None or not Path(SYSTEM_PYTHON).exists():
            raise DeviceError(
                "HID devices are emulated by umockdev, which is not installed. Install umockdev, gir1.2-umockdev-1.0 and "
                "python3-gi, or remove the hid streams."
            )
        self.process = subprocess.Popen(
            ["umockdev-wrapper", SYSTEM_PYTHON, hid_server.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.root = self.read_line().decode()
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

    def read_line(self) -> bytes:
        """Wait for the next line of the server and return it; empty when the server has ended."""
        assert self.process.stdout is not None
        line = b""
        while not line.endswith(b"\n"):
            piece = os.read(self.process.stdout.fileno(), 1)
            if not piece:
                return b""
            line += piece
        return line.strip()

    def send(self, command: str) -> None:
        """Send a command to the server."""
        assert self.process.stdin is not None
        self.process.stdin.write(command.encode() + b"\n")
        self.process.stdin.flush()

    def receive(self) -> None:
        """Pass reports of hosts to their devices."""
        assert self.process.stdout is not None
        data = os.read(self.process.stdout.fileno(), 65_536)
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            number, _, report = line.decode().partition(" ")
            self.devices[int(number)].reports.append(bytes.fromhex(report))

    def close(self) -> None:
        """Terminate the server."""
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        self.process.terminate()
        self.process.wait()


class Host:
    """The host of a device. umockdev does not report whether there is one."""

    def __init__(self, endpoint: Hid) -> None:
        self.endpoint = endpoint

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a report."""
        for piece in pieces:
            self.endpoint.server.send(f"send {self.endpoint.number} {piece.hex()}")
        return [len(piece) for piece in pieces]


class Hid:
    """A HID device."""

    def __init__(self, sensor: Sensor, address: Address, folder: Path) -> None:
        """Add a device to the server of ``folder``, which is started if there is none."""
        if folder not in _servers:
            _servers[folder] = Server(folder)
        self.address, self._folder = address, folder
        self.server = _servers[folder]
        self.number = len(self.server.devices)
        self.server.devices.append(self)
        self.reports: list[bytes] = []
        usb_id = address.target.partition("?")[0] if ":" in address.target else (*sensor.usb_ids, "16c0:0486")[0]
        vendor, _, product = usb_id.lower().partition(":")
        descriptor = bytes.fromhex(DESCRIPTORS.get(usb_id.lower(), RAW)).hex()
        self.server.send(f"add {self.number} {vendor} {product} {descriptor} {type(sensor).__name__}")
        self.server.read_line()
        self._unplugged = False
        self.peers = [Host(self)]

    def descriptors(self) -> list[int]:
        """Return the server's output for the first device, and nothing for the others."""
        assert self.server.process.stdout is not None
        return [self.server.process.stdout.fileno()] if self.number == 0 else []

    def ready(self, descriptor: int) -> list[tuple[Host, bytes]]:
        """Receive the reports of hosts for all devices."""
        self.server.receive()
        return self.look()

    def look(self) -> list[tuple[Host, bytes]]:
        """Return the reports of hosts to this device, without the report number 0."""
        reports, self.reports = self.reports, []
        return [(self.peers[0], report.removeprefix(b"\0")) for report in reports if not self._unplugged]

    def unplug(self) -> None:
        """Stop receiving and sending."""
        self._unplugged, self.peers = True, []

    def replug(self) -> None:
        """Restart the device."""
        self._unplugged, self.peers = False, [Host(self)]

    def close(self) -> None:
        """Close the server of all devices."""
        if _servers.get(self._folder) is self.server:
            del _servers[self._folder]
            self.server.close()
