"""Hold the dialogues of a sensor with an emulated device, without a link between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from tacpipe.sensors.sensor import Ask, Dialogue

PIECE_BYTES = 7  # default size of the pieces in which replies arrive


@dataclass
class Device:
    """An emulated device. This base class streams from the start and ignores requests."""

    streaming: bool = True
    rate_hz: float | None = None  # None: the sensor's rate; set by devices that receive their rate
    heard: bytearray = field(default_factory=bytearray)

    def hear(self, data: bytes) -> list[bytes]:
        """Process bytes from the host and return the replies in order."""
        return []

    def polled(self) -> int:
        """Return the number of frames requested since the last call; always 0 for a device that streams."""
        return 0


class Conversation(NamedTuple):
    """A dialogue that was held: the messages of the host, and the received bytes that are no replies."""

    sent: list[bytes]
    unclaimed: bytes


def hold_dialogue(
    dialogue: Dialogue, device: Device, greeting: bytes = b"", between: bytes = b"", piece_bytes: int = PIECE_BYTES
) -> Conversation:
    """Hold a dialogue such as `Sensor.opening` with a device whose replies arrive in pieces of ``piece_bytes``.

    ``greeting`` are bytes that arrived before the dialogue, and ``between`` those before each reply. Raises
    `AssertionError` if a reply is missing.
    """
    sent: list[bytes] = []
    incoming, unclaimed, reply = greeting, b"", None
    while True:
        try:
            ask = next(dialogue) if reply is None else dialogue.send(reply)
        except StopIteration:
            return Conversation(sent, unclaimed + incoming)
        sent.append(ask.send)
        incoming += b"".join([between, *device.hear(ask.send)])
        reply = b""
        if ask.until is not None:
            start, stop = find_reply(ask, incoming, piece_bytes)
            unclaimed += incoming[:start]
            reply, incoming = incoming[start:stop], incoming[stop:]


def find_reply(ask: Ask, incoming: bytes, piece_bytes: int = PIECE_BYTES) -> tuple[int, int]:
    """Return start and stop of the reply to a request in bytes that arrive in pieces.

    Raises `AssertionError` if there is none.
    """
    for stop in range(0, len(incoming) + piece_bytes, piece_bytes):
        if span := ask.find_reply(incoming[:stop]):
            return span
    raise AssertionError(f"{ask.what} to {ask.send.hex(' ')} is not among {incoming.hex(' ')}")
