"""Bytes of the links reach the model's process in order, or are thrown away and counted; nobody waits for it."""

import socket
from collections.abc import Iterator

import pytest

from tacpipe.live import wire
from tacpipe.live.wire import RecorderTap
from tacpipe.recording.spool import StreamNote
from tacpipe.sensors.framing import Chunks

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def chunk(number: int, size: int = 10) -> Chunks:
    return Chunks.from_pairs([(number, bytes([number % 256]) * size)])


def receive(theirs: socket.socket, blocks: wire.Blocks) -> list[tuple[str, Chunks | StreamNote]]:
    theirs.setblocking(False)
    blocks_received: list[tuple[str, Chunks | StreamNote]] = []
    while True:
        try:
            blocks_received += blocks.feed(theirs.recv(777))
        except BlockingIOError:
            return blocks_received


def numbers(blocks_received: list[tuple[str, Chunks | StreamNote]]) -> list[int]:
    return [int(block.t_ns[0]) for _, block in blocks_received if isinstance(block, Chunks)]


def test_what_is_put_arrives_in_order_with_its_stream_stamps_and_bytes(pair: Pair) -> None:
    tap = RecorderTap(["a", "b"])
    tap.connect(pair[0], StreamNote(1, "", wire.BEGIN, "5"))
    tap.put("b", chunk(7))
    tap.put("a", StreamNote(8, "a", "lost", "unplugged"))

    begin, first, second = receive(pair[1], wire.Blocks(["a", "b"]))
    assert begin == ("", StreamNote(1, "", wire.BEGIN, "5"))
    assert first[0] == "b" and isinstance(first[1], Chunks)
    assert (first[1].t_ns.tolist(), first[1].data) == ([7], bytes([7]) * 10)
    assert second == ("a", StreamNote(8, "a", "lost", "unplugged"))


def test_what_the_socket_does_not_take_waits_and_loses_no_byte(pair: Pair) -> None:
    tap, blocks = RecorderTap(["a"]), wire.Blocks(["a"])
    tap.connect(pair[0])
    for number in range(400):  # several times what a socket holds
        tap.put("a", chunk(number, 5000))
    blocks_received = receive(pair[1], blocks)
    assert 0 < len(numbers(blocks_received)) < 400
    while len(numbers(blocks_received)) < 400:
        tap.flush()
        blocks_received += receive(pair[1], blocks)
    assert numbers(blocks_received) == list(range(400)) and tap.overflows == 0


def test_a_queue_that_is_full_is_thrown_away_counted_and_reported_to_the_model(pair: Pair) -> None:
    tap, blocks = RecorderTap(["a"], max_bytes=200_000), wire.Blocks(["a"])
    tap.connect(pair[0])
    for number in range(400):
        tap.put("a", chunk(number, 5000))
    assert tap.overflows > 0 and tap.bytes_lost > 0
    blocks_received = receive(pair[1], blocks)
    for _ in range(100):
        tap.flush()
        blocks_received += receive(pair[1], blocks)
    retained = numbers(blocks_received)
    assert retained == sorted(retained) and retained[-1] == 399 and len(retained) < 400
    overflows = [place for place, (_, block) in enumerate(blocks_received) if isinstance(block, StreamNote)]
    assert {blocks_received[place][1].what for place in overflows} == {wire.OVERFLOW}  # type: ignore[union-attr]
    gaps = [place for place in range(1, len(retained)) if retained[place] != retained[place - 1] + 1]
    assert len(gaps) == len(overflows)  # each gap is reported where it is


@pytest.mark.parametrize("gone", ["never there", "closed", "taken away"])
def test_without_a_process_nothing_is_raised(pair: Pair, gone: str) -> None:
    tap = RecorderTap(["a"])
    if gone != "never there":
        tap.connect(pair[0])
        pair[1].close() if gone == "closed" else tap.connect(None)
    for number in range(100):
        tap.put("a", chunk(number, 5000))
    tap.flush()
    tap.note(StreamNote(1, "", wire.STOP))
    assert tap.overflows == 0


def test_a_process_that_is_started_in_the_middle_gets_the_beginning_of_each_stream(pair: Pair) -> None:
    tap = RecorderTap(["a", "b"])
    tap.connect(pair[0], StreamNote(1, "", wire.BEGIN, "5"))
    tap.put_begins()
    assert [(name, block.what) for name, block in receive(pair[1], wire.Blocks(["a", "b"]))] == [  # type: ignore[union-attr]
        ("", wire.BEGIN),
        ("a", "began"),
        ("b", "began"),
    ]
