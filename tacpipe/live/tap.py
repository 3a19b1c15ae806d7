"""What hands the bytes of the links on to the model's process, while they are recorded: it never waits and never raises.

The threads that read the links call `put`. What the socket does not take at once waits in a queue of bounded size; when
that is full, all of it is thrown away and counted, and the model's process is informed. The recording is not touched by it.
"""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Mapping, Sequence

from tacpipe.live import wire
from tacpipe.recording import clock
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks

MOST_BYTES = 8 << 20  # that wait for the model's process: some seconds of the first paper's rig, many times over


class Tap:
    """The recorder's side of the connection to the model's process, which may be replaced while it is in use."""

    def __init__(self, streams: Sequence[str], most_bytes: int = MOST_BYTES) -> None:
        self.overflows = 0  # how often the queue was thrown away
        self.bytes_lost = 0
        self._numbers: Mapping[str, int] = {name: number for number, name in enumerate(streams)}
        self._most_bytes = most_bytes
        self._keeping = threading.Lock()
        self._connection: socket.socket | None = None
        self._waiting: deque[memoryview] = deque()
        self._waiting_bytes = 0

    def connect(self, connection: socket.socket | None, *first: Note) -> None:
        """Send what comes from now on over a socket, ``first`` before it; None: send nothing until the next call."""
        with self._keeping:
            self._waiting.clear()
            self._waiting_bytes = 0
            self._connection = connection
            if connection is not None:
                connection.setblocking(False)
            for note in first:
                self._put(wire.block(None, note))

    def put(self, stream: str, content: Chunks | Note) -> None:
        """Send what came of a stream, or a note on it; thread-safe."""
        with self._keeping:
            if self._connection is not None:
                self._put(wire.block(self._numbers[stream], content))

    def note(self, note: Note) -> None:
        """Send a note on all streams."""
        with self._keeping:
            if self._connection is not None:
                self._put(wire.block(None, note))

    def begun(self) -> None:
        """Send what a recording begins with for each stream, to a process that is started in the middle of one."""
        for stream in self._numbers:
            self.put(stream, Note(clock.now_ns(), stream, BEGAN))

    def flush(self) -> None:
        """Send what waits, as far as it is taken."""
        with self._keeping:
            self._send()

    def _put(self, data: bytes) -> None:
        if self._waiting_bytes + len(data) > self._most_bytes:
            self._overflow()
        self._waiting.append(memoryview(data))
        self._waiting_bytes += len(data)
        self._send()

    def _overflow(self) -> None:
        """Throw away all but the rest of a block whose beginning was sent."""
        begun = len(self._waiting) > 0 and self._waiting[0].nbytes < len(self._waiting[0].obj)  # type: ignore[arg-type]
        kept = [self._waiting[0]] if begun else []
        self.overflows += 1
        self.bytes_lost += self._waiting_bytes - sum(one.nbytes for one in kept)
        note = memoryview(wire.block(None, Note(clock.now_ns(), "", wire.OVERFLOW)))
        self._waiting = deque([*kept, note])
        self._waiting_bytes = sum(one.nbytes for one in self._waiting)

    def _send(self) -> None:
        while self._waiting and self._connection is not None:
            try:
                sent = self._connection.send(self._waiting[0])
            except (BlockingIOError, InterruptedError):
                return
            except OSError:  # the process is gone; who watches it connects the next one
                self._connection = None
                return
            self._waiting_bytes -= sent
            if sent == self._waiting[0].nbytes:
                self._waiting.popleft()
            else:
                self._waiting[0] = self._waiting[0][sent:]
