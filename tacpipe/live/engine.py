"""The logic that live sessions of all tasks share: it receives blocks of bytes and returns messages.

An engine reads no clock and performs no input or output. `Engine.take` stores blocks, `Engine.due_ns` returns when
`Engine.step` must be called next, and `step` returns the messages that are due.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from tacpipe.io import Json
from tacpipe.live import wire
from tacpipe.live.messages import Description, Message
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, OVER
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

SETTLE_NS = 2_000_000  # duration after a row's time in which its samples may still arrive from other threads


class Engine(ABC):
    """Converts the blocks of a session's streams to messages of a model."""

    def __init__(self, sensors: Mapping[str, Sensor], settle_ns: int = SETTLE_NS) -> None:
        self.sensors = dict(sensors)
        self.settle_ns = settle_ns
        self.skipped = 0  # number of messages skipped under overload
        self.overflows = 0  # number of times that blocks were dropped
        self._offset_ns: int | None = None
        self._seq = 0  # number of the latest message

    @property
    def offset_ns(self) -> int | None:
        """The offset from the monotonic clock to the recording's UTC, or None if no recording is running."""
        return self._offset_ns

    @property
    def running(self) -> bool:
        """Whether a recording is running."""
        return self._offset_ns is not None

    @property
    def late(self) -> int:
        """Number of samples that arrived too late to be used."""
        return 0

    @property
    def states(self) -> dict[str, str]:
        """Facts on the session for its summary, such as which streams were late, by name."""
        return {}

    @property
    def beginning(self) -> Json | None:
        """The state with which another process can continue the recording, or None if there is none yet."""
        return None

    def take(self, stream: str, block: Chunks | StreamNote) -> None:
        """Process a block of a stream or a note on it or, if ``stream`` is empty, a note on all streams."""
        if isinstance(block, Chunks):
            self.take_chunks(stream, block)
        elif stream:
            self.take_note(stream, block)
        elif block.what == wire.CONTINUE:
            self.continue_recording(block.detail)
        elif block.what == wire.BEGIN:
            self._offset_ns = int(block.detail)
            self.begin_recording(self._offset_ns)
        elif block.what == wire.END:
            self.end_recording()
        elif block.what == wire.OVERFLOW:
            self.overflow()

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream: that its part of the recording begins or ends, or that bytes were lost."""
        if note.what == BEGAN:
            self.begin_stream(stream)
        elif note.what == OVER:
            self.end_stream(stream)

    def next_seq(self) -> int:
        """Return the number of the next message."""
        self._seq += 1
        return self._seq

    def published(self, message: Message, now_ns: int) -> None:
        """Write the latency into a message just before it is published."""
        if self._offset_ns is not None and message.answers:
            message.latency_ms = (now_ns + self._offset_ns - message.made_from_t_ns) / 1e6

    def finish(self) -> Sequence[Message]:
        """Return the remaining messages at the end of the session."""
        return []

    def continue_recording(self, beginning: str) -> None:
        """Restore the state, as JSON, of a process that ended; the next recording continues from it."""
        return

    def end_recording(self) -> None:
        """Handle the end of the recording."""
        self._offset_ns = None

    def end_stream(self, stream: str) -> None:
        """Handle the end of a stream's part of the recording."""
        return

    def overflow(self) -> None:
        """Handle dropped blocks."""
        self.overflows += 1

    @abstractmethod
    def describe(self, model: str) -> Description:
        """Return the description of this engine's messages; ``model`` is the model's path."""

    @abstractmethod
    def begin_recording(self, offset_ns: int) -> None:
        """Start a recording whose UTC is the monotonic clock plus ``offset_ns``."""

    @abstractmethod
    def begin_stream(self, stream: str) -> None:
        """Handle the start of a stream's part of the recording."""

    @abstractmethod
    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream."""

    @abstractmethod
    def due_ns(self, now_ns: int) -> int:
        """Return when `step` must be called next, on the monotonic clock."""

    @abstractmethod
    def step(self, now_ns: int) -> Sequence[Message]:
        """Return the messages that are due."""
