"""Read and write USB HID devices through hidapi. Each entry is one report."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import ports
from tacpipe.links.link import Arrived, OpenLink
from tacpipe.links.ports import HidInterface
from tacpipe.sensors.sensor import Sensor

MAX_WAIT_S = 0.03  # the kernel queues 63 reports, 63 ms of the fastest device, and then drops the newest
KEYS = ("interface", "usage_page", "serial")  # keys that may follow the ? of an address
LONG = 0xFE  # prefix of a long item; the next byte is its size
INPUT, USAGE_PAGE, REPORT_SIZE, REPORT_ID, REPORT_COUNT, PUSH, POP = 0x80, 0x04, 0x74, 0x84, 0x94, 0xA4, 0xB4


def open_hid(target: str, sensor: Sensor, name: str) -> HidLink:
    """Open the device ``VENDOR:PRODUCT``, ``VENDOR:PRODUCT?interface=0&serial=1234``, or a path.

    If a device has several interfaces, the one in the address is opened; without it, the one with the sensor's
    ``usage_page``, or else the first. Raises `DeviceError` if the device is missing, ambiguous, or not permitted.
    """
    module = ports.hid_module()
    info = choose_interface(target, module.enumerate(), sensor.usage_page, name)
    path: bytes = info["path"]
    device = module.device()
    try:
        device.open_path(path)
    except OSError as error:
        raise _open_error(path.decode(), info, name) from error
    device.set_nonblocking(1)
    return HidLink(name, device)


def choose_interface(target: str, interfaces: list[HidInterface], usage_page: int | None, name: str) -> HidInterface:
    """Return the entry of hidapi's ``interfaces`` that matches an address.

    Raises `UsageError` for an invalid address, and `DeviceError` if no device or more than one matches.
    """
    device, _, query = target.partition("?")
    options = dict(parse_qsl(query))
    if unknown := set(options) - set(KEYS):
        raise UsageError(f"hid:{target}: there is no key {', '.join(sorted(unknown))}; the keys are {', '.join(KEYS)}.")
    matching = [info for info in interfaces if _matches(info, device, options)]
    if not matching:
        raise DeviceError(
            f"{name}: there is no HID device {target}; {ports.describe_ports(ports.hid_ports())}. Plug it in, or "
            f"correct the transport."
        )
    preferred = [info for info in matching if info["usage_page"] == usage_page] or matching
    lowest = min(info["interface_number"] for info in preferred)
    preferred = [info for info in preferred if info["interface_number"] == lowest]
    if len({info["path"] for info in preferred}) > 1:
        serials = ", ".join(f"hid:{device}?serial={info['serial_number'] or '...'}" for info in preferred)
        paths = ", ".join(f"hid:{info['path'].decode()}" for info in preferred)
        raise DeviceError(
            f"{name}: {len(preferred)} devices match {target}; give a serial number, {serials}, or a path, {paths}."
        )
    return preferred[0]


def _matches(info: HidInterface, device: str, options: dict[str, str]) -> bool:
    """Return whether an interface is the one with this path, or vendor and product, and has the values in ``options``."""
    if info["path"].decode() != device and f"{info['vendor_id']:04x}:{info['product_id']:04x}" != device.lower():
        return False
    return (
        options.get("serial", info["serial_number"]) == info["serial_number"]
        and options.get("interface", str(info["interface_number"])) == str(info["interface_number"])
        and options.get("usage_page", f"{info['usage_page']:04x}").lower() == f"{info['usage_page']:04x}"
    )


def _open_error(path: str, info: HidInterface, name: str) -> DeviceError:
    """Return the error for a device that cannot be opened, with the rule that permits it."""
    if os.access(path, os.R_OK | os.W_OK):
        return DeviceError(f"{name}: {path} cannot be opened; unplug the device and plug it in again.")
    rule = (
        f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{info["vendor_id"]:04x}", '
        f'ATTRS{{idProduct}}=="{info["product_id"]:04x}", MODE="0660", TAG+="uaccess"'
    )
    return DeviceError(
        f"{name}: you may not open {path}; write the line {rule} to /etc/udev/rules.d/70-tacpipe.rules, run "
        f"`sudo udevadm control --reload`, and plug the device in again."
    )


class HidLink(OpenLink):
    """An open HID device."""

    packets = True

    def __init__(self, name: str, device: Any) -> None:
        super().__init__(name)
        self.device = device
        self.reports = parse_report_descriptor(_descriptor(device))

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the reports that arrived within ``timeout_s``. Raises `LinkLostError` without the device."""
        deadline = time.monotonic() + timeout_s
        entries: Arrived = []
        try:
            while not entries and not self._closed:
                left_s = min(deadline - time.monotonic(), MAX_WAIT_S)
                report = self.device.read(self.reports.max_size, max(1, int(left_s * 1000)))
                while report:
                    entries.append((time.monotonic_ns(), bytes(report)))
                    report = self.device.read(self.reports.max_size)
                if left_s < MAX_WAIT_S:
                    break
        except (OSError, ValueError) as error:
            if not entries:
                raise self.lost(f"it was unplugged ({error})") from error
        return entries

    def _send(self, data: bytes) -> None:
        """Send a report. Raises `LinkLostError` if the device is gone or refuses it."""
        prefix = b"" if self.reports.has_numbers else b"\0"  # hidapi requires a report number; 0 means none
        try:
            sent = self.device.write(prefix + data)
        except (OSError, ValueError) as error:
            raise self.lost(f"it was unplugged ({error})") from error
        if sent < 0:
            raise self.lost("it accepts no report")

    def _release(self) -> None:
        self.device.close()


def _descriptor(device: Any) -> bytes:
    """Return the report descriptor. It is empty if hidapi is older than 0.14 or the system does not provide it."""
    try:
        return bytes(device.get_report_descriptor())
    except (AttributeError, OSError, ValueError):
        return b""


@dataclass(frozen=True)
class Reports:
    """The reports that a HID device sends."""

    usage_page: int = 0  # the first usage page
    # bits per report, by report number; the number is 0 if reports are not numbered
    bits: dict[int, int] = field(default_factory=dict)

    @property
    def has_numbers(self) -> bool:
        """True if the first byte of each report is its number."""
        return any(self.bits)

    @property
    def max_size(self) -> int:
        """Bytes of the max_size report including its number, or 64 if the device does not declare its reports."""
        return max((-(-bits // 8) for bits in self.bits.values()), default=64) + self.has_numbers


def parse_report_descriptor(descriptor: bytes) -> Reports:
    """Return the reports that a HID report descriptor declares.

    Source: Device Class Definition for Human Interface Devices (HID), version 1.11, section 6.2.2.

    >>> parse_report_descriptor(bytes.fromhex("06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0"))
    Reports(usage_page=65451, bits={0: 512})
    """
    bits: dict[int, int] = {}
    state, stack = {USAGE_PAGE: 0, REPORT_SIZE: 0, REPORT_COUNT: 0, REPORT_ID: 0}, []
    first_page, offset = 0, 0
    while offset < len(descriptor):
        prefix = descriptor[offset]
        if prefix == LONG:
            offset += 3 + (descriptor[offset + 1] if offset + 1 < len(descriptor) else 0)
            continue
        size = (0, 1, 2, 4)[prefix & 3]
        value = int.from_bytes(descriptor[offset + 1 : offset + 1 + size], "little")
        item = prefix & 0xFC
        offset += 1 + size
        if item == INPUT:
            number = state[REPORT_ID]
            bits[number] = bits.get(number, 0) + state[REPORT_SIZE] * state[REPORT_COUNT]
        elif item == PUSH:
            stack.append(dict(state))
        elif item == POP and stack:
            state = stack.pop()
        elif item in state:
            state[item] = value
            first_page = first_page or state[USAGE_PAGE]
    return Reports(first_page, bits)
