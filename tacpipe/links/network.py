"""Connect to devices by TCP and UDP, with the kernel's arrival timestamps, and explain network errors."""

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
from tacpipe.links.link import SCHEMES, Arrivals, Arrived, DescriptorLink, LinkLostError
from tacpipe.printable import plain
from tacpipe.sensors.sensor import LocalAddress, Sensor

CONNECT_S = 5.0
# silence before the first probe, pause, number of probes
KEEPALIVE_IDLE_S, KEEPALIVE_PAUSE_S, KEEPALIVE_PROBES = 2, 1, 3


def parse_host_port(scheme: str, text: str) -> tuple[str, int]:
    """Return host and port of an address without its scheme. The host is empty if it means all interfaces.

    Raises `UsageError` for an invalid port.

    >>> parse_host_port("udp", "[fe80::1]:4010"), parse_host_port("udp", ":4010")
    (('fe80::1', 4010), ('', 4010))
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError(f"{scheme}:{text} has no valid port; write it like {SCHEMES[scheme]}.")
    return host.strip("[]"), int(port)


def connect(host: str, port: int, name: str) -> socket.socket:
    """Open a non-blocking TCP connection that sends small messages immediately and detects a dead peer.

    Raises `DeviceError` if the host is unknown, unreachable, or refuses the connection.
    """
    try:
        connection = socket.create_connection((host, port), timeout=CONNECT_S)
    except OSError as error:
        raise connection_error(error, host, port, name) from error
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", KEEPALIVE_IDLE_S),
        ("TCP_KEEPINTVL", KEEPALIVE_PAUSE_S),
        ("TCP_KEEPCNT", KEEPALIVE_PROBES),
    ):
        if hasattr(socket, option):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    return connection


def connection_error(error: OSError, host: str, port: int, name: str) -> DeviceError:
    """Return the `DeviceError` for a ``host`` that could not be reached."""
    if isinstance(error, socket.gaierror):
        return DeviceError(f"{name}: the host {host} is not known; check its name, or give its IP address.")
    if isinstance(error, ConnectionRefusedError):
        return DeviceError(
            f"{name}: {host} is reachable, but refuses port {port}; start the program or device mode that serves it, and "
            f"disconnect other clients."
        )
    if isinstance(error, TimeoutError):
        return DeviceError(
            f"{name}: {host} did not respond on port {port} within {CONNECT_S:g} s; check that it is switched on, "
            f"and that no firewall blocks it."
        )
    if error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return DeviceError(
            f"{name}: {host} cannot be reached from this computer; check the cable, and that both are in the same network."
        )
    return DeviceError(f"{name}: {host} port {port} cannot be opened: {error.strerror or error}.")


MAX_DATAGRAM = 1 << 16  # bytes
QUEUE_BYTES = 8 << 20  # requested size of the kernel's receive queue
LINGER_S = 0.005  # wait after the first datagram, to fetch several at once; the kernel has stamped them
LIVE_LINGER_S = 0.001  # the same wait if live consumers receive the data
STAMPS, DROPS = 35, 40  # SO_TIMESTAMPNS and SO_RXQ_OVFL of <asm-generic/socket.h>, which Python does not define
FORCED_QUEUE = 33  # SO_RCVBUFFORCE of the same header
FIRST = "first"  # option value: accept only the sender of the first datagram
MAX_FETCHED = 16_384  # maximum number of datagrams per fetch
ANCILLARY_BYTES = 128  # buffer size for both ancillary messages


def open_udp(target: str, sensor: Sensor, name: str) -> UdpLink:
    """Open a UDP port. It listens if the address is ``:PORT`` or the sensor only sends; otherwise it connects to the host.

    A listening port with ``?sender=ADDRESS`` accepts only datagrams from that address, and with ``?sender=first`` only those
    from the first sender. Raises `UsageError` for another option, and `DeviceError` if a local port is in use or the host is
    unknown or unreachable.
    """
    host_and_port, _, option = target.partition("?")
    host, port = parse_host_port("udp", host_and_port)
    if not host or sensor.listens:
        sender = _parse_sender(option, name)
        return UdpLink(name, bind_port(host, port, name), prompt=needs_prompt_reads(sensor), sender=sender)
    if option:
        raise UsageError(f"{name}: only datagrams from {host} are read there; remove ?{plain(option)}.")
    port_socket = None
    try:
        family, *_, peer = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        port_socket = socket.socket(family, socket.SOCK_DGRAM)
        _prepare(port_socket)
        port_socket.connect(peer)
    except OSError as error:
        if port_socket is not None:
            port_socket.close()
        raise connection_error(error, host, port, name) from error
    return UdpLink(name, port_socket, prompt=needs_prompt_reads(sensor), connected=True)


def _parse_sender(option: str, name: str) -> str:
    """Return the sender in the option of an address, or "" for any sender. Raises `UsageError` if it is invalid."""
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
    """Return a socket that listens on a local port; port 0 selects a free one. Raises `DeviceError` if it is in use."""
    port_socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    _prepare(port_socket)
    try:
        port_socket.bind((host, port))
    except OSError as error:
        port_socket.close()
        if error.errno == errno.EADDRINUSE:
            users = ports.describe_holders(ports.holders_of_port("udp", port))
            raise DeviceError(
                f"{name}: UDP port {port} is used by {users}; stop it, or choose another port."
            ) from error
        if error.errno == errno.EADDRNOTAVAIL:
            raise DeviceError(
                f"{name}: {host} is not an address of this computer; listen on its addresses, or on all with udp::{port}."
            ) from error
        raise connection_error(error, host, port, name) from error
    return port_socket


def needs_prompt_reads(sensor: Sensor) -> bool:
    """Return whether packets must be read immediately, because the sensor answers each or requests the next."""
    return type(sensor).answer is not Sensor.answer or type(sensor).request is not Sensor.request


def _prepare(port_socket: socket.socket) -> None:
    """Make a socket non-blocking, with a large queue, and the kernel's timestamps and counts of drops if possible."""
    port_socket.setblocking(False)
    for option, value in ((socket.SO_RCVBUF, QUEUE_BYTES), (FORCED_QUEUE, QUEUE_BYTES), (STAMPS, 1), (DROPS, 1)):
        try:
            port_socket.setsockopt(socket.SOL_SOCKET, option, value)
        except OSError:  # missing option or permission; the data are the same without it
            continue


class UdpLink(DescriptorLink):
    """A UDP port. Each entry is one datagram."""

    packets = True

    def __init__(
        self, name: str, port: socket.socket, *, prompt: bool, connected: bool = False, sender: str = ""
    ) -> None:
        """Wrap a socket; ``prompt`` reads without a wait, ``connected`` sends to the peer, only ``sender`` is accepted."""
        super().__init__(name, port.fileno())
        self.socket = port
        self._prompt, self._connected = prompt, connected
        self._linger_s = LINGER_S
        self._arrivals = Arrivals()
        self._overruns = 0
        self._stamped = False
        self._sender: Any = None  # sender of the last datagram
        self._accepted_sender = sender  # the only accepted host, `FIRST` before the first datagram, or "" for any
        self._foreign = 0
        self._failed: LinkLostError | None = None  # link loss that has not been reported yet

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
        """The number of ignored datagrams of other senders."""
        return self._foreign

    @property
    def kernel_stamped(self) -> bool:
        """True if the kernel stamped the last datagram."""
        return self._stamped

    def reduce_latency(self) -> None:
        """Fetch datagrams within `LIVE_LINGER_S`."""
        self._linger_s = LIVE_LINGER_S

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the datagrams that arrived within ``timeout_s``. Raises a `LinkLostError` of an earlier read."""
        entries = super()._receive(timeout_s) if self._failed is None else []
        if self._failed is not None and not entries:  # if there are entries, the next read reports the loss
            failed, self._failed = self._failed, None
            raise failed
        return entries

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the queued datagrams with their arrivals on the monotonic clock."""
        if not self._prompt:
            time.sleep(self._linger_s)
        queued = self._read_queue()
        self._arrivals.read_clocks()
        return [(self._arrivals.to_monotonic(wall_ns), data) for wall_ns, data in queued]

    def _read_queue(self) -> Arrived:
        """Return the queued datagrams with their arrivals on the wall clock. An error is stored for `_receive`.

        Datagrams of other senders are only counted. At most `MAX_FETCHED` are fetched, so that a read always ends.
        """
        entries: Arrived = []
        for _ in range(MAX_FETCHED):
            try:
                data, ancillary, _, sender = self.socket.recvmsg(MAX_DATAGRAM, ANCILLARY_BYTES)
            except BlockingIOError:
                return entries
            except OSError as error:
                if self._failed is not None:
                    return entries
                self._failed = self._receive_error(error)  # the kernel reports it once, before the queued datagrams
                continue
            arrival_ns = self._arrival_ns(ancillary)
            if self._accepts(sender):
                self._sender = sender
                entries.append((arrival_ns, data))
            else:
                self._foreign += 1
        return entries

    def _accepts(self, sender: Any) -> bool:
        """Return whether datagrams of a sender are accepted; the first sender becomes the only one for `FIRST`."""
        if not self._accepted_sender:
            return True
        host = str(sender[0]).partition("%")[0]  # the part before %, without the interface of a link-local address
        if self._accepted_sender == FIRST:
            self._accepted_sender = host
        return host == self._accepted_sender

    def _receive_error(self, error: OSError) -> LinkLostError:
        if isinstance(error, ConnectionRefusedError):
            return self.lost("the host refuses the port", "the port, and that the device streams")
        return self.lost(error.strerror or str(error))

    def _arrival_ns(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        """Return the arrival time from the ancillary messages of a datagram, and store the count of drops."""
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
        """Send a datagram to the peer, or to the last sender.

        Raises `DeviceError` if there is none, `LinkLostError` if it fails.
        """
        if not self._connected and self._sender is None:
            raise DeviceError(
                f"{self.name}: nothing was received yet, so the address to send to is unknown. Start the sender first."
            )
        try:
            if self._connected:
                self.socket.send(data)
            else:
                self.socket.sendto(data, self._sender)
        except OSError as error:
            raise self.lost(error.strerror or str(error)) from error

    def _release(self) -> None:
        self.socket.close()
        super()._release()


def open_tcp(target: str, sensor: Sensor, name: str) -> TcpLink:
    """Open a TCP connection. Raises `DeviceError` if the host is unknown, unreachable, or refuses the connection."""
    host, port = parse_host_port("tcp", target)
    return TcpLink(name, connect(host, port, name))


def open_tcp_udp(target: str, sensor: Sensor, name: str) -> ControlledLink:
    """Open a TCP control connection and a free local UDP port for data. Raises `DeviceError` like `open_tcp`."""
    host, port = parse_host_port("tcp+udp", target)
    control = TcpLink(name, connect(host, port, name))
    local_host = control.socket.getsockname()[0]
    return ControlledLink(name, bind_port(local_host, 0, name), control, prompt=needs_prompt_reads(sensor))


class TcpLink(DescriptorLink):
    """A TCP connection."""

    def __init__(self, name: str, connection: socket.socket) -> None:
        super().__init__(name, connection.fileno())
        self.socket = connection

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        data = self._read_available("the other end closed the connection")
        return [(time.monotonic_ns(), data)] if data else []

    def _release(self) -> None:
        self.socket.close()
        super()._release()


class ControlledLink(UdpLink):
    """A device that sends datagrams while its control connection is open. `write` and dialogues use the connection."""

    def __init__(self, name: str, data: socket.socket, control: TcpLink, *, prompt: bool) -> None:
        super().__init__(name, data, prompt=prompt)
        self.control = control
        self._poll.register(control.socket.fileno(), select.POLLIN)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the queued datagrams; the end of the control connection is stored for the next read."""
        if any(fileno == self.control.socket.fileno() for fileno, _ in ready):
            try:
                self.control.read(0)  # after the dialogue, all that can arrive here is the end of the connection
            except LinkLostError as error:
                self._failed = error
        return super()._fetch(ready)

    def _send(self, data: bytes) -> None:
        self.control.write(data)

    def _release(self) -> None:
        self.control.close()
        super()._release()
