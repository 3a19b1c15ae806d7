"""What goes between the recording process and the model's process: blocks as in a spool one way, lines of JSON back."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.recording import spool_blocks
from tacpipe.recording.spool_blocks import CHUNKS, HEAD, MARK, NOTE, WHOLE, Note
from tacpipe.sensors.framing import Chunks

CLOCK = "clock"  # a note on all streams: what is added to the monotonic clock to have the recording's UTC, ns
BEGIN = "begin"  # a recording begins: what its streams give follows behind a note of each
CONTINUE = "continue"  # before the next BEGIN: grid and level at rest of a process that ended, which it continues
END = "end"  # the recording ends
OVERFLOW = "overflow"  # blocks were thrown away, because the model's process did not fetch them
STOP = "stop"  # the session is over


def block(stream: int | None, content: Chunks | Note) -> bytes:
    """Return one block as bytes; ``stream`` is the number of its stream, None for a note on all of them."""
    if isinstance(content, Chunks):
        body = content.t_ns.astype("<i8").tobytes() + content.size.astype("<u4").tobytes() + content.data
        return spool_blocks.of(CHUNKS, 0 if stream is None else stream, len(content.size), body)
    note = json.dumps({"t_ns": content.t_ns, "what": content.what, "detail": content.detail}).encode()
    return spool_blocks.of(NOTE, WHOLE if stream is None else stream, 0, note)


class Blocks:
    """Cuts received bytes into blocks again."""

    def __init__(self, streams: Sequence[str]) -> None:
        self._streams = list(streams)
        self._text = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[str, Chunks | Note]]:
        """Yield each block that is complete now with the name of its stream, empty for a note on all.

        Raises `TacpipeError` for bytes that are not blocks: the other process is not of this version.
        """
        self._text += data
        place = 0
        while place + HEAD.size <= len(self._text):
            mark, _, kind, number, _, count, size = HEAD.unpack_from(self._text, place)
            if mark != MARK:
                raise TacpipeError("The recording process sent what is not a block; do both run the same tacpipe?")
            stop = place + HEAD.size + size
            if stop > len(self._text):
                break
            stream = "" if number == WHOLE else self._streams[number]
            found = spool_blocks.content(kind, stream, count, bytes(self._text[place + HEAD.size : stop]))
            place = stop
            if found is not None:
                yield stream, found
        del self._text[:place]


class Lines:
    """Cuts received bytes into objects, one a line."""

    def __init__(self) -> None:
        self._text = b""

    def feed(self, data: bytes) -> list[dict[str, Any]]:
        """Return the objects that are complete now."""
        *lines, self._text = (self._text + data).split(b"\n")
        return [json.loads(line) for line in lines if line]


def line(content: dict[str, Any]) -> bytes:
    """Return an object as a line."""
    return json.dumps(content, separators=(",", ":")).encode() + b"\n"
