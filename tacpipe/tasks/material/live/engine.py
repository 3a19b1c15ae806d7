"""Convert the blocks of a live session to predictions of a material model.

The current slide is classified several times per second from all samples so far.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import ClassVar

from tacpipe.channels.streams import finger_stream
from tacpipe.live.decoding import likely_schema
from tacpipe.live.engine import SETTLE_NS
from tacpipe.live.messages import Message
from tacpipe.live.rows import RowEngine
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.material.live.messages import ENDED, FINAL, SLIDING, WAITING, MaterialDescription, MaterialMessage
from tacpipe.tasks.material.live.slide import SlideSoFar
from tacpipe.tasks.material.live.slides import SlideRow, SlidesSoFar

IDLE_NS = 20_000_000


class MaterialEngine(RowEngine[SlidesSoFar]):
    """A live session with a material model."""

    most_rows: ClassVar[int] = 1 << 30  # each slide has its final answer

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        finger: str,
        slide: SlideSoFar,
        description: MaterialDescription,
        *,
        every_ns: int,
        settle_ns: int = SETTLE_NS,
        pause_ns: int = 0,
    ) -> None:
        """Store the sensors and settings. If ``pause_ns`` is 0, a recording is one slide."""
        super().__init__(
            sensors,
            lambda beginning: SlidesSoFar(slide, tuple(sensors), finger, pause_ns, beginning),
            settle_ns=settle_ns,
        )
        self.every_ns = every_ns
        self._description = description
        self._ended_streams: set[str] = set()  # streams without further data for the recording
        self._due_ns: int | None = None

    def describe(self, model: str) -> MaterialDescription:
        """Return the description of the session's messages."""
        return self._description

    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording."""
        super().begin_recording(offset_ns)
        self._due_ns, self._ended_streams = None, set()

    def end_recording(self) -> None:
        """Wait for the ends of its streams; a recording ends with the last of them."""

    def end_stream(self, stream: str) -> None:
        """Mark a stream as ended for the recording."""
        self._ended_streams.add(stream)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream that has not ended; those after its end are not in the recording."""
        if stream not in self._ended_streams:
            super().take_chunks(stream, chunks)

    def due_ns(self, now_ns: int) -> int:
        """Return the monotonic time of the next call of `step`."""
        if self._due_ns is None or self._ended_streams:
            return now_ns + IDLE_NS
        return max(self._due_ns, now_ns + IDLE_NS // 20)

    def step(self, now_ns: int) -> Sequence[Message]:
        """Return the final messages of ended slides, followed by the message that is due."""
        if self._ended_streams and self.running:
            return self.finish() if self._ended_streams >= set(self.sensors) else []
        if not self.running or (self._due_ns is not None and now_ns < self._due_ns):
            return []
        if self._due_ns is not None:
            self.skipped += (now_ns - self._due_ns) // self.every_ns
        self._due_ns = now_ns + self.every_ns
        return super().step(now_ns)

    def finish(self) -> Sequence[Message]:
        """Return the remaining final messages of the ended recording."""
        if self._offset_ns is None:
            return []
        for name, decoder in self._decoders.items():
            for batch in decoder.last():
                self.rows.push(name, decoder.columns(batch, self._offset_ns))
        messages = self._messages(self.rows.advance(None), time.perf_counter())
        self._offset_ns = None
        return messages

    def message(self, row: SlideRow) -> MaterialMessage:
        """Return the message for the slide's samples up to a time."""
        answer = row.answer
        state = SLIDING if answer.rows else WAITING
        if answer.is_over:
            state = ENDED
        if row.is_final:
            state = FINAL
        return MaterialMessage(
            self.next_seq(),
            row.t_ns,
            self._description.channels,
            answer.probabilities,
            state,
            answer.rows,
            answer.fraction,
            cause=answer.cause or ("" if answer.probabilities is not None else self._why),
            made_from_t_ns=row.newest_ns,
            slide=row.slide,
        )

    def no_answer(self, t_ns: int, cause: str) -> MaterialMessage:
        """Return a message without a material."""
        return MaterialMessage(self.next_seq(), t_ns, self._description.channels, None, cause=cause)

    def published(self, message: Message, now_ns: int) -> None:
        """Write the latency into a message before publication, also if it has no prediction."""
        if self._offset_ns is not None and message.made_from_t_ns:
            message.latency_ms = (now_ns + self._offset_ns - message.made_from_t_ns) / 1e6


def find_finger(sensors: Mapping[str, Sensor]) -> str:
    """Return the stream with tactile channels. Raises `TacpipeError` if there is not exactly one."""
    schemas = {name: likely_schema(sensor) for name, sensor in sensors.items()}
    tables = {name: schema.empty_table() for name, schema in schemas.items()}
    finger_table = finger_stream("of this rig", tables)
    return next(name for name, table in tables.items() if table is finger_table)
