"""Evaluate recordings of live sessions: what was published next to what `predict --causal` computes, and the latencies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Times
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.live.messages import summarize_latencies
from tacpipe.live.stages import require_sessions
from tacpipe.plugins.stage import Result

if TYPE_CHECKING:
    import pyarrow as pa

BITS: Mapping[str, type[np.signedinteger[Any]]] = {"double": np.int64, "float": np.int32}  # bits of compared columns
# a recording, the times of its answers (row,) and its published columns at these -> further figures
Measure = Callable[[Recording, Times, Mapping[str, Any]], Mapping[str, Any]]


def evaluate(
    model: Model,
    recordings: Dataset,
    stream: str,
    predict: Callable[[Recording], pa.Table],
    measure: Measure = lambda recording, times, published: {},
) -> Result:
    """Return rows, equality and latencies of sessions that published ``stream``, with what ``measure`` adds.

    ``predict`` returns the answers that follow from a recording. Raises `UsageError` for a recording without a session, or
    of another model.
    """
    require_sessions(model.digest, recordings, stream)
    sessions = {}
    for name, recording in sorted(recordings.recordings.items()):
        sessions[name] = _session(recording, recording.table(stream), predict(recording), measure)
    totals = {key: sum(session[key] for session in sessions.values()) for key in ("published", "compared", "equal")}
    notes = [
        f"{totals['equal']} of {totals['compared']} published answers are what `tacpipe predict --causal` gives, bit for "
        f"bit.",
        *(
            f"{name}: latency median {figures['median_ms']:.1f} ms, 99 % {figures['p99_ms']:.1f} ms."
            for name, session in sessions.items()
            if (figures := session["latency"])["count"]
        ),
    ]
    metrics = {"live": {**totals, "recordings": sessions}}
    return Result(
        files={model_files.CONFIG: model.files[model_files.CONFIG], "metrics.json": model_files.to_json(metrics)},
        notes=notes,
    )


def _session(recording: Recording, stream: pa.Table, predicted: pa.Table, measure: Measure) -> dict[str, Any]:
    """Return the figures of one recorded session."""
    clock = "t_device_ns" if "t_device_ns" in stream.column_names else "t_ns"
    compared = [
        field.name for field in predicted.schema if field.name in stream.column_names and str(field.type) in BITS
    ]
    columns = {name: stream[name].to_numpy() for name in stream.column_names}
    answered = np.asarray(np.isfinite([columns[name] for name in compared]).all(axis=0))
    published = {name: values[answered] for name, values in columns.items()}
    _, rows, predicted_rows = np.intersect1d(published[clock], predicted["t_ns"].to_numpy(), return_indices=True)
    equal = np.ones(len(rows), bool)
    for name in compared:
        computed = predicted[name].to_numpy()[predicted_rows]
        bits = BITS[str(predicted.schema.field(name).type)]
        equal &= published[name][rows].view(bits) == computed.view(bits)
    latency = recording.table("latency")
    return {
        "published": int(answered.sum()),
        "compared": len(rows),
        "equal": int(equal.sum()),
        "latency": summarize_latencies(latency["latency_ms"].to_numpy()),
        **{name: int(latency[name].to_numpy().max(initial=0)) for name in ("late", "skipped")},
        **measure(recording, published[clock], published),
    }
