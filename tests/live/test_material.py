"""Test that live materials are those of the samples so far, and finally those of `tacpipe predict`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live import wire
from tacpipe.live.messages import packets
from tacpipe.live.rows import OVERLOADED, RESTARTED
from tacpipe.live.settings import Settings
from tacpipe.plugins import registry
from tacpipe.recording import rig as rigs_of
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, OVER
from tacpipe.scores import calibration
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.live import Live
from tacpipe.sensors.sensor import Samples
from tacpipe.simulation.slide import SlideRig, simulate_trial
from tacpipe.tasks.material import calibration as material_calibration
from tacpipe.tasks.material import network_training, sensor_calibration
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.live import slides as material_replay
from tacpipe.tasks.material.live.engine import MaterialEngine
from tacpipe.tasks.material.live.messages import FINAL, SLIDING, WAITING, MaterialMessage
from tacpipe.tasks.material.live.slide import UNLIKE
from tacpipe.tasks.material.live.task import MaterialLive, MaterialSettings
from tacpipe.tasks.material.model import predictions
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import FakeDataset, FakeRecording
from tests.live import rigs
from tests.simulation.slide_datasets import SEED, indices, slides
from tests.stage_params import fitting
from tests.tasks.material.textures import Slide

FRAMES = 120
RIG_TEXT = '[[stream]]\nname = "finger"\nsensor = "biotac"\ntransport = "serial:/dev/ttyACM0"\n'
SLIDE_COLUMNS = ["class", "rows", "seen", "ended", "slide"]
EVERY_NS = 100_000_000
SETTLE_NS = 2_000_000
OFFSET_NS = 10**18
RIG = SlideRig(materials=3, pac=False, arm_every=0)
TRAINED, UNSEEN = range(3), 3
KINDS: dict[str, dict[str, Any]] = {
    "statistics": {"architecture": "statistics"},
    "x-lstm": {"architecture": "x-lstm", "hidden": 6, "epochs": 1, "batch": 4},
    "minirocket": {"architecture": "minirocket", "features": 200},
}


class Opened:
    """A model of slides of a BioTac, as `tacpipe.open` gives it."""

    def __init__(self, files: Any, **params: Any) -> None:
        self.files, self.source = files, self
        self.chain = [rigs.step("segment.slides", frames=FRAMES, **params)]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Opened]:
    return {kind: Opened(train(kind, tmp_path_factory.mktemp(kind))) for kind in KINDS}


def train(kind: str, folder: Path) -> Any:
    """Return the files of a model of the simulated slides."""
    parts = [
        slides(RIG, indices(RIG, ["biotac"], chosen_trials), frames=FRAMES) for chosen_trials in (TRAINED, [UNSEEN])
    ]
    return network_training.train(fitting("train.material", KINDS[kind]), parts[0], parts[1], folder, None)


def opened(model: Any, sensors: dict[str, Any], **changed: Any) -> MaterialEngine:
    """Return the engine of a session with these settings."""
    settings = Settings("models/material", task=MaterialSettings(**{"least": 0.5, **changed}))
    return MaterialLive().engine(model, rigs_of.parse(RIG_TEXT), sensors, settings)


def trial(kind: int) -> Any:
    """Return the stream of a simulated slide that no model was trained on."""
    return simulate_trial(SEED, indices(RIG, ["biotac"], [UNSEEN])[kind], RIG).streams["biotac"]


class Session:
    """An engine with a BioTac, whose frames arrive as those of a simulated trial."""

    def __init__(self, model: Any, kind: int = 1, table: Any = None, **changed: Any) -> None:
        self.sensor = rigs_of.build_sensor("biotac", {}, "finger")
        self.engine = opened(model, {"finger": self.sensor}, **changed)
        self.table = trial(kind) if table is None else table
        names = [field.name for field in self.sensor.fields()]
        values = np.column_stack([self.table.column(name).to_numpy() for name in names]).astype(np.uint16)
        self.t_ns = self.table.column("t_ns").to_numpy() - OFFSET_NS
        samples = Samples((values,), seq=np.arange(len(values)))
        self.packets = split_frames(self.sensor, self.sensor.encode(samples))
        self.sent = 0

    def begin(self) -> None:
        """Begin the recording."""
        self.engine.take("", StreamNote(0, "", wire.BEGIN, str(OFFSET_NS)))
        self.engine.take("finger", StreamNote(0, "finger", BEGAN))

    def run(self, until_ns: int, cut: int = 7) -> list[MaterialMessage]:
        """Have all arrive up to a time, some at once, and return what is published meanwhile."""
        messages: list[Any] = []
        while self.sent < len(self.t_ns) and self.t_ns[self.sent] <= until_ns:
            stop = min(self.sent + cut, int(np.searchsorted(self.t_ns, until_ns, side="right")))
            chunks = [(int(self.t_ns[row]), self.packets[row]) for row in range(self.sent, stop)]
            self.engine.take("finger", Chunks.from_pairs(chunks))
            self.sent = stop
            messages += self.engine.step(int(self.t_ns[stop - 1]) + SETTLE_NS)
        return messages

    def end(self) -> MaterialMessage:
        """End the recording and return the last message."""
        self.engine.take("", StreamNote(0, "", wire.END))
        self.engine.take("finger", StreamNote(0, "finger", OVER))
        last = self.engine.step(int(self.t_ns[-1]) + 10**9)[-1]
        assert isinstance(last, MaterialMessage)
        return last


def predicted(model: Any, table: Any, **params: Any) -> Any:
    """Return the probabilities that `tacpipe predict` gives a recording of this stream, None where it refuses it."""
    stage = registry.load("segment.slides")
    recording = Slide({"finger": table}, "trial", {"sensor": "biotac"})
    try:
        cut = stage(stage.params(frames=FRAMES, **params), recording)
    except TacpipeError:
        return None
    shard = Slide(cut.streams, "trial", {**recording.attributes, **cut.attributes})
    scores = predictions(Classifier.load(model.files), FakeDataset({"trial": shard}, {}))  # type: ignore[arg-type]
    columns = [name for name in scores.column_names if name.startswith("score_")]
    return calibration.probabilities(np.column_stack([scores.column(name).to_numpy() for name in columns]))[0].astype(
        np.float32
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_answer_at_the_end_is_that_of_predict_however_the_bytes_were_cut(
    kind: str, models: dict[str, Opened]
) -> None:
    expected = None
    for cut in (1, 13):
        session = Session(models[kind])
        session.begin()
        session.run(10**19, cut)
        last = session.end()
        expected = predicted(models[kind], session.table) if expected is None else expected
        assert last.state == FINAL and last.seen == 1.0 and last.probabilities is not None
        assert last.probabilities.tobytes() == expected.tobytes()
        assert not session.engine.running and session.engine.late <= 1  # the first frame, which the next one confirms


@pytest.mark.parametrize("kind", KINDS)
def test_each_answer_is_that_of_a_recording_which_ends_then(kind: str, models: dict[str, Opened]) -> None:
    session = Session(models[kind])
    session.begin()
    messages = session.run(10**19)
    complete = [message for message in messages if message.seen == 1.0]
    assert len(complete) > 20 and all(message.state == SLIDING for message in complete)
    for message in complete[:: len(complete) // 4]:
        rows = int((session.t_ns <= message.t_ns - OFFSET_NS).sum())
        expected = predicted(models[kind], session.table.slice(0, rows))
        assert message.probabilities is not None and message.probabilities.tobytes() == expected.tobytes()


def test_a_calibrated_model_names_what_predict_answers_or_states_that_the_slide_is_like_none(
    models: dict[str, Opened],
) -> None:
    training, validation = (
        slides(RIG, indices(RIG, ["biotac"], chosen_trials), frames=FRAMES) for chosen_trials in (TRAINED, range(4, 8))
    )
    files = material_calibration.calibrate(
        models["statistics"].files, CalibrationRequest((10, 50, 90), False, 0.1, 0), training, validation
    )
    fitted = sensor_calibration.unpack_calibrations(files[sensor_calibration.CALIBRATION_FILE], {"biotac": None})
    for moved, cause in ((-1e9, ""), (1e9, UNLIKE)):
        bundles = {
            name: replace(fitted_calibration, threshold=fitted_calibration.threshold + moved)
            for name, fitted_calibration in fitted.items()
        }
        session = Session(
            Opened({**files, sensor_calibration.CALIBRATION_FILE: sensor_calibration.pack_calibrations(bundles)})
        )
        session.begin()
        session.run(int(session.t_ns[-1]))
        last = session.end()
        assert (last.probabilities is None) == bool(cause)
        assert last.cause == cause
    assert session.engine.describe("models/material").to_dict()["confidence"] == "probability"


@pytest.mark.parametrize("kind", KINDS)
def test_a_material_is_unknown_until_enough_of_the_slide_has_come(kind: str, models: dict[str, Opened]) -> None:
    session = Session(models[kind])
    session.begin()
    messages = session.run(10**19)
    before = [message for message in messages if message.state == WAITING]
    assert before and {message.cause for message in before} == {"no slide has begun"}
    enough = 1.0 if kind == "minirocket" else 0.5
    for message in messages[len(before) :]:
        assert (message.probabilities is None) == (message.seen < enough) == bool(message.cause)
        content: Any = message.to_dict()
        assert (content["material"] == "unknown") == (message.probabilities is None)
        assert message.probabilities is None or abs(sum(content["probabilities"].values()) - 1) < 1e-5
    fractions = [message.seen for message in messages]
    assert fractions == sorted(fractions) and 0 < fractions[len(before)] < 1


def test_a_finger_that_falls_silent_is_named_and_the_material_is_unknown_until_it_is_back(
    models: dict[str, Opened],
) -> None:
    session = Session(models["statistics"])
    session.begin()
    half = int(session.t_ns[len(session.t_ns) // 2])
    assert session.run(half)[-1].probabilities is not None
    (silent,) = session.engine.step(half + EVERY_NS + SETTLE_NS)
    assert isinstance(silent, MaterialMessage)
    assert silent.probabilities is None and silent.cause == "nothing new comes from finger"
    assert session.run(10**19)[-1].probabilities is not None


# duration of a pause; rows in which nothing is touched between two slides, at 100 Hz
PAUSE_NS, FREE_ROWS = 400_000_000, 120


def touches() -> tuple[Any, list[int]]:
    """Return a stream of three slides with rows between in which nothing is touched, and the last row of each slide."""
    parts, ends, rows = [], [], 0
    for kind in range(3):
        table = trial(kind)
        begins = int((table.column("pdc").to_numpy() > 20).argmax())
        free = table.slice(0, begins)
        assert begins > 10
        parts += [table, *[free] * (FREE_ROWS // begins)]
        rows += table.num_rows
        ends.append(rows - 1)
        rows += begins * (FREE_ROWS // begins)
    joined = pa.concat_tables(parts).combine_chunks()
    t_ns = joined.column("t_ns")[0].as_py() + np.arange(joined.num_rows, dtype=np.int64) * 10_000_000
    place = joined.column_names.index("t_ns")
    return joined.set_column(place, joined.schema.field("t_ns"), pa.array(t_ns)), ends


@pytest.mark.parametrize("cut", [1, 13])
def test_each_of_several_slides_has_its_final_answer_which_is_that_of_predict(
    cut: int, models: dict[str, Opened]
) -> None:
    model = Opened(models["statistics"].files, trigger="load")
    table, ends = touches()
    session = Session(model, table=table, pause_s=PAUSE_NS / 1e9)
    session.begin()
    published = session.run(10**19, cut)
    published.append(session.end())
    finals = [message for message in published if message.state == FINAL]
    assert [message.slide for message in finals] == [
        1,
        2,
        3,
        4,
    ]  # a pause is left behind the last slide, in which none began
    assert finals[-1].probabilities is None and finals[-1].cause == "no slide has begun"
    t_ns, begins = table.column("t_ns").to_numpy(), 0
    answered: list[bytes] = []
    for message, last in zip(finals[:3], ends, strict=True):
        stop = int(np.searchsorted(t_ns, message.t_ns, side="right"))
        assert (
            0 < message.t_ns - t_ns[last] <= PAUSE_NS + 10**8
        )  # the end lies in the pause: the finger leaves within the trial
        expected = predicted(model, table.slice(begins, stop - begins), trigger="load")
        assert message.probabilities is not None and message.probabilities.tobytes() == expected.tobytes()
        answered.append(message.probabilities.tobytes())
        assert all(
            earlier.slide == message.slide for earlier in published if t_ns[begins] < earlier.t_ns <= message.t_ns
        )
        begins = stop
    recordings: Any = type("Given", (), {"recordings": {"rec": FakeRecording({"finger": table}, "rec", RECORDED)}})()
    (replayed,) = material_replay.predict(model, recordings).recordings.values()  # type: ignore[arg-type]
    rows = replayed.streams[""]
    assert rows.column("slide").to_pylist() == [1, 2, 3, 4]
    assert rows.column("t_ns").to_pylist()[:3] == [message.t_ns for message in finals[:3]]
    names = [name for name in rows.column_names if name.startswith("probability_")]
    likely = np.column_stack([rows.column(name).to_numpy() for name in names]).astype(np.float32)
    assert likely[:3].tobytes() == b"".join(answered)
    assert rows.column("material").to_pylist()[3] == "unknown" and np.isnan(likely[3]).all()


RECORDED = {"sensor": "biotac", "rate_hz": 100, "live_pause_s": PAUSE_NS / 1e9, "live_least": 0.5}


def test_without_a_pause_a_recording_is_one_slide(models: dict[str, Opened]) -> None:
    model = Opened(models["statistics"].files, trigger="load")
    table, _ = touches()
    session = Session(model, table=table)
    session.begin()
    assert all(message.slide == 1 and message.state != FINAL for message in session.run(10**19, 50))
    assert session.end().state == FINAL


def test_a_pause_is_refused_where_only_an_arm_could_end_a_slide(models: dict[str, Opened]) -> None:
    with pytest.raises(UsageError, match="the rig has no stream but finger"):
        Session(models["statistics"], pause_s=0.5)


def test_what_was_lost_makes_this_recording_unknown_and_not_the_next(models: dict[str, Opened]) -> None:
    session = Session(models["statistics"])
    session.engine.take("", StreamNote(0, "", wire.CONTINUE, json.dumps({"slide": 2})))
    session.begin()
    messages = session.run(int(session.t_ns[300]))
    assert messages and {message.cause for message in messages} == {RESTARTED}
    session.begin()
    session.engine.take("", StreamNote(0, "", wire.OVERFLOW))
    assert {message.cause for message in session.run(int(session.t_ns[400]))} == {OVERLOADED}
    next_session = Session(models["statistics"])
    next_session.begin()
    assert next_session.run(10**19)[-1].cause == ""


def test_rows_of_the_sessions_stream_hold_what_was_published() -> None:
    sensor = rigs_of.build_sensor(
        "live", {"task": "material", "output": "material", "channels": ["cork", "felt"]}, "live"
    )
    assert isinstance(sensor, Live)
    assert [field.name for field in sensor.fields()] == [*SLIDE_COLUMNS, "probability_cork", "probability_felt"]
    for probabilities in (None, np.array([0.25, 0.75], np.float32)):
        message = MaterialMessage(1, 5, ("cork", "felt"), probabilities, SLIDING, 60, 0.5)
        (sent,) = packets(message, sensor, 7)
        samples = sensor.decode(np.frombuffer(sent, np.uint8)[None])
        assert samples.seq is not None and samples.t_device_ns is not None
        assert (samples.seq[0], samples.t_device_ns[0]) == (7, 5)
        number = -1 if probabilities is None else 1
        assert samples.values[0][0][:5].tolist() == [number, 60, 0.5, 0, 1]
        likely = [np.nan, np.nan] if probabilities is None else probabilities
        assert np.array_equal(samples.values[0][0][5:], likely, equal_nan=True)


def test_a_rig_that_the_model_cannot_read_is_refused_by_what_is_missing(models: dict[str, Opened]) -> None:
    model: Any = models["statistics"]
    biotac, range_finder = (rigs_of.build_sensor(kind, {}, kind) for kind in ("biotac", "tfmini"))
    two = rigs_of.build_sensor("biotac", {"fingers": 2}, "biotac")
    for sensors, changed, sentence in (
        ({"range": range_finder}, {}, "tactile"),
        ({"a": biotac, "b": biotac}, {}, "2 streams"),
        ({"finger": two}, {}, "other channels"),
        ({"finger": biotac}, {"sensor": "roboskin"}, "roboskin"),
    ):
        with pytest.raises(TacpipeError, match=sentence):
            opened(model, sensors, **changed)
    lowest: Any = Opened(model.files, trigger="load", rest="lowest")
    with pytest.raises(TacpipeError, match="lowest"):
        opened(lowest, {"finger": biotac})


def test_a_model_of_several_sensors_needs_the_name_of_the_rigs(tmp_path: Path) -> None:
    rig = SlideRig(materials=2, pac=False, arm_every=0)
    parts = [
        slides(rig, indices(rig, ["biotac", "roboskin"], chosen_trials), frames=FRAMES)
        for chosen_trials in (range(2), [2])
    ]
    model: Any = Opened(
        network_training.train(fitting("train.material", KINDS["statistics"]), parts[0], parts[1], tmp_path, None)
    )
    sensors = {"finger": rigs_of.build_sensor("biotac", {}, "finger")}
    with pytest.raises(UsageError, match="--sensor"):
        opened(model, sensors)
    assert opened(model, sensors, sensor="biotac").describe("m").frames == FRAMES
