"""Read and write websockets. Each entry is one message, text as UTF-8."""

from __future__ import annotations

import contextlib
import logging
import time
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError
from tacpipe.links import network
from tacpipe.links.link import Arrived, OpenLink
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

MAX_MESSAGE = 1 << 24  # bytes
LOGGER = logging.getLogger("tacpipe.links.websocket")  # a lost connection raises an error and is not logged
LOGGER.addHandler(logging.NullHandler())
LOGGER.propagate = False
CLOSE_S = 1.0  # timeout for the peer to close the connection


def open_websocket(target: str, sensor: Sensor, name: str) -> WebsocketLink:
    """Open the websocket ``HOST:PORT`` or ``HOST:PORT/PATH``.

    Raises `DeviceError` if the host is unknown, unreachable, refuses the connection, or is not a websocket server.
    """
    with extras.explain_missing(name):
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

    host_and_port, _, path = target.partition("/")
    host, port = network.parse_host_port("ws", host_and_port)
    # connect here: no proxy is used, and errors have the same texts as those of other links
    tcp_socket = network.connect(host, port, name)
    try:
        connection = connect(
            f"ws://{host_and_port}/{path}",
            sock=tcp_socket,
            compression=None,
            max_size=MAX_MESSAGE,
            open_timeout=network.CONNECT_S,
            close_timeout=CLOSE_S,
            logger=LOGGER,
        ).__enter__()
    except (WebSocketException, TimeoutError, OSError, EOFError) as error:
        tcp_socket.close()
        raise DeviceError(
            f"{name}: the server at {host} port {port} is not a websocket server ({error or type(error).__name__}); "
            "check the port."
        ) from error
    return WebsocketLink(name, connection)


class WebsocketLink(OpenLink):
    """An open websocket."""

    packets = True

    def __init__(self, name: str, connection: ClientConnection) -> None:
        super().__init__(name)
        self.connection = connection

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the messages that arrived within ``timeout_s``.

        Raises `LinkLostError` if the other end closed the websocket.
        """
        from websockets.exceptions import ConnectionClosed

        entries: Arrived = []
        try:
            while True:
                message = self.connection.recv(timeout=0 if entries else timeout_s)
                data = message.encode() if isinstance(message, str) else message
                entries.append((time.monotonic_ns(), data))
        except TimeoutError:
            return entries
        except ConnectionClosed as error:
            if entries or self._closed:
                return entries
            raise self.lost(f"the other end closed the websocket ({error})") from error

    def _send(self, data: bytes) -> None:
        """Send a message, as text if it is UTF-8. Raises `LinkLostError` if the other end closed the websocket."""
        from websockets.exceptions import ConnectionClosed

        try:
            try:
                self.connection.send(data.decode())  # servers of sensors expect text
            except UnicodeDecodeError:
                self.connection.send(data)
        except ConnectionClosed as error:
            raise self.lost(f"the other end closed the websocket ({error})") from error

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self.connection.close()
