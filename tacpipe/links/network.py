"""Connect to devices by TCP and UDP, with the kernel's arrival stamps, and put network errors into sentences."""

from __future__ import annotations

import errno
import ipaddress
import select
import socket
import struct
import time
from typing import Any

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import ports
from tacpipe.links.link import SCHEMES, Arrivals, Arrived, Descriptor, LinkLostError
from tacpipe.printable import plain
from tacpipe.sensors.sensor import LocalAddress, Sensor

CONNECT_S = 5.0
IDLE_S, EVERY_S, TIMES = (
    2,
    1,
    3,
)  # keep-alive probes: silence before the first, pause, number


def format_place(scheme: str, text: str) -> tuple[str, int]:
    """Return host and port of the text after the colon of an address. The host is empty for all interfaces.

    Raises `UsageError` for an invalid port.

    >>> format_place("udp", "[fe80::1]:4010"), format_place("udp", ":4010")
    (('fe80::1', 4010), ('', 4010))
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError(f"{scheme}:{text} names no port; it should read like {SCHEMES[scheme]}.")
    return host.strip("[]"), int(port)


def connect(host: str, port: int, name: str) -> socket.socket:
    """Return a non-blocking TCP connection that sends small messages at once and detects a dead peer.

    Raises `DeviceError` for a host that is unknown, unreachable, or refuses.
    """
    try:
        connection = socket.create_connection((host, port), timeout=CONNECT_S)
    except OSError as error:
        raise failed(error, host, port, name) from error
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (("TCP_KEEPIDLE", IDLE_S), ("TCP_KEEPINTVL", EVERY_S), ("TCP_KEEPCNT", TIMES)):
        if hasattr(socket, option):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    return connection


def failed(error: OSError, host: str, port: int, name: str) -> DeviceError:
    """Return the `DeviceError` for a ``host`` that could not be reached."""
    if isinstance(error, socket.gaierror):
        return DeviceError(f"{name}: the host {host} is not known; check its name, or give its IP address.")
    if isinstance(error, ConnectionRefusedError):
        return DeviceError(
            f"{name}: {host} is there, but refuses port {port}; start the program or the mode of the device that "
            f"serves it, and let no other client hold it."
        )
    if isinstance(error, TimeoutError):
        return DeviceError(
            f"{name}: {host} did not answer on port {port} within {CONNECT_S:g} s; check that it is switched on, "
            f"and that no firewall is between."
        )
    if error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return DeviceError(
            f"{name}: {host} cannot be reached from this computer; check the cable, and that both are in one network."
        )
    return DeviceError(f"{name}: {host} port {port} cannot be opened: {error.strerror or error}.")


MOST_DATAGRAM = 1 << 16  # bytes of the largest datagram
QUEUE = 8 << 20  # requested size in bytes of the kernel's receive queue
LINGER_S = 0.005  # pause after the first datagram, to fetch more with it; the kernel has stamped them
HASTY_S = 0.001  # the same pause for live consumers
STAMPS, DROPS = 35, 40  # SO_TIMESTAMPNS and SO_RXQ_OVFL of <asm-generic/socket.h>, which Python does not name
FORCED_QUEUE = 33  # SO_RCVBUFFORCE of the same
FIRST = "first"  # option value: accept only the sender of the first datagram
MOST_QUEUED = 16_384  # limit of datagrams per fetch
ROOM = 128  # bytes for both ancillary messages


def open_udp(place: str, sensor: Sensor, name: str) -> UdpLink:
    """Return an open port. It listens for ``:PORT`` and for sensors that only send; otherwise it talks to the host.

    A listening port with ``?sender=ADDRESS`` accepts datagrams of that address only, and with ``?sender=first`` those of the
    first sender. Raises `UsageError` for another option, and `DeviceError` for a local port that is in use or a host that
    is unknown or unreachable.
    """
    place, _, option = place.partition("?")
    host, port = format_place("udp", place)
    if not host or sensor.listens:
        sender = _declared(option, name)
        return UdpLink(name, bind_port(host, port, name), prompt=needs_prompt_reads(sensor), sender=sender)
    if option:
        raise UsageError(f"{name}: only what {host} sends is read there; leave ?{plain(option)} out.")
    port_socket = None
    try:
        family, *_, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        port_socket = socket.socket(family, socket.SOCK_DGRAM)
        _prepare(port_socket)
        port_socket.connect(target)
    except OSError as error:
        if port_socket is not None:
            port_socket.close()
        raise failed(error, host, port, name) from error
    return UdpLink(name, port_socket, prompt=needs_prompt_reads(sensor), talks=True)


def _declared(option: str, name: str) -> str:
    """Return the sender that the option of an address declares, empty for any. Raises `UsageError` for an invalid one."""
    key, _, sender = option.partition("=")
    if not option or (key == "sender" and sender == FIRST):
        return sender
    try:
        if key == "sender":
            return str(ipaddress.ip_address(sender))
    except ValueError:
        pass
    raise UsageError(f"{name}: ?{plain(option)} is not a sender; write ?sender=192.168.1.20, or ?sender={FIRST}.")


def bind_port(host: str, port: int, name: str) -> socket.socket:
    """Return a socket that listens on a local port, 0 for a free one. Raises `DeviceError` for a port in use."""
    port_socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    _prepare(port_socket)
    try:
        port_socket.bind((host, port))
    except OSError as error:
        port_socket.close()
        if error.errno == errno.EADDRINUSE:
            users = ports.describe_holders(ports.holders_of_port("udp", port))
            raise DeviceError(f"{name}: UDP port {port} is in use by {users}; end it, or take another port.") from error
        if error.errno == errno.EADDRNOTAVAIL:
            raise DeviceError(
                f"{name}: {host} is not an address of this computer; listen on one of its own, or on all with udp::{port}."
            ) from error
        raise failed(error, host, port, name) from error
    return port_socket


def needs_prompt_reads(sensor: Sensor) -> bool:
    """Return whether packets must be read at once, because the sensor answers each or requests the next."""
    return type(sensor).answer is not Sensor.answer or type(sensor).request is not Sensor.request


def _prepare(port_socket: socket.socket) -> None:
    port_socket.setblocking(False)
    for option, value in ((socket.SO_RCVBUF, QUEUE), (FORCED_QUEUE, QUEUE), (STAMPS, 1), (DROPS, 1)):
        try:
            port_socket.setsockopt(socket.SOL_SOCKET, option, value)
        except OSError:  # the kernel or this user lacks the option; the bytes are the same
            continue


class UdpLink(Descriptor):
    """A UDP port. Each entry is one datagram."""

    packets = True

    def __init__(self, name: str, port: socket.socket, *, prompt: bool, talks: bool = False, sender: str = "") -> None:
        super().__init__(name, port.fileno())
        self.socket = port
        self._prompt, self._talks = prompt, talks
        self._linger_s = LINGER_S
        self._arrivals = Arrivals()
        self._overruns = 0
        self._stamped = False
        self._sender: Any = None  # sender of the last datagram
        self._declared = sender  # the only accepted host, `FIRST` until its first datagram, empty for any host
        self._foreign = 0
        self._failed: LinkLostError | None = None  # loss of the link that is not reported yet

    @property
    def local(self) -> LocalAddress:
        """The local ``host`` and ``port``."""
        host, port = self.socket.getsockname()[:2]
        return {"host": host, "port": port}

    @property
    def overruns(self) -> int:
        """The number of datagrams that the kernel dropped because its queue was full."""
        return self._overruns

    @property
    def foreign(self) -> int:
        """The number of datagrams of other senders that were left out."""
        return self._foreign

    @property
    def kernel_stamped(self) -> bool:
        """True where the kernel stamped the last datagram."""
        return self._stamped

    def hasten(self) -> None:
        """Fetch datagrams within `HASTY_S`."""
        self._linger_s = HASTY_S

    def _receive(self, timeout_s: float) -> Arrived:
        entries = super()._receive(timeout_s) if self._failed is None else []
        if self._failed is not None and not entries:  # otherwise the next read reports the loss
            failed, self._failed = self._failed, None
            raise failed
        return entries

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        if not self._prompt:
            time.sleep(self._linger_s)
        queued = self._queued()
        self._arrivals.look()
        return [(self._arrivals.to_monotonic(wall_ns), data) for wall_ns, data in queued]

    def _queued(self) -> Arrived:
        """Return the queued datagrams with their arrivals on the wall clock. `_receive` reports an error later.

        Datagrams of other senders are only counted. At most `MOST_QUEUED` are fetched, so that a read always ends.
        """
        entries: Arrived = []
        for _ in range(MOST_QUEUED):
            try:
                data, ancillary, _, sender = self.socket.recvmsg(MOST_DATAGRAM, ROOM)
            except BlockingIOError:
                return entries
            except OSError as error:
                if self._failed is not None:
                    return entries
                self._failed = self._refused(error)  # the kernel reports it once, before the queued datagrams
                continue
            arrival_ns = self._arrival(ancillary)
            if self._accepts(sender):
                self._sender = sender
                entries.append((arrival_ns, data))
            else:
                self._foreign += 1
        return entries

    def _accepts(self, sender: Any) -> bool:
        if not self._declared:
            return True
        host = str(sender[0]).partition("%")[0]  # without the interface of a link-local address
        if self._declared == FIRST:
            self._declared = host
        return host == self._declared

    def _refused(self, error: OSError) -> LinkLostError:
        if isinstance(error, ConnectionRefusedError):
            return self.lost("the host is there, but refuses the port", "the port, and that it streams")
        return self.lost(error.strerror or str(error))

    def _arrival(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        """Return the arrival in the ancillary messages of a datagram, and note the count of drops."""
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
                f"{self.name}: nothing has arrived yet, so the address of the sender is unknown. Start the sender first."
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


MOST_READ = 1 << 16  # bytes per read


def open_tcp(place: str, sensor: Sensor, name: str) -> TcpLink:
    """Return an open connection. Raises `DeviceError` for a host that is unknown, unreachable, or refuses."""
    host, port = format_place("tcp", place)
    return TcpLink(name, connect(host, port, name))


def open_both(place: str, sensor: Sensor, name: str) -> ControlledLink:
    """Return a control connection with a free local UDP port for data. Raises `DeviceError` as `open_tcp`."""
    host, port = format_place("tcp+udp", place)
    control = TcpLink(name, connect(host, port, name))
    local_host = control.socket.getsockname()[0]
    return ControlledLink(name, bind_port(local_host, 0, name), control, prompt=needs_prompt_reads(sensor))


class TcpLink(Descriptor):
    """A TCP connection."""

    def __init__(self, name: str, connection: socket.socket) -> None:
        super().__init__(name, connection.fileno())
        self.socket = connection

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        try:
            data = self.socket.recv(MOST_READ)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self.lost(error.strerror or str(error)) from error
        if not data:
            raise self.lost("the other end closed the connection")
        return [(time.monotonic_ns(), data)]

    def _release(self) -> None:
        self.socket.close()
        super()._release()


class ControlledLink(UdpLink):
    """Datagrams of a device that sends while its control connection is open. `write` and dialogues use the connection."""

    def __init__(self, name: str, data: socket.socket, control: TcpLink, *, prompt: bool) -> None:
        super().__init__(name, data, prompt=prompt)
        self.control = control
        self._poll.register(control.socket.fileno(), select.POLLIN)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        if any(fileno == self.control.socket.fileno() for fileno, _ in ready):
            try:
                self.control.read(0)  # after the dialogue only the end of the connection comes here
            except LinkLostError as error:
                self._failed = error
        return super()._fetch(ready)

    def _send(self, data: bytes) -> None:
        self.control.write(data)

    def _release(self) -> None:
        self.control.close()
        super()._release()
