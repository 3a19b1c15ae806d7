"""Serve messages as JSON over websockets. Subscribers can neither delay the session nor exhaust its memory."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import logging
import os
import socket
import threading
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qs, parse_qsl, urlsplit

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.http11 import Request, Response
from websockets.typing import Origin

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import network
from tacpipe.live.messages import Description, Message, to_json
from tacpipe.printable import excerpt

HOST = "127.0.0.1"  # default host of the server
TOKEN = "TACPIPE_LIVE_TOKEN"  # variable of the environment; subscribers must send its value unless it is empty
CONNECTIONS = 32  # maximum number of open connections, subscribed or not
QUEUED = 16  # messages queued per subscriber; a third of a second at 50 Hz
QUEUED_BYTES = 1 << 20  # maximum size of the messages queued per subscriber
SENDING_BYTES = 1 << 18  # kernel's buffer of a connection
BEHIND = 100  # number of successive dropped messages after which a subscriber is disconnected
# bytes that a client may send: for its request, then per second
RECEIVED_BYTES, RECEIVED_BYTES_S = 1 << 14, 1 << 10
# The page comes from one file, and connects to its own server only.
PAGE_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self' ws: wss:"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
OPEN_S = 2.0  # timeout of a handshake
END_S = 1.0  # timeout for closing all connections
SILENT = logging.getLogger("tacpipe.live.websocket")  # a client that disconnects is not an error
SILENT.addHandler(logging.NullHandler())
SILENT.propagate = False


class WebsocketPublisher:
    """A server of websockets in one thread. It drops messages for a slow subscriber, and then the subscriber.

    `place` is ``HOST:PORT`` with an optional ``?origin=ORIGIN`` for each web page that may subscribe: browsers send where a
    page comes from, and other pages are refused. Programs send no origin and are accepted.
    """

    def __init__(self, place: str, about: Description) -> None:
        """Start a server at ``HOST:PORT``, with any number of ``origin`` options.

        Raises `UsageError` for other options, and the errors of `_listening_socket`.
        """
        target, _, options = place.partition("?")
        origins = parse_qsl(options, keep_blank_values=True)
        if any(name != "origin" or not value for name, value in origins):
            raise UsageError(
                f"--publish ws:{target}?{excerpt(options)}: the only option is origin, as in "
                f"ws:{target}?origin=http://localhost:3000."
            )
        self.dropped = 0
        self._about = to_json(about.to_dict()).decode()
        self._token = os.environ.get(TOKEN, "")
        self._connections: set[ServerConnection] = set()
        self._subscribers: dict[ServerConnection, int] = {}  # number of successive messages that each subscriber missed
        listening = _listening_socket(target)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="websocket", daemon=True)
        self._thread.start()
        self._server = self._wait(self._serve(listening, [origin for _, origin in origins]))

    @property
    def subscribers(self) -> int:
        """How many subscribers there are."""
        return len(self._subscribers)

    def publish(self, message: Message) -> None:
        """Send a message to each subscriber that keeps up."""
        if self._subscribers:
            self._loop.call_soon_threadsafe(self._send, to_json(message.to_dict()).decode())

    def close(self) -> None:
        """End the server and its connections."""
        self._wait(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(END_S)
        if not self._thread.is_alive():
            self._loop.close()

    def _wait(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Run a coroutine in the server's thread and return its result."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _serve(self, listening: socket.socket, origins: list[str]) -> Server:
        """Start the server on a listening socket, for pages of these ``origins`` and for programs."""
        return await serve(
            self._subscribe,
            sock=listening,
            origins=[None, *map(Origin, [*own_origins(listening), *origins])],
            process_request=self._check_request,
            compression=None,
            open_timeout=OPEN_S,
            close_timeout=END_S,
            max_size=RECEIVED_BYTES_S,
            create_connection=cast(type[ServerConnection], functools.partial(BoundedConnection, self._connections)),
            logger=SILENT,
        )

    async def _end(self) -> None:
        """Close the server, and abort connections that do not close within `END_S`, such as unfinished handshakes."""
        self._server.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_S):
                await self._server.wait_closed()
        for connection in self._connections:
            connection.transport.abort()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_S):
                await self._server.wait_closed()  # the tasks of aborted connections end with the loop's next steps

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal for a client without the token, the page for a browser, and None for a subscriber.

        The token is a header or part of the address.
        """
        sent = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        header = request.headers.get("Authorization", f"Bearer {sent}")
        if self._token and not hmac.compare_digest(header.encode(errors="replace"), f"Bearer {self._token}".encode()):
            return connection.respond(401, f"Send the token of {TOKEN}.\n")
        if "Upgrade" in request.headers:
            return None
        response = connection.respond(200, page())
        del response.headers["Content-Type"]
        for name, value in PAGE_HEADERS.items():
            response.headers[name] = value
        return response

    async def _subscribe(self, connection: ServerConnection) -> None:
        """Send a client the description and then the published messages, until it disconnects."""
        broadcast([connection], self._about)
        self._subscribers[connection] = 0
        try:
            await connection.wait_closed()
        finally:
            del self._subscribers[connection]

    def _send(self, text: str) -> None:
        """Send a message to the subscribers that are not behind, in the server's thread.

        Others miss it; a subscriber that missed `BEHIND` messages in a row is cut off.
        """
        backlog_bytes = min(QUEUED * len(text), QUEUED_BYTES)
        ready = []
        for connection, missed in self._subscribers.items():
            late = connection.transport.get_write_buffer_size() > backlog_bytes
            self._subscribers[connection] = missed + 1 if late else 0
            self.dropped += late
            if missed + late == BEHIND:
                connection.transport.abort()
            elif not late:
                ready.append(connection)
        broadcast(ready, text)


def page() -> str:
    """Return the page that draws the messages in a browser."""
    return (Path(__file__).parent / "page.html").read_text(encoding="utf-8")


def own_origins(listening: socket.socket) -> list[str]:
    """Return where the page of a listening socket may come from: its address, and this computer by name."""
    host, port = listening.getsockname()[:2]
    hosts = [f"[{host}]" if ":" in host else host, "localhost", "127.0.0.1", socket.gethostname()]
    return [f"http://{name}:{port}" for name in dict.fromkeys(hosts)]


def _listening_socket(target: str) -> socket.socket:
    """Return a socket that listens at ``HOST:PORT``. Raises `UsageError` for no port, `DeviceError` for one in use."""
    host, port = network.parse_host_port("ws", target)
    try:
        family, *_, address = socket.getaddrinfo(host or HOST, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address, family=family)
    except OSError as error:
        raise DeviceError(f"--publish ws:{target}: {error.strerror or error}. Take another port.") from error
    listening.setsockopt(
        socket.SOL_SOCKET, socket.SO_SNDBUF, SENDING_BYTES
    )  # connections inherit the size of this buffer
    return listening


class BoundedConnection(ServerConnection):
    """A connection that ends itself where its server has too many, or where the client sends too much."""

    def __init__(self, connections: set[ServerConnection], *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._all = connections

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Register with the server, or close if there are too many connections."""
        self._began_s, self._received = self.loop.time(), 0
        super().connection_made(transport)
        if len(self._all) < CONNECTIONS:
            self._all.add(self)
        else:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Process data from the client, or close."""
        self._received += len(data)
        allowed = RECEIVED_BYTES + RECEIVED_BYTES_S * (self.loop.time() - self._began_s)
        if self._received > allowed:
            self.transport.abort()
        else:
            super().data_received(data)

    def connection_lost(self, error: Exception | None) -> None:
        """Unregister from the server."""
        self._all.discard(self)
        super().connection_lost(error)
