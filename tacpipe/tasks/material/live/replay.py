"""The final answer of each slide of recordings, as a live session gives it: `tacpipe predict --causal` of materials."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.channels.finger import finger
from tacpipe.channels.streams import EVENTS
from tacpipe.errors import TacpipeError
from tacpipe.live.stages import streams_as_recorded
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.sensors.live import LATENCY
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import PREDICTIONS
from tacpipe.tasks.material.live.messages import LEAST_SEEN, MATERIAL
from tacpipe.tasks.material.live.slide import Answer, SlideSoFar, parts, slide_params

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Model, Recording

PAUSE, LEAST = "live_pause_s", "live_least"  # attributes of a session's recording: what it was asked for
UNREAD = (MATERIAL, LATENCY, EVENTS, "truth")  # streams that no session reads
Row = tuple[str, int, int, Answer]  # recording, number of the slide, up to when it was read, answer


def predict(model: Model, recordings: Dataset) -> Result:
    """Return one table, ``predictions``: a row a slide, with number, end, rows, material, cause and probabilities.

    Recordings are given as they were recorded. A recording is one slide, and where its session was asked for a pause (its
    attribute ``live_pause_s``) one after another. Raises `TacpipeError`, naming the recording, where one is not what the
    model reads.
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
    tables = {name: table for name, table in streams_as_recorded(recording).items() if name not in UNREAD}
    attributes: Mapping[str, Any] = recording.attributes
    table = finger(recording.name, tables)
    stream = next(name for name, candidate in tables.items() if candidate is table)
    sensor = str(
        attributes["sensor"] if attributes.get("sensor") in classifier.layouts else next(iter(classifier.layouts))
    )
    rate_hz = attributes.get("rate_hz")
    least_seen = float(attributes.get(LEAST, LEAST_SEEN))
    slide = SlideSoFar(classifier, params, sensor, least_seen, float(rate_hz) if rate_hz else None)
    pause_ns = round(float(attributes.get(PAUSE, 0.0)) * 1e9)
    numbered_parts = enumerate(parts(slide, stream, pause_ns, tables), start=1)
    return [(recording.name, number, end_ns, slide.answer(part)) for number, (end_ns, part) in numbered_parts]


def _table(names: tuple[str, ...], rows: list[Row]) -> pa.Table:
    import pyarrow as pa

    answers = [answer for *_, answer in rows]
    likely = np.array(
        [np.full(len(names), np.nan) if answer.probabilities is None else answer.probabilities for answer in answers],
        np.float32,
    ).reshape(len(rows), len(names))
    about = {"quantity": "prediction"}
    materials = [
        "unknown" if answer.probabilities is None else names[int(answer.probabilities.argmax())] for answer in answers
    ]
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), [row[0] for row in rows]),
        (pa.field("slide", pa.int32()), [row[1] for row in rows]),
        (pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}), [row[2] for row in rows]),
        (pa.field("rows", pa.int32()), [answer.rows for answer in answers]),
        (pa.field("material", pa.string(), metadata=about), materials),
        (pa.field("cause", pa.string()), [answer.cause for answer in answers]),
        *(
            (pa.field(f"probability_{name}", pa.float32(), metadata={"quantity": "probability"}), likely[:, number])
            for number, name in enumerate(names)
        ),
    ]
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))
