"""Serial ports, USB CDC and pseudo-terminals: opened for this program alone, read as bytes come."""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import holders, ports
from tacpipe.links.opened import Arrived, Descriptor
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Line, Sensor

if TYPE_CHECKING:
    import serial

MOST = 1 << 16  # bytes a read; the kernel's own buffer holds 4 KiB
PSEUDO = "/dev/pts/"  # terminals whose other end is a program, which may well hold both


def open_serial(place: str, sensor: Sensor, name: str) -> SerialLink:
    """Return the open port, set as the sensor wants it, what came while it settled thrown away.

    Raises `DeviceError` for a port that is missing, busy, not permitted, or no serial port.
    """
    refuse_missing(place, name)
    port = _opened(place, sensor.baud, sensor.line, name)
    held = [] if str(Path(place).resolve()).startswith(PSEUDO) else holders.of_file(place)
    if held:  # it did not lock the port, and would take bytes that are meant for us
        port.close()
        raise _busy(place, held, name)
    if sensor.line.settle_s:
        time.sleep(sensor.line.settle_s)
        port.reset_input_buffer()
    return SerialLink(name, port)


def refuse_missing(place: str, name: str) -> None:
    """Raise `DeviceError` where no port is at ``place``, naming those that are there."""
    if not Path(place).exists():
        raise DeviceError(
            f"{name}: there is no port {place}; {ports.listed(ports.serial_ports())}. Plug the device in, or correct "
            f"the transport."
        )


def refused(error: OSError, place: str, name: str) -> DeviceError:
    """Return the sentence for an error of opening a port that is there."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceError(f"{name}: you may not open {place}; {_right(place)}.")
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return _busy(place, holders.of_file(place), name)
    if error.errno in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return DeviceError(f"{name}: {place} is not a serial port; {ports.listed(ports.serial_ports())}.")
    return DeviceError(f"{name}: {place} cannot be opened: {error.strerror or error}. Unplug it and plug it in again.")


def _opened(place: str, baud: int, line: Line, name: str) -> serial.Serial:
    with extras.named(name):
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
    except OSError as error:  # a SerialException is one, but states the number of the error in its text alone
        raise refused(_cause(error), place, name) from error
    with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):  # no adapter that knows it
        port.set_low_latency_mode(True)  # FTDI adapters else hold bytes back for up to 16 ms
    return port


def _cause(error: OSError) -> OSError:
    """Return the error of the system within one of pyserial's, where there is one."""
    within = error.__context__  # an OSError or a termios.error, which is none
    number = within.args[0] if within is not None and within.args else None
    return OSError(number, os.strerror(number)) if isinstance(number, int) else error


def _busy(place: str, held: list[str], name: str) -> DeviceError:
    return DeviceError(
        f"{name}: {place} is held by {holders.describe(held)}; end it, because two readers share no bytes."
    )


def _right(place: str) -> str:
    """Return how to get the right to a port: usually that of its group."""
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
        if not data:  # ready to be read, and nothing there: the end
            raise self.lost("it was unplugged")
        return [(time.monotonic_ns(), data)]

    def _release(self) -> None:
        self.port.close()
        super()._release()
