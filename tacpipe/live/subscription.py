"""Receive the messages of a live session, each young or unknown.

A subscription asks for each message and states its clock; the server returns this time with its own time when it heard the
request. When the request was sent, the server's clock showed less than that, so now it shows at most ``heard_ns`` plus the
time since the request. The age that follows is never too small: it needs neither equal clocks nor equal delays in both
directions, and contains the delay of the request.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

from tacpipe.errors import UsageError
from tacpipe.plugins import extras
from tacpipe.printable import excerpt

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

RECONNECT_S = 0.1  # wait between attempts to connect
OPEN_S, CLOSE_S = 2.0, 0.5  # timeouts of connecting and closing
PING_S, PONG_S = 1.0, 2.0  # time between pings, and time without an answer after which the connection is lost
UNKNOWN = "unknown"


class Subscription:
    """The messages of a live session: an endless iterator whose items never come later than ``max_age_ms``.

    Each item is the newest message, a dict with the additional field ``age_ms``. If no message of at most ``max_age_ms``
    comes in time, it is ``{"kind": "unknown", "cause": …}``. A thread connects, and connects again when the session ends.
    """

    def __init__(self, address: str, max_age_ms: float) -> None:
        """Begin to connect. Raises `UsageError` and `MissingModuleError` as `tacpipe.subscribe` does."""
        parts = urlsplit(address)
        if parts.scheme not in ("ws", "wss") or not parts.hostname:
            raise UsageError(f"{excerpt(address)} is not the address of a live session, as ws://127.0.0.1:8765.")
        if not max_age_ms > 0:
            raise UsageError(f"max_age_ms is {max_age_ms}; it must be above 0.")
        with extras.explain_missing("tacpipe.subscribe"):
            import websockets.sync.client  # noqa: F401  used by the thread
        query = "&".join([*([parts.query] if parts.query else []), f"pull=1&max_age_ms={max_age_ms:g}"])
        self.description: Mapping[str, Any] | None = None  # None until the session has sent it
        self._address = parts._replace(path=parts.path or "/", query=query).geturl()
        self._max_age_ms = max_age_ms
        self._cause = "the session is not connected yet"
        self._connection: ClientConnection | None = None
        self._is_asked = False  # whether a request has no answer yet
        self._too_old = 0  # number of messages of this connection that were received and were too old
        self._is_closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._stay_connected, name="subscription", daemon=True)
        self._thread.start()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> dict[str, Any]:
        """Return the newest message, or that it is unknown."""
        from websockets.exceptions import ConnectionClosed

        until_s = time.monotonic() + self._max_age_ms / 1e3
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._connection is not None, until_s - time.monotonic())
                connection = self._connection
            if connection is None:
                return {"kind": UNKNOWN, "cause": self._cause}
            try:
                message = self._receive(connection, max(0.0, until_s - time.monotonic()))
            except TimeoutError:
                return {"kind": UNKNOWN, "cause": f"no message came within {self._max_age_ms:g} ms"}
            except ConnectionClosed:
                self._lose(connection)
                continue
            if message is not None:
                return message

    def _receive(self, connection: ClientConnection, timeout_s: float) -> dict[str, Any] | None:
        """Return the next message of a connection, or None if it is the description or too old."""
        if not self._is_asked:
            connection.send(str(time.monotonic_ns()))
            self._is_asked = True
        message: dict[str, Any] = json.loads(connection.recv(timeout_s))
        if message["kind"] == "description":
            self.description = message
            return None
        self._is_asked = False
        measured_ns = message["sent_ns"] if message["sampled_ns"] is None else message["sampled_ns"]
        age_ms = (message["heard_ns"] - measured_ns + time.monotonic_ns() - message["asked_ns"]) / 1e6
        if age_ms > self._max_age_ms:
            self._too_old += 1
            return None
        return {**message, "missed": message["missed"] + self._too_old, "age_ms": age_ms}

    def _lose(self, connection: ClientConnection | None) -> None:
        """Have the thread connect again, if this is still the connection."""
        with self._changed:
            if self._connection is connection:
                self._connection, self._cause = None, "the session has closed the connection"
            self._changed.notify_all()

    def _stay_connected(self) -> None:
        """Connect, and connect again whenever the connection is lost, until the subscription is closed."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        timeouts: dict[str, Any] = {"open_timeout": OPEN_S, "close_timeout": CLOSE_S}
        pings: dict[str, Any] = {"ping_interval": PING_S, "ping_timeout": PONG_S}
        while not self._is_closed:
            try:
                with connect(self._address, max_size=None, compression=None, **timeouts, **pings) as connection:
                    self._offer(connection)
            except (OSError, WebSocketException) as error:
                self._cause = f"the session is not connected: {error}"
                time.sleep(RECONNECT_S)

    def _offer(self, connection: ClientConnection) -> None:
        """Let the caller use a connection until it is lost or the subscription is closed."""
        with self._changed:
            self._connection, self._is_asked, self._too_old = connection, False, 0
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_closed or self._connection is None)

    def close(self) -> None:
        """Disconnect."""
        self._is_closed = True
        self._lose(self._connection)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
