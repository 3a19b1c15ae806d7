"""UDP: datagrams with the kernel's own arrival stamps and its count of those it had to drop."""

from __future__ import annotations

import errno
import ipaddress
import socket
import struct
import time
from collections.abc import Mapping
from typing import Any

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import holders, network
from tacpipe.links.arrival import Arrivals
from tacpipe.links.link import LinkLostError
from tacpipe.links.opened import Arrived, Descriptor
from tacpipe.printable import plain
from tacpipe.sensors.sensor import Sensor

MOST = 1 << 16  # bytes of the largest datagram
QUEUE = 8 << 20  # bytes that the kernel keeps until they are fetched, if it grants that many
LINGER_S = 0.005  # after the first datagram, for more to be fetched with it: their stamps are the kernel's
HASTY_S = 0.001  # the same where somebody acts on what comes
STAMPS, DROPS = 35, 40  # SO_TIMESTAMPNS and SO_RXQ_OVFL of <asm-generic/socket.h>, which Python does not name
FORCED_QUEUE = 33  # SO_RCVBUFFORCE of the same
FIRST = "first"  # the sender of the first datagram
MOST_QUEUED = 16_384  # datagrams that are fetched in one go
ROOM = 128  # bytes for both ancillary messages


def open_udp(place: str, sensor: Sensor, name: str) -> UdpLink:
    """Return an open port: listening for ``:PORT`` and for sensors that are listened to, else talking to the host.

    Where it listens, ``?sender=ADDRESS`` has it read what that address sends alone, and ``?sender=first`` what the first one
    sends that it hears. Raises `UsageError` for another sender, `DeviceError` for a local port that is taken, and for a host
    that is unknown or unreachable.
    """
    place, _, option = place.partition("?")
    host, port = network.place("udp", place)
    if not host or sensor.listens:
        sender = _declared(option, name)
        return UdpLink(name, bound(host, port, name), prompt=hurries(sensor), sender=sender)
    if option:
        raise UsageError(f"{name}: only what {host} sends is read there; leave ?{plain(option)} out.")
    made = None
    try:
        family, *_, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        made = socket.socket(family, socket.SOCK_DGRAM)
        _prepare(made)
        made.connect(target)
    except OSError as error:
        if made is not None:
            made.close()
        raise network.failed(error, host, port, name) from error
    return UdpLink(name, made, prompt=hurries(sensor), talks=True)


def _declared(option: str, name: str) -> str:
    """Return the sender that the option of an address declares, empty for any. Raises `UsageError` for what is none."""
    key, _, sender = option.partition("=")
    if not option or (key == "sender" and sender == FIRST):
        return sender
    try:
        if key == "sender":
            return str(ipaddress.ip_address(sender))
    except ValueError:
        pass
    raise UsageError(f"{name}: ?{plain(option)} is not a sender; write ?sender=192.168.1.20, or ?sender={FIRST}.")


def bound(host: str, port: int, name: str) -> socket.socket:
    """Return a socket that listens on a local port, 0 for a free one. Raises `DeviceError` if it is taken."""
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    _prepare(made)
    try:
        made.bind((host, port))
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            held = holders.describe(holders.of_port("udp", port))
            raise DeviceError(f"{name}: UDP port {port} is held by {held}; end it, or take another port.") from error
        if error.errno == errno.EADDRNOTAVAIL:
            raise DeviceError(
                f"{name}: {host} is not an address of this computer; listen on one of its own, or on all with udp::{port}."
            ) from error
        raise network.failed(error, host, port, name) from error
    return made


def hurries(sensor: Sensor) -> bool:
    """Whether packets must be read at once, because a sensor answers them, or asks for the next when it has one."""
    return type(sensor).answer is not Sensor.answer or type(sensor).request is not Sensor.request


def _prepare(made: socket.socket) -> None:
    made.setblocking(False)
    for option, value in ((socket.SO_RCVBUF, QUEUE), (FORCED_QUEUE, QUEUE), (STAMPS, 1), (DROPS, 1)):
        try:
            made.setsockopt(socket.SOL_SOCKET, option, value)
        except OSError:  # not this kernel, or not this user's right: less comfort, the same bytes
            continue


class UdpLink(Descriptor):
    """A UDP port; each entry that is read is one datagram."""

    packets = True

    def __init__(self, name: str, port: socket.socket, *, prompt: bool, talks: bool = False, sender: str = "") -> None:
        super().__init__(name, port.fileno())
        self.socket = port
        self._prompt, self._talks = prompt, talks
        self._linger_s = LINGER_S
        self._arrivals = Arrivals()
        self._overruns = 0
        self._stamped = False
        self._sender: Any = None  # of the last datagram
        self._declared = sender  # the only host whose datagrams count, `FIRST` until it is known; empty: any
        self._foreign = 0
        self._failed: LinkLostError | None = None  # why the link is lost, until that is reported

    @property
    def local(self) -> Mapping[str, Any]:
        """The ``host`` and ``port`` that datagrams are awaited on."""
        host, port = self.socket.getsockname()[:2]
        return {"host": host, "port": port}

    @property
    def overruns(self) -> int:
        """How many datagrams the kernel dropped because its queue was full."""
        return self._overruns

    @property
    def foreign(self) -> int:
        """How many datagrams of other senders were left out."""
        return self._foreign

    @property
    def kernel_stamped(self) -> bool:
        """Whether the kernel stamped the last datagram."""
        return self._stamped

    def hasten(self) -> None:
        """Fetch datagrams within a millisecond."""
        self._linger_s = HASTY_S

    def _receive(self, timeout_s: float) -> Arrived:
        found = super()._receive(timeout_s) if self._failed is None else []
        if self._failed is not None and not found:  # else what had arrived comes first, and the loss at the next read
            failed, self._failed = self._failed, None
            raise failed
        return found

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        if not self._prompt:
            time.sleep(self._linger_s)
        queued = self._queued()
        self._arrivals.look()
        return [(self._arrivals.of(wall_ns), data) for wall_ns, data in queued]

    def _queued(self) -> Arrived:
        """Return the datagrams that wait, with their arrivals on the wall clock; an error is kept for `_receive`.

        Those of other senders are counted alone. A flood is left to the next read, so that one always ends.
        """
        found: Arrived = []
        for _ in range(MOST_QUEUED):
            try:
                data, ancillary, _, sender = self.socket.recvmsg(MOST, ROOM)
            except BlockingIOError:
                return found
            except OSError as error:
                if self._failed is not None:
                    return found
                self._failed = self._refused(error)  # which the kernel states once, before what waits
                continue
            arrival_ns = self._arrival(ancillary)
            if self._counts(sender):
                self._sender = sender
                found.append((arrival_ns, data))
            else:
                self._foreign += 1
        return found

    def _counts(self, sender: Any) -> bool:
        if not self._declared:
            return True
        host = str(sender[0]).partition("%")[0]  # without the interface of a link-local one
        if self._declared == FIRST:
            self._declared = host
        return host == self._declared

    def _refused(self, error: OSError) -> LinkLostError:
        if isinstance(error, ConnectionRefusedError):
            return self.lost("the host is there, but refuses the port", "the port, and that it streams")
        return self.lost(error.strerror or str(error))

    def _arrival(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        """Return the arrival that the ancillary messages of a datagram state, and take note of drops."""
        wall_ns = None
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == STAMPS:
                seconds, nanoseconds = struct.unpack("@ll", data[: struct.calcsize("@ll")])
                wall_ns = seconds * 1_000_000_000 + nanoseconds
            elif level == socket.SOL_SOCKET and kind == DROPS:
                self._overruns = int.from_bytes(data[:4], "little")
        self._stamped = wall_ns is not None
        return time.time_ns() if wall_ns is None else wall_ns

    def _send(self, data: bytes) -> None:
        if not self._talks and self._sender is None:
            raise DeviceError(
                f"{self.name}: nothing came there yet, so nobody can be answered; start the sender first."
            )
        try:
            if self._talks:
                self.socket.send(data)
            else:
                self.socket.sendto(data, self._sender)
        except OSError as error:
            raise self.lost(error.strerror or str(error)) from error

    def _release(self) -> None:
        self.socket.close()
        super()._release()
