"""Live sessions of models of quantities and of classes publish what the recording gives afterwards, to the bit."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live import wire
from tacpipe.live.decoding import likely_schema
from tacpipe.live.stages import RecordingInMemory
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.tasks.classify.params import ClassifyLinear
from tacpipe.tasks.classify.task import ClassifyTask
from tacpipe.tasks.learning.live.answering import AnswerEngine
from tacpipe.tasks.learning.live.messages import ClassMessage, EstimateMessage, LearnedMessage
from tacpipe.tasks.learning.live.task import RegressLive, check_causal, windows_for
from tacpipe.tasks.learning.model import LearnedModel
from tacpipe.tasks.regress.params import RegressBoosting, RegressLinear, RegressTrees
from tacpipe.tasks.regress.task import RegressTask
from tests.fake_recordings import FakeShard, dataset
from tests.sensors import made

STREAMS = ("left", "right")
PERIOD_NS, START_NS, OFFSET_NS, SETTLE_NS, ROWS = 20_000_000, 10**12, 5 * 10**17, 2_000_000, 150
SYNCHRONIZE: Any = {
    "stage": "synchronize",
    "version": registry.load("synchronize").version,
    "params": params_of.to_json(registry.load("synchronize").params()),
    "fitted": None,
}


class Skins:
    """Two skins with the packets of one recording, the recording, and its synchronized rows with a target."""

    def __init__(self) -> None:
        self.sensors = {name: rigs.build_sensor("xela", {"rate_hz": 50}, name) for name in STREAMS}
        self.packets, tables = {}, {}
        for number, (name, sensor) in enumerate(self.sensors.items()):
            samples = made.samples("xela", sensor, ROWS, number + 1)
            self.packets[name] = split_frames(sensor, sensor.encode(samples))
            t_ns = np.array([self.at_ns(name, row) + OFFSET_NS for row in range(ROWS)])
            schema = pa.schema([likely_schema(sensor).field("t_ns"), *sensor.fields()])
            typed = zip(np.hstack(samples.values).T, sensor.fields(), strict=True)
            values = [pa.array(column).cast(field.type) for column, field in typed]
            tables[name] = pa.Table.from_arrays([pa.array(t_ns), *values], schema=schema)
        self.recording: Any = RecordingInMemory("trial-0", tables, {"master": "left"})
        self.rows = self.synchronized(self.recording)

    @staticmethod
    def synchronized(recording: RecordingInMemory) -> FakeShard:
        """Return the synchronized rows of a recording with a target and a label."""
        stage = registry.load("synchronize")
        output = stage(stage.params(), recording)
        table: Any = output.streams[""]
        table = table.read_all() if hasattr(table, "read_all") else table
        rng = np.random.default_rng(0)
        values = table["left_taxel01_z"].to_numpy().astype(float) + rng.normal(0, 1, table.num_rows)
        table = table.append_column(pa.field("ft_force", pa.float64(), metadata={"unit": "N"}), pa.array(values))
        table = table.append_column("phase", pa.array((values > np.median(values)).astype(np.int64)))
        return FakeShard("trial-0", table, {**output.attributes, "object": "a"})

    @staticmethod
    def at_ns(stream: str, row: int) -> int:
        """When a sample arrives, on the monotonic clock."""
        return START_NS + row * PERIOD_NS + (3_000_000 if stream == "right" else 0)

    def engine(self, model: LearnedModel) -> AnswerEngine:
        """Return an engine whose streams have begun."""
        schemas = {name: likely_schema(sensor) for name, sensor in self.sensors.items()}
        opened = functools.partial(windows_for, model, [SYNCHRONIZE], schemas, "left")
        engine = AnswerEngine(model, self.sensors, opened, settle_ns=SETTLE_NS)
        engine.resting_ns = 0
        engine.take("", StreamNote(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
        for name in STREAMS:
            engine.take(name, StreamNote(START_NS, name, BEGAN))
        return engine

    def published(self, engine: AnswerEngine, size: int) -> list[LearnedMessage]:
        """Return the messages of a session whose samples arrive ``size`` at a time."""
        messages: list[Any] = []
        for first in range(0, ROWS, size):
            chosen = range(first, min(first + size, ROWS))
            for name in STREAMS:
                pairs = [(self.at_ns(name, row), self.packets[name][row]) for row in chosen]
                engine.take(name, Chunks.from_pairs(pairs))
            messages += engine.step(self.at_ns("right", chosen[-1]) + SETTLE_NS)
        return messages


@pytest.fixture(scope="module")
def skins() -> Skins:
    return Skins()


MODELS: list[Any] = [
    RegressLinear(target="ft_force", context_s=0.1, rest_s=0.1, inputs="*_taxel*"),
    RegressTrees(target="ft_force", context_s=0.1, trees=10, inputs="*_taxel*"),
    RegressBoosting(target="ft_force", context_s=0.1, trees=10, inputs="*_taxel*"),
    ClassifyLinear(label="phase", context_s=0.1, inputs="*_taxel*"),
]


def trained(params: Any, skins: Skins, folder: Path) -> LearnedModel:
    task = RegressTask if params.KIND == "quantity" else ClassifyTask
    return LearnedModel.load(task.train.function(params, dataset(skins.rows), None, folder).files)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("params", MODELS, ids=lambda params: f"{params.KIND}-{params.architecture}")
def test_published_answers_are_those_of_the_recording_to_the_bit(
    params: Any, size: int, skins: Skins, tmp_path: Path
) -> None:
    model = trained(params, skins, tmp_path)
    messages = [message for message in skins.published(skins.engine(model), size) if message.answers]
    table: Any = model.tables(dataset(skins.rows), [10, 90] if params.KIND == "quantity" else [])["trial-0"]
    assert [message.t_ns for message in messages] == table["t_ns"].to_pylist() and len(messages) > 130
    for message, row in zip(messages, table.to_pylist(), strict=True):
        if isinstance(message, EstimateMessage):
            assert message.by_name == {"ft_force": row["ft_force"]}
            assert message.low_by_name == {"ft_force": row["ft_force_p10"]}
            assert message.high_by_name == {"ft_force": row["ft_force_p90"]}
        else:
            assert isinstance(message, ClassMessage)
            assert message.answer == row["answer"]
            assert message.by_name == {name: row[f"probability_{name}"] for name in model.answers.names}


def test_a_message_says_why_there_is_no_answer(skins: Skins, tmp_path: Path) -> None:
    engine = skins.engine(trained(MODELS[0], skins, tmp_path))
    messages = skins.published(engine, 1)
    assert messages[0].cause == "the window of left, right is being filled" and not messages[0].answers
    (silent,) = engine.step(skins.at_ns("right", ROWS) + 400_000_000)
    assert silent.cause == "nothing comes from left, right"


def test_a_description_names_targets_with_their_units_or_classes(skins: Skins, tmp_path: Path) -> None:
    about = skins.engine(trained(MODELS[0], skins, tmp_path)).describe("force")
    assert about.to_dict()["targets"] == {"ft_force": "N"}
    assert about.columns()[0] == ("ft_force", "N")
    assert skins.engine(trained(MODELS[3], skins, tmp_path)).describe("phase").to_dict()["classes"] == ["0", "1"]


def test_a_rig_without_a_stream_or_channel_of_the_model_is_refused(skins: Skins, tmp_path: Path) -> None:
    model = trained(MODELS[0], skins, tmp_path)
    schemas = {name: likely_schema(sensor) for name, sensor in skins.sensors.items()}
    with pytest.raises(UsageError, match="The model reads the stream right, and there are left"):
        windows_for(model, [SYNCHRONIZE], {"left": schemas["left"]}, "left", None)
    fewer = {**schemas, "right": schemas["right"].remove(schemas["right"].get_field_index("taxel01_x"))}
    with pytest.raises(UsageError, match="The stream right has no channel right_taxel01_x"):
        windows_for(model, [SYNCHRONIZE], fewer, "left", None)


def test_a_model_of_rows_that_a_session_cannot_compute_does_not_run_live() -> None:
    other: Any = {**SYNCHRONIZE, "stage": "segment.slides"}
    with pytest.raises(TacpipeError, match="trained on the output of `tacpipe segment slides`"):
        check_causal([other], {"params": {}}, allow_look_ahead=False)
    with pytest.raises(TacpipeError, match="median over all rows of each session"):
        check_causal([SYNCHRONIZE], {"params": {"recentre": "session"}}, allow_look_ahead=False)
    ahead: Any = {**SYNCHRONIZE, "params": {**SYNCHRONIZE["params"], "values": "interpolate"}}
    with pytest.raises(TacpipeError, match="no later samples"):
        check_causal([ahead], {"params": {}}, allow_look_ahead=False)
    check_causal([ahead], {"params": {}}, allow_look_ahead=True)


def test_causal_predictions_of_a_recording_are_those_of_its_synchronized_rows(skins: Skins, tmp_path: Path) -> None:
    files = RegressTask.train.function(MODELS[0], dataset(skins.rows), None, tmp_path).files
    model = LearnedModel.load(files)

    class Opened:
        class source:  # noqa: N801
            chain = (SYNCHRONIZE,)

    opened: Any = Opened()
    opened.files = files
    request: Any = dataclasses.make_dataclass("Request", ["quantiles", "allow_look_ahead"])((), allow_look_ahead=False)
    result = RegressLive().predict(opened, dataset(skins.recording), request)
    assert result.recordings["trial-0"].streams[""].equals(model.tables(dataset(skins.rows))["trial-0"])
