"""Parse hosts and ports, connect to them, and put network errors into sentences."""

from __future__ import annotations

import errno
import socket

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links.link import SCHEMES

CONNECT_S = 5.0
IDLE_S, EVERY_S, TIMES = (
    2,
    1,
    3,
)  # keep-alive probes: silence before the first, pause, number


def place(scheme: str, text: str) -> tuple[str, int]:
    """Return host and port of the text after the colon of an address. The host is empty for all interfaces.

    Raises `UsageError` for an invalid port.

    >>> place("udp", "[fe80::1]:4010"), place("udp", ":4010")
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
