"""Read and write serial ports, USB CDC and pseudo-terminals, opened for this program only."""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import ports
from tacpipe.links.link import Arrived, Descriptor
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Line, Sensor

if TYPE_CHECKING:
    import serial

MOST = 1 << 16  # bytes per read; the kernel's own buffer has 4 KiB
PSEUDO = "/dev/pts/"  # terminals whose other end is a program, which may have both ends open


def open_serial(place: str, sensor: Sensor, name: str) -> SerialLink:
    """Return the open port with the sensor's settings. Bytes that came while it settled are discarded.

    Raises `DeviceError` for a port that is missing, busy, not permitted, or no serial port.
    """
    refuse_missing(place, name)
    port = _open_port(place, sensor.baud, sensor.line, name)
    users = [] if str(Path(place).resolve()).startswith(PSEUDO) else ports.holders_of_file(place)
    if users:  # another program has the port open without a lock, and would take some of the bytes
        port.close()
        raise _busy(place, users, name)
    if sensor.line.settle_s:
        time.sleep(sensor.line.settle_s)
        port.reset_input_buffer()
    return SerialLink(name, port)


def refuse_missing(place: str, name: str) -> None:
    """Raise `DeviceError` where there is no port at ``place``, with a list of the existing ports."""
    if not Path(place).exists():
        raise DeviceError(
            f"{name}: there is no port {place}; {ports.listed(ports.serial_ports())}. Plug the device in, or correct "
            f"the transport."
        )


def refused(error: OSError, place: str, name: str) -> DeviceError:
    """Return the `DeviceError` for an existing port that cannot be opened."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceError(f"{name}: you may not open {place}; {_right(place)}.")
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return _busy(place, ports.holders_of_file(place), name)
    if error.errno in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return DeviceError(f"{name}: {place} is not a serial port; {ports.listed(ports.serial_ports())}.")
    return DeviceError(f"{name}: {place} cannot be opened: {error.strerror or error}. Unplug it and plug it in again.")


def _open_port(place: str, baud: int, line: Line, name: str) -> serial.Serial:
    with extras.explain_missing(name):
        import serial

    port = serial.Serial(timeout=0, exclusive=True)
    port.port, port.baudrate = place, baud
    if line.dtr is not None:  # set before it opens, so that the line does not toggle
        port.dtr = line.dtr
    if line.rts is not None:
        port.rts = line.rts
    try:
        port.open()
    except ValueError as error:
        raise UsageError(f"{name}: {place} cannot be set to {baud} baud ({error}); correct the option baud.") from error
    except OSError as error:  # a SerialException is an OSError with its error number in the text only
        raise refused(_cause(error), place, name) from error
    with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):  # adapters without the mode
        port.set_low_latency_mode(True)  # FTDI adapters otherwise delay bytes by up to 16 ms
    return port


def _cause(error: OSError) -> OSError:
    """Return the system's error that caused one of pyserial's, where there is one."""
    cause = error.__context__  # an OSError or a termios.error, which is not an OSError
    number = cause.args[0] if cause is not None and cause.args else None
    return OSError(number, os.strerror(number)) if isinstance(number, int) else error


def _busy(place: str, users: list[str], name: str) -> DeviceError:
    return DeviceError(
        f"{name}: {place} is held by {ports.describe_holders(users)}; end it, because two readers share no bytes."
    )


def _right(place: str) -> str:
    """Return how to get access to a port, usually through its group."""
    try:
        group = grp.getgrgid(Path(place).stat().st_gid).gr_name
    except (KeyError, OSError):
        group = "dialout"
    group = "dialout" if group == "root" else group
    return f"it belongs to the group {group}: run `sudo usermod -aG {group} $USER`, then log in again"


class SerialLink(Descriptor):
    """An open serial port."""

    def __init__(self, name: str, port: serial.Serial) -> None:
        super().__init__(name, port.fileno())
        self.port = port

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        try:
            data = os.read(self._fileno, MOST)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self.lost("it was unplugged" if error.errno == errno.EIO else str(error.strerror)) from error
        if not data:  # readable without data is the end of the stream
            raise self.lost("it was unplugged")
        return [(time.monotonic_ns(), data)]

    def _release(self) -> None:
        self.port.close()
        super()._release()
