"""Read a stream of JPEG images by HTTP (multipart/x-mixed-replace), as mjpg-streamer and ustreamer serve it."""

from __future__ import annotations

import contextlib
import netrc
import socket
import time
from base64 import b64encode
from urllib.parse import urlsplit

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import network
from tacpipe.links.link import Arrived, DescriptorLink
from tacpipe.printable import excerpt, plain
from tacpipe.sensors.camera import Frame, pack_frame, pack_settings
from tacpipe.sensors.sensor import Sensor
from tacpipe.video.images import read_shape

MAX_HEAD_BYTES = 1 << 14  # maximum size of the head of a response or of an image
MAX_IMAGE_BYTES = 1 << 25
READ_BYTES = 1 << 18
ANSWER_S = 5.0  # timeout for the head of the response
HEAD_END = b"\r\n\r\n"
STAMP = "x-timestamp"  # seconds, which mjpg-streamer and ustreamer send with each image
MAX_STAMP_S = 1e10  # later stamps are invalid
Head = dict[str, str]  # fields by lower-case name; "" is the key of the first line


def open_mjpeg(place: str, sensor: Sensor, name: str) -> MjpegLink:
    """Return the open stream of an address such as ``http://192.168.1.20:8080/?action=stream``.

    The credentials for its host in ``~/.netrc`` are sent. Raises `UsageError` for an invalid address or file, and
    `DeviceError` for a host that is unknown, unreachable or serves something else.
    """
    address = urlsplit(place)
    try:
        host, port = address.hostname, address.port or 80
    except ValueError:
        host, port = None, 0
    if address.scheme != "http" or not host:
        raise UsageError(
            f"mjpeg:{plain(place)} names no stream; it should read like mjpeg:http://192.168.1.20:8080/stream."
        )
    path = (address.path or "/") + (f"?{address.query}" if address.query else "")
    authorization = _authorization(host)
    connection = network.connect(host, port, name)
    try:
        head = f"GET {path} HTTP/1.0\r\nHost: {host}:{port}\r\nAccept: multipart/x-mixed-replace\r\n"
        connection.sendall(head.encode("ascii", "replace") + authorization + b"\r\n")
        parser, images = MultipartParser(), []
        until_s = time.monotonic() + ANSWER_S
        connection.settimeout(ANSWER_S)
        while parser.boundary is None and time.monotonic() < until_s:
            data = connection.recv(READ_BYTES)
            if not data:
                break
            images = parser.feed(data)
        connection.setblocking(False)
    except TimeoutError:
        parser.fault = f"it did not answer within {ANSWER_S:g} s"
    except OSError as error:
        connection.close()
        raise network.connection_error(error, host, port, name) from error
    if parser.boundary is None:
        connection.close()
        reason = parser.fault or "it ended the connection"
        hint = (
            f"Give the user and password of {host} in ~/.netrc" if " 401" in reason else "Open the address in a browser"
        )
        raise DeviceError(f"{name}: {place} serves no stream of images: {reason}. {hint}.")
    return MjpegLink(name, connection, parser, images)


def _authorization(host: str) -> bytes:
    """Return the field of a request with the credentials for a host in ``~/.netrc``, or b"" if there are none."""
    try:
        login, _, password = netrc.netrc().authenticators(host) or ("", "", "")
    except FileNotFoundError:
        return b""
    except (
        OSError,
        UnicodeDecodeError,
        netrc.NetrcParseError,
    ):  # not quoted, because the text could contain a password
        raise UsageError(
            "~/.netrc cannot be read. It needs lines such as `machine HOST login USER password PASSWORD`, and "
            "`chmod 600 ~/.netrc`."
        ) from None
    return b"Authorization: Basic " + b64encode(f"{login}:{password}".encode()) + b"\r\n" if login else b""


class MultipartParser:
    """Splits the bytes of a response into images."""

    def __init__(self) -> None:
        self.boundary: bytes | None = None  # None until the head of the response has arrived
        self.fault = ""  # why the bytes are not a stream of images
        self._bytes = bytearray()
        self._head: Head | None = None  # head of the image that is being received

    def feed(self, data: bytes) -> list[tuple[Head, bytes]]:
        """Add bytes and return the newly completed images, each with the fields of its head."""
        self._bytes += data
        if self.boundary is None and not self._take_response_head():
            return []
        images: list[tuple[Head, bytes]] = []
        while not self.fault and (image := self._take_image()) is not None:
            images.append(image)
        return images

    def _take_response_head(self) -> bool:
        """Take the head of the response, and return whether images follow; a wrong head sets ``fault``."""
        head = self._take_head()
        if head is None:
            return False
        kind, _, parameters = head.get("content-type", "").partition(";")
        boundary = parameters.partition("boundary=")[2].partition(";")[0].strip().strip('"')
        if " 200" not in head[""] or kind.strip().lower() != "multipart/x-mixed-replace" or not boundary:
            self.fault = f"the answer is {excerpt(head[''])}, {excerpt(head.get('content-type', 'of no type'))}"
            return False
        self.boundary = b"--" + boundary.encode("ascii", "replace").removeprefix(b"--")
        return True

    def _take_head(self) -> Head | None:
        """Remove and return the head at the start of the bytes, or None if it is incomplete; a long one sets ``fault``."""
        stop = self._bytes.find(HEAD_END)
        if stop < 0:
            if len(self._bytes) > MAX_HEAD_BYTES:
                self.fault = f"a head has more than {MAX_HEAD_BYTES} bytes"
            return None
        lines = self._bytes[:stop].decode("latin-1").strip("\r\n").split("\r\n")
        del self._bytes[: stop + len(HEAD_END)]
        fields = (line.partition(":") for line in lines[1:])
        return {"": lines[0]} | {key.strip().lower(): value.strip() for key, _, value in fields}

    def _take_image(self) -> tuple[Head, bytes] | None:
        """Remove and return the head and the image at the start of the bytes, or None if they are incomplete.

        A large image sets ``fault``.
        """
        assert self.boundary is not None
        if self._head is None:
            start = self._bytes.find(self.boundary)
            if start < 0:
                return None
            del self._bytes[:start]
            self._head = self._take_head()
            if self._head is None:
                return None
        stated = self._head.get("content-length", "")
        size = int(stated) if stated.isdigit() else self._bytes.find(self.boundary)
        if size > MAX_IMAGE_BYTES or (size < 0 and len(self._bytes) > MAX_IMAGE_BYTES):
            self.fault = f"an image has more than {MAX_IMAGE_BYTES} bytes"
            return None
        if size < 0 or len(self._bytes) < size:
            return None
        head, image = self._head, bytes(self._bytes[:size])
        del self._bytes[:size]
        self._head = None
        return head, (image if stated.isdigit() else image.rstrip(b"\r\n"))


class MjpegLink(DescriptorLink):
    """A connection to a server of images. Each entry is the settings or a frame, as `tacpipe.sensors.camera` packs them.

    The first image determines whether the server sends time stamps.
    """

    packets = True

    def __init__(
        self, name: str, connection: socket.socket, parser: MultipartParser, images: list[tuple[Head, bytes]]
    ) -> None:
        """Wrap a connection, and the images that arrived with the head of the response."""
        super().__init__(name, connection.fileno())
        self.socket, self._parser, self._first_images = connection, parser, images
        self._last_us = 0
        self._is_described = False

    def _receive(self, timeout_s: float) -> Arrived:
        images, self._first_images = self._first_images, []
        return self._entries(images) if images else super()._receive(timeout_s)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the images that have arrived. Raises `LinkLostError` if the server ended or sends something else."""
        server = "the program that serves the images"
        images = self._parser.feed(
            self._read_available("the server ended the connection", server, max_bytes=READ_BYTES)
        )
        if self._parser.fault:
            raise self.lost(self._parser.fault, server)
        return self._entries(images)

    def _entries(self, images: list[tuple[Head, bytes]]) -> Arrived:
        """Return frames of images with increasing numbers, after the settings before the first of them."""
        t_ns = time.monotonic_ns()
        entries: Arrived = []
        for head, image in images:
            stamp_ns = _stamp_ns(head)
            if not self._is_described and read_shape(image) is not None:
                self._is_described = True
                entries.append((t_ns, pack_settings({"stamps": "server" if stamp_ns else "arrival"})))
            self._last_us = max(t_ns // 1000, self._last_us + 1)
            entries.append((t_ns, pack_frame(Frame(0, self._last_us, stamp_ns, image))))
        return entries

    def _release(self) -> None:
        super()._release()
        with contextlib.suppress(OSError):
            self.socket.close()


def _stamp_ns(head: Head) -> int:
    """Return the server's stamp of an image in ns, or 0 if there is none.

    >>> _stamp_ns({"x-timestamp": "1700000000.25"}), _stamp_ns({})
    (1700000000250000000, 0)
    """
    whole, _, part = head.get(STAMP, "").partition(".")
    if not whole.isascii() or not whole.isdigit() or (part and not part.isdigit()) or int(whole) > MAX_STAMP_S:
        return 0
    return int(whole) * 10**9 + int((part + "0" * 9)[:9])
