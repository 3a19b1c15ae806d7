"""Forecasts on the simulated rig: the value of the plan, the bounds of a forecast, and the unpredictable part.

Forecasters are trained and evaluated on trials in which nothing slips. Ground truth is for evaluation, never for training.
"""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from tacpipe.arrays import AnyFloats, Bools, Int64s
from tacpipe.plugins.registry import load
from tacpipe.scores.intervals import skill
from tacpipe.simulation import taxels, trajectory
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.predictors import iterate_predictions
from tests.fake_recordings import FakeRecording, FakeShard, column, dataset
from tests.stage_params import fitting

HORIZON = 10
ROW_NS = 20_000_000
STICK = {"friction_scale": 4.0}
STILL = {"still": True, "hold_probability": 0.0}
PLANNED_SLIP = {"effort": 1.05}
GRIP_LOSS = {"effort": 0.9, "grip_loss_probability": 1.0, "grip_loss": 0.3}
TRAINING, WATCHED, TESTED = range(30), range(30, 32), range(32, 44)
SLIPPING = range(100, 124)
ALOFT_M = 0.002  # Offset from its start, when the hand is moving.
SMALL = {
    "hidden": 64,
    "dropout": 0.0,
    "batch": 32,
    "epochs": 11,
    "learning_rate": 4e-3,
    "stride": 6,
    "baselines": False,
}
LAGS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 20)  # Rows before now at which the exact motion is known.

simulate, synchronize, contacts = load("simulate.forward"), load("synchronize"), load("segment.contacts")


@cache
def recorded(index: int, grid: str = "uniform", **rig: Any) -> FakeShard:
    """Return a segmented trial of the rig."""
    recording = simulate(simulate.params(**rig), index)
    synced = synchronize(
        synchronize.params(values="interpolate", **({"rate_hz": 50.0} if grid == "uniform" else {"grid": grid})),
        FakeRecording(recording.streams),
    )
    table = contacts(contacts.params(), FakeRecording({"": synced.streams[""]})).streams[""]
    return FakeShard(f"trial-{index}", table, dict(recording.attributes) | {"grid": grid})


def trials(indices: range, **rig: Any) -> list[FakeShard]:
    return [recorded(index, **rig) for index in indices]


def trained(folder: Path, training: list[FakeShard], watched: list[FakeShard], **params: Any) -> Forecaster:
    fitting_params = fitting("train.forward", SMALL, **params)
    return Forecaster.load(forward_training.train(fitting_params, dataset(*training), dataset(*watched), folder))


@pytest.fixture(scope="module")
def forecasters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Forecaster]:
    """Return forecasters by the plan that they receive: planned, none or shuffled."""
    training, watched = trials(TRAINING, **STICK), trials(WATCHED, **STICK)
    return {
        actions: trained(tmp_path_factory.mktemp(actions), training, watched, actions=actions)
        for actions in ("planned", "none", "shuffled")
    }


def floats(shard: FakeShard, name: str) -> AnyFloats:
    return column(shard.content, name).astype(np.float64)


def columns(shard: FakeShard, pattern: str) -> AnyFloats:
    return np.column_stack([floats(shard, pattern.format(axis)) for axis in "xyz"])


def aloft(shard: FakeShard, starts: Int64s) -> Bools:
    """Return which windows begin when the object is in the air: before, the grip determines most of the signal."""
    position = columns(shard, "robot_position_{}_m")
    distance_m = np.linalg.norm(position - position[0], axis=1)
    in_air: Bools = np.logical_or.accumulate(distance_m > ALOFT_M)[starts]
    return in_air


def errors(forecaster: Forecaster, shard: FakeShard, *, everywhere: bool = False) -> dict[str, AnyFloats]:
    """Return the squared errors in counts (window, step) of model and persistence, in the air."""
    track = tracks.track(shard, forecaster.codec)  # type: ignore[arg-type]
    starts = track.starts(forecaster.context, forecaster.horizon)
    chosen = starts if everywhere else starts[aloft(shard, starts)]
    parts = list(iterate_predictions(forecaster, track, chosen))
    return {
        name: np.concatenate(
            [np.square(dict(batch.each_prediction())[name].count - batch.truth.count).mean(axis=2) for batch in parts]
        )
        for name in (MODEL, BASELINE)
    }


def skill_at_the_end(forecaster: Forecaster, *, everywhere: bool = False) -> float:
    """Return the skill over persistence ten steps ahead on trials that the forecaster has not seen."""
    trial_errors = [errors(forecaster, shard, everywhere=everywhere) for shard in trials(TESTED, **STICK)]
    model, baseline = (
        np.concatenate([errors_by_name[name][:, -1] for errors_by_name in trial_errors]).mean()
        for name in (MODEL, BASELINE)
    )
    return float(skill(np.array([model]), np.array([baseline]))[0])


def acceleration_forecast() -> Any:
    """Return a network that predicts the acceleration from its past, position and velocity, all without error.

    It learns from more trajectories than the forecasters do, and sees twice as far back: what it cannot foresee lies in
    the chance by which trajectories are made.
    """
    torch.manual_seed(0)
    rows = [flight(index) for index in range(240)]
    past, change = (torch.from_numpy(np.concatenate(part)).float() for part in zip(*rows, strict=True))
    mean, spread = past.mean(0), past.std(0) + 1e-6
    network = torch.nn.Sequential(
        torch.nn.Linear(past.shape[1], 96),
        torch.nn.GELU(),
        torch.nn.Linear(96, 96),
        torch.nn.GELU(),
        torch.nn.Linear(96, 3),
    )
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    steps = 6 * len(past) // 512
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        batch = torch.randint(len(past), (512,))
        loss = torch.nn.functional.mse_loss(network((past[batch] - mean) / spread), change[batch])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        falling.step()
    return lambda inputs: network((torch.from_numpy(inputs).float() - mean) / spread).detach().numpy()


def flight(index: int) -> tuple[AnyFloats, AnyFloats]:
    """Return the exact inputs of a random trajectory in the air at each row, and the next change of acceleration."""
    rng = np.random.default_rng([7, index])
    path = trajectory.draw_trajectory(trajectory.PROTOCOLS[index % 2], 12.0, 1.5, rng)
    stride = round(ROW_NS * trajectory.RATE_HZ / 1e9)
    position, acceleration = path.position_m[::stride], path.acceleration_m_s2[::stride]
    now = np.arange(1_500 // stride + 10, len(position) - HORIZON)
    return inputs_at(position, acceleration, now), acceleration[now + HORIZON] - acceleration[now]


def inputs_at(position: AnyFloats, acceleration: AnyFloats, now: Int64s) -> AnyFloats:
    before = [acceleration[now - lag] for lag in LAGS]
    return np.hstack([*before, position[now] - position[0], position[now] - position[now - 1]])


def bound_without_plan() -> float:
    """Return the best skill with the object, the skin and the past known, but not the coming acceleration.

    Touch in the air is linear in acceleration but for a few percent. Its slope is fitted on each test trial itself, so
    that it is known as nobody can know it; neither noise nor what is not linear is counted.
    """
    forecast = acceleration_forecast()
    missed, moved = 0.0, 0.0
    for shard in trials(TESTED, **STICK):
        track = tracks.track(shard, tracks.codec_of(shard.content.schema, {}))  # type: ignore[arg-type]
        starts = track.starts(10, HORIZON)
        starts = starts[aloft(shard, starts) & (starts >= max(LAGS))]
        now = starts + 9
        acceleration = columns(shard, "gt_acceleration_{}_m_s2")
        felt = track.tactile[now + HORIZON] - track.tactile[now]
        change = acceleration[now + HORIZON] - acceleration[now]
        slope = np.linalg.lstsq(change, felt, rcond=None)[0]
        told_change = forecast(inputs_at(columns(shard, "robot_position_{}_m"), acceleration, now))
        missed += np.square((change - told_change) @ slope).sum()
        moved += np.square(felt).sum()
    return 1 - missed / moved


@dataclasses.dataclass(frozen=True)
class Watch:
    """Load over pressure (time,), felt and predicted ten steps before, and its value at the onset of slip."""

    felt: AnyFloats
    ahead: AnyFloats
    limit: float


def watch(forecaster: Forecaster, shard: FakeShard) -> Watch:
    """Return the pull of the object over the pressure of the fingers, in counts, and the true friction in the same unit."""
    track = tracks.track(shard, forecaster.codec)  # type: ignore[arg-type]
    ahead = np.full_like(track.tactile, np.nan)
    for batch in iterate_predictions(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
        ahead[batch.forecast.now] = dict(batch.each_prediction())[MODEL].count[:, -1]
    felt = pull_over_pressure(track.tactile[:])
    pull = np.hypot(floats(shard, "gt_force_x_n"), floats(shard, "gt_force_z_n"))
    pressure = floats(shard, "gt_finger1_normal_n") + floats(shard, "gt_finger2_normal_n")
    sticking = (floats(shard, "gt_slip") == 0) & (pressure > 2) & (pull > 0.1 * pressure)
    true = pull[sticking] / pressure[sticking]
    limit = float(felt[sticking] @ true / (true @ true)) * float(shard.attributes["gt_friction"])
    return Watch(felt, pull_over_pressure(ahead), limit)


def pull_over_pressure(counts: AnyFloats) -> AnyFloats:
    """Return the ratio (time,) that friction bounds; ``counts`` are (time, channel)."""
    x, y, z = (counts[:, axis::3].sum(axis=1) for axis in range(3))
    ratio: AnyFloats = np.hypot(x, y) / np.maximum(np.abs(z), 1.0)
    return ratio


def median_lead(forecaster: Forecaster, kind: dict[str, Any]) -> float:
    """Return the median of the rows by which alarms precede slip, over trials in which the object slips.

    The event is the slip itself, at the first row T of the truth's. An alarm is on in a row in which touch, as predicted
    ten rows later, would pass what friction holds; this test knows the friction, the forecaster does not. The lead is T
    less the first row with an alarm from T - 12, for what a forecast rounds, but never above 10, to T + 9; with none it
    is -10. The onset of a change of load, as `tacpipe.tasks.forward.alarms` detects it, is another event: the load rises
    before the object slips, and an exact forecast leads the rise by a few rows only.
    """
    leads = []
    for shard in trials(SLIPPING, **kind):
        slipping = np.flatnonzero(floats(shard, "gt_slip") > 0)
        if not len(slipping):
            continue
        watched, onset = watch(forecaster, shard), int(slipping[0])
        first = max(onset - HORIZON - 2, 0)
        alarm = watched.ahead[first : onset + HORIZON] > watched.limit
        leads.append(min(onset - first - int(alarm.argmax()), HORIZON) if alarm.any() else -HORIZON)
    assert len(leads) >= len(SLIPPING) - 2
    return float(np.median(leads))


def loaded(index: int) -> FakeShard:
    """Return a trial without motion, under a load that the tare does not reveal, on the logged rows of xela1."""
    shard = recorded(index, grid="logged", **STILL)
    rng, content = np.random.default_rng([8, index]), shard.content
    for position, about in enumerate(content.schema):
        if (about.metadata or {}).get(b"quantity") == b"tactile":
            values = content.column(position).to_numpy() + np.round(rng.normal(0, 300))
            content = content.set_column(position, about, pa.array(values, about.type))
    return FakeShard(shard.name, content, shard.attributes)


def altered(shard: FakeShard, change: dict[str, AnyFloats]) -> FakeShard:
    """Return the recording with some values added to its columns."""
    content = shard.content
    for name, values in change.items():
        position = content.column_names.index(name)
        about = content.schema.field(position)
        content = content.set_column(
            position, about, pa.array(content.column(position).to_numpy() + values, about.type)
        )
    return FakeShard(shard.name, content, shard.attributes)


def predicted_counts(forecaster: Forecaster, shard: FakeShard) -> tuple[Int64s, AnyFloats]:
    """Return the rows at which predictions are made, and the predicted counts (window, step, channel)."""
    track = tracks.track(shard, forecaster.codec)  # type: ignore[arg-type]
    parts = list(iterate_predictions(forecaster, track, track.starts(forecaster.context, forecaster.horizon)))
    counts = np.concatenate([dict(batch.each_prediction())[MODEL].count for batch in parts])
    return np.concatenate([batch.forecast.now for batch in parts]), counts


def from_row(shard: FakeShard, row: int, values: AnyFloats | float) -> AnyFloats:
    added = np.zeros(shard.content.num_rows)
    added[row:] = values
    return added


@pytest.mark.long
def test_who_knows_the_plan_foresees_most_of_the_change_of_load(forecasters: dict[str, Forecaster]) -> None:
    assert skill_at_the_end(forecasters["planned"]) >= 0.8
    assert skill_at_the_end(forecasters["planned"], everywhere=True) >= 0.8


@pytest.mark.long
def test_without_the_plan_no_more_is_foreseen_than_acceleration_can_be(forecasters: dict[str, Forecaster]) -> None:
    bound = bound_without_plan()
    assert skill_at_the_end(forecasters["none"]) <= bound
    assert skill_at_the_end(forecasters["planned"]) > bound + 0.05


@pytest.mark.long
def test_plans_of_other_windows_help_no_more_than_none(forecasters: dict[str, Forecaster]) -> None:
    without = skill_at_the_end(forecasters["none"])
    assert skill_at_the_end(forecasters["shuffled"]) <= without + 0.05
    assert skill_at_the_end(forecasters["planned"]) >= without + 0.2


@pytest.mark.long
def test_under_constant_load_nobody_beats_the_noise(tmp_path: Path) -> None:
    noise = (np.square(taxels.NOISE_COUNT) + 1 / 12).mean()
    forecaster = trained(tmp_path, [loaded(index) for index in range(8)], [loaded(8)], epochs=6, hidden=32)
    # The channels of xela1, whose rows are not interpolated.
    first_skin = slice(0, len(forecaster.codec.channels) // 2)
    squared: dict[str, list[AnyFloats]] = {MODEL: [], BASELINE: []}
    for index in range(9, 14):
        shard = loaded(index)
        track = tracks.track(shard, forecaster.codec)  # type: ignore[arg-type]
        for batch in iterate_predictions(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
            for name, errors_of_name in squared.items():
                errors_of_name.append(
                    np.square(dict(batch.each_prediction())[name].count - batch.truth.count)[..., first_skin].mean(
                        axis=2
                    )
                )
    model, baseline = (np.concatenate(squared[name]).mean(axis=0) / noise for name in (MODEL, BASELINE))  # (step,)
    assert baseline == pytest.approx(2.0, rel=0.05)
    assert (model >= (1 + 1 / 10) * 0.95).all()
    assert (model <= 2.0).all()


@pytest.mark.long
def test_touch_that_is_to_come_changes_no_forecast(forecasters: dict[str, Forecaster]) -> None:
    forecaster, shard, row = forecasters["planned"], recorded(TESTED[0], **STICK), 300
    rng = np.random.default_rng(3)
    off = {
        name: from_row(shard, row + 1, rng.normal(0, 500, shard.content.num_rows - row - 1))
        for name in forecaster.codec.channels
    }
    now, before = predicted_counts(forecaster, shard)
    _, after = predicted_counts(forecaster, altered(shard, off))
    assert np.abs(after[now <= row] - before[now <= row]).max() < 0.01
    assert np.abs(after[now == row + 1] - before[now == row + 1]).max() > 10


@pytest.mark.long
@pytest.mark.parametrize("ahead", [1, 4, 10])
def test_a_plan_changes_no_forecast_before_its_own_step(ahead: int, forecasters: dict[str, Forecaster]) -> None:
    forecaster, shard, row = forecasters["planned"], recorded(TESTED[0], **STICK), 300
    off = {f"robot_position_{axis}_m": from_row(shard, row + ahead, 0.01) for axis in "xyz"}
    now, before = predicted_counts(forecaster, shard)
    _, after = predicted_counts(forecaster, altered(shard, off))
    moved = np.abs(after - before)[now == row][0].max(axis=1)  # (step,)
    assert (moved[: ahead - 1] < 0.01).all()
    assert moved[ahead - 1] > 1
    assert np.abs(after[now < row + ahead - HORIZON] - before[now < row + ahead - HORIZON]).max() < 0.01


@pytest.mark.long
def test_a_slip_that_the_plan_makes_is_announced_to_who_knows_it(forecasters: dict[str, Forecaster]) -> None:
    lead = median_lead(forecasters["planned"], PLANNED_SLIP)
    assert lead >= 5
    assert median_lead(forecasters["none"], PLANNED_SLIP) <= lead - 5


@pytest.mark.long
def test_nobody_announces_that_the_grip_gives_way(forecasters: dict[str, Forecaster]) -> None:
    assert median_lead(forecasters["planned"], GRIP_LOSS) <= 0
    assert median_lead(forecasters["none"], GRIP_LOSS) <= 0
