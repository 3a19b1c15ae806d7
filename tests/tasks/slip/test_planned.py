"""Planned motion as input of slip models: what is read of a plan, and that nothing measured is read ahead."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.plans import PosePlan
from tacpipe.live.settings import Settings
from tacpipe.plugins import params as params_of
from tacpipe.recording import rig as rigs
from tacpipe.sensors.plan import Plan
from tacpipe.tasks.learning.examples import unlabelled
from tacpipe.tasks.slip import evaluation
from tacpipe.tasks.slip.live.task import SlipLive, SlipSettings
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.params import SlipBoosting
from tacpipe.tasks.slip.planned import GRAVITY_M_S2, POINTS, STEP_NS, motion, sample
from tacpipe.tasks.slip.windows import FingerReader, read_training
from tests.fake_recordings import FakeRecording, dataset
from tests.tasks.slip.slip_recordings import SECONDS, held_object, trained

SMALL = SlipBoosting(
    trees=20, leaves=6, leaf=3, learning_rate=0.2, stride=11, actions="planned"
)  # few windows are fast to bin
SLIP_S = 6.0


def plan_table(arrived_s: float, at_s: np.ndarray, height_m: np.ndarray) -> pa.Table:
    """Return a plan of a hand that moves up and down."""
    poses = np.zeros((len(at_s), 7))
    poses[:, 2], poses[:, 6] = height_m, 1.0
    columns = [np.full(len(at_s), round(arrived_s * 1e9)), np.rint(at_s * 1e9).astype(np.int64), *poses.T]
    schema = pa.schema([pa.field("t_ns", pa.int64()), *Plan().fields()])
    return pa.Table.from_arrays([pa.array(column) for column in columns], schema=schema)


def with_plans(recording: FakeRecording, jolt_s: float | None) -> FakeRecording:
    """Return a recording with plans each 0.2 s, of a hand that is jolted for 0.2 s at a time."""
    plans = []
    for arrived_s in np.arange(0.1, SECONDS, 0.2).tolist():
        at_s = arrived_s + np.arange(0, 1.01, 0.02)
        since = np.clip((at_s - (jolt_s if jolt_s is not None else 99.0)) / 0.2, 0, 1)
        plans.append(plan_table(arrived_s, at_s, 0.05 * np.sin(np.pi * since) ** 2))
    return dataclasses.replace(recording, tables={**recording.tables, "plan": pa.concat_tables(plans)})


def jolted_trials(count: int, first: int = 0) -> list[FakeRecording]:
    """Return recordings whose touch announces no slip, and whose plan has a jolt at each slip."""
    trials = []
    for seed in range(first, first + count):
        slip_s = 3.0 + (seed * 7 % 11) / 2 if seed % 2 else None
        trials.append(with_plans(held_object(seed, slip_s, rise_s=0.05), slip_s))
    return trials


READ = read_training(dataset(*jolted_trials(2)), SMALL)


def test_a_plan_of_constant_acceleration_has_its_load_ahead_up_to_its_end() -> None:
    t_ns = np.arange(0, 700_000_000, 30_000_000)
    poses = np.zeros((len(t_ns), 7))
    poses[:, 2] = 0.5 * 3.0 * np.square(t_ns / 1e9)  # 3 m/s² upwards
    ahead = sample(*motion(PosePlan(t_ns, poses)), 100_000_000)
    after_ns = 100_000_000 + np.arange(POINTS + 1) * STEP_NS
    exists = after_ns <= t_ns[-1]
    np.testing.assert_allclose(ahead[exists, 0], 1 + 3.0 / GRAVITY_M_S2)
    np.testing.assert_allclose(ahead[exists, 1], 3.0 / GRAVITY_M_S2)
    inside = after_ns < t_ns[-2]
    np.testing.assert_allclose(ahead[inside, 2], 3.0 * after_ns[inside] / 1e9)
    assert np.isnan(ahead[~exists]).all()


def test_points_of_a_plan_that_follow_closely_do_not_amplify_rounding() -> None:
    t_ns = np.arange(0, 500_000_000, 1_000_000)
    poses = np.zeros((len(t_ns), 7))
    poses[:, 0] = np.round(0.2 * t_ns / 1e9, 4)  # a constant speed, in steps of 0.1 mm
    ahead = sample(*motion(PosePlan(t_ns, poses)), 0)
    assert np.nanmax(ahead[:, 1]) < 0.3


@pytest.mark.parametrize("points", [1, 2])
def test_a_short_plan_has_no_acceleration(points: int) -> None:
    poses = np.zeros((points, 7))
    poses[-1, 0] = 0.1
    _, moved = motion(PosePlan(np.arange(points) * 10**8, poses))
    assert not moved[:, 3:].any()
    np.testing.assert_allclose(moved[:, 0], 1.0 if points == 2 else 0.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(60, 190), st.integers(0, 1000))
def test_no_row_depends_on_what_is_measured_or_planned_after_it(row: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    recording = with_plans(held_object(1, SLIP_S), SLIP_S)
    arm_ns = recording.tables["plan"]["t_ns"]
    arm = pa.table({"t_ns": arm_ns, "position_z_m": rng.normal(size=len(arm_ns))})
    reader, _ = READ
    t_ns = int(recording.tables["left"]["t_ns"][row].as_py())
    changed = {name: change_after(table, t_ns, rng) for name, table in {**recording.tables, "robot": arm}.items()}
    rows = np.arange(30, row + 1)
    before, after = (
        features_of(reader, FakeRecording(tables, "trial", {}), rows)
        for tables in ({**recording.tables, "robot": arm}, changed)
    )
    assert before.tobytes() == after.tobytes()
    planned = recording.tables["plan"].filter(recording.tables["plan"]["t_ns"].to_numpy() <= t_ns)
    other = dataclasses.replace(recording, tables={**recording.tables, "plan": change_after(planned, 0, rng)})
    assert (features_of(reader, other, rows)[-1] != before[-1]).any()


def features_of(reader: FingerReader, recording: Any, rows: np.ndarray) -> np.ndarray:
    return unlabelled(reader, reader.track(recording), [], rows).features("statistics")


def change_after(table: pa.Table, t_ns: int, rng: np.random.Generator) -> pa.Table:
    """Return a table with other values in the rows after a time."""
    later = table["t_ns"].to_numpy() > t_ns
    changed = table
    for name in table.column_names:
        if pa.types.is_floating(table.schema.field(name).type):
            values = table[name].to_numpy().copy()
            values[later] += rng.normal(size=int(later.sum())) * 10
            changed = changed.set_column(
                changed.schema.get_field_index(name), table.schema.field(name), pa.array(values)
            )
    return changed


def test_a_model_with_plans_predicts_slips_that_touch_does_not_announce(tmp_path: Path) -> None:
    areas = {}
    for actions in ("none", "planned"):
        params = dataclasses.replace(SMALL, actions=actions)
        files = trained(params, dataset(*jolted_trials(16)), None, tmp_path / actions)
        metrics = json.loads(evaluation.evaluate(files, dataset(*jolted_trials(12, 100))).files["metrics.json"])
        areas[actions] = metrics["model"]["auc"]["before"]["value"]
        assert ("planned_motion" in metrics) == (actions == "planned")
    assert areas["planned"] > 0.88
    assert areas["none"] < 0.75


def test_a_recording_without_plans_is_predicted_from_touch(tmp_path: Path) -> None:
    files = trained(SMALL, dataset(*jolted_trials(8)), None, tmp_path)
    table = SlipModel.load(files).table(held_object(101, SLIP_S))
    assert np.isfinite(table["probability"].to_numpy()).all()


def test_training_recordings_without_plans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="None of 2 training recordings has a stream plan"):
        trained(SMALL, dataset(held_object(1, 4.0), held_object(2, None)), None, tmp_path)


def test_params_without_plans_are_stored_as_before() -> None:
    assert "actions" not in params_of.to_json(SlipBoosting())
    assert params_of.to_json(SMALL)["actions"] == "planned"


def test_a_session_of_a_model_with_plans_needs_a_source_of_plans(tmp_path: Path) -> None:
    files = trained(SMALL, dataset(*jolted_trials(8)), None, tmp_path)

    class Model:
        class source:  # noqa: N801
            chain: tuple[Any, ...] = ()

    Model.files = files  # type: ignore[attr-defined]
    streams = (
        f'[[stream]]\nname = "{name}"\nsensor = "xela"\ntransport = "ws:127.0.0.1:5000"\n' for name in ("left", "right")
    )
    rig = rigs.parse("".join(streams))
    config = json.loads(files["config.json"])
    for finger in config["inputs"]:
        finger["channels"] = [field.name for field in rig.streams[finger["stream"]].sensor.fields()][:6]
    files["config.json"] = json.dumps(config).encode()
    model: Any = Model
    live = SlipLive()
    with pytest.raises(UsageError, match="has no source of plans"):
        live.plan(model, rig, Settings(task=SlipSettings()))
    planned = live.plan(model, rig, Settings(task=SlipSettings(plan="udp::9000")))
    assert str(planned.rig.streams["plan"].address) == "udp:127.0.0.1:9000"
