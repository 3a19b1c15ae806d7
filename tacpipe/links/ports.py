"""List the serial ports and HID devices of this computer, and the processes that use a device or a port."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import DeviceError, MissingModuleError
from tacpipe.io import files
from tacpipe.plugins import extras

BY_ID = Path("/dev/serial/by-id")
PROCESSES = Path("/proc")


@dataclass(frozen=True)
class Port:
    """A port with a device."""

    address: str  # the address for a rig file
    usb_id: str = ""  # "16d0:14cc", empty for what is not a USB device
    product: str = ""  # the name that the device reports
    lasting: str = ""  # a name of the same port that does not change when cables are swapped

    def __str__(self) -> str:
        described = ", ".join(part for part in (self.usb_id, self.product) if part)
        return f"{self.address} ({described})" if described else self.address


def serial_ports() -> list[Port]:
    """Return the serial ports of this computer. Raises `MissingModuleError` without pyserial."""
    with extras.explain_missing("A serial port"):
        from serial.tools import list_ports

    lasting = {str(path.resolve()): str(path) for path in files.listed(BY_ID)}
    serial = []
    for port in sorted(list_ports.comports()):
        usb_id = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else ""
        product = port.product or ("" if port.description in (None, "n/a") else port.description)
        serial.append(Port(f"serial:{port.device}", usb_id, product, lasting.get(port.device, "")))
    return serial


def hid_ports() -> list[Port]:
    """Return the interfaces of HID devices, none where hidapi is not installed."""
    try:
        interfaces = hid_module().enumerate()
    except (DeviceError, MissingModuleError):
        return []
    return [
        Port(
            f"hid:{described['path'].decode()}",
            f"{described['vendor_id']:04x}:{described['product_id']:04x}",
            _described(described),
        )
        for described in interfaces
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
    """Return hidapi's module: ``hidraw`` on Linux, which leaves the kernel's driver in place, otherwise ``hid``.

    Raises `MissingModuleError` where it is not installed, and `DeviceError` where another package has a module of that name.
    """
    name = "hidraw" if sys.platform == "linux" else "hid"
    module: Any = None
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        absent = extras.missing(error, "A HID device")
        if absent is not None and importlib.util.find_spec("hid") is None:
            raise absent from error
    if hasattr(module, "device"):
        return module
    raise DeviceError(
        f"Another package has taken the place of hidapi's module {name}: `pip uninstall hid`, then "
        f"`pip install --force-reinstall hidapi`."
    )


def holders_of_file(path: str) -> list[str]:
    """Return the other processes that have ``path`` open, as ``screen (process 4711)``. Unreadable ones are left out."""
    return _processes_with({str(Path(path).resolve())})


def holders_of_port(kind: str, port: int) -> list[str]:
    """Return the processes that listen on a local port; ``kind`` is ``udp`` or ``tcp``."""
    targets = set()
    for table in (f"{kind}", f"{kind}6"):
        try:
            lines = (PROCESSES / "net" / table).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            columns = line.split()
            if int(columns[1].rpartition(":")[2], 16) == port:
                targets.add(f"socket:[{columns[9]}]")
    return _processes_with(targets)


def describe_holders(holders: list[str]) -> str:
    """Return the processes as the end of a sentence.

    >>> describe_holders(["screen (process 4711)"]), describe_holders([])
    ('screen (process 4711)', 'a process of another user')
    """
    return " and ".join(holders) if holders else "a process of another user"


def _processes_with(targets: set[str]) -> list[str]:
    return [
        f"{_name(process)} (process {process.name})"
        for process in sorted(PROCESSES.glob("[0-9]*"), key=lambda path: int(path.name))
        if int(process.name) != os.getpid() and targets & _open_files(process)
    ]


def _open_files(process: Path) -> set[str]:
    targets: set[str] = set()
    try:
        for file in (process / "fd").iterdir():
            try:
                targets.add(str(file.readlink()))
            except OSError:  # closed meanwhile
                continue
    except OSError:  # another user's, or gone
        return targets
    return targets


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"
