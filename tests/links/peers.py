"""The other ends of links, one of each kind, that a test talks through."""

from __future__ import annotations

import os
import pty
import queue
import socket
import threading
import time
import tty
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from tacpipe.links.can import pack_frame, unpack_frames
from tacpipe.links.link import Link, parse
from tacpipe.links.opening import open_link
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Sensor

SOON_S = 300.0  # The longest wait for anything; only a failure waits so long


@dataclass
class Peer:
    """An open link and its other end."""

    link: Link
    send: Callable[[bytes], None]  # one packet, or some bytes, to the link
    heard: Callable[[int], bytes]  # the next so many bytes that the link wrote
    leave: Callable[[], None]  # go away, as an unplugged device does
    packets: bool = True
    send_raw: Callable[[bytes], None] | None = None  # write bytes to the line as they are
    stack: ExitStack = field(default_factory=ExitStack)

    def receive(self, count: int) -> list[tuple[int, bytes]]:
        """Read until ``count`` bytes came."""
        received: list[tuple[int, bytes]] = []
        until = time.monotonic() + SOON_S
        while sum(len(data) for _, data in received) < count and time.monotonic() < until:
            received += self.link.read(0.1)
        return received


class Quiet(Sensor):
    """A sensor of which a link needs to know nothing."""

    baud = 115_200
    rate_hz = 100.0


class Listened(Quiet):
    """A sensor that is listened to."""

    listens = True


def open_address(address: str, sensor: Sensor | None = None) -> Link:
    """Return the open link of an address."""
    return open_link(parse(address), sensor or OptoForce(), "probe")


@contextmanager
def serial() -> Iterator[Peer]:
    """A serial port: a pseudo-terminal."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = open_address(f"serial:{os.ttyname(slave)}")
    os.close(slave)
    ends = ExitStack()
    ends.callback(os.close, master)
    with ends:
        yield Peer(
            link, lambda data: _write_all(master, data), lambda count: _read(master, count), ends.close, packets=False
        )
        link.close()


@contextmanager
def tcp() -> Iterator[Peer]:
    """A TCP server."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_address(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        connection, _ = server.accept()
    with connection:
        yield Peer(link, connection.sendall, lambda count: _exactly(connection, count), connection.close, packets=False)
    link.close()


@contextmanager
def udp_talking() -> Iterator[Peer]:
    """A device that answers whoever spoke to it; when it is gone, its port refuses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.settimeout(SOON_S)
        device.bind(("127.0.0.1", 0))
        link = open_address(f"udp:127.0.0.1:{device.getsockname()[1]}")
        address = ("127.0.0.1", link.local["port"])

        def leave() -> None:
            device.close()
            link.write(b"are you there?")  # The kernel answers with a refusal

        yield Peer(link, lambda data: _send_to(device, data, address), device.recv, leave)
    link.close()


@contextmanager
def tcp_and_udp() -> Iterator[Peer]:
    """A device with a control connection whose data come by UDP."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as data:
        link = open_address(f"tcp+udp:127.0.0.1:{server.getsockname()[1]}")
        control, _ = server.accept()
        address = ("127.0.0.1", link.local["port"])
        with control:
            yield Peer(
                link,
                lambda sent: _send_to(data, sent, address),
                lambda count: _exactly(control, count),
                control.close,
            )
    link.close()


@contextmanager
def websocket() -> Iterator[Peer]:
    """A websocket server."""
    from websockets.sync.server import ServerConnection, serve

    opened: queue.Queue[ServerConnection] = queue.Queue()
    over = threading.Event()

    def hold(connection: ServerConnection) -> None:
        opened.put(connection)
        over.wait()

    with serve(hold, "127.0.0.1", 0) as server:
        runs = threading.Thread(target=server.serve_forever)
        runs.start()
        link = open_address(f"ws:127.0.0.1:{server.socket.getsockname()[1]}")
        connection = opened.get(timeout=SOON_S)
        yield Peer(
            link, lambda data: connection.send(data), lambda count: _bytes(connection.recv(SOON_S)), connection.close
        )
        link.close()
        over.set()
        server.shutdown()
        runs.join()


@contextmanager
def can_virtual() -> Iterator[Peer]:
    """A CAN bus within this process, from which nothing can be unplugged."""
    import can

    channel = uuid.uuid4().hex
    link = open_address(f"can:virtual:{channel}")
    with can.Bus(interface="virtual", channel=channel) as bus:

        def send(data: bytes) -> None:
            for message in unpack_frames(data):
                bus.send(message)

        def heard(count: int) -> bytes:
            message = bus.recv(SOON_S)
            assert message is not None
            return pack_frame(message)

        yield Peer(link, send, heard, lambda: None)
        link.close()


@contextmanager
def can_slcan(monkeypatch: pytest.MonkeyPatch) -> Iterator[Peer]:
    """A CAN adapter that speaks slcan over a serial port: text, with the frame ``t1232AABB`` and so on."""
    from can.interfaces import slcan

    master, slave = pty.openpty()
    tty.setraw(slave)
    clock = SimpleNamespace(sleep=lambda _: None, time=time.time, perf_counter=time.perf_counter)
    monkeypatch.setattr(slcan, "time", clock)  # adapters may take two seconds to boot, this one does not
    link = open_address(f"can:slcan:{os.ttyname(slave)}@1000000", Quiet())
    os.close(slave)
    ends = ExitStack()
    ends.callback(os.close, master)

    def send(data: bytes) -> None:
        for message in unpack_frames(data):
            payload = bytes(message.data).hex().upper()
            _write_all(master, f"t{message.arbitration_id:03X}{len(message.data)}{payload}\r".encode())

    with ends:
        yield Peer(
            link, send, lambda count: _slcan_frame(master), ends.close, send_raw=lambda data: _write_all(master, data)
        )
        link.close()


@contextmanager
def folder(path: Path) -> Iterator[Peer]:
    """A watched folder."""
    path.mkdir()
    link = open_address(f"folder:{path}", Quiet())
    numbers = iter(range(1000))

    def send(data: bytes) -> None:
        (path / f"{next(numbers):03d}.tmp").write_bytes(data)
        last = sorted(path.glob("*.tmp"))[-1]
        last.rename(last.with_suffix(".pcd"))

    def leave() -> None:
        for file in path.iterdir():
            file.unlink()
        path.rmdir()

    yield Peer(link, send, lambda count: b"", leave)
    link.close()


def _write_all(fileno: int, data: bytes) -> None:
    while data:
        data = data[os.write(fileno, data) :]


def _read(fileno: int, count: int) -> bytes:
    received = b""
    while len(received) < count:
        received += os.read(fileno, count - len(received))
    return received


def _exactly(connection: socket.socket, count: int) -> bytes:
    connection.settimeout(SOON_S)
    received = b""
    while len(received) < count:
        received += connection.recv(count - len(received))
    return received


def _send_to(port: socket.socket, data: bytes, address: tuple[str, int]) -> None:
    port.sendto(data, address)


def _bytes(message: str | bytes) -> bytes:
    return message.encode() if isinstance(message, str) else message


def _slcan_frame(master: int) -> bytes:
    text = b""
    while not text.startswith(b"t"):  # lines that set the adapter up come first
        text = b""
        while not text.endswith(b"\r"):
            text += _read(master, 1)
    count = int(text[4:5])
    return (
        int(text[1:4], 16).to_bytes(4, "little") + bytes([count]) + bytes.fromhex(text[5:-1].decode()).ljust(8, b"\0")
    )
