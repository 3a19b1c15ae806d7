"""The same questions for all kinds of links, each against a real other end."""

import contextlib
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from can import CanError
from websockets.exceptions import ConnectionClosedOK

from tacpipe.links.can import CanLink
from tacpipe.links.link import LinkLostError
from tacpipe.links.websocket import WebsocketLink
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.icub_skin import IcubSkin
from tests.links import peers
from tests.links.peers import Peer

KINDS: dict[str, Callable[[], AbstractContextManager[Peer]]] = {
    "serial": peers.serial,
    "tcp": peers.tcp,
    "udp": peers.udp_talking,
    "tcp+udp": peers.tcp_and_udp,
    "ws": peers.websocket,
    "virtual": peers.can_virtual,
}
EVERY = (*KINDS, "slcan", "folder")
FRAMES = [number.to_bytes(4, "little") + b"\x03" + bytes([number, 1, 2]) + bytes(5) for number in range(20)]


@pytest.fixture
def peer(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Peer]:
    """An open link of the kind that the test asks for, with its other end."""
    kind = request.param
    manager: AbstractContextManager[Peer]
    if kind == "folder":
        manager = peers.folder(tmp_path / "watched")
    elif kind == "slcan":
        manager = peers.can_slcan(monkeypatch)
    else:
        manager = KINDS[kind]()
    with manager as connected:
        if kind == "udp":  # a device that answers must have been spoken to
            connected.link.write(b"hello")
            assert connected.heard(5) == b"hello"
        yield connected


@pytest.mark.parametrize("peer", EVERY, indirect=True)
def test_all_bytes_come_in_order_with_stamps_that_never_go_back(peer: Peer) -> None:
    start_ns = time.monotonic_ns()
    for frame in FRAMES:
        peer.send(frame)

    packets = peer.receive(sum(map(len, FRAMES)))

    stamps = [t_ns for t_ns, _ in packets]
    assert b"".join(data for _, data in packets) == b"".join(FRAMES)
    if peer.packets:
        assert [data for _, data in packets] == FRAMES
    assert stamps == sorted(stamps)
    tick = 10_000_000  # Resolution of the clock that stamps files
    assert start_ns - tick <= stamps[0] and stamps[-1] <= time.monotonic_ns()


@pytest.mark.parametrize("peer", EVERY, indirect=True)
def test_while_nothing_comes_nothing_is_read(peer: Peer) -> None:
    assert peer.link.read(0.01) == []
    peer.send(FRAMES[7])
    assert b"".join(data for _, data in peer.receive(len(FRAMES[7]))) == FRAMES[7]
    assert peer.link.read(0) == []
    assert peer.link.overruns == 0


@pytest.mark.parametrize("peer", [kind for kind in EVERY if kind != "folder"], indirect=True)
def test_what_is_written_arrives(peer: Peer) -> None:
    peer.link.write(FRAMES[5])

    assert peer.heard(len(FRAMES[5])) == FRAMES[5]


@pytest.mark.parametrize("peer", [kind for kind in EVERY if kind != "virtual"], indirect=True)
def test_a_device_that_went_away_is_lost_and_the_error_names_the_stream(peer: Peer) -> None:
    peer.send(FRAMES[0])
    peer.receive(len(FRAMES[0]))
    peer.leave()

    with pytest.raises(LinkLostError, match=r"probe \(.+\)"):
        for _ in range(50):
            peer.link.read(0.1)


@pytest.mark.parametrize("peer", EVERY, indirect=True)
def test_a_link_may_be_closed_twice_and_not_read_again(peer: Peer) -> None:
    peer.link.close()
    peer.link.close()

    with pytest.raises(LinkLostError, match="probe"):
        peer.link.read(0.01)
    with pytest.raises(LinkLostError, match="probe"):
        peer.link.write(b"late")


@pytest.mark.parametrize("error", [termios.error(5, "Input/output error"), ValueError("port is not open")])
def test_an_adapter_that_is_gone_can_still_be_closed(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    with peers.can_slcan(monkeypatch) as peer:
        bus = cast("CanLink", peer.link).bus
        port = bus.serialPortOrig  # type: ignore[attr-defined]  # of slcan alone

        def fail() -> None:
            raise error

        monkeypatch.setattr(bus, "shutdown", fail)
        peer.link.close()

        assert not port.is_open
        monkeypatch.undo()
        with contextlib.suppress(CanError):
            bus.shutdown()


@pytest.mark.parametrize(
    "line",
    [
        b"t12\r",
        b"t123\r",
        b"t1238AABB\r",
        b"t1232AAXB\r",
        b"t1232AAB\r",
        b"t1239AABBCCDDEEFF001122\r",
        b"q1232AABB\r",
        b"t12\xff2AABB\r",
        b"T0000012\r",
        b"t1238AABBCCD\r",
        b"\xff\x80\x07",
    ],
)
def test_a_damaged_line_of_an_slcan_adapter_costs_the_bytes_of_that_line_only(
    line: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with peers.can_slcan(monkeypatch) as peer:
        assert peer.send_raw is not None
        peer.send(FRAMES[0])
        peer.send_raw(line)
        peer.send(FRAMES[1])
        size = len(line) - (len(line) % 13 == 0)
        entries = peer.receive(2 * 13 + size)

    assert [data for _, data in entries] == [FRAMES[0], line[:size], FRAMES[1]]
    stamps = [t_ns for t_ns, _ in entries]
    assert stamps == sorted(stamps)
    framer = IcubSkin().framer()
    framer.feed(Chunks.from_pairs(entries))
    assert (framer.account.framed, framer.account.lost) == (2 * 13, size)


@pytest.mark.parametrize("reply", [b"\r", b"\a", b"z\r", b"Z\r", b"F00\r", b"V1013\r", b"r1232\r", b"t1232AABB1F40\r"])
def test_replies_and_time_stamps_of_an_slcan_adapter_are_not_damage(
    reply: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with peers.can_slcan(monkeypatch) as peer:
        assert peer.send_raw is not None
        peer.send_raw(reply)
        peer.send(FRAMES[1])
        count = 2 if reply.startswith(b"t") else 1
        assert {len(data) for _, data in peer.receive(13 * count)} == {13}


@pytest.mark.parametrize("data", [b"text", b"\xff\x00"])
def test_what_is_written_to_a_websocket_that_closed_says_that_it_is_lost(data: bytes) -> None:
    def closed(_: str | bytes) -> None:
        raise ConnectionClosedOK(None, None)

    link = WebsocketLink("Stream probe", cast("Any", SimpleNamespace(send=closed)))
    with pytest.raises(LinkLostError, match="probe"):
        link.write(data)


@pytest.mark.parametrize("peer", ["serial", "tcp", "udp", "tcp+udp", "ws", "folder"], indirect=True)
def test_a_reader_that_waits_returns_when_another_thread_closes_the_link(peer: Peer) -> None:
    returned = threading.Event()

    def read() -> None:
        with contextlib.suppress(LinkLostError):  # it was closed before this thread came to read
            peer.link.read(600)
        returned.set()

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    peer.link.close()

    assert returned.wait(peers.SOON_S)
    reader.join()
