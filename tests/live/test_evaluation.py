"""Test `tacpipe evaluate --live`, which compares a session's messages with the offline chain on the same recording."""

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
from tacpipe.tasks.forward.live import measures as truth
from tacpipe.tasks.forward.live import measures as worth
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
def test_published_forecasts_are_compared_with_the_offline_chain_and_recomputed(lab: Lab) -> None:
    for command in (*TRAINED, CALIBRATED):
        lab.run(command)
    lab.run("predict models/g data/r -o data/p --steps 1,2 --causal --quantiles 10,90")
    model, name = tacpipe.open("models/g"), "trial-000"
    session = record(tacpipe.open("data/r")[name], tacpipe.open("data/p")[name].table())
    recordings: Any = type("Given", (), {"recordings": {name: session}, "files": {}})()
    result = evaluation.evaluate(model, recordings)
    live = json.loads(result.files["metrics.json"])["live"]
    rows = live["rows"]
    assert rows["compared"] == rows["published"] == rows["recomputed"] == session.table("forecast").num_rows
    assert rows["equal"] == rows["compared"] - 2 and rows["differ_after_late_samples"] == 2
    uncalibrated = json.loads(evaluation.evaluate(tacpipe.open("models/f"), recordings).files["metrics.json"])["live"]
    assert uncalibrated["rows"]["equal"] == rows["compared"] - 1  # the uncalibrated model has no quantiles to compare
    assert rows["late_samples"] == 1 and rows["skipped"] == 0 and 0 < rows["of_errors"] < rows["published"]
    assert live["latency"]["median_ms"] == LATENCY_MS
    assert set(live["mae"]) == set(worth.PREDICTORS)
    assert 0 < live["mae"]["live"]["t1"] < 10 * live["mae"]["offline"]["t1"]
    assert len(result.files["live.csv"].decode().splitlines()) == 1 + len(worth.PREDICTORS)
    assert "bit for bit" in result.notes[-2] and "2 others" in result.notes[-2]


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


def test_rows_are_compared_bit_for_bit_and_only_where_both_have_them() -> None:
    published = np.array([[[1.0]], [[2.0]], [[3.0]], [[np.nan]]], np.float32)
    recomputed = np.array([[[2.0]], [[3.0 + 2**-20]], [[np.nan]], [[9.0]]], np.float32)
    result, equal = truth.equality(np.array([10, 20, 30, 40]), published, np.array([20, 30, 40, 50]), recomputed)
    assert (result.published, result.recomputed, result.compared, result.equal) == (4, 4, 3, 2)
    assert equal.tolist() == [False, True, False, True]
    assert 0 < result.largest_difference < 1e-6


def test_minus_zero_is_not_zero() -> None:
    zero, minus_zero = np.zeros((1, 1, 1), np.float32), -np.zeros((1, 1, 1), np.float32)
    assert truth.equality(np.array([0]), zero, np.array([0]), minus_zero)[0].equal == 0


def test_nothing_is_interpolated_over_a_gap_or_an_unusable_row() -> None:
    t_ns, values = np.arange(5) * 10, np.arange(5.0)[:, None]
    groups, usable = np.array([0, 0, 1, 1, 1]), np.array([True, True, True, False, True])
    result = truth.interpolate(t_ns, values, groups, usable, np.array([-1, 0, 4, 15, 20, 25, 40, 41]))[:, 0]
    assert np.array_equal(result, [np.nan, 0, 0.4, np.nan, 2, np.nan, 4, np.nan], equal_nan=True)


def test_steps_are_periods_on_a_uniform_grid_and_rows_on_another() -> None:
    rows = np.array([0, 21, 39, 60])
    assert truth.targets(rows, np.array([0, 39]), (1, 3), 20.0).tolist() == [[20, 60], [59, 99]]
    assert truth.targets(rows, np.array([0, 39]), (1, 3), None).tolist() == [[21, 60], [60, -1]]


def test_errors_are_summed_over_rows_and_channels() -> None:
    predicted = np.array([[[1.0, 2.0]], [[3.0, 5.0]]])
    squared, absolute = truth.sums(predicted, np.zeros((2, 1, 2)))
    assert squared.tolist() == [39.0] and absolute.tolist() == [11.0]


def test_latencies_of_no_forecast_are_a_count() -> None:
    assert messages.summarize_latencies(np.array([np.nan])) == {"count": 0}
