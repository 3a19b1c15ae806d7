"""The final answer of each slide of recordings, as a live session gives it: `tacpipe predict --causal` of materials."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.channels.finger import finger
from tacpipe.channels.streams import EVENTS
from tacpipe.errors import TacpipeError
from tacpipe.live.options import OWN, Options
from tacpipe.live.unstored import recorded
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import PREDICTIONS
from tacpipe.tasks.material.live.parts import parts
from tacpipe.tasks.material.live.slide import Answer, SlideSoFar, slide_params

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Model, Recording

PAUSE, LEAST = "live_pause_s", "live_least"  # attributes of a session's recording: what it was asked for
BESIDE = (*OWN, EVENTS, "truth")  # streams that no session reads
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
    tables = {name: table for name, table in recorded(recording).items() if name not in BESIDE}
    known: Mapping[str, Any] = recording.attributes
    table = finger(recording.name, tables)
    stream = next(name for name, one in tables.items() if one is table)
    sensor = str(known["sensor"] if known.get("sensor") in classifier.layouts else next(iter(classifier.layouts)))
    rate_hz = known.get("rate_hz")
    least = float(known.get(LEAST, Options.least))
    slide = SlideSoFar(classifier, params, sensor, least, float(rate_hz) if rate_hz else None)
    pause_ns = round(float(known.get(PAUSE, 0.0)) * 1e9)
    found = enumerate(parts(slide, stream, pause_ns, tables), start=1)
    return [(recording.name, number, end_ns, slide.answer(part)) for number, (end_ns, part) in found]


def _table(names: tuple[str, ...], rows: list[Row]) -> pa.Table:
    import pyarrow as pa

    answers = [answer for *_, answer in rows]
    likely = np.array(
        [np.full(len(names), np.nan) if one.probabilities is None else one.probabilities for one in answers], np.float32
    ).reshape(len(rows), len(names))
    about = {"quantity": "prediction"}
    named = ["unknown" if one.probabilities is None else names[int(one.probabilities.argmax())] for one in answers]
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), [row[0] for row in rows]),
        (pa.field("slide", pa.int32()), [row[1] for row in rows]),
        (pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}), [row[2] for row in rows]),
        (pa.field("rows", pa.int32()), [one.rows for one in answers]),
        (pa.field("material", pa.string(), metadata=about), named),
        (pa.field("cause", pa.string()), [one.cause for one in answers]),
        *(
            (pa.field(f"probability_{name}", pa.float32(), metadata={"quantity": "probability"}), likely[:, number])
            for number, name in enumerate(names)
        ),
    ]
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))
