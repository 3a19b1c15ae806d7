"""Serve messages as JSON over websockets. Subscribers can neither delay the session nor exhaust its memory.

Each subscriber states the maximum age of its messages, and only few messages are on their way to it: it asks for each
message (``?pull=1``), or its pongs to the server's pings show that messages reached it. When it is ready, it gets the
newest message, and the number of those that it missed. So no message waits in a buffer until it is old.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import logging
import os
import socket
import threading
import time
from collections.abc import Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qs, parse_qsl, urlsplit

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.typing import Origin

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import network
from tacpipe.live.messages import Description, Message, to_json
from tacpipe.printable import excerpt

HOST = "127.0.0.1"  # default host of the server
TOKEN = "TACPIPE_LIVE_TOKEN"  # variable of the environment; subscribers must send its value unless it is empty
CONNECTIONS = 32  # maximum number of open connections, subscribed or not
MAX_AGE_MS = 100.0  # maximum age of messages for a subscriber that states none
UNDERWAY = 4  # maximum number of messages on their way to a subscriber
# bytes that a client may send: for its handshake, then per second (1,000 requests or pongs), and in one message
RECEIVED_BYTES, RECEIVED_BYTES_S, RECEIVED_MESSAGE_BYTES = 1 << 14, 1 << 16, 1 << 10
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


@dataclass(frozen=True)
class PublishedMessage:
    """A message as JSON, without the fields that differ between subscribers and without its closing brace."""

    text: str
    offset_ns: int  # from the monotonic clock to that of its stamps
    measured_ns: int  # when its newest sample was measured, or when it was published if it is about no moment

    @classmethod
    def from_message(cls, message: Message) -> PublishedMessage:
        """Return a message that is published now."""
        content = {name: value for name, value in message.to_dict().items() if name != "sent_ns"}
        now_ns = time.monotonic_ns() + message.offset_ns
        measured_ns = now_ns if message.sampled_ns is None else message.sampled_ns
        return cls(to_json(content).decode()[:-1], message.offset_ns, measured_ns)


@dataclass(eq=False)
class Subscriber:
    """What a connection has asked for and got."""

    connection: ServerConnection
    max_age_ns: float
    is_pulling: bool  # whether it asks for each message
    number: int  # number of the last message that it got, or of the last one before it subscribed
    ready: int  # number of messages that it may get now
    missed: int = 0
    asked: tuple[int, int] | None = None  # its clock when it last asked, and the monotonic clock when that arrived
    pong: asyncio.Task[None] | None = None  # waits for the answer to the latest ping


class WebsocketPublisher:
    """A server of websockets in one thread. A slow subscriber gets fewer messages.

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
        self._subscribers: set[Subscriber] = set()
        self._newest: PublishedMessage | None = None
        self._number = 0  # number of published messages
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
        """Send a message to each subscriber that is ready for it."""
        if self._subscribers:
            self._loop.call_soon_threadsafe(self._replace_newest, PublishedMessage.from_message(message))

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
            max_size=RECEIVED_MESSAGE_BYTES,
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
            try:
                parse_query(request.path)
            except ValueError:
                return connection.respond(400, "max_age_ms must be a number of milliseconds above 0.\n")
            return None
        response = connection.respond(200, page())
        del response.headers["Content-Type"]
        for name, value in PAGE_HEADERS.items():
            response.headers[name] = value
        return response

    async def _subscribe(self, connection: ServerConnection) -> None:
        """Send a client the description and then the newest messages, until it disconnects."""
        assert connection.request is not None  # the handshake is complete
        max_age_ms, is_pulling = parse_query(connection.request.path)
        ready = 0 if is_pulling else UNDERWAY
        subscriber = Subscriber(connection, max_age_ms * 1e6, is_pulling, self._number, ready)
        self._subscribers.add(subscriber)  # before its first message, after which it expects those that follow
        broadcast([connection], self._about)
        try:
            async for text in connection:
                if is_pulling:
                    subscriber.asked = int(text), time.monotonic_ns()
                    self._continue(subscriber)
        except ValueError:
            await connection.close(CloseCode.INVALID_DATA, "A request is an integer: the time of your clock in ns.")
        finally:
            self._subscribers.discard(subscriber)

    def _replace_newest(self, message: PublishedMessage) -> None:
        """Send a message to the subscribers that are ready, in the server's thread."""
        self._newest, self._number = message, self._number + 1
        for subscriber in self._subscribers:
            self.dropped += subscriber.number < self._number - 1
            self._send(subscriber)

    def _continue(self, subscriber: Subscriber) -> None:
        """Count that a subscriber is ready for another message, and send it if there is one."""
        subscriber.ready = min(subscriber.ready + 1, UNDERWAY)
        self._send(subscriber)

    def _send(self, subscriber: Subscriber) -> None:
        """Send the newest message to a subscriber that is ready and has not got it, unless it is too old."""
        message = self._newest
        if message is None or subscriber.number == self._number or not subscriber.ready:
            return
        now_ns = time.monotonic_ns() + message.offset_ns
        if now_ns - message.measured_ns > subscriber.max_age_ns:
            return
        subscriber.missed += self._number - subscriber.number - 1
        subscriber.number = self._number
        subscriber.ready -= 1
        fields = {"sent_ns": now_ns, "missed": subscriber.missed}
        if subscriber.asked is not None:
            asked_ns, heard_ns = subscriber.asked
            fields |= {"asked_ns": asked_ns, "heard_ns": heard_ns + message.offset_ns}
        broadcast([subscriber.connection], f"{message.text},{to_json(fields).decode()[1:]}")
        if not subscriber.is_pulling:
            subscriber.pong = self._loop.create_task(self._await_pong(subscriber))

    async def _await_pong(self, subscriber: Subscriber) -> None:
        """Wait until the messages so far have reached a subscriber."""
        with contextlib.suppress(ConnectionClosed):
            await (await subscriber.connection.ping())
            self._continue(subscriber)


def parse_query(path: str) -> tuple[float, bool]:
    """Return the maximum age in ms, and whether the client asks for each message, from the path of its request.

    Raises `ValueError` for an age that is not above 0.
    """
    options = dict(parse_qsl(urlsplit(path).query))
    max_age_ms = float(options.get("max_age_ms", MAX_AGE_MS))
    if not max_age_ms > 0:
        raise ValueError
    return max_age_ms, options.get("pull") == "1"


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
