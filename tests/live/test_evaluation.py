"""Test `tacpipe evaluate --live`, which compares a session's messages with the offline chain on the same recording."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.errors import UsageError
from tacpipe.live import messages
from tacpipe.live.preparation import open_model
from tacpipe.live.stages import MODEL, require_sessions
from tacpipe.tasks.forward.live import evaluation
from tacpipe.tasks.forward.live.chain import Cause, GridForecast
from tests.conftest import Lab
from tests.fake_recordings import FakeRecording
from tests.live.sessions import CALIBRATED, TRAINED

LATENCY_MS, LATE_ROW, CHANGED_ROW = 5.0, 20, 22


def record(recording: Any, predictions: pa.Table) -> FakeRecording:
    """A recording with the streams of a session that published ``predictions``, one of them altered after a late sample."""
    t_ns = predictions["t_ns"].to_numpy()
    columns = {name: predictions[name].to_numpy().copy() for name in predictions.column_names[1:]}
    columns[next(iter(columns))][CHANGED_ROW] += 1
    columns[list(columns)[-1]][CHANGED_ROW + 1] += 1  # a quantile
    clocks = {"t_ns": t_ns + 5_000_000, "t_device_ns": t_ns}
    late = (np.arange(len(t_ns)) >= LATE_ROW).astype(np.float32)
    session_streams = {
        "forecast": pa.table({**clocks, **columns}),
        "latency": pa.table(
            {**clocks, "latency_ms": np.full(len(t_ns), LATENCY_MS, np.float32), "late": late, "skipped": 0 * late}
        ),
    }
    tables = {name: recording.table(name) for name in recording.streams}
    return FakeRecording({**tables, **session_streams}, recording.name, recording.attributes)


@pytest.mark.long
def test_published_forecasts_are_compared_with_recomputed_ones_and_with_the_rows_that_they_are_for(lab: Lab) -> None:
    for command in (*TRAINED, CALIBRATED):
        lab.run(command)
    lab.run("predict models/g data/r -o data/p --steps 1,2 --causal --quantiles 10,90")
    model, name = tacpipe.open("models/g"), "trial-000"
    session = record(tacpipe.open("data/r")[name], tacpipe.open("data/p")[name].table())
    recordings: Any = type("Given", (), {"recordings": {name: session}, "files": {}})()
    result = evaluation.evaluate(model, recordings)
    live = json.loads(result.files["metrics.json"])["live"]
    measured = live["recordings"][name]
    assert live["compared"] == live["published"] == session.table("forecast").num_rows
    assert live["equal"] == live["compared"] - 2
    uncalibrated = json.loads(evaluation.evaluate(tacpipe.open("models/f"), recordings).files["metrics.json"])["live"]
    assert uncalibrated["equal"] == live["compared"] - 1  # the uncalibrated model has no quantiles to compare
    assert (measured["late"], measured["skipped"]) == (1, 0) and measured["latency"]["median_ms"] == LATENCY_MS
    assert set(measured["mae"]) == {"live", "persistence"} and 0 < measured["errors_of"]["t1"] < live["published"]
    assert 0 < measured["mae"]["live"]["t1"] < 10 * measured["mae"]["persistence"]["t1"]
    assert "bit for bit" in result.notes[0] and "latency median 5.0 ms" in result.notes[1]


class Session:
    """A recording of a session that ran the model of a digest."""

    streams = ("forecast", "latency")

    def __init__(self, digest: str | None) -> None:
        self.attributes = {} if digest is None else {MODEL: digest}


def test_a_session_of_another_model_is_refused_with_both_digests() -> None:
    own_digest, other_digest = "ab" * 32, "cd" * 32
    recordings: Any = type("Given", (), {"recordings": {"one": Session(own_digest), "two": Session(other_digest)}})()
    with pytest.raises(UsageError) as raised:
        require_sessions(own_digest, recordings, "forecast")
    assert "session of two ran the model cdcdcdcdcdcd, and this one is abababababab" in str(raised.value)
    assert "leave --live out" in str(raised.value)
    recordings.recordings = {"one": Session(own_digest), "stated by nobody": Session(None)}
    require_sessions(own_digest, recordings, "forecast")


@pytest.mark.long
def test_the_model_of_the_session_is_known_by_the_digest_that_tacpipe_live_records(lab: Lab) -> None:
    for command in TRAINED:
        lab.run(command)
    lab.run(TRAINED[-1].replace("models/f", "models/g").replace("--hidden 4", "--hidden 5"))
    digest, other_digest = (open_model(model).dataset.digest for model in ("models/f", "models/g"))
    recordings: Any = type("Given", (), {"recordings": {"one": Session(digest)}})()
    assert digest != other_digest
    require_sessions(tacpipe.open("models/f").digest, recordings, "forecast")
    with pytest.raises(UsageError, match="ran the model"):
        evaluation.evaluate(tacpipe.open("models/g"), recordings)


@pytest.mark.long
def test_a_recording_without_a_session_is_refused(lab: Lab) -> None:
    for command in TRAINED:
        lab.run(command)
    ran = lab.call("evaluate models/f data/r --live -o results/live")
    assert ran.code == 2 and "tacpipe live -o" in ran.err and not Path("results/live").exists()


def test_a_forecast_is_compared_with_the_row_that_it_is_for_unless_one_of_both_is_in_a_gap() -> None:
    levels = (0.0, 2.0, 5.0, None, 9.0)  # of a channel in the rows of a grid; None: before the level at rest is known
    rows = [
        GridForecast(10 * number, 0, None, None if level is None else np.array([level], np.float32), Cause.NONE)
        for number, level in enumerate(levels)
    ]
    times, published = np.array([0, 10, 20, 35]), {"z_t1": np.array([1.0, 2.5, 0.0, 0.0], np.float32)}
    assert evaluation.errors(rows, times, published, ["z"]) == {
        "mae": {"live": {"t1": 1.75}, "persistence": {"t1": 2.5}},
        "errors_of": {"t1": 2},
    }
    rows[2] = dataclasses.replace(rows[2], gaps=("xela1",))
    in_gap = evaluation.errors(rows, times, published, ["z"])
    assert in_gap["mae"]["live"] == {"t1": 1.0} and in_gap["errors_of"] == {"t1": 1}


def test_latencies_of_no_forecast_are_a_count() -> None:
    assert messages.summarize_latencies(np.array([np.nan])) == {"count": 0}
