"""A proxy between a client and a server of objects, which fails as networks and servers do."""

from __future__ import annotations

import contextlib
import http.client
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

from tests.stores import places

FAULTS = ("refused", "503", "500", "cut upload", "lost answer", "cut answer", "slow")
WAIT_S = 0.05


@dataclass
class Proxy:
    """What a proxy did; ``fault`` gives what happens to the request of a number, None for nothing."""

    fault: Callable[[int], str | None] = lambda number: None
    endpoint: str = ""
    requests: int = 0
    texts: list[str] = field(default_factory=list)  # the first line of each request
    lock: threading.Lock = field(default_factory=threading.Lock)

    def next(self, text: str) -> str | None:
        """Return what happens to the next request."""
        with self.lock:
            self.requests += 1
            self.texts.append(text)
            return self.fault(self.requests)

    def begin(self, fault: Callable[[int], str | None]) -> None:
        """Count requests from here."""
        with self.lock:
            self.requests, self.texts, self.fault = 0, [], fault


class _Handler(BaseHTTPRequestHandler):
    """Passes requests on, and fails where its proxy is to."""

    protocol_version = "HTTP/1.1"
    proxy: Proxy
    upstream: tuple[str, int]

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        fault = self.proxy.next(self.requestline)
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length // 2 if fault == "cut upload" else length)
        if fault in ("503", "500"):
            self.answer(int(fault), [], b"<Error><Code>SlowDown</Code></Error>")
        elif fault in ("refused", "cut upload"):
            self.hang_up()
        else:
            time.sleep(WAIT_S if fault == "slow" else 0.0)
            found = self.asked(body)
            if fault == "lost answer":
                self.hang_up()
            else:
                self.answer(*found, cut=fault == "cut answer")

    do_PUT = do_POST = do_DELETE = do_HEAD = do_GET  # noqa: N815

    def asked(self, body: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
        """Return what the server answers: status, headers, content."""
        connection = http.client.HTTPConnection(*self.upstream, timeout=60)
        with contextlib.closing(connection):
            connection.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
            for name, value in self.headers.items():
                if name.lower() != "connection":
                    connection.putheader(name, value)
            connection.endheaders(body)
            found = connection.getresponse()
            headers = [one for one in found.getheaders() if one[0].lower() not in ("connection", "transfer-encoding")]
            return found.status, headers, found.read()

    def answer(self, status: int, headers: list[tuple[str, str]], content: bytes, *, cut: bool = False) -> None:
        """Answer, with ``cut`` half of the content alone although all of it was announced."""
        self.send_response_only(status)
        for name, value in headers:
            if name.lower() != "content-length" or self.command == "HEAD":
                self.send_header(name, value)
        if self.command != "HEAD":
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[: len(content) // 2] if cut else content)
        if cut:
            self.hang_up()

    def hang_up(self) -> None:
        """End the connection at once, as a router does that restarts."""
        self.close_connection = True
        with contextlib.suppress(OSError):
            self.wfile.flush()
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.shutdown(socket.SHUT_RDWR)


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: object, client_address: object) -> None:
        """Print nothing: clients that give up are expected here."""


@contextlib.contextmanager
def between(upstream: str) -> Iterator[Proxy]:
    """Yield a proxy of the server at ``upstream``."""
    place, found = urlsplit(upstream), Proxy()

    class Handler(_Handler):
        proxy = found
        upstream = str(place.hostname), int(place.port or 80)

    with places.serving(_Server(("127.0.0.1", 0), Handler)) as found.endpoint:
        yield found
