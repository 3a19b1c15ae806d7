"""Live sessions with a slip model: what is published is what `predict --causal` gives, to the bit."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live import wire
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN
from tacpipe.sensors import plan
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.tasks.learning.live.windows import StreamSoFar
from tacpipe.tasks.slip.calibration import EventScore
from tacpipe.tasks.slip.labels import SlipLabels
from tacpipe.tasks.slip.live import evaluation
from tacpipe.tasks.slip.live.engine import SlipEngine
from tacpipe.tasks.slip.live.evaluation import SessionAlarms
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tacpipe.tasks.slip.live.task import SlipLive, SlipSettings
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.params import SlipBoosting, SlipNetwork
from tests.fake_recordings import FakeRecording, dataset
from tests.sensors import made
from tests.tasks.slip.slip_recordings import trained
from tests.test_docs import module

STREAMS = ("left", "right")
PERIOD_NS, START_NS, OFFSET_NS, SETTLE_NS = 20_000_000, 10**12, 5 * 10**17, 2_000_000
SMALL = SlipBoosting(trees=10, leaves=4, leaf=5, learning_rate=0.3, window_s=0.4, horizon_s=0.4, rest_s=0.1)
ROWS = 150
NETWORK = SlipNetwork(
    channels=4, layers=2, epochs=1, window_s=0.4, horizon_s=0.4, rest_s=0.1, actions="planned", stride=2
)


def plan_packet(row: int) -> tuple[int, bytes]:
    """Return when the plan that is sent after a row arrives, on the monotonic clock, and its packet.

    The plan shakes the hand while a slip is near.
    """
    arrived_ns = START_NS + row * PERIOD_NS + 7_000_000
    t_ns = arrived_ns + OFFSET_NS + np.arange(0, 500_000_000, 25_000_000)
    poses = np.zeros((len(t_ns), 7))
    size_m = 0.05 if 35 <= row < 70 or 85 <= row < 120 else 0.01
    poses[:, 0], poses[:, 6] = size_m * np.sin(row + t_ns % 10**9 / 1e8), 1.0
    return arrived_ns, plan.packet(t_ns.tolist(), poses)


def plan_stream(packets: Mapping[int, tuple[int, bytes]]) -> pa.Table:
    """Return the recorded stream of packets."""
    sensor = plan.Plan()
    samples = sensor.decode([packet for _, packet in packets.values()])
    arrived = np.array([arrived_ns + OFFSET_NS for arrived_ns, _ in packets.values()])[samples.rows]
    columns = [arrived, *np.hstack(samples.values).T]
    schema = pa.schema([pa.field("t_ns", pa.int64()), *sensor.fields()])
    columns[1] = samples.values[0][:, 0]
    return pa.Table.from_arrays([pa.array(column) for column in columns], schema=schema)


class Rig:
    """Two skins with the samples and packets of one recording, and a model that was trained on it."""

    def __init__(self) -> None:
        self.sensors = {name: rigs.build_sensor("xela", {"rate_hz": 50}, name) for name in STREAMS}
        self.packets, streams = {}, {}
        for number, (name, sensor) in enumerate(self.sensors.items()):
            samples = made.samples("xela", sensor, ROWS, number + 1)
            self.packets[name] = split_frames(sensor, sensor.encode(samples))
            t_ns = np.array([self.at_ns(name, row) + OFFSET_NS for row in range(ROWS)])
            values = np.hstack(samples.values)
            schema = pa.schema([pa.field("t_ns", pa.int64()), *sensor.fields()])
            columns = [
                pa.array(column).cast(field.type) for column, field in zip(values.T, sensor.fields(), strict=True)
            ]
            streams[name] = pa.Table.from_arrays([pa.array(t_ns), *columns], schema=schema)
        self.plans = {row: plan_packet(row) for row in range(10, ROWS, 15)}
        streams["plan"] = plan_stream(self.plans)
        self.recording = FakeRecording(streams, "trial-0", {"slip_intervals": "1.2-1.4 2.2-2.4"})

    @staticmethod
    def at_ns(stream: str, row: int) -> int:
        """When a sample arrives, on the monotonic clock."""
        return START_NS + row * PERIOD_NS + (3_000_000 if stream == "right" else 0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig()


@pytest.fixture(scope="module")
def model(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> SlipModel:
    files = trained(SMALL, dataset(rig.recording), None, tmp_path_factory.mktemp("workspace"))
    return SlipModel.load(files)


@pytest.fixture(
    scope="module", params=[dataclasses.replace(SMALL, actions="planned"), NETWORK], ids=["trees", "network"]
)
def planned_model(request: Any, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> SlipModel:
    files = trained(request.param, dataset(rig.recording), None, tmp_path_factory.mktemp("workspace"))
    return SlipModel.load(files)


def engine_for(rig: Rig, model: SlipModel, level: float = 0.0) -> SlipEngine:
    sensors = {**rig.sensors, **({"plan": plan.Plan()} if model.reader.reads_plans else {})}
    engine = SlipEngine(model, sensors, SlipDescription("m", 50.0, 0.4, "1", {}), level, settle_ns=SETTLE_NS)
    engine.resting_ns = 0
    engine.take("", StreamNote(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
    for name in sensors:
        engine.take(name, StreamNote(START_NS, name, BEGAN))
    return engine


def answered(engine: SlipEngine, now_ns: int) -> list[SlipMessage]:
    """Return the messages that are due."""
    return [message for message in engine.step(now_ns) if isinstance(message, SlipMessage)]


def published(rig: Rig, engine: SlipEngine, rows: int = ROWS, size: int = 1) -> list[SlipMessage]:
    """Return the messages of a session whose samples arrive ``size`` at a time."""
    messages: list[SlipMessage] = []
    for first in range(0, rows, size):
        chosen = range(first, min(first + size, rows))
        for name in STREAMS:
            engine.take(name, Chunks.from_pairs([(rig.at_ns(name, row), rig.packets[name][row]) for row in chosen]))
        if "plan" in engine.sensors and (pairs := [rig.plans[row] for row in chosen if row in rig.plans]):
            engine.take("plan", Chunks.from_pairs(pairs))
        messages += answered(engine, rig.at_ns("right", min(first + size, rows) - 1) + SETTLE_NS)
    return messages


@pytest.mark.parametrize("size", [1, 3])
def test_published_probabilities_are_those_of_the_recording_to_the_bit(rig: Rig, model: SlipModel, size: int) -> None:
    assert_published(rig, model, size)


@pytest.mark.parametrize("size", [1, 3])
def test_probabilities_with_plans_are_those_of_the_recording_to_the_bit(
    rig: Rig, planned_model: SlipModel, size: int
) -> None:
    scores = assert_published(rig, planned_model, size)
    no_plans = dataclasses.replace(rig.recording, tables={name: rig.recording.tables[name] for name in STREAMS})
    assert (planned_model.table(no_plans)["score"].to_numpy() != scores).any()


def test_a_plan_that_arrives_after_its_probability_is_late(rig: Rig, planned_model: SlipModel) -> None:
    engine = engine_for(rig, planned_model)
    published(rig, engine, 60)
    assert engine.late == 0
    engine.take("plan", Chunks.from_pairs([rig.plans[40]]))
    engine.step(rig.at_ns("right", 60) + SETTLE_NS)
    assert engine.late == 1


def assert_published(rig: Rig, model: SlipModel, size: int) -> np.ndarray:
    """Compare the messages of a session with the table of its recording, and return the scores."""
    messages = [message for message in published(rig, engine_for(rig, model), size=size) if message.answers]
    table = model.table(rig.recording)
    assert [message.t_ns for message in messages] == table["t_ns"].to_pylist()
    for name in ("probability", "score"):
        sent = np.array([getattr(message, name) for message in messages])
        assert sent.tobytes() == table[name].to_numpy().tobytes()
    scores: np.ndarray = table["score"].to_numpy()
    return scores


def test_an_alarm_is_on_from_its_level(rig: Rig, model: SlipModel) -> None:
    scores = model.table(rig.recording)["score"].to_numpy()
    level = float(np.median(scores))
    messages = published(rig, engine_for(rig, model, level))
    assert [message.alarm_state for message in messages if message.answers] == [
        ON if score >= level else OFF for score in scores
    ]
    assert {message.alarm_state for message in messages if not message.answers} == {UNKNOWN}


def test_a_message_says_why_there_is_no_probability(rig: Rig, model: SlipModel) -> None:
    engine = engine_for(rig, model)
    (first, *_) = published(rig, engine, 5)
    assert first.cause == "the window of left, right is being filled"
    assert not first.answers
    (silent,) = engine.step(rig.at_ns("right", 4) + 400_000_000)
    assert silent.cause == "nothing comes from left, right"


def test_a_session_that_fell_behind_publishes_the_newest_probabilities_and_counts_the_others(
    rig: Rig, model: SlipModel
) -> None:
    messages = published(rig, engine_for(rig, model), 60, 60)
    assert len(messages) == 4
    assert messages[-1].skipped == 56
    assert messages[-1].t_ns == rig.at_ns("left", 59) + OFFSET_NS


def test_a_process_that_replaces_another_takes_its_levels_at_rest(rig: Rig, model: SlipModel) -> None:
    before = engine_for(rig, model)
    published(rig, before, 60)
    state = before.beginning
    assert state is not None
    engine = SlipEngine(model, rig.sensors, SlipDescription("m", 50.0, 0.4, "1", {}), 0.0, settle_ns=SETTLE_NS)
    engine.take("", StreamNote(START_NS, "", wire.CONTINUE, json.dumps(state)))
    engine.take("", StreamNote(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
    for name in STREAMS:
        engine.take(name, StreamNote(START_NS, name, BEGAN))
        pairs = [(rig.at_ns(name, row), rig.packets[name][row]) for row in range(60, 100)]
        engine.take(name, Chunks.from_pairs(pairs))
    messages = [message for message in answered(engine, rig.at_ns("right", 99) + SETTLE_NS) if message.answers]
    expected = {row["t_ns"]: row["score"] for row in model.table(rig.recording).to_pylist()}
    assert messages
    assert all(message.score == expected[message.t_ns] for message in messages)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=12), st.integers(0, 1000))
def test_rows_are_the_same_however_a_stream_is_cut(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = sum(sizes)
    raw = rng.normal(100, 10, (count, 3))
    raw[rng.random(raw.shape) < 0.1] = np.nan
    t_ns = np.arange(count, dtype=np.int64) * PERIOD_NS
    from tacpipe.tasks.learning.inputs import InputStream, RawStream

    finger = InputStream("left", ("a", "b", "c"), ({}, {}, {}), 5, 50.0, np.array([2.0, 3.0, 4.0]))
    whole = RawStream(t_ns, raw).above_rest(finger, 100_000_000)
    so_far = StreamSoFar(finger, 100_000_000)
    for first, size in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True):
        so_far.add(t_ns[first : first + size], raw[first : first + size])
    if so_far.rest is not None:
        assert so_far.values.tobytes() == whole.values.tobytes()


def session_recording(rig: Rig, model: SlipModel, change: float = 0.0) -> FakeRecording:
    """Return the recording of a session that published the model's probabilities plus a ``change`` in the last row."""
    table = model.table(rig.recording)
    probability = table["probability"].to_numpy().copy()
    probability[-1] += change
    stream = pa.table(
        {
            "t_ns": table["t_ns"],
            "t_device_ns": table["t_ns"],
            "probability": probability,
            "score": table["score"],
            "alarm": pa.array(np.zeros(table.num_rows, np.int8)),
        }
    )
    columns = {"latency_ms": 4.0, "late": 0.0, "skipped": 0.0}
    figures = {name: np.full(table.num_rows, value, np.float32) for name, value in columns.items()}
    latency = pa.table({"t_ns": table["t_ns"], **figures})
    return dataclasses.replace(rig.recording, tables={**rig.recording.tables, "slip": stream, "latency": latency})


class OpenedModel:
    """A model as `evaluate` gets it."""

    def __init__(self, model: SlipModel, files: Any = None) -> None:
        self.digest = "sha256:a"
        self.files = files


def test_the_evaluation_of_a_session_counts_equal_probabilities(
    rig: Rig, model: SlipModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SlipModel, "load", classmethod(lambda cls, files: model))
    opened: Any = OpenedModel(model, {"config.json": b"{}"})
    for change, differing in ((0.0, 0), (1e-9, 1)):
        result = evaluation.evaluate(opened, dataset(session_recording(rig, model, change)))
        live = json.loads(result.files["metrics.json"])["live"]
        assert live["published"] == live["compared"] == live["equal"] + differing > 50
        assert live["recordings"]["trial-0"]["latency"]["p99_ms"] == 4.0
    with pytest.raises(UsageError, match="is not a recording of a live session"):
        evaluation.evaluate(opened, dataset(rig.recording))
    other = dataclasses.replace(session_recording(rig, model), attributes={"live_model": "sha256:b"})
    with pytest.raises(UsageError, match="ran the model"):
        evaluation.evaluate(opened, dataset(other))


def test_a_model_trained_behind_a_stage_has_no_causal_predictions() -> None:
    class Chained:
        class source:  # noqa: N801
            chain = ({"stage": "extract.difference"},)

    opened: Any = Chained()
    with pytest.raises(TacpipeError, match="trained on the output of `tacpipe extract difference`"):
        SlipLive().predict(opened, dataset(), None)  # type: ignore[arg-type]


def test_the_options_of_a_session_are_those_of_its_settings() -> None:
    assert SlipSettings().alarms_per_minute == 1.0


def test_the_picture_of_the_demo_shows_each_slip(rig: Rig, model: SlipModel, tmp_path: Path) -> None:
    import pandas as pd

    t_ns = np.arange(200, dtype=np.int64) * PERIOD_NS
    stream = pd.DataFrame({"t_device_ns": t_ns, "probability": np.linspace(0, 1, 200), "alarm": np.arange(200) > 150})
    events = np.array([[t_ns[160], t_ns[165]]])
    event = EventScore("a", "b", t_ns[160] / 1e9, 180.0, 0.0, 280.0)
    read = model.reader.track(rig.recording)  # type: ignore[arg-type]
    track = dataclasses.replace(read, start_ns=0, labels=SlipLabels(events, None))
    path = module("live_demo").draw(tmp_path / "live.png", stream, track, SessionAlarms([event], 0, 0.05), "one slip")
    assert path.read_bytes().startswith(b"\x89PNG")
