"""The logic of a live session that all tasks share: blocks of bytes in, messages out.

An engine reads no clock and does no input or output. `Engine.take` keeps blocks, `Engine.due_ns` returns when
`Engine.step` is to be called next, and `step` returns the messages that are due.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

from tacpipe.io import Json
from tacpipe.live import wire
from tacpipe.live.messages import Description, Message
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, OVER
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

SETTLE_NS = 2_000_000  # time after a moment in which samples that belong to it may still come from other threads


class Continuation(Protocol):
    """The state that a new process needs to continue the recording of the process before."""

    def to_json(self) -> Json:
        """Return it as the note `wire.CONTINUE` holds it."""


class Engine(ABC):
    """Turns the blocks of a session's streams into messages of a model."""

    def __init__(self, sensors: Mapping[str, Sensor], settle_ns: int = SETTLE_NS) -> None:
        self.sensors = dict(sensors)
        self.settle_ns = settle_ns
        self.skipped = 0  # messages so far that were left out under overload
        self.overflows = 0  # times that blocks were thrown away
        self._offset_ns: int | None = None
        self._seq = 0  # number of the last message

    @property
    def offset_ns(self) -> int | None:
        """The difference of the recording's UTC and the monotonic clock, or None if no recording runs."""
        return self._offset_ns

    @property
    def running(self) -> bool:
        """True while a recording runs."""
        return self._offset_ns is not None

    @property
    def late(self) -> int:
        """Samples so far that came too late to be read."""
        return 0

    @property
    def beginning(self) -> Continuation | None:
        """The state that another process needs to continue the recording; None while there is none."""
        return None

    def take(self, stream: str, block: Chunks | StreamNote) -> None:
        """Take a block of a stream, or a note on all streams (``stream`` is empty)."""
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
        """Take a note on a stream: that its part of the recording begins or is over, or that bytes of it were lost."""
        if note.what == BEGAN:
            self.begin_stream(stream)
        elif note.what == OVER:
            self.end_stream(stream)

    def next_seq(self) -> int:
        """Return the number of the next message."""
        self._seq += 1
        return self._seq

    def published(self, message: Message, now_ns: int) -> None:
        """Write the latency into a message that is about to be published."""
        if self._offset_ns is not None and message.answers:
            message.latency_ms = (now_ns + self._offset_ns - message.made_from_t_ns) / 1e6

    def alarm_levels(self) -> wire.AlarmsJson | None:
        """Return the levels of the alarms, or None if the task has no alarms."""
        return None

    def finish(self) -> Sequence[Message]:
        """Return the messages that are left when the session is over."""
        return []

    def continue_recording(self, beginning: str) -> None:
        """Take what `Continuation.to_json` gave, as JSON, of the process before; the next recording continues it."""
        return

    def end_recording(self) -> None:
        """Take note that the recording is over."""
        self._offset_ns = None

    def end_stream(self, stream: str) -> None:
        """Take note that nothing more of a stream belongs to the recording."""
        return

    def overflow(self) -> None:
        """Take note that blocks were thrown away."""
        self.overflows += 1

    @abstractmethod
    def describe(self, model: str) -> Description:
        """Return what the messages of this engine are, made by the model of a path."""

    @abstractmethod
    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording whose UTC is the monotonic clock plus ``offset_ns``."""

    @abstractmethod
    def begin_stream(self, stream: str) -> None:
        """Take note that what comes of a stream now belongs to the recording."""

    @abstractmethod
    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Keep bytes of a stream."""

    @abstractmethod
    def due_ns(self, now_ns: int) -> int:
        """Return when `step` is to be called next, on the monotonic clock."""

    @abstractmethod
    def step(self, now_ns: int) -> Sequence[Message]:
        """Return the messages that are due."""
