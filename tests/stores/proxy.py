"""Run a proxy between a client and a server of objects, which fails as networks and servers do."""

from __future__ import annotations

import contextlib
import http.client
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

from tests.stores import places

FAULTS = ("refused", "503", "500", "cut upload", "lost answer", "cut answer", "slow")
WAIT_S = 0.05


@dataclass
class Proxy:
    """The state of a proxy; ``fault`` maps the number of a request to its fault or None."""

    fault: Callable[[int], str | None] = lambda number: None
    change: Change | None = None  # maps requests to wrong answers
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
    disable_nagle_algorithm = True  # Otherwise the content waits 40 ms for the client to acknowledge the headers.
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
            request, change = Request(self.command, self.path), self.proxy.change

            def forward(request: Request) -> Answer:
                return Answer(*self.forward_request(request.path, body))

            answer = change(request, forward) if change else forward(request)
            if fault == "lost answer":
                self.hang_up()
            else:
                self.answer(answer.status, answer.headers, answer.content, cut=fault == "cut answer")

    do_PUT = do_POST = do_DELETE = do_HEAD = do_GET  # noqa: N815

    def forward_request(self, path: str, body: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
        """Return what the server answers: status, headers, content."""
        connection = http.client.HTTPConnection(*self.upstream, timeout=60)
        with contextlib.closing(connection):
            connection.putrequest(self.command, path, skip_host=True, skip_accept_encoding=True)
            for name, value in self.headers.items():
                if name.lower() != "connection":
                    connection.putheader(name, value)
            connection.endheaders(body)
            response = connection.getresponse()
            headers = [
                header
                for header in response.getheaders()
                if header[0].lower() not in ("connection", "transfer-encoding")
            ]
            return response.status, headers, response.read()

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
    place, running_proxy = urlsplit(upstream), Proxy()

    class Handler(_Handler):
        proxy = running_proxy
        upstream = str(place.hostname), int(place.port or 80)

    with places.serving(_Server(("127.0.0.1", 0), Handler)) as running_proxy.endpoint:
        yield running_proxy


@dataclass(frozen=True)
class Request:
    """A request of a client: the method, and the path with its query."""

    method: str
    path: str

    @property
    def is_list(self) -> bool:
        """Return whether it lists names."""
        return self.method == "GET" and "list-type=" in self.path

    @property
    def is_object(self) -> bool:
        """Return whether it reads the content of an object."""
        return self.method == "GET" and not self.is_list


@dataclass(frozen=True)
class Answer:
    """An answer of a server."""

    status: int
    headers: list[tuple[str, str]]
    content: bytes


Forward = Callable[[Request], Answer]
Change = Callable[[Request, Forward], Answer]  # maps a request to a wrong answer; it may ask the server or not


def refuse(status: int, code: str, methods: str = "GET PUT POST DELETE HEAD") -> Change:
    """Return a change that answers some methods with an error, and has the server do nothing."""
    content = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>no</Message></Error>'.encode()

    def change(request: Request, forward: Forward) -> Answer:
        if request.method not in methods.split():
            return forward(request)
        return Answer(status, [("Content-Type", "application/xml")], content)

    return change


def change_objects(edit: Callable[[bytes], bytes]) -> Change:
    """Return a change of the content of objects."""

    def change(request: Request, forward: Forward) -> Answer:
        answer = forward(request)
        changes = request.is_object and answer.status in (200, 206)
        return replace(answer, content=edit(answer.content)) if changes else answer

    return change


def change_lists(pattern: bytes, replacement: bytes) -> Change:
    """Return a change of lists of names by a regular expression."""

    def change(request: Request, forward: Forward) -> Answer:
        answer = forward(request)
        return replace(answer, content=re.sub(pattern, replacement, answer.content)) if request.is_list else answer

    return change


def change_header(name: str, value: str, methods: str = "GET HEAD") -> Change:
    """Return a change of a header of answers to some methods."""

    def change(request: Request, forward: Forward) -> Answer:
        answer = forward(request)
        if request.method not in methods.split() or answer.status >= 300:
            return answer
        return replace(answer, headers=[item for item in answer.headers if item[0].lower() != name] + [(name, value)])

    return change


def change_clock(header: str, iso: str) -> Change:
    """Return a change of all times that a server states."""
    in_lists = change_lists(rb"<LastModified>[^<]*", b"<LastModified>" + iso.encode())
    in_headers = change_header("last-modified", header)
    return lambda request, forward: in_headers(request, lambda relayed: in_lists(relayed, forward))


def lose_uploads(request: Request, forward: Forward) -> Answer:
    """Acknowledge the upload of an object, and keep nothing."""
    lost = request.method == "PUT" and "/objects/" in request.path
    return Answer(200, [("ETag", '"0"')], b"") if lost else forward(request)


def answer_login(request: Request, forward: Forward) -> Answer:
    """Answer as the login page of a network does."""
    return Answer(200, [("Content-Type", "text/html")], b"<html><form action=login>Password</form></html>")


WRONG_ANSWERS: dict[str, Change] = {
    "other content": change_objects(lambda content: bytes(byte ^ 1 for byte in content)),
    "shorter content": change_objects(lambda content: content[: len(content) // 2]),
    "longer content": change_objects(lambda content: content + b"more"),
    "no content": change_objects(lambda content: b""),
    "sizes of zero in lists": change_lists(rb"<Size>\d+", b"<Size>0"),
    "huge sizes in lists": change_lists(rb"<Size>\d+", b"<Size>9000000000000000000"),
    "negative sizes in lists": change_lists(rb"<Size>\d+", b"<Size>-5"),
    "a size of zero": change_header("content-length", "0", "HEAD"),
    "a huge size": change_header("content-length", "9000000000000000000", "HEAD"),
    "an empty list": change_lists(rb"(?s)<Contents>.*</Contents>", b""),
    "a cut list": change_lists(rb"(?s)</Name>.*", b""),
    "names that lead out": change_lists(rb"<Key>[^<]*/", b"<Key>../../"),
    "a login page": answer_login,
    "a redirect": lambda request, forward: Answer(307, [("Location", "http://127.0.0.1:9/login")], b""),
    "a redirect to itself": lambda request, forward: Answer(307, [("Location", request.path)], b""),
    "403": refuse(403, "AccessDenied"),
    "404": refuse(404, "NoSuchKey"),
    "409": refuse(409, "OperationAborted"),
    "412": refuse(412, "PreconditionFailed"),
    "uploads end with 404": refuse(404, "NoSuchKey", "PUT"),
    "uploads end with 409": refuse(409, "ConditionalRequestConflict", "PUT"),
    "uploads end with 412": refuse(412, "PreconditionFailed", "PUT"),
    "uploads are lost": lose_uploads,
    "a clock in 1970": change_clock("Thu, 01 Jan 1970 00:00:00 GMT", "1970-01-01T00:00:00.000Z"),
    "a clock in 2099": change_clock("Thu, 31 Dec 2099 23:59:59 GMT", "2099-12-31T23:59:59.000Z"),
    "no clock": change_clock("yesterday", "yesterday"),
}
