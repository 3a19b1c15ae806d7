"""The set-point of an arm's controller is read from the arm's own stream, and taken to go on as it did."""

from typing import Any

import numpy as np
import pytest

from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.live.decoding import likely_schema
from tacpipe.recording import rig as rigs_of
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.forward import causal
from tacpipe.tasks.forward.live.chain import Cause, LiveChain
from tacpipe.tasks.forward.live.plans import Targets
from tests.fake_recordings import FakeRecording
from tests.live import rigs
from tests.live.rigs import MS, T0, Made
from tests.sensors import made

ARMS: dict[str, dict[str, Any]] = {
    "franka": {"targets": True},
    "ur-rtde": {"outputs": ("actual_TCP_pose", "target_TCP_pose")},
    "kuka-rsi": {"outputs": ("RIst", "RSol")},
}


def moving(count: int, step_ms: float = 4.0) -> tuple[Any, Any]:
    """Return stamps and poses of a set-point that moves by 0.2 m/s along x and turns by 0.5 rad/s about z."""
    at_s = np.arange(count) * step_ms / 1e3
    zero, half = np.zeros(count), 0.25 * at_s
    poses = np.column_stack([0.4 + 0.2 * at_s, zero, zero + 0.3, zero, zero, np.sin(half), np.cos(half)])
    return T0 + np.rint(at_s * 1e9).astype(np.int64), poses


@pytest.mark.parametrize("kind", ARMS)
def test_the_set_points_of_an_arm_are_read_as_pose_and_velocities(kind: str) -> None:
    sensor: Sensor = rigs_of.build_sensor(kind, ARMS[kind], "robot")
    samples = made.samples(kind, sensor, 40, 3)
    t_ns, poses = moving(40)
    names = [field.name for field in sensor.fields()]
    first = names.index("target_position_x_m")
    block = next(
        number
        for number, block_values in enumerate(samples.values)
        if block_values.shape[1] > 1 or len(samples.values) == 1
    )
    before = 0
    for number, block_values in enumerate(samples.values):
        if before <= first < before + block_values.shape[1]:
            block = number
            block_values[:, first - before : first - before + 7] = poses
            break
        before += block_values.shape[1]
    assert samples.values[block].shape[0] == 40
    packets = split_frames(sensor, sensor.encode(samples))
    batch = LinkReader(sensor).feed(Chunks.from_pairs(list(zip(t_ns.tolist(), packets, strict=True))))
    from tacpipe.live.decoding import BatchColumns, batch_schema

    targets = Targets("robot", likely_schema(sensor))
    targets.push(BatchColumns(batch, batch_schema(batch, sensor), 0))
    last = int(batch.t_ns[-1])
    state = targets.state(last)
    row = int(np.searchsorted(t_ns, last))
    assert state is not None
    assert np.abs(state[:7] - poses[row]).max() < 1e-4
    assert np.abs(state[7:] - [0.2, 0, 0, 0, 0, 0.5]).max() < 0.02
    assert targets.state(last + 51 * MS) is None


def test_a_stream_without_set_points_is_refused_with_the_option_that_records_them() -> None:
    with pytest.raises(UsageError, match="target_TCP_pose"):
        Targets("robot", likely_schema(rigs_of.build_sensor("ur-rtde", {}, "robot")))


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return rigs.model(tmp_path_factory.mktemp("planned"))


def aimed(seed: int) -> FakeRecording:
    """A recording whose arm states its set-points too: 30 ms ahead of where it is."""
    recording = rigs.recording(seed)
    robot = recording.tables["robot"]
    t_ns = robot["t_ns"].to_numpy()
    names = [field.name for field in schema.pose_fields()]
    ahead = [np.interp(t_ns + 30 * MS, t_ns, robot[name].to_numpy()) for name in names]
    columns = [robot[name].to_numpy() for name in names]
    table = schema.stream(t_ns, [*columns, *ahead], [*schema.pose_fields(), *schema.target_pose_fields()])
    return FakeRecording({**recording.tables, "robot": table}, recording.name)


def fed(model: Made, recording: FakeRecording, cuts: list[int], plan_from: str = "robot") -> list[Any]:
    chain = LiveChain.for_model(
        *model, {name: table.schema for name, table in recording.tables.items()}, plan_from=plan_from
    )
    forecasts = []
    for name, table, cut in rigs.pieces(recording, cuts, list(recording.tables)):
        chain.push(name, table)
        if name == list(recording.tables)[-1]:
            forecasts += chain.advance(cut)
    return forecasts


def test_a_forecast_reads_set_points_as_its_plan_however_they_came(model: Made) -> None:
    recording = aimed(5)
    uncut = fed(model, recording, [])
    cut = fed(model, recording, [T0 + at * MS for at in range(100, 2900, 37)])
    ready = [forecast for forecast in uncut if forecast.count is not None]
    assert ready and all(forecast.cause == Cause.NONE for forecast in ready)
    assert [forecast.t_ns for forecast in uncut] == [forecast.t_ns for forecast in cut]
    for forecast, cut_forecast in zip(uncut, cut, strict=True):
        assert (forecast.count is None) == (cut_forecast.count is None)
        assert (
            forecast.count is None
            or cut_forecast.count is None
            or forecast.count.tobytes() == cut_forecast.count.tobytes()
        )
    without = {forecast.t_ns: forecast for forecast in fed(model, recording, [], plan_from="")}
    assert {Cause.NO_PLAN} == {forecast.cause for forecast in without.values() if forecast.count is not None}
    assert any((forecast.count != without[forecast.t_ns].count).any() for forecast in ready)


def test_the_plan_is_what_the_set_point_did_last_taken_to_continue(
    model: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []
    used = causal.extrapolate_arm

    def extrapolate_arm(*arguments: Any) -> Any:
        calls.append(arguments)
        return used(*arguments)

    monkeypatch.setattr(causal, "extrapolate_arm", extrapolate_arm)
    recording = aimed(6)
    fed(model, recording, [])
    robot = recording.tables["robot"]
    t_ns, x_m = robot["t_ns"].to_numpy(), robot["target_position_x_m"].to_numpy()
    for at_ns, _, state in calls[:: max(1, len(calls) // 5)]:
        assert abs(state[0] - x_m[np.searchsorted(t_ns, at_ns, side="right") - 1]) < 1e-6


def test_a_stream_that_the_rig_lacks_is_refused_by_its_name(model: Made) -> None:
    with pytest.raises(UsageError, match="gantry"):
        fed(model, aimed(5), [], plan_from="gantry")
