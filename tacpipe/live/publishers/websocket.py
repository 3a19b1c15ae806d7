"""Messages as JSON over websockets: a server that any number of clients subscribe to, each with a queue of its own."""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import threading
from typing import TYPE_CHECKING

from tacpipe.errors import DeviceError
from tacpipe.links import network
from tacpipe.live.messages import About, Published, to_json
from tacpipe.plugins import extras

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

QUEUED = 16  # messages that wait for a client; a third of a second at 50 Hz
BEHIND = 100  # messages dropped in a row, after which a client is cut off
SILENT = logging.getLogger("tacpipe.live.websocket")  # a client that goes is no error
SILENT.addHandler(logging.NullHandler())
SILENT.propagate = False
END_S = 1.0  # in which the server's threads must have ended


class _Client:
    """One subscriber: what waits for it, and how many messages in a row it did not fetch in time."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.waiting: queue.Queue[str | None] = queue.Queue(QUEUED)
        self.behind = 0


class WebsocketPublisher:
    """A server of websockets; what a slow client does not take is dropped for it, and then the client is."""

    def __init__(self, place: str, about: About) -> None:
        with extras.named("--publish ws"):
            from websockets.sync.server import serve

        host, port = network.place("ws", place)
        self.dropped = 0
        self._about = to_json(about.to_dict()).decode()
        self._clients: set[_Client] = set()
        self._threads: set[threading.Thread] = set()  # of the server, one a connection
        self._keeping = threading.Lock()
        try:
            self._server = serve(self._serve, host or None, port, compression=None, logger=SILENT)
        except OSError as error:
            raise DeviceError(f"--publish ws:{place}: {error.strerror or error}. Take another port.") from error
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def subscribers(self) -> int:
        """How many clients there are."""
        return len(self._clients)

    def publish(self, message: Published) -> None:
        """Put a message into the queue of each client that has room."""
        with self._keeping:
            clients = list(self._clients)
        if not clients:
            return
        text = to_json(message.to_dict()).decode()
        for client in clients:
            try:
                client.waiting.put_nowait(text)
                client.behind = 0
            except queue.Full:
                self.dropped += 1
                client.behind += 1
                if client.behind == BEHIND:
                    self._cut_off(client)

    def close(self) -> None:
        """End the server and its connections."""
        with self._keeping:
            clients = list(self._clients)
        for client in clients:
            try:
                client.waiting.put_nowait(None)
            except queue.Full:
                self._cut_off(client)
        self._server.shutdown()
        for thread in (self._thread, *list(self._threads)):
            thread.join(END_S)

    def _cut_off(self, client: _Client) -> None:
        with self._keeping:
            self._clients.discard(client)
        with contextlib.suppress(OSError):
            client.connection.socket.shutdown(socket.SHUT_RDWR)  # also ends a write that waits for the client

    def _serve(self, connection: ServerConnection) -> None:
        """Send one client what waits for it, until it goes; run by a thread of the server."""
        client = _Client(connection)
        self._threads.add(threading.current_thread())
        with contextlib.suppress(Exception):  # of a client that goes, in any of the ways that one can
            connection.send(self._about)
            with self._keeping:
                self._clients.add(client)
            while (text := client.waiting.get()) is not None:
                connection.send(text)
        with self._keeping:
            self._clients.discard(client)
