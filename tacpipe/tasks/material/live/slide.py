"""Predict the material during a slide: apply `tacpipe segment slides` and the model to the samples so far.

The prediction at any time equals that for a recording that ends there, so it uses no future samples, and at the end of
the recording it equals that of `tacpipe predict`. Only slides that are still shorter than those of training are treated
differently: models that accept slides of any length read the available rows, once there are enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Float32s
from tacpipe.channels.streams import EVENTS, finger_stream
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.errors import TacpipeError
from tacpipe.live.stages import RecordingInMemory, stage_params, streams_as_recorded
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.sensors.live import LATENCY
from tacpipe.store.records import Step
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import PREDICTIONS
from tacpipe.tasks.material.live.messages import MATERIAL, MIN_SEEN
from tacpipe.tasks.material.slides import STREAM, describe_difference

if TYPE_CHECKING:
    Tables = Mapping[str, pa.Table]

SLIDES = "segment.slides"
ENDED_NS = 200_000_000  # time without a row of the slide after which it has ended
UNLIKE = "the slide is like none of the materials that the model knows"


def slide_params(steps: Sequence[Step]) -> Any:
    """Return the params of the stage `segment slides` of a material model.

    Raises `UsageError` if that stage now has another version, `TacpipeError` if the model has other preprocessing
    stages.
    """
    names = [step["stage"] for step in steps]
    if names != [SLIDES]:
        commands = ", ".join(f"`tacpipe {name.replace('.', ' ')}`" for name in names) or "no stage"
        raise TacpipeError(
            f"The model was trained on the output of {commands}, but a session cuts slides with `tacpipe segment "
            "slides` only. Train it on recordings that went through that stage."
        )
    params_found = stage_params(steps[0])
    if params_found.trigger == "load" and params_found.rest != "start":
        raise TacpipeError(
            f"The model was trained with `segment slides --rest {params_found.rest}`, which searches the complete recording "
            f"for the rest level. A session takes it from the start. Train it with --rest start."
        )
    return params_found


class RecordingSoFar(RecordingInMemory):
    """Streams of a recording so far, which are decoded already."""

    def columns(self, stream: str = "") -> Any:
        """Return a stream."""
        return self.tables[stream]


@dataclass(frozen=True)
class Answer:
    """A model's prediction for a slide so far."""

    scores: Float32s | None  # (class,); None if no material is predicted, with the reason in ``cause``
    rows: int = 0  # number of rows of the slide so far
    fraction: float = 0.0  # fraction of the rows that the model reads
    is_over: bool = False  # whether the slide had no new row for `ENDED_NS`
    cause: str = ""
    probabilities: Float32s | None = field(default=None)  # (class,)


class SlideSoFar:
    """Predicts the material of the slide in the samples so far."""

    def __init__(
        self, classifier: Classifier, params: Any, sensor: str, least_fraction: float, rate_hz: float | None = None
    ) -> None:
        """Store the params of `segment slides` and the minimum fraction of a slide. Raises an error for an unknown sensor.

        ``rate_hz`` is the rig's nominal rate. If None, the rate is that of the arrival times, which are bursty on a
        busy computer.
        """
        self._classifier, self._params, self._sensor = classifier, params, sensor
        self._attributes = {"sensor": sensor} | ({"rate_hz": rate_hz} if rate_hz else {})
        self._layout, self._reader = classifier.layout(sensor), classifier.readers[sensor]
        self._stage = registry.load(SLIDES)
        self._least_fraction = least_fraction

    @property
    def frames(self) -> int:
        """Number of rows that the model reads of a slide."""
        return self._layout.frames

    @property
    def any_length(self) -> bool:
        """Whether the model accepts fewer rows."""
        return self._reader.any_length

    def answer(self, streams: Mapping[str, pa.Table]) -> Answer:
        """Return the prediction for a recording of these streams that ends now, or why there is none."""
        recording = RecordingSoFar("so far", streams, self._attributes)
        try:
            segmented = self._stage(replace(self._params, crop="none"), recording)
        except TacpipeError:
            return Answer(None, cause="no slide has begun")
        table = segmented.streams[STREAM]
        rows = table.num_rows
        newest_ns = finger_stream("so far", streams).column("t_ns")[-1].as_py()
        is_over = rows > 0 and newest_ns - table.column("t_ns")[-1].as_py() > ENDED_NS
        try:
            slide, is_incomplete = self._slide_rows(recording, table)
            layout, frames = slides_of.frames(slide, self._sensor, self._classifier.quantities)
        except TacpipeError as error:
            return Answer(None, rows, 0.0, is_over, str(error))
        answer = Answer(None, rows, min(1.0, len(frames) / self.frames), is_over)
        differs = f"the slide {describe_difference(self._layout, layout)} as the model was trained on"
        if layout.channels != self._layout.channels or len(frames) > self.frames:
            return replace(answer, cause=differs)
        if len(frames) < self.frames and not (self.any_length and answer.fraction >= self._least_fraction):
            enough = f"{self._least_fraction:.0%} of {self.frames}" if self.any_length else str(self.frames)
            return replace(answer, cause=f"{len(frames)} rows of the slide have come, and {enough} are needed")
        if not is_incomplete and not self._layout.is_compatible(layout):
            return replace(answer, cause=differs)
        scores = self._reader.read(frames[None]).scores
        if self._classifier.is_unknown(scores, frames[None], self._sensor)[0]:
            return replace(answer, scores=scores[0], cause=UNLIKE)
        return replace(
            answer, scores=scores[0], probabilities=self._classifier.probabilities_of(scores, self._sensor)[0]
        )

    def is_over(self, streams: Mapping[str, pa.Table], finger_stream: str, pause_ns: int) -> bool:
        """Return whether the slide in these streams has ended and been followed by a pause.

        With the trigger ``load``, a pause is a time without contact, whatever the arm does; the samples after it start
        without contact, as in a recording. With ``pressure``, it is a time in which the arm has stopped.
        """
        is_by_load = self._params.trigger == "load"
        tables = {name: table for name, table in streams.items() if not is_by_load or name == finger_stream}
        if finger_stream not in tables:
            return False
        try:
            recording = RecordingSoFar("so far", tables, self._attributes)
            slide = self._stage(replace(self._params, crop="none"), recording).streams[STREAM]
        except TacpipeError:  # no slide has started
            return False
        newest_ns, last_ns = (table.column("t_ns")[-1].as_py() for table in (tables[finger_stream], slide))
        return bool(newest_ns - last_ns >= pause_ns)

    @property
    def ends_by_arm(self) -> bool:
        """Whether a slide ends only when the arm stops."""
        return bool(self._params.trigger != "load")

    def _slide_rows(self, recording: RecordingSoFar, table: pa.Table) -> tuple[Any, bool]:
        """Return the slide's rows, selected by the stage or as far as available, and whether there are too few."""
        params = self._params
        first = params.offset_frames if params.crop == "offset" else 0
        if params.crop == "none" or table.num_rows - first >= params.frames:
            slide = self._stage(params, recording)
            return RecordingSoFar("so far", slide.streams, {**recording.attributes, **slide.attributes}), False
        remaining = table.slice(min(first, table.num_rows))
        return RecordingSoFar("so far", {STREAM: remaining}, recording.attributes), remaining.num_rows < self.frames


MOMENT_NS = 100_000_000  # interval between checks of a part, starting at the finger's first sample


class SlideSplitter:
    """Detects the ends of slides in the samples of a part of a recording."""

    def __init__(self, slide: SlideSoFar, finger: str, pause_ns: int) -> None:
        """Store the slide definition, the finger's stream and the pause duration."""
        self._slide, self._finger, self._pause_ns = slide, finger, pause_ns
        self._moments = 0  # number of checks of this part

    def begin(self) -> None:
        """Start the next part."""
        self._moments = 0

    def end_ns(self, tables: Tables, until_ns: int) -> int | None:
        """Return the time at which the slide of this part ended, or None if it has not ended by ``until_ns``.

        ``tables`` contains the streams of this part, complete up to ``until_ns``.
        """
        if self._finger not in tables:
            return None
        first_ns = int(tables[self._finger].column("t_ns")[0].as_py())
        while (at_ns := first_ns + (self._moments + 1) * MOMENT_NS) <= until_ns:
            self._moments += 1
            if self._slide.is_over(rows_until(tables, at_ns), self._finger, self._pause_ns):
                return at_ns
        return None


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


def split_slides(
    slide: SlideSoFar, finger: str, pause_ns: int, tables: Tables
) -> Iterator[tuple[int, dict[str, pa.Table]]]:
    """Yield the end and the streams of each part of a recording; if ``pause_ns`` is 0, there is one part."""
    remaining = {name: table for name, table in tables.items() if table.num_rows}
    last_ns = max((int(table.column("t_ns")[-1].as_py()) for table in remaining.values()), default=0)
    splitter = SlideSplitter(slide, finger, pause_ns)
    was_split = False
    while pause_ns and (end_ns := splitter.end_ns(remaining, last_ns)) is not None:
        yield end_ns, rows_until(remaining, end_ns)
        remaining, was_split = rows_after(remaining, end_ns), True
        splitter.begin()
    if finger in remaining or not was_split:
        yield last_ns, remaining


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
    table = finger_stream(recording.name, tables)
    stream = next(name for name, candidate in tables.items() if candidate is table)
    sensor = str(
        attributes["sensor"] if attributes.get("sensor") in classifier.layouts else next(iter(classifier.layouts))
    )
    rate_hz = attributes.get("rate_hz")
    least_seen = float(attributes.get(LEAST_ATTR) or MIN_SEEN)
    slide = SlideSoFar(classifier, params, sensor, least_seen, float(rate_hz) if rate_hz else None)
    pause_ns = round(float(attributes.get(PAUSE_ATTR) or 0.0) * 1e9)
    numbered_parts = enumerate(split_slides(slide, stream, pause_ns, tables), start=1)
    return [(recording.name, number, end_ns, slide.answer(part)) for number, (end_ns, part) in numbered_parts]


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
