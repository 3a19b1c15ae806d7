"""Convert the blocks of a live session to predictions of a material model.

A recording contains one slide, as for `tacpipe segment slides`, or, with a pause, several successive ones
(`split_slides`). The current slide is classified several times per second from all samples so far. The last prediction
of a slide, from all of its samples, is final.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from typing import ClassVar, NamedTuple

import pyarrow as pa

from tacpipe.channels.streams import finger_stream
from tacpipe.io import Json
from tacpipe.live.decoding import BatchColumns, likely_schema
from tacpipe.live.engine import SETTLE_NS
from tacpipe.live.messages import Message
from tacpipe.live.rows import RowEngine
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.material.live.messages import ENDED, FINAL, SLIDING, WAITING, MaterialDescription, MaterialMessage
from tacpipe.tasks.material.live.slide import Answer, SlideSoFar, SlideSplitter, rows_after, rows_until

GAP_NS = 50_000_000  # age of the finger's newest sample above which its stream counts as silent
MAX_DURATION_NS = 120_000_000_000  # maximum duration of a recording, whose rows are in memory until it ends
IDLE_NS = 20_000_000


class SlideRow(NamedTuple):
    """The prediction for a slide at a time."""

    t_ns: int  # time up to which samples were read
    answer: Answer
    slide: int  # number of the slide in its recording, from 1
    newest_ns: int  # arrival of the newest sample that was read; 0: there is none
    is_final: bool


class SlidesSoFar:
    """The slides of a recording so far, each with a row whenever it is asked for and a final one."""

    def __init__(
        self, slide: SlideSoFar, streams: Collection[str], finger: str, pause_ns: int, beginning: Json | None
    ) -> None:
        """Start without samples. If ``pause_ns`` is 0, the recording is one slide.

        A ``beginning`` is that of a recording whose earlier samples are lost, so that no material can be predicted.
        """
        self.streams, self.master, self.late = streams, finger, dict.fromkeys(streams, 0)
        self._slide = slide
        self._splitter = SlideSplitter(slide, finger, pause_ns) if pause_ns else None
        self._number = 1 if beginning is None else int(beginning["slide"])
        self._is_incomplete = beginning is not None
        self._is_long = False
        self._tables: dict[str, pa.Table] = {}
        self._read_ns = 0  # end of the samples that were read

    @property
    def beginning(self) -> Json:
        """The number of the slide; the samples are lost for other rows."""
        return {"slide": self._number}

    def push(self, stream: str, samples: BatchColumns) -> None:
        """Add samples of a stream in the order of arrival."""
        if self._is_incomplete or self._is_long:
            return
        table = samples.table()
        self.late[stream] += int((table.column("t_ns").to_numpy() <= self._read_ns).sum())
        stored = [self._tables[stream]] if stream in self._tables else []
        self._tables[stream] = pa.concat_tables([*stored, table]).combine_chunks()

    def take_over(self, previous: SlidesSoFar) -> None:
        """Take nothing: the samples of earlier rows have a gap."""

    def advance(self, until_ns: int | None) -> list[SlideRow]:
        """Return the final rows of slides that ended by a time, and the row of the current slide.

        None is the end of the recording, where that row is final as well.
        """
        last_ns = (table.column("t_ns")[-1].as_py() for table in self._tables.values())
        end_ns = int(max(last_ns, default=self._read_ns)) if until_ns is None else until_ns
        rows = self._end_slides(end_ns)
        if not rows or self.master in self._tables:  # otherwise the next slide has no samples yet
            rows.append(self._row(end_ns, is_final=until_ns is None))
        return rows

    def _end_slides(self, until_ns: int) -> list[SlideRow]:
        """Return the final rows of slides that ended by a time, and discard their samples."""
        rows: list[SlideRow] = []
        while self._splitter is not None and not self._is_long:
            end_ns = self._splitter.end_ns(self._tables, until_ns)
            if end_ns is None:
                break
            rows.append(self._row(end_ns, is_final=True))
            self._tables = rows_after(self._tables, end_ns)
            self._number += 1
            self._splitter.begin()
        return rows

    def _row(self, until_ns: int, *, is_final: bool) -> SlideRow:
        """Return the row of the current slide from its samples up to a time."""
        streams = rows_until(self._tables, until_ns)
        newest_ns = {name: int(table.column("t_ns")[-1].as_py()) for name, table in streams.items()}
        silent_ns = 0 if is_final else until_ns - newest_ns.get(self.master, until_ns)
        answer = self._answer(streams, silent_ns)
        self._read_ns = max(self._read_ns, until_ns)
        return SlideRow(until_ns, answer, self._number, max(newest_ns.values(), default=0), is_final)

    def _answer(self, streams: Mapping[str, pa.Table], silent_ns: int) -> Answer:
        """Return the prediction for streams, or why there is none; the finger has been silent for ``silent_ns``."""
        if self._is_incomplete:
            return Answer(None)
        if self.master not in streams:
            return Answer(None, cause=f"nothing comes from {self.master}")
        if silent_ns > GAP_NS:
            return Answer(None, cause=f"nothing new comes from {self.master}")
        t_ns = streams[self.master].column("t_ns")
        self._is_long = self._is_long or t_ns[-1].as_py() - t_ns[0].as_py() > MAX_DURATION_NS
        if self._is_long:
            longest_s = MAX_DURATION_NS / 1e9
            cause = f"the recording is longer than {longest_s:g} s; begin another one for the next slide"
            return Answer(None, cause=cause)
        return self._slide.answer(streams)


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
