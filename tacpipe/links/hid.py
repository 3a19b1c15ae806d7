"""USB HID through hidapi: one report an entry."""

from __future__ import annotations

import os
import time
from typing import Any
from urllib.parse import parse_qsl

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import ports, report_descriptor
from tacpipe.links.opened import Arrived, Opened
from tacpipe.sensors.sensor import Sensor

LONGEST_WAIT_S = 0.03  # the kernel keeps 63 reports, 63 ms of the fastest device, and then drops the newest
CHOICES = ("interface", "usage_page", "serial")  # what an address may state behind its ?


def open_hid(place: str, sensor: Sensor, name: str) -> HidLink:
    """Return the open device of ``VENDOR:PRODUCT``, ``VENDOR:PRODUCT?interface=0&serial=1234``, or a path.

    Of the interfaces of one device that is taken which the address names, else the one of the sensor's ``usage_page``, else
    the first. Raises `DeviceError` for a device that is missing, there twice, or not permitted.
    """
    module = ports.hid_module()
    info = chosen(place, module.enumerate(), sensor.usage_page, name)
    path: bytes = info["path"]
    device = module.device()
    try:
        device.open_path(path)
    except OSError as error:
        raise _refused(path.decode(), info, name) from error
    device.set_nonblocking(1)
    return HidLink(name, device)


def chosen(place: str, there: list[dict[str, Any]], usage_page: int | None, name: str) -> dict[str, Any]:
    """Return the interface that an address means of those that hidapi lists.

    Raises `UsageError` for an address that is none, `DeviceError` where none or more than one device fits.
    """
    which, _, query = place.partition("?")
    wanted = dict(parse_qsl(query))
    if unknown := set(wanted) - set(CHOICES):
        raise UsageError(f"hid:{place}: there is no {', '.join(sorted(unknown))}; there are {', '.join(CHOICES)}.")
    fitting = [info for info in there if _is(info, which, wanted)]
    if not fitting:
        raise DeviceError(
            f"{name}: there is no HID device {place}; {ports.listed(ports.hid_ports())}. Plug it in, or correct the "
            f"transport."
        )
    ours = [info for info in fitting if info["usage_page"] == usage_page] or fitting
    lowest = min(info["interface_number"] for info in ours)
    ours = [info for info in ours if info["interface_number"] == lowest]
    if len({info["path"] for info in ours}) > 1:
        serials = ", ".join(f"hid:{which}?serial={info['serial_number'] or '...'}" for info in ours)
        paths = ", ".join(f"hid:{info['path'].decode()}" for info in ours)
        raise DeviceError(
            f"{name}: {len(ours)} devices are {place}; name one by its serial, {serials}, or its path, {paths}."
        )
    return ours[0]


def _is(info: dict[str, Any], which: str, wanted: dict[str, str]) -> bool:
    if info["path"].decode() != which and f"{info['vendor_id']:04x}:{info['product_id']:04x}" != which.lower():
        return False
    return (
        wanted.get("serial", info["serial_number"]) == info["serial_number"]
        and wanted.get("interface", str(info["interface_number"])) == str(info["interface_number"])
        and wanted.get("usage_page", f"{info['usage_page']:04x}").lower() == f"{info['usage_page']:04x}"
    )


def _refused(path: str, info: dict[str, Any], name: str) -> DeviceError:
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


class HidLink(Opened):
    """An open HID device."""

    packets = True

    def __init__(self, name: str, device: Any) -> None:
        super().__init__(name)
        self.device = device
        self.reports = report_descriptor.parse(_descriptor(device))

    def _receive(self, timeout_s: float) -> Arrived:
        until = time.monotonic() + timeout_s
        found: Arrived = []
        try:
            while not found and not self._closed:
                left_s = min(until - time.monotonic(), LONGEST_WAIT_S)
                report = self.device.read(self.reports.most, max(1, int(left_s * 1000)))
                while report:
                    found.append((time.monotonic_ns(), bytes(report)))
                    report = self.device.read(self.reports.most)
                if left_s < LONGEST_WAIT_S:
                    break
        except (OSError, ValueError) as error:
            if not found:
                raise self.lost(f"it was unplugged ({error})") from error
        return found

    def _send(self, data: bytes) -> None:
        leading = b"" if self.reports.numbered else b"\0"  # hidapi wants a report's number, 0 where there is none
        try:
            sent = self.device.write(leading + data)
        except (OSError, ValueError) as error:
            raise self.lost(f"it was unplugged ({error})") from error
        if sent < 0:
            raise self.lost("it takes no report")

    def _release(self) -> None:
        self.device.close()


def _descriptor(device: Any) -> bytes:
    """Return the report descriptor, nothing where hidapi is older than 0.14 or the system does not state."""
    try:
        return bytes(device.get_report_descriptor())
    except (AttributeError, OSError, ValueError):
        return b""
