"""Which serial ports and HID devices this computer has now, and what they state of themselves."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import DeviceError, MissingModuleError
from tacpipe.io import files
from tacpipe.plugins import extras

BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class Port:
    """A port with something behind it."""

    address: str  # as a rig file names it
    usb_id: str = ""  # "16d0:14cc", empty for what is not a USB device
    what: str = ""  # what the device calls itself
    lasting: str = ""  # a name of the same port that stays when cables are swapped

    def __str__(self) -> str:
        described = ", ".join(part for part in (self.usb_id, self.what) if part)
        return f"{self.address} ({described})" if described else self.address


def serial_ports() -> list[Port]:
    """Return the serial ports that are there. Raises `MissingModuleError` without pyserial."""
    with extras.named("A serial port"):
        from serial.tools import list_ports

    lasting = {str(path.resolve()): str(path) for path in files.listed(BY_ID)}
    found = []
    for port in sorted(list_ports.comports()):
        usb_id = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else ""
        what = port.product or ("" if port.description in (None, "n/a") else port.description)
        found.append(Port(f"serial:{port.device}", usb_id, what, lasting.get(port.device, "")))
    return found


def hid_ports() -> list[Port]:
    """Return the interfaces of HID devices that are there; none where hidapi is not installed."""
    try:
        found = hid_module().enumerate()
    except (DeviceError, MissingModuleError):
        return []
    return [
        Port(
            f"hid:{described['path'].decode()}",
            f"{described['vendor_id']:04x}:{described['product_id']:04x}",
            _described(described),
        )
        for described in found
    ]


def _described(described: dict[str, Any]) -> str:
    place = f"interface {described['interface_number']} usage page {described['usage_page']:04x}"
    return f"{described['product_string'] or ''} {place}".strip()


def listed(ports: list[Port]) -> str:
    """Return the ports as the end of a sentence.

    >>> listed([Port("serial:/dev/ttyACM0", "16d0:14cc", "TSF-85"), Port("serial:/dev/ttyS0")])
    'there are serial:/dev/ttyACM0 (16d0:14cc, TSF-85) and serial:/dev/ttyS0'
    >>> listed([])
    'there is none at all'
    """
    if not ports:
        return "there is none at all"
    return f"there {'are' if len(ports) > 1 else 'is'} {' and '.join(str(port) for port in ports)}"


def hid_module() -> Any:
    """Return hidapi's module: ``hidraw`` on Linux, which leaves the kernel's driver in place, else ``hid``.

    Raises `MissingModuleError` where it is not installed, `DeviceError` where another package's module of the name is in its
    place.
    """
    name = "hidraw" if sys.platform == "linux" else "hid"
    found: Any = None
    try:
        found = importlib.import_module(name)
    except ImportError as error:
        absent = extras.missing(error, "A HID device")
        if absent is not None and importlib.util.find_spec("hid") is None:
            raise absent from error
    if hasattr(found, "device"):
        return found
    raise DeviceError(
        f"Another package has taken the place of hidapi's module {name}: `pip uninstall hid`, then "
        f"`pip install --force-reinstall hidapi`."
    )
