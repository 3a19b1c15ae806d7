"""Connect the recording process with the model's process.

The threads that read the links call `RecorderTap.put`, which never waits and never raises. Blocks that the socket does
not accept immediately wait in a bounded queue. When it is full, the whole queue is dropped and counted, and the model's
process is notified. The recording loses nothing.

Blocks are sent one way, in the format of a spool; JSON lines are sent back.
"""

from __future__ import annotations

import json
import socket
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import TypedDict

from tacpipe.errors import TacpipeError
from tacpipe.io import Json
from tacpipe.recording import clock, spool
from tacpipe.recording.spool import CHUNKS, HEAD, MARK, NOTE, WHOLE, StreamNote
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks

CLOCK = "clock"  # note on all streams: offset in ns from the monotonic clock to the recording's UTC
BEGIN = "begin"  # start of a recording; the data of each stream follow its own note
CONTINUE = "continue"  # precedes BEGIN: the state from which a new process continues
END = "end"  # end of a recording
OVERFLOW = "overflow"  # blocks were dropped because the model's process did not read them
STOP = "stop"  # end of the session
QUEUED_BYTES = 8 << 20  # maximum size of the queue, enough for many seconds of a rig


def pack_block(stream: int | None, content: Chunks | StreamNote) -> bytes:
    """Return an encoded block; ``stream`` is the number of its stream, or None for a note on all streams."""
    if isinstance(content, Chunks):
        body = content.t_ns.astype("<i8").tobytes() + content.size.astype("<u4").tobytes() + content.data
        return spool.pack_block(CHUNKS, 0 if stream is None else stream, len(content.size), body)
    note = json.dumps({"t_ns": content.t_ns, "what": content.what, "detail": content.detail}).encode()
    return spool.pack_block(NOTE, WHOLE if stream is None else stream, 0, note)


class Blocks:
    """Splits received bytes into blocks."""

    def __init__(self, streams: Sequence[str]) -> None:
        self._streams = list(streams)
        self._text = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[str, Chunks | StreamNote]]:
        """Yield each complete block with the name of its stream, which is empty for a note on all streams.

        Raises `TacpipeError` for invalid bytes, which come from a process of another version.
        """
        self._text += data
        offset = 0
        while offset + HEAD.size <= len(self._text):
            magic, _, kind, stream_index, _, count, size = HEAD.unpack_from(self._text, offset)
            if magic != MARK:
                raise TacpipeError(
                    "The recording process sent invalid data. Check that both run the same version of tacpipe."
                )
            stop = offset + HEAD.size + size
            if stop > len(self._text):
                break
            stream = "" if stream_index == WHOLE else self._streams[stream_index]
            content = spool.unpack_block(kind, stream, count, bytes(self._text[offset + HEAD.size : stop]))
            offset = stop
            if content is not None:
                yield stream, content
        del self._text[:offset]


class LatencyFigures(TypedDict):
    """The latencies of a session's answers."""

    count: int
    p50_ms: float
    p99_ms: float
    max_ms: float


class SessionFigures(TypedDict, total=False):
    """The state of a session as reported by the model's process and completed by the recording process."""

    kind: str
    answers: str  # plural noun for answers of the model
    forecasts: int
    skipped: int
    late: int
    overflows: int
    dropped: int
    cause: str
    states: dict[str, str]
    cpu_s: float
    latency: LatencyFigures
    above_10_ms: int
    above_20_ms: int
    restarts: int


class ModelLine(TypedDict, total=False):
    """A line from the model's process: its readiness, a rejection, a report, or the start of a recording."""

    ready: bool
    refused: str
    exit_code: int
    report: SessionFigures
    beginning: Json  # state of `tacpipe.live.engine.Engine.beginning`
    offset_ns: int | None


class LineCutter:
    """Splits received bytes into JSON objects, one per line."""

    def __init__(self) -> None:
        self._text = b""

    def feed(self, data: bytes) -> list[ModelLine]:
        """Return the objects that are now complete."""
        *lines, self._text = (self._text + data).split(b"\n")
        return [json.loads(line) for line in lines if line]


def line(content: ModelLine) -> bytes:
    """Return an object as one line."""
    return json.dumps(content, separators=(",", ":")).encode() + b"\n"


class RecorderTap:
    """The recorder's side of the connection to the model's process, which can be replaced while in use."""

    def __init__(self, streams: Sequence[str], max_bytes: int = QUEUED_BYTES) -> None:
        self.overflows = 0  # number of times that the queue was dropped
        self.bytes_lost = 0
        self._numbers: Mapping[str, int] = {name: number for number, name in enumerate(streams)}
        self._most_bytes = max_bytes
        self._keeping = threading.Lock()
        self._connection: socket.socket | None = None
        self._waiting: deque[memoryview] = deque()
        self._waiting_bytes = 0

    def connect(self, connection: socket.socket | None, *first: StreamNote) -> None:
        """Send later blocks over this socket, starting with ``first``; with None, send nothing until the next call."""
        with self._keeping:
            self._waiting.clear()
            self._waiting_bytes = 0
            self._connection = connection
            if connection is not None:
                connection.setblocking(False)
            for note in first:
                self._append(pack_block(None, note))

    def put(self, stream: str, content: Chunks | StreamNote) -> None:
        """Send a block of a stream, or a note on it. Thread-safe."""
        with self._keeping:
            if self._connection is not None:
                self._append(pack_block(self._numbers[stream], content))

    def note(self, note: StreamNote) -> None:
        """Send a note on all streams."""
        with self._keeping:
            if self._connection is not None:
                self._append(pack_block(None, note))

    def put_begins(self) -> None:
        """Send the note that each stream begins, for a process started during a recording."""
        for stream in self._numbers:
            self.put(stream, StreamNote(clock.now_ns(), stream, BEGAN))

    def flush(self) -> None:
        """Send queued blocks as far as the socket accepts them."""
        with self._keeping:
            self._send()

    def _append(self, data: bytes) -> None:
        """Queue data, after dropping the queue if it is too long, and send what the socket accepts."""
        if self._waiting_bytes + len(data) > self._most_bytes:
            self._drop_queue()
        self._waiting.append(memoryview(data))
        self._waiting_bytes += len(data)
        self._send()

    def _drop_queue(self) -> None:
        """Drop the queue, except the rest of a partially sent block."""
        is_partly_sent = len(self._waiting) > 0 and self._waiting[0].nbytes < len(self._waiting[0].obj)  # type: ignore[arg-type]
        retained = [self._waiting[0]] if is_partly_sent else []
        self.overflows += 1
        self.bytes_lost += self._waiting_bytes - sum(part.nbytes for part in retained)
        note = memoryview(pack_block(None, StreamNote(clock.now_ns(), "", OVERFLOW)))
        self._waiting = deque([*retained, note])
        self._waiting_bytes = sum(part.nbytes for part in self._waiting)

    def _send(self) -> None:
        """Send queued data until the socket accepts no more."""
        while self._waiting and self._connection is not None:
            try:
                sent = self._connection.send(self._waiting[0])
            except (BlockingIOError, InterruptedError):
                return
            except OSError:  # the process has ended; the supervisor connects the next one
                self._connection = None
                return
            self._waiting_bytes -= sent
            if sent == self._waiting[0].nbytes:
                self._waiting.popleft()
            else:
                self._waiting[0] = self._waiting[0][sent:]
