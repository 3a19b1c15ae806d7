"""Convert the blocks of a live session to predictions of a material model.

A recording contains one slide, as for `tacpipe segment slides`, or, with a pause, several successive ones
(`split_slides`). The current slide is classified several times per second from all samples so far. The last prediction
of a slide, from all of its samples, is final.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import pyarrow as pa

from tacpipe.channels.streams import finger_stream
from tacpipe.io import Json
from tacpipe.live.decoding import Decoder, likely_schema
from tacpipe.live.engine import SETTLE_NS, Engine
from tacpipe.live.messages import Message
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, OVER
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.material.live.messages import ENDED, FINAL, SLIDING, WAITING, MaterialDescription, MaterialMessage
from tacpipe.tasks.material.live.slide import Answer, SlideSoFar, SlideSplitter, rows_after, rows_until

GAP_NS = 50_000_000  # age of the finger's newest sample above which its stream counts as silent
MAX_DURATION_NS = 120_000_000_000  # maximum duration of a recording, whose rows are in memory until it ends
IDLE_NS = 20_000_000
RESTARTED = "the model's process was started anew, and lacks what came before"
THROWN = "blocks were thrown away under overload"


@dataclass(frozen=True)
class RunningRecording:
    """Indicates a running recording to a process that replaces another one and lacks the earlier samples."""

    def to_json(self) -> Json:
        """Return an empty object, because there is nothing else to store."""
        return {}


class MaterialEngine(Engine):
    """A live session with a material model."""

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
        super().__init__(sensors, settle_ns)
        self._splitter = SlideSplitter(slide, finger, pause_ns) if pause_ns else None
        self._number = 1  # index of the slide in its recording
        self.every_ns = every_ns
        self._late = 0
        self._finger, self._slide, self._description = finger, slide, description
        self._stop_reason = ""  # reason why this recording gets no more predictions
        self._continues = False
        self._decoders: dict[str, Decoder] = {}
        self._tables: dict[str, pa.Table] = {}
        self._ended_streams: set[str] = set()  # streams without further data for the recording
        self._due_ns: int | None = None
        self._read_ns = 0  # end of the samples that were read

    @property
    def late(self) -> int:
        """Number of samples so far that arrived after the prediction for their time."""
        return self._late

    @property
    def beginning(self) -> RunningRecording | None:
        """Marker of a running recording; None if none is running."""
        return RunningRecording() if self.running else None

    def describe(self, model: str) -> MaterialDescription:
        """Return the description of the session's messages."""
        return self._description

    def continue_recording(self, beginning: str) -> None:
        """Mark the next recording as lacking its first samples."""
        self._continues = True

    def begin_recording(self, offset_ns: int) -> None:
        """Start a recording whose clock is ``offset_ns`` ahead of the monotonic one, and discard what came before."""
        self._stop_reason, self._continues = RESTARTED if self._continues else "", False
        self._due_ns, self._read_ns = None, 0
        self._decoders, self._tables, self._ended_streams = {}, {}, set()
        self._number = 1
        if self._splitter is not None:
            self._splitter.begin()

    def end_recording(self) -> None:
        """Wait for the ends of its streams; a recording ends with the last of them."""

    def overflow(self) -> None:
        """Stop predictions for this recording, because blocks are missing."""
        super().overflow()
        self._stop_reason = THROWN

    def begin_stream(self, stream: str) -> None:
        """Decode a stream from the start of the recording."""
        self._decoders[stream] = Decoder(self.sensors[stream])

    def end_stream(self, stream: str) -> None:
        """Mark a stream as ended for the recording."""
        self._ended_streams.add(stream)

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream; lost bytes are reported to its decoder."""
        super().take_note(stream, note)
        if note.what not in (BEGAN, OVER):
            self._keep(stream, note)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream that has not ended."""
        self._keep(stream, chunks)

    def _keep(self, stream: str, block: Chunks | StreamNote) -> None:
        if stream in self._decoders and stream not in self._ended_streams:
            self._decoders[stream].take(block)

    def due_ns(self, now_ns: int) -> int:
        """Return the monotonic time of the next call of `step`."""
        if self._due_ns is None or self._ended_streams:
            return now_ns + IDLE_NS
        return max(self._due_ns, now_ns + IDLE_NS // 20)

    def step(self, now_ns: int) -> list[MaterialMessage]:
        """Return the final messages of ended slides, followed by the message that is due."""
        if self._offset_ns is None:
            return []
        if self._ended_streams:
            return self.finish() if self._ended_streams >= set(self.sensors) else []
        if self._due_ns is not None and now_ns < self._due_ns:
            return []
        if self._due_ns is not None:
            self.skipped += (now_ns - self._due_ns) // self.every_ns
        self._due_ns = now_ns + self.every_ns
        return self._build_messages(now_ns + self._offset_ns - self.settle_ns, final=False)

    def finish(self) -> list[MaterialMessage]:
        """Return the remaining final messages of the ended recording."""
        if self._offset_ns is None:
            return []
        messages = self._build_messages(0, final=True)
        self._offset_ns = None
        return messages

    def published(self, message: Message, now_ns: int) -> None:
        """Write the latency into a message before publication, also if it has no prediction."""
        if self._offset_ns is not None and message.made_from_t_ns:
            message.latency_ms = (now_ns + self._offset_ns - message.made_from_t_ns) / 1e6

    def _build_messages(self, until_ns: int, *, final: bool) -> list[MaterialMessage]:
        """Return the messages for all samples up to a time; a recording's final message uses all samples."""
        began_s = time.perf_counter()
        self._fetch(final=final)
        end_ns = until_ns
        if final:
            last_ns = (table.column("t_ns")[-1].as_py() for table in self._tables.values())
            end_ns = int(max(last_ns, default=self._read_ns))
        messages = self._end_slides(end_ns)
        if not messages or self._finger in self._tables:  # otherwise the next slide has no samples yet
            messages.append(self._build_message(end_ns, final=final))
        messages[-1].compute_ms = (time.perf_counter() - began_s) * 1e3
        return messages

    def _end_slides(self, until_ns: int) -> list[MaterialMessage]:
        """Return the final messages of slides that ended by ``until_ns``, and discard their samples."""
        messages: list[MaterialMessage] = []
        while self._splitter is not None and not self._stop_reason:
            end_ns = self._splitter.end_ns(self._tables, until_ns)
            if end_ns is None:
                break
            messages.append(self._build_message(end_ns, final=True))
            self._tables = rows_after(self._tables, end_ns)
            self._number += 1
            self._splitter.begin()
        return messages

    def _build_message(self, until_ns: int, *, final: bool) -> MaterialMessage:
        """Return the message for the slide's samples up to a time."""
        streams = rows_until(self._tables, until_ns)
        newest_ns = {name: int(table.column("t_ns")[-1].as_py()) for name, table in streams.items()}
        answer = self._predict(streams, 0 if final else until_ns - newest_ns.get(self._finger, until_ns))
        self._read_ns = max(self._read_ns, until_ns)
        state = SLIDING if answer.rows else WAITING
        if answer.is_over:
            state = ENDED
        if final:
            state = FINAL
        return MaterialMessage(
            self.next_seq(),
            until_ns,
            self._description.channels,
            answer.probabilities,
            state,
            answer.rows,
            answer.fraction,
            answer.cause,
            max(newest_ns.values(), default=0),
            skipped=self.skipped,
            late=self._late,
            slide=self._number,
        )

    def _predict(self, streams: Mapping[str, pa.Table], silent_ns: int) -> Answer:
        """Return the prediction for streams, or why there is none; the finger has been silent for ``silent_ns``."""
        if self._stop_reason:
            return Answer(None, cause=self._stop_reason)
        if self._finger not in streams:
            return Answer(None, cause=f"nothing comes from {self._finger}")
        if silent_ns > GAP_NS:
            return Answer(None, cause=f"nothing new comes from {self._finger}")
        t_ns = streams[self._finger].column("t_ns")
        if t_ns[-1].as_py() - t_ns[0].as_py() > MAX_DURATION_NS:
            self._stop_reason = (
                f"the recording is longer than {MAX_DURATION_NS / 1e9:g} s; begin another one for the next slide"
            )
            return Answer(None, cause=self._stop_reason)
        return self._slide.answer(streams)

    def _fetch(self, *, final: bool) -> None:
        """Append new samples to the stored tables, unless no prediction is possible, and count late ones."""
        assert self._offset_ns is not None
        for name, decoder in self._decoders.items():
            batches = decoder.last() if final else decoder.batches()
            new_tables = [decoder.columns(batch, self._offset_ns).table() for batch in batches]
            if not new_tables or self._stop_reason:
                continue
            self._late += sum(int((table.column("t_ns").to_numpy() <= self._read_ns).sum()) for table in new_tables)
            stored = [self._tables[name]] if name in self._tables else []
            self._tables[name] = pa.concat_tables([*stored, *new_tables]).combine_chunks()


def find_finger(sensors: Mapping[str, Sensor]) -> str:
    """Return the stream with tactile channels. Raises `TacpipeError` if there is not exactly one."""
    schemas = {name: likely_schema(sensor) for name, sensor in sensors.items()}
    tables = {name: schema.empty_table() for name, schema in schemas.items()}
    finger_table = finger_stream("of this rig", tables)
    return next(name for name, table in tables.items() if table is finger_table)
