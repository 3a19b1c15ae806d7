"""List serial ports and HID devices, open serial ports, and find the processes that use a device or port."""

from __future__ import annotations

import contextlib
import errno
import grp
import importlib
import importlib.util
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from tacpipe.errors import DeviceError, MissingModuleError, UsageError
from tacpipe.io import files
from tacpipe.links.link import Arrived, DescriptorLink
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor, SerialLine

if TYPE_CHECKING:
    import serial

BY_ID = Path("/dev/serial/by-id")
PROCESSES = Path("/proc")


@dataclass(frozen=True)
class Port:
    """A serial port or a HID device."""

    address: str  # the address for a rig file
    usb_id: str = ""  # such as "16d0:14cc"; empty if it is not a USB device
    product: str = ""  # product name that the device reports
    persistent_path: str = ""  # a path of the same port that does not change when cables are swapped

    def __str__(self) -> str:
        details = ", ".join(part for part in (self.usb_id, self.product) if part)
        return f"{self.address} ({details})" if details else self.address


def serial_ports() -> list[Port]:
    """Return the serial ports of this computer. Raises `MissingModuleError` without pyserial."""
    with extras.explain_missing("A serial port"):
        from serial.tools import list_ports

    persistent_paths = {str(path.resolve()): str(path) for path in files.listed(BY_ID)}
    serial = []
    for port in sorted(list_ports.comports()):
        usb_id = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else ""
        product = port.product or ("" if port.description in (None, "n/a") else port.description)
        serial.append(Port(f"serial:{port.device}", usb_id, product, persistent_paths.get(port.device, "")))
    return serial


def hid_ports() -> list[Port]:
    """Return the interfaces of HID devices, or an empty list if hidapi is not installed."""
    try:
        interfaces: list[HidInterface] = hid_module().enumerate()
    except (DeviceError, MissingModuleError):
        return []
    return [
        Port(
            f"hid:{info['path'].decode()}",
            f"{info['vendor_id']:04x}:{info['product_id']:04x}",
            _describe_interface(info),
        )
        for info in interfaces
    ]


class HidInterface(TypedDict):
    """An interface of a HID device, as hidapi lists it."""

    path: bytes
    vendor_id: int
    product_id: int
    product_string: str | None
    serial_number: str
    interface_number: int
    usage_page: int


def _describe_interface(info: HidInterface) -> str:
    interface = f"interface {info['interface_number']} usage page {info['usage_page']:04x}"
    return f"{info['product_string'] or ''} {interface}".strip()


def describe_ports(ports: list[Port]) -> str:
    """Return a clause that lists the ports.

    >>> describe_ports([Port("serial:/dev/ttyACM0", "16d0:14cc", "TSF-85"), Port("serial:/dev/ttyS0")])
    'there are serial:/dev/ttyACM0 (16d0:14cc, TSF-85) and serial:/dev/ttyS0'
    >>> describe_ports([])
    'there is none at all'
    """
    if not ports:
        return "there is none at all"
    return f"there {'are' if len(ports) > 1 else 'is'} {' and '.join(str(port) for port in ports)}"


def hid_module() -> Any:
    """Return hidapi's module: ``hidraw`` on Linux, which does not detach the kernel's driver, otherwise ``hid``.

    Raises `MissingModuleError` if it is not installed, and `DeviceError` if another package has a module of that name.
    """
    name = "hidraw" if sys.platform == "linux" else "hid"
    module: Any = None
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        missing_error = extras.missing(error, "A HID device")
        if missing_error is not None and importlib.util.find_spec("hid") is None:
            raise missing_error from error
    if hasattr(module, "device"):
        return module
    raise DeviceError(
        f"Another package replaces hidapi's module {name}: run `pip uninstall hid`, then "
        f"`pip install --force-reinstall hidapi`."
    )


def holders_of_file(path: str) -> list[str]:
    """Return the other processes that have ``path`` open, as ``screen (process 4711)``. Unreadable ones are skipped."""
    return _find_processes({str(Path(path).resolve())})


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
    return _find_processes(targets)


def describe_holders(holders: list[str]) -> str:
    """Return the processes as a noun phrase.

    >>> describe_holders(["screen (process 4711)"]), describe_holders([])
    ('screen (process 4711)', 'a process of another user')
    """
    return " and ".join(holders) if holders else "a process of another user"


def _find_processes(targets: set[str]) -> list[str]:
    """Return the names of other processes with one of these files or sockets open."""
    return [
        f"{_name(process)} (process {process.name})"
        for process in sorted(PROCESSES.glob("[0-9]*"), key=lambda path: int(path.name))
        if int(process.name) != os.getpid() and targets & _open_files(process)
    ]


def _open_files(process: Path) -> set[str]:
    """Return the targets of a process's open files; empty if it is not permitted to read them."""
    targets: set[str] = set()
    try:
        for file in (process / "fd").iterdir():
            try:
                targets.add(str(file.readlink()))
            except OSError:  # the process has closed it in the meantime
                continue
    except OSError:  # another user's process, or one that has ended
        return targets
    return targets


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"


PSEUDO = "/dev/pts/"  # pseudo-terminals: one program may have both ends open


def open_serial(target: str, sensor: Sensor, name: str) -> SerialLink:
    """Open a serial port with the sensor's settings. Bytes that arrive while it settles are discarded.

    Raises `DeviceError` if the port is missing, busy, not permitted, or not a serial port.
    """
    refuse_missing(target, name)
    port = _open_port(target, sensor.baud, sensor.line, name)
    users = [] if str(Path(target).resolve()).startswith(PSEUDO) else holders_of_file(target)
    if users:  # another program has the port open without a lock, and would read some of the bytes
        port.close()
        raise _busy(target, users, name)
    if sensor.line.settle_s:
        time.sleep(sensor.line.settle_s)
        port.reset_input_buffer()
    return SerialLink(name, port)


def refuse_missing(target: str, name: str) -> None:
    """Raise `DeviceError` with a list of the existing ports if there is no port at ``target``."""
    if not Path(target).exists():
        raise DeviceError(
            f"{name}: there is no port {target}; {describe_ports(serial_ports())}. Plug the device in, or correct the "
            f"transport."
        )


def open_error(error: OSError, target: str, name: str) -> DeviceError:
    """Return the `DeviceError` for an existing port that cannot be opened."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceError(f"{name}: you may not open {target}; {_access_advice(target)}.")
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return _busy(target, holders_of_file(target), name)
    if error.errno in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return DeviceError(f"{name}: {target} is not a serial port; {describe_ports(serial_ports())}.")
    return DeviceError(f"{name}: {target} cannot be opened: {error.strerror or error}. Unplug it and plug it in again.")


def _open_port(target: str, baud: int, line: SerialLine, name: str) -> serial.Serial:
    """Return an open serial port. Raises `UsageError` for a wrong baud rate, and `DeviceError` if it cannot be opened."""
    with extras.explain_missing(name):
        import serial

    port = serial.Serial(timeout=0, exclusive=True)
    port.port, port.baudrate = target, baud
    if line.dtr is not None:  # set before the port opens, so that the line does not toggle
        port.dtr = line.dtr
    if line.rts is not None:
        port.rts = line.rts
    try:
        port.open()
    except ValueError as error:
        raise UsageError(
            f"{name}: {target} cannot be set to {baud} baud ({error}); correct the option baud."
        ) from error
    except OSError as error:  # a SerialException is an OSError whose error number is only in its text
        raise open_error(_cause(error), target, name) from error
    with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):  # adapters without the mode
        port.set_low_latency_mode(True)  # FTDI adapters otherwise delay bytes by up to 16 ms
    return port


def _cause(error: OSError) -> OSError:
    """Return the system error that caused an error of pyserial, or the error itself if there is none."""
    cause = error.__context__  # either an OSError or a termios.error, which is not an OSError
    number = cause.args[0] if cause is not None and cause.args else None
    return OSError(number, os.strerror(number)) if isinstance(number, int) else error


def _busy(target: str, users: list[str], name: str) -> DeviceError:
    return DeviceError(
        f"{name}: {target} is used by {describe_holders(users)}; stop it, because two programs cannot read the same port."
    )


def _access_advice(target: str) -> str:
    """Return advice on how to get access to a port, usually through its group."""
    try:
        group = grp.getgrgid(Path(target).stat().st_gid).gr_name
    except (KeyError, OSError):
        group = "dialout"
    group = "dialout" if group == "root" else group
    return f"it belongs to the group {group}: run `sudo usermod -aG {group} $USER`, then log in again"


class SerialLink(DescriptorLink):
    """An open serial port."""

    def __init__(self, name: str, port: serial.Serial) -> None:
        super().__init__(name, port.fileno())
        self.port = port

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        data = self._read_available("it was unplugged")  # a readable port without data is at its end
        return [(time.monotonic_ns(), data)] if data else []

    def _release(self) -> None:
        self.port.close()
        super()._release()
