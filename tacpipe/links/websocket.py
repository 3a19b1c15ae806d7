"""Read and write websockets. Each entry is one message, text as UTF-8."""

from __future__ import annotations

import contextlib
import logging
import time
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError
from tacpipe.links import network
from tacpipe.links.link import Arrived, Opened
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

MOST = 1 << 24  # limit of a message in bytes
SILENT = logging.getLogger(
    "tacpipe.links.websocket"
)  # a lost connection is an error of its own, not a logged traceback
SILENT.addHandler(logging.NullHandler())
SILENT.propagate = False
CLOSE_S = 1.0  # time that the other end has to close the connection


def open_websocket(place: str, sensor: Sensor, name: str) -> WebsocketLink:
    """Return an open websocket of ``HOST:PORT`` or ``HOST:PORT/PATH``.

    Raises `DeviceError` for a host that is unknown, unreachable, refuses, or speaks something else.
    """
    with extras.explain_missing(name):
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

    host_and_port, _, path = place.partition("/")
    host, port = network.format_place("ws", host_and_port)
    wire = network.connect(
        host, port, name
    )  # our own connection uses no proxy and has the same error texts as all links
    try:
        connection = connect(
            f"ws://{host_and_port}/{path}",
            sock=wire,
            compression=None,
            max_size=MOST,
            open_timeout=network.CONNECT_S,
            close_timeout=CLOSE_S,
            logger=SILENT,
        ).__enter__()
    except (WebSocketException, TimeoutError, OSError, EOFError) as error:
        wire.close()
        raise DeviceError(
            f"{name}: the server at {host} port {port} is not a websocket ({error or type(error).__name__}); check "
            "the port."
        ) from error
    return WebsocketLink(name, connection)


class WebsocketLink(Opened):
    """An open websocket."""

    packets = True

    def __init__(self, name: str, connection: ClientConnection) -> None:
        super().__init__(name)
        self.connection = connection

    def _receive(self, timeout_s: float) -> Arrived:
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
