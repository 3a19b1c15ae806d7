"""A session of any task publishes what `tacpipe predict --causal` gives its recording, to the bit, however samples come."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.live import wire
from tacpipe.live.decoding import Decoder
from tacpipe.live.rows import RowEngine
from tacpipe.live.settings import Settings
from tacpipe.plugins import registry
from tacpipe.plugins.model import PredictionRequest
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, LOST, OVER
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.tasks.classify.params import ClassifyLinear
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.learning.model import recentre
from tacpipe.tasks.regress.params import RegressBoosting
from tacpipe.tasks.slip.params import SlipBoosting
from tests.fake_recordings import FakeRecording, FakeShard, dataset
from tests.live import test_material as slides
from tests.live.rigs import SMALL, segmented, stage, step
from tests.sensors import made
from tests.stage_params import fitting
from tests.tasks.slip.slip_recordings import trained as trained_slip

pytestmark = pytest.mark.long
MS = 1_000_000
PERIOD_NS, START_NS, OFFSET_NS, ROWS = 20 * MS, 10**12, 5 * 10**17, 500
HELD_NS = 7000 * MS  # time after the start from which samples are held up
RIG = "".join(
    f'[[stream]]\nname = "{name}"\nsensor = "xela"\ntransport = "ws:127.0.0.1:{port}"\noptions = {{ rate_hz = 50 }}\n'
    for name, port in (("left", 5001), ("right", 5002))
)


class Delivery(NamedTuple):
    """Bytes of a stream: when they arrived, and when the engine received them."""

    taken_ns: int
    arrived_ns: int
    stream: str
    packet: bytes | None  # None: the link was lost


def deliver(packets: Mapping[str, list[bytes]], period_ns: int = PERIOD_NS) -> list[Delivery]:
    """Return packets that arrive one each period, those of the second stream 3 ms after those of the first."""
    deliveries = []
    for number, (stream, sent) in enumerate(packets.items()):
        for row, packet in enumerate(sent):
            at_ns = START_NS + row * period_ns + number * 3 * MS
            deliveries.append(Delivery(at_ns, at_ns, stream, packet))
    return deliveries


def in_bursts(deliveries: list[Delivery]) -> list[Delivery]:
    """Have eight packets of a stream arrive at once, as from an adapter with a slow timer."""
    burst_ns = 8 * PERIOD_NS
    late_ns = [-(-(sent.arrived_ns - START_NS) // burst_ns) * burst_ns + START_NS for sent in deliveries]
    return [sent._replace(taken_ns=at_ns, arrived_ns=at_ns) for sent, at_ns in zip(deliveries, late_ns, strict=True)]


def unplugged(deliveries: list[Delivery]) -> list[Delivery]:
    """Lose the last stream from the fourth second to the sixth."""
    stream, first_ns, last_ns = deliveries[-1].stream, START_NS + 4000 * MS, START_NS + 6000 * MS
    kept = [sent for sent in deliveries if sent.stream != stream or not first_ns < sent.arrived_ns < last_ns]
    return [*kept, Delivery(first_ns, first_ns, stream, None)]


def starting_late(deliveries: list[Delivery]) -> list[Delivery]:
    """Start the last stream five seconds after the recording began."""
    stream = deliveries[-1].stream
    return [sent for sent in deliveries if sent.stream != stream or sent.arrived_ns > START_NS + 5000 * MS]


def held_up(deliveries: list[Delivery]) -> list[Delivery]:
    """Have the engine receive half a second of the last stream at its end, as from a thread that did not run."""
    stream, first_ns, last_ns = deliveries[-1].stream, START_NS + HELD_NS, START_NS + HELD_NS + 500 * MS
    return [
        sent._replace(taken_ns=last_ns) if sent.stream == stream and first_ns <= sent.arrived_ns < last_ns else sent
        for sent in deliveries
    ]


DISTURBANCES: dict[str, Callable[[list[Delivery]], list[Delivery]]] = {
    "steady": lambda deliveries: deliveries,
    "in bursts": in_bursts,
    "unplugged": unplugged,
    "starting late": starting_late,
    "held up": held_up,
}


class Trained:
    """A model as `tacpipe.open` returns it, with the streams that it reads."""

    digest = "0" * 64

    def __init__(self, task: str, files: Mapping[str, bytes], chain: list[Any], rig_text: str, **task_settings: Any):
        live = registry.load_task(task).live
        assert live is not None
        self.live, self.files, self.source, self.chain = live, files, self, chain
        self.rig = rigs.parse(rig_text)
        self.sensors = {name: stream.sensor for name, stream in self.rig.streams.items()}
        self.settings = Settings("model", task=live.settings(**task_settings))

    def engine(self) -> RowEngine[Any]:
        """Return the engine of a session."""
        opened: Any = self
        engine = self.live.engine(opened, self.rig, self.sensors, self.settings)
        assert isinstance(engine, RowEngine)
        return engine

    def predict(self, recording: FakeRecording) -> pa.Table:
        """Return what `tacpipe predict --causal` gives a recording."""
        opened: Any = self
        request = PredictionRequest(steps=(1, 3))
        (output,) = self.live.predict(opened, dataset(recording), request).recordings.values()
        return output.streams[""]


def run(engine: RowEngine[Any], deliveries: list[Delivery]) -> list[Any]:
    """Return the messages of a session that receives these deliveries."""
    engine.take("", StreamNote(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
    for stream in engine.sensors:
        engine.take(stream, StreamNote(START_NS, stream, BEGAN))
    waiting = sorted(deliveries, key=lambda sent: (sent.taken_ns, sent.arrived_ns, sent.stream))
    messages: list[Any] = []
    last_ns, place = waiting[-1].taken_ns, 0
    for now_ns in range(START_NS, last_ns + 400 * MS, 2 * MS):
        while place < len(waiting) and waiting[place].taken_ns <= now_ns:
            sent = waiting[place]
            note = StreamNote(sent.arrived_ns, sent.stream, LOST, "unplugged")
            content = note if sent.packet is None else Chunks.from_pairs([(sent.arrived_ns, sent.packet)])
            engine.take(sent.stream, content)
            place += 1
        messages += engine.step(now_ns)
    engine.take("", StreamNote(0, "", wire.END))
    for stream in engine.sensors:
        engine.take(stream, StreamNote(0, stream, OVER))
    return [*messages, *engine.step(last_ns + 500 * MS)]


def recorded(sensors: Mapping[str, Any], deliveries: list[Delivery], **attributes: Any) -> FakeRecording:
    """Return the recording of these deliveries."""
    tables = {}
    for name, sensor in sensors.items():
        decoder = Decoder(sensor)
        for sent in sorted((sent for sent in deliveries if sent.stream == name), key=lambda sent: sent.arrived_ns):
            note = StreamNote(sent.arrived_ns, name, LOST, "unplugged")
            decoder.take(note if sent.packet is None else Chunks.from_pairs([(sent.arrived_ns, sent.packet)]))
        tables[name] = pa.concat_tables(decoder.columns(batch, OFFSET_NS).table() for batch in decoder.last())
    return FakeRecording(tables, "trial-0", {"master": "left", "ended": "stopped", **attributes})


class Case(NamedTuple):
    """A trained model, the packets of a session, and the numbers in a message and in a row of predictions."""

    model: Trained
    packets: Mapping[str, list[bytes]]
    published: Callable[[Any], Any]
    predicted: Callable[[Mapping[str, Any]], Any]
    attributes: Mapping[str, Any] = {}
    period_ns: int = PERIOD_NS


def skin_packets(seed: int) -> dict[str, list[bytes]]:
    """Return packets of two skins with random samples."""
    sensors = rigs.parse(RIG).streams
    return {
        name: split_frames(stream.sensor, stream.sensor.encode(made.samples("xela", stream.sensor, ROWS, seed + place)))
        for place, (name, stream) in enumerate(sensors.items())
    }


def skin_recording(seed: int, **attributes: Any) -> FakeRecording:
    """Return a steady recording of two skins."""
    sensors = {name: stream.sensor for name, stream in rigs.parse(RIG).streams.items()}
    return dataclasses.replace(recorded(sensors, deliver(skin_packets(seed)), **attributes), name=f"trial-{seed}")


def forward_case(folder: Path) -> Case:
    shards = [segmented(skin_recording(seed)) for seed in (10, 20, 30)]
    params = fitting("train.forward", {**SMALL, "actions": "none"})
    files = forward_training.train(params, dataset(*shards[:2]), dataset(shards[2]), folder)
    model = Trained("forward", files, [step("synchronize"), step("segment.contacts")], RIG)
    names = model.engine().rows.channels

    def published(message: Any) -> Any:
        return message.values[[0, 2]].ravel()

    def predicted(row: Mapping[str, Any]) -> Any:
        return np.array([row[f"{name}_t{number}"] for number in (1, 3) for name in names], np.float32)

    return Case(model, skin_packets(0), published, predicted)


def labelled(seed: int) -> FakeShard:
    """Return the synchronized rows of a recording with a target and a label."""
    shard = stage("synchronize", skin_recording(seed, session="today"))
    values = shard.content["left_taxel01_z"].to_numpy().astype(float)
    table = shard.content.append_column(pa.field("force", pa.float64(), metadata={"unit": "N"}), pa.array(values))
    return dataclasses.replace(
        shard, content=table.append_column("phase", pa.array((values > np.median(values)).astype(np.int64)))
    )


def learned_case(task: str, params: Any, folder: Path) -> Case:
    files = registry.load_task(task).train.function(params, dataset(labelled(0)), None, folder).files
    if params.recentre:
        files = recentre(files, dataset(labelled(5))).files
    names = ["force"] if task == "regress" else ["0", "1"]
    prefix = "" if task == "regress" else "probability_"
    return Case(
        Trained(task, files, [step("synchronize")], RIG),
        skin_packets(0),
        lambda message: [message.by_name[name] for name in names],
        lambda row: [row[f"{prefix}{name}"] for name in names],
    )


def slip_case(folder: Path) -> Case:
    small = SlipBoosting(trees=10, leaves=4, leaf=5, learning_rate=0.3, window_s=0.4, horizon_s=0.4, rest_s=0.1)
    recording = skin_recording(0, slip_intervals="1.2-1.4 2.2-2.4 6.0-6.5")
    model = Trained("slip", trained_slip(small, dataset(recording), None, folder), [], RIG)
    return Case(model, skin_packets(0), lambda message: [message.probability], lambda row: [row["probability"]])


def material_case(folder: Path) -> Case:
    opened = slides.Opened(slides.train("statistics", folder))
    session = slides.Session(opened)
    model = Trained("material", opened.files, list(opened.source.chain), slides.RIG_TEXT)
    return Case(
        model,
        {"finger": session.packets},
        lambda message: message.probabilities,
        lambda row: np.array([row[name] for name in row if name.startswith("probability_")], np.float32),
        {"sensor": "biotac", "rate_hz": session.sensor.rate_hz},
        10 * MS,
    )


CASES: dict[str, Callable[[Path], Case]] = {
    "forward": forward_case,
    "regress": functools.partial(
        learned_case, "regress", RegressBoosting(target="force", context_s=0.1, rest_s=0.1, trees=10, inputs="*_taxel*")
    ),
    "classify": functools.partial(
        learned_case, "classify", ClassifyLinear(label="phase", context_s=0.1, inputs="*_taxel*", recentre="session")
    ),
    "slip": slip_case,
    "material": material_case,
}


def test_every_task_that_answers_samples_is_tried() -> None:
    assert {*CASES, "touch"} == {name for name in registry.tasks() if registry.load_task(name).live is not None}


@pytest.fixture(scope="module")
def case(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return CASES[request.param](tmp_path_factory.mktemp("workspace"))


# a slide of a single stream is over when that starts after five seconds
PAIRS = [pair for pair in itertools.product(CASES, DISTURBANCES) if pair != ("material", "starting late")]


@pytest.mark.parametrize(("case", "disturbance"), PAIRS, indirect=["case"], scope="module")
def test_published_answers_are_those_of_the_recording_to_the_bit(disturbance: str, case: Case) -> None:
    deliveries = DISTURBANCES[disturbance](deliver(case.packets, case.period_ns))
    engine = case.model.engine()
    messages = run(engine, deliveries)
    answered = {message.t_ns: message for message in messages if message.answers}
    table = case.model.predict(recorded(case.model.sensors, deliveries, **case.attributes))
    expected = {row["t_ns"]: case.predicted(row) for row in table.to_pylist()}
    assert expected
    compared = sorted(answered.keys() & expected.keys())
    assert len(compared) > 0.5 * len(expected)
    differing = [t_ns for t_ns in compared if np.any(case.published(answered[t_ns]) != np.asarray(expected[t_ns]))]
    assert (engine.late > 1) == (disturbance == "held up")  # a first frame counts that the next one confirms
    held_up_ns = OFFSET_NS + START_NS + HELD_NS
    assert all(held_up_ns <= t_ns < held_up_ns + 1500 * MS for t_ns in differing)
    assert engine.late or not differing
