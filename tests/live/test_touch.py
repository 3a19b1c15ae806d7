"""Test that candidate grasps are ranked by the predictions of `tacpipe predict` and a criterion."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live import wire
from tacpipe.live.messages import packets
from tacpipe.recording import rig as rigs_of
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.grasps import is_request
from tacpipe.sensors.live import Live
from tacpipe.tasks.touch import model as touch_prediction
from tacpipe.tasks.touch.live import engine as touch_engine
from tacpipe.tasks.touch.live.engine import WAITING, TouchEngine
from tacpipe.tasks.touch.live.messages import COLUMNS, TouchMessage
from tacpipe.tasks.touch.predictor import Predictor
from tests.tasks.touch import handmade

OFFSET_NS = 10**18
COUNT = 5
KINDS: dict[str, dict[str, Any]] = {
    "tree-ensemble": {},
    "patches": {"architecture": "patches"},
    "pointnet": handmade.POINTNET,
}
Files = Mapping[str, bytes]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Files]:
    return {kind: handmade.trained(tmp_path_factory.mktemp(kind), **params) for kind, params in KINDS.items()}


def candidates() -> list[Grasp]:
    return [handmade.grasp(number) for number in range(20, 20 + COUNT)]


def request(cloud: Any = None, grasps: list[Grasp] | None = None, number: int = 7) -> dict[str, Any]:
    """Return a request as a planner sends it."""
    listed = [
        {
            "g1": grasp.g1_m.tolist(),
            "g2": grasp.g2_m.tolist(),
            "wrist": None if grasp.wrist is None else grasp.wrist.tolist(),
        }
        for grasp in (candidates() if grasps is None else grasps)
    ]
    points = cloud
    if isinstance(cloud, Cloud):
        points = cloud.points_m.astype(np.float64)
        points = np.hstack([points, np.zeros((len(points), 0)) if cloud.colours is None else cloud.colours]).tolist()
    return {"version": 1, "request": number, "cloud": points, "grasps": listed}


class Session:
    """An engine with one stream of requests."""

    def __init__(self, files: Files, rank: str = "contact", folder: Path | None = None) -> None:
        self.sensor = rigs_of.build_sensor("grasps", {} if folder is None else {"folder": str(folder)}, "requests")
        self.engine = TouchEngine({"requests": self.sensor}, Predictor.load(files), touch_engine.criterion(rank))
        self.t_ns = 0
        self.engine.take("", StreamNote(0, "", wire.BEGIN, str(OFFSET_NS)))
        self.engine.take("requests", StreamNote(0, "requests", BEGAN))

    def send(self, *requests: Any) -> None:
        """Have requests arrive, a millisecond apart."""
        for content in requests:
            self.t_ns += 1_000_000
            self.engine.take("requests", Chunks.from_pairs([(self.t_ns, json.dumps(content).encode())]))

    def ask(self, content: Any) -> TouchMessage:
        """Return the answer to a request."""
        self.send(content)
        (message,) = self.engine.step(self.t_ns)
        return message


def predicted(files: Files, cloud: Cloud) -> Any:
    """Return what `tacpipe predict` gives the candidates (grasp, value)."""
    shards = [
        handmade.recording(number, "unseen", felt=False, cloud=cloud, grasp=grasp)
        for number, grasp in enumerate(candidates())
    ]
    table = touch_prediction.predict(files, handmade.dataset(*shards)).recordings["predictions"].streams[""]
    columns = [name for name in COLUMNS if name in table.column_names]
    return columns, np.column_stack([table.column(name).to_numpy() for name in columns])


@pytest.mark.parametrize("kind", KINDS)
def test_the_touch_of_each_candidate_is_that_of_predict(kind: str, models: dict[str, Files]) -> None:
    cloud = handmade.cloud(3)
    message = Session(models[kind]).ask(request(cloud))
    columns, expected = predicted(models[kind], cloud)
    assert message.touch is not None and message.touch.shape == (COUNT, len(COLUMNS))
    values = message.touch[:, [COLUMNS.index(name) for name in columns]].astype(np.float32)
    assert values.tobytes() == expected.astype(np.float32).tobytes()
    missing = [COLUMNS.index(name) for name in COLUMNS if name not in columns]
    assert np.isnan(message.touch[:, missing]).all()
    assert message.t_ns == OFFSET_NS + 1_000_000 and message.request == 7


def test_candidates_are_ranked_by_contact_balance_or_a_level_as_computed_by_hand(models: dict[str, Files]) -> None:
    cloud = handmade.cloud(3)
    _, values = predicted(models["tree-ensemble"], cloud)
    level = {}
    for finger in ("th", "mf"):
        low, high = biotac_sp.RANGES[f"pdc_{finger}"]
        pressed = (values[:, COLUMNS.index(f"pdc_{finger}")].astype(np.float64) - low) / (high - low)
        low, high = biotac_sp.RANGES[f"e_{finger}"]
        first = COLUMNS.index(f"e_{finger}_01")
        fallen = 1 - (values[:, first : first + 24].astype(np.float64) - low) / (high - low)
        level[finger] = (pressed + fallen.mean(axis=1)) / 2
    mean = (level["th"] + level["mf"]) / 2
    expected = {
        "contact": mean,
        "balance": -np.abs(level["th"] - level["mf"]),
        "level:0.45": -np.abs(mean - 0.45),
    }
    for rank, scores in expected.items():
        message = Session(models["tree-ensemble"], rank).ask(request(cloud))
        assert np.allclose(message.scores, scores, atol=1e-6)
        assert message.ranks.index(1) == int(scores.argmax())
        content: Any = message.to_dict()
        assert content["best"] == int(scores.argmax()) and content["criterion"] == rank
        assert [candidate["rank"] for candidate in content["candidates"]] == list(message.ranks)
        assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_a_cloud_comes_as_points_as_a_file_of_the_folder_or_from_the_request_before(
    models: dict[str, Files], tmp_path: Path
) -> None:
    cloud = handmade.cloud(3)
    assert cloud.colours is not None
    (tmp_path / "egg.ply").write_bytes(point_files.pack_ply(cloud.points_m, cloud.colours))
    np.savez(tmp_path / "egg.npz", points_m=cloud.points_m, colours=cloud.colours)
    session = Session(models["tree-ensemble"], folder=tmp_path)
    first = session.ask(request(cloud)).touch
    assert first is not None
    for cloud_reference in ("egg.ply", "egg.npz", None):
        message = session.ask(request(cloud_reference)).touch
        assert message is not None and message.tobytes() == first.tobytes()


def test_a_request_that_cannot_be_answered_gets_a_cause_and_the_next_one_is_answered(
    models: dict[str, Files], tmp_path: Path
) -> None:
    cloud = handmade.cloud(3)
    far = Grasp(np.array([1.0, 1, 1]), np.array([1.1, 1, 1]))
    same: Any = {"version": 1, "request": 1, "cloud": None, "grasps": [{"g1": [0, 0, 0], "g2": [0, 0, 0]}]}
    (tmp_path / "bad.npz").write_bytes(b"no")
    session = Session(models["tree-ensemble"], folder=tmp_path)
    for content, sentence in (
        (request(None), "no cloud"),
        (request("absent.ply"), "absent.ply"),
        (request("../x.ply"), "not within"),
        (request("/etc/passwd"), "not within"),
        (request("bad.npz"), "bad.npz"),
        (request(cloud, [far]), "from the nearest point"),
        (same, "two different points"),
        (request([[0.0, 0.0, 0.0]]), "cloud of 1 points"),
    ):
        message = session.ask(content)
        assert message.touch is None and sentence in message.cause, message.cause
        assert message.to_dict()["candidates"] is None and packets(message, live(), 0) == []
    assert session.ask(request(cloud)).answers
    closed = Session(models["tree-ensemble"]).ask(request("egg.ply"))
    assert "option folder" in closed.cause


def test_of_more_requests_than_can_wait_the_oldest_are_left_out_and_counted(models: dict[str, Files]) -> None:
    session = Session(models["tree-ensemble"])
    session.send(*(request(handmade.cloud(3), number=number) for number in range(WAITING + 3)))
    messages = []
    while answered := session.engine.step(session.t_ns):
        messages += answered
    assert [message.request for message in messages] == list(range(3, WAITING + 3))
    assert session.engine.skipped == messages[-1].skipped == 3


@pytest.mark.parametrize(
    "change",
    [
        {"version": 2},
        {"request": "a"},
        {"grasps": []},
        {"grasps": [{"g1": [0, 0, 0]}]},
        {"grasps": [{"g1": [0, 0, 0], "g2": [0, 0, "x"]}]},
        {"grasps": [{"g1": [0, 0, 0], "g2": [1, 0, 0], "wrist": [[1, 0, 0]]}]},
        {"cloud": []},
        {"cloud": [[0, 0]]},
        {"cloud": [[0, 0, 0], [0, 0, 0, 1, 1, 1]]},
        {"cloud": 5},
    ],
)
def test_what_is_no_request_is_no_frame(change: dict[str, Any]) -> None:
    assert is_request(json.dumps(request(handmade.cloud(3))).encode())
    assert not is_request(json.dumps(request(handmade.cloud(3)) | change).encode())


def live() -> Live:
    sensor = rigs_of.build_sensor("live", {"task": "touch", "output": "touch", "channels": list(COLUMNS)}, "live")
    assert isinstance(sensor, Live)
    return sensor


def test_the_sessions_stream_has_a_row_a_candidate(models: dict[str, Files]) -> None:
    message = Session(models["tree-ensemble"]).ask(request(handmade.cloud(3)))
    sensor = live()
    sent = packets(message, sensor, 3)
    samples = sensor.decode(np.stack([np.frombuffer(packet, np.uint8) for packet in sent]))
    assert samples.seq is not None and samples.seq.tolist() == [3, 4, 5, 6, 7]
    assert samples.values[0].tolist() == [[7, row, rank] for row, rank in enumerate(message.ranks)]
    assert message.touch is not None
    assert np.array_equal(samples.values[1][:, 3:], message.touch.astype(np.float32))


def test_a_rig_without_requests_and_a_criterion_that_cannot_be_are_refused(models: dict[str, Files]) -> None:
    sensors = {"range": rigs_of.build_sensor("tfmini", {}, "range")}
    with pytest.raises(TacpipeError, match="sensor grasps"):
        TouchEngine(sensors, Predictor.load(models["tree-ensemble"]), touch_engine.criterion("contact"))
    with pytest.raises(TacpipeError, match="both fingers"):
        Session(models["pointnet"], "balance")  # this model predicts the thumb's pressure alone
    for text in ("", "best", "level", "level:x", "level:nan", "contact:1"):
        with pytest.raises(UsageError, match="--rank"):
            touch_engine.criterion(text)
