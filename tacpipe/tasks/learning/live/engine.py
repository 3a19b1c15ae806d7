"""Convert the blocks of a live session to answers of a model, one per row.

The engine computes an answer as soon as all samples that arrived by then have been decoded. A task adds the message.
"""

from __future__ import annotations

import json
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tacpipe.io import Json
from tacpipe.live.decoding import Decoder
from tacpipe.live.engine import SETTLE_NS, Engine
from tacpipe.live.messages import Message
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.learning.live.windows import LiveRow, LiveWindows, RestLevels

EVERY_NS = 1_000_000  # time between two checks for new samples
BEHIND = 4  # maximum number of answers that are computed at once; older ones are skipped
SILENT_NS = 250_000_000  # time without a sample after which a message reports it


@dataclass(frozen=True)
class MeasuredRest:
    """The levels at rest, with which another process can continue the recording."""

    by_stream: Mapping[str, list[float]]

    def to_json(self) -> Json:
        """Return the levels by stream."""
        return {"rest": dict(self.by_stream)}


class WindowEngine(Engine):
    """A live session with a model that answers windows."""

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        open_windows: Callable[[RestLevels], LiveWindows],
        *,
        settle_ns: int = SETTLE_NS,
    ) -> None:
        """Start without samples; ``open_windows`` returns windows that know some levels at rest."""
        super().__init__(sensors, settle_ns)
        self._open_windows = open_windows
        self._late = 0  # late samples of earlier windows
        self._rest: RestLevels = {}
        self._decoders: dict[str, Decoder] = {}
        self._heard_ns: int | None = None  # monotonic time of the latest message
        self._why = ""
        self.windows = open_windows({})

    @property
    def late(self) -> int:
        """Number of samples so far that arrived after the answer for their time."""
        return self._late + self.windows.late

    @property
    def beginning(self) -> MeasuredRest | None:
        """The levels at rest; None until all are measured."""
        levels = {name: so_far.rest for name, so_far in self.windows.by_stream.items()}
        measured = {name: level.tolist() for name, level in levels.items() if level is not None}
        return MeasuredRest(measured) if len(measured) == len(levels) else None

    def continue_recording(self, beginning: str) -> None:
        """Take the levels at rest of a process that ended."""
        self._rest = json.loads(beginning)["rest"]

    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording."""
        self._decoders = {}
        self._restart(self._rest)
        self._rest = {}
        self._heard_ns = None

    def overflow(self) -> None:
        """Continue without the rows so far, because blocks were dropped."""
        super().overflow()
        if self.running:
            levels = self.beginning
            self._restart(levels.by_stream if levels is not None else {})
            self._why = "blocks were dropped under overload"

    def begin_stream(self, stream: str) -> None:
        """Decode a stream from the start of the recording."""
        if stream in self.windows.streams:
            self._decoders[stream] = Decoder(self.sensors[stream])

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream; lost bytes are reported to its decoder."""
        super().take_note(stream, note)
        if note.what == LOST and stream in self._decoders:
            self._decoders[stream].take(note)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream that is read."""
        if stream in self._decoders:
            self._decoders[stream].take(chunks)

    def due_ns(self, now_ns: int) -> int:
        """Return when `step` must be called next."""
        return now_ns + EVERY_NS

    def step(self, now_ns: int) -> Sequence[Message]:
        """Return the message of each row whose time has come."""
        if self._offset_ns is None:
            return []
        began_s = time.perf_counter()
        for name, decoder in self._decoders.items():
            for batch in decoder.batches():
                self.push(name, decoder.columns(batch, self._offset_ns))
        rows = self.windows.rows(now_ns + self._offset_ns - self.settle_ns)
        self.skipped += max(0, len(rows) - BEHIND)
        messages = [self._message(row) for row in rows[-BEHIND:]]
        if not messages:
            return self._silence(now_ns)
        self._heard_ns = now_ns
        for message in messages:
            message.skipped, message.late = self.skipped, self.late
            message.compute_ms = (time.perf_counter() - began_s) * 1e3 / len(messages)
        return messages

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        self.windows.push(stream, samples)

    @abstractmethod
    def answer(self, row: LiveRow) -> Message:
        """Return the message with the answer to the full windows of a row."""

    @abstractmethod
    def no_answer(self, t_ns: int, cause: str) -> Message:
        """Return a message without an answer."""

    def _message(self, row: LiveRow) -> Message:
        """Return the message for a row, with a cause if a window is not full."""
        if row.windows is None:
            return self.no_answer(row.t_ns, self._why or f"the window of {', '.join(row.missing)} is being filled")
        self._why = ""
        return self.answer(row)

    def _restart(self, rest: RestLevels) -> None:
        """Discard all rows; ``rest`` are known levels at rest by stream, others are measured again."""
        self._late += self.windows.late
        self.windows = self._open_windows(rest)
        self._why = ""

    def _silence(self, now_ns: int) -> list[Message]:
        """Return a message without an answer if there was no row for too long, else nothing."""
        assert self._offset_ns is not None
        if self._heard_ns is None:
            self._heard_ns = now_ns
        if now_ns - self._heard_ns < SILENT_NS:
            return []
        self._heard_ns = now_ns
        message = self.no_answer(now_ns + self._offset_ns, f"no sample comes from {self.windows.master}")
        message.skipped, message.late = self.skipped, self.late
        return [message]
