"""The slides of a recording or of a session so far, and their final predictions for `tacpipe predict --causal`.

A recording contains one slide, as for `tacpipe segment slides`, or, with a pause, several successive ones. The last
prediction of a slide, from all of its samples, is final.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.channels.streams import EVENTS, finger_stream
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.errors import TacpipeError
from tacpipe.io import Json
from tacpipe.live.decoding import BatchColumns
from tacpipe.live.stages import streams_as_recorded
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.sensors.live import LATENCY
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.live.messages import MATERIAL, MIN_SEEN
from tacpipe.tasks.material.live.slide import Answer, SlideSoFar, slide_params
from tacpipe.tasks.material.predictions import PREDICTIONS

if TYPE_CHECKING:
    Tables = Mapping[str, pa.Table]

GAP_NS = 50_000_000  # age of the finger's newest sample above which its stream counts as silent
MAX_DURATION_NS = 120_000_000_000  # maximum duration of a recording, whose rows are in memory until it ends
MOMENT_NS = 100_000_000  # interval between checks whether a slide has ended, starting at the finger's first sample


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
        self,
        slide: SlideSoFar,
        streams: Collection[str],
        finger: str,
        pause_ns: int,
        beginning: Json | None = None,
    ) -> None:
        """Start without samples. If ``pause_ns`` is 0, the recording is one slide.

        A ``beginning`` is that of a recording whose earlier samples are lost, so that no material can be predicted.
        """
        self.streams, self.master, self.late = streams, finger, dict.fromkeys(streams, 0)
        self._slide = slide
        self._pause_ns = pause_ns
        self._moments = 0  # number of checks whether the current slide has ended
        self._number = 1 if beginning is None else int(beginning["slide"])
        self._is_incomplete = beginning is not None
        self._is_long = False
        self._tables: dict[str, pa.Table] = {}
        self._read_ns = 0  # end of the samples that were read

    @property
    def beginning(self) -> Json:
        """The number of the slide; the samples are lost for other rows."""
        return {"slide": self._number}

    def push(self, stream: str, samples: pa.Table | BatchColumns) -> None:
        """Add samples of a stream in the order of arrival."""
        if self._is_incomplete or self._is_long or not samples.num_rows:
            return
        table = samples.table() if isinstance(samples, BatchColumns) else samples
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
        while not self._is_long and (end_ns := self._slide_end_ns(until_ns)) is not None:
            rows.append(self._row(end_ns, is_final=True))
            self._tables = rows_after(self._tables, end_ns)
            self._number += 1
            self._moments = 0
        return rows

    def _slide_end_ns(self, until_ns: int) -> int | None:
        """Return the time at which the current slide ended, or None if it has not ended by ``until_ns``."""
        if not self._pause_ns or self.master not in self._tables:
            return None
        first_ns = int(self._tables[self.master].column("t_ns")[0].as_py())
        while (at_ns := first_ns + (self._moments + 1) * MOMENT_NS) <= until_ns:
            self._moments += 1
            if self._slide.is_over(rows_until(self._tables, at_ns), self.master, self._pause_ns):
                return at_ns
        return None

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


def rows_until(tables: Tables, t_ns: int) -> dict[str, pa.Table]:
    """Return the rows of each stream up to a time; empty streams are omitted."""
    return {name: tables[name].slice(0, count) for name, count in _counts(tables, t_ns).items() if count}


def rows_after(tables: Tables, t_ns: int) -> dict[str, pa.Table]:
    """Return the rows of each stream after a time; empty streams are omitted."""
    counts = _counts(tables, t_ns)
    return {name: tables[name].slice(count) for name, count in counts.items() if count < tables[name].num_rows}


def _counts(tables: Tables, t_ns: int) -> dict[str, int]:
    """Return the number of rows of each stream up to a time."""
    return {
        name: int(np.searchsorted(table.column("t_ns").to_numpy(), t_ns, "right")) for name, table in tables.items()
    }


PAUSE_ATTR, LEAST_ATTR = "live_pause_s", "live_least"  # attributes with the settings of a session's recording
UNREAD_STREAMS = (MATERIAL, LATENCY, EVENTS, "truth")  # streams that sessions do not read
Row = tuple[str, int, int, Answer]  # recording, index of the slide, end of the samples that were read, prediction


def predict(model: Model, recordings: Dataset) -> Result:
    """Return one table, ``predictions``, with one row per slide: index, end, rows, material, cause and probabilities.

    ``recordings`` are raw. A recording is one slide or, if its session had a pause (attribute ``live_pause_s``),
    several successive ones. Raises `TacpipeError` with the name of a recording that does not fit the model.
    """
    classifier = Classifier.load(model.files)
    params = slide_params(model.source.chain)
    rows: list[Row] = []
    for name, recording in sorted(recordings.recordings.items()):
        try:
            rows += _slides(classifier, params, recording)
        except TacpipeError as error:
            raise type(error)(f"{name}: {error}") from error
    return Result({PREDICTIONS: RecordingOutput(_table(classifier.names, rows))})


def _slides(classifier: Classifier, params: Any, recording: Recording) -> list[Row]:
    """Return the rows of a recording's slides, as a session with its settings predicted them.

    Raises `TacpipeError` if its streams do not fit the model.
    """
    tables = {name: table for name, table in streams_as_recorded(recording).items() if name not in UNREAD_STREAMS}
    attributes = recording.attributes
    finger = finger_stream(recording.name, tables)
    stream = next(name for name, table in tables.items() if table is finger)
    sensor = str(
        attributes["sensor"] if attributes.get("sensor") in classifier.layouts else next(iter(classifier.layouts))
    )
    rate_hz = attributes.get("rate_hz")
    least_seen = float(attributes.get(LEAST_ATTR) or MIN_SEEN)
    slide = SlideSoFar(classifier, params, sensor, least_seen, float(rate_hz) if rate_hz else None)
    pause_ns = round(float(attributes.get(PAUSE_ATTR) or 0.0) * 1e9)
    slides = SlidesSoFar(slide, tuple(tables), stream, pause_ns)
    for name, table in tables.items():
        slides.push(name, table)
    return [(recording.name, row.slide, row.t_ns, row.answer) for row in slides.advance(None)]


def _table(names: tuple[str, ...], rows: list[Row]) -> pa.Table:
    """Return the table of predictions, with a probability of each class in ``names``; "unknown" without a prediction."""
    answers = [answer for *_, answer in rows]
    probabilities = np.array(
        [np.full(len(names), np.nan) if answer.probabilities is None else answer.probabilities for answer in answers],
        np.float32,
    ).reshape(len(rows), len(names))
    metadata = {"quantity": "prediction"}
    materials = [
        "unknown" if answer.probabilities is None else names[int(answer.probabilities.argmax())] for answer in answers
    ]
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), [row[0] for row in rows]),
        (pa.field("slide", pa.int32()), [row[1] for row in rows]),
        (pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}), [row[2] for row in rows]),
        (pa.field("rows", pa.int32()), [answer.rows for answer in answers]),
        (pa.field("material", pa.string(), metadata=metadata), materials),
        (pa.field("cause", pa.string()), [answer.cause for answer in answers]),
        *(
            (
                pa.field(f"probability_{name}", pa.float32(), metadata={"quantity": "probability"}),
                probabilities[:, number],
            )
            for number, name in enumerate(names)
        ),
    ]
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))
