"""Compare clocks, repeats and slips estimated from the simulated rig's streams with the ground truth."""

from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import schema
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation import faults, pick_and_move, taxels
from tests.fake_recordings import FakeRecording, column

TRIALS = 20
simulate, synchronize = load("simulate.forward"), load("synchronize")
contacts, slips = load("segment.contacts"), load("segment.slips")


def record(trial: int, **rig: Any) -> RecordingOutput:
    recording: RecordingOutput = simulate(simulate.params(**rig), trial)
    return recording


def sync(recording: RecordingOutput, **params: Any) -> RecordingOutput:
    rows = {"values": "interpolate", **({} if "grid" in params else {"rate_hz": 50.0}), **params}
    synced_recording: RecordingOutput = synchronize(synchronize.params(**rows), FakeRecording(recording.streams))
    return synced_recording


@cache
def label(trial: int, **rig: Any) -> pa.Table:
    table = sync(record(trial, **rig)).streams[""]
    return slips(slips.params(), FakeRecording(contacts(contacts.params(), FakeRecording({"": table})).streams))


def flags(table: pa.Table, name: str) -> np.ndarray:
    return np.asarray(column(table, name) > 0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "lowest_score"),
    [
        ({"effort": 1.15}, 0.95),
        ({"effort": 0.9, "grip_loss_probability": 1.0, "grip_loss": 0.3}, 0.95),
        ({"effort": 1.15, "noise_scale": 5.0}, 0.80),
    ],
)
def test_the_slip_label_is_that_of_the_mechanics(rig: dict[str, float], lowest_score: float) -> None:
    tables = [label(trial, **rig) for trial in range(TRIALS)]
    predicted = np.concatenate([flags(table, "slip") for table in tables])
    truth = np.concatenate([flags(table, "gt_slip") for table in tables])
    assert 2 * (predicted & truth).sum() / (predicted.sum() + truth.sum()) >= lowest_score


@pytest.mark.long
def test_an_object_is_dropped_within_two_rows_of_its_fall() -> None:
    for trial in range(TRIALS):
        table = label(trial, effort=1.15)
        predicted, truth = flags(table, "dropped"), flags(table, "gt_dropped")
        assert predicted.any() == truth.any()
        assert abs(int(predicted.argmax()) - int(truth.argmax())) <= 2


@pytest.mark.long
def test_where_nothing_slips_there_is_at_most_one_false_frame_a_minute() -> None:
    tables = [label(trial, friction_scale=4.0) for trial in range(TRIALS)]
    assert not any(flags(table, "gt_slip").any() for table in tables)
    minutes = sum(table.num_rows for table in tables) / 50 / 60
    for name in ("slip", "slip_online", "dropped"):
        assert sum(flags(table, name).sum() for table in tables) <= minutes


def test_the_offset_of_each_clock_is_known_to_a_fraction_of_a_sample() -> None:
    half_ms = {"xela1": 10.0, "xela2": 10.0, "robot": 0.5, "proximity": 1.25}
    for trial in range(TRIALS):
        recording = record(trial)
        attributes = sync(recording).attributes
        for stream, limit_ms in half_ms.items():
            offset_ms, true_ns = (
                attributes[f"{stream}_clock_offset_ms"],
                recording.attributes[f"gt_{stream}_clock_offset_ns"],
            )
            assert isinstance(offset_ms, float) and isinstance(true_ns, int)
            assert abs(offset_ms + true_ns / 1e6) < 0.05 * limit_ms  # The requirement is half a sample.


def errors(trial: int, clock: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return how far the channels of each finger, then of the arm, lie from the truth on the grid, in units of its sd."""
    rig = {"noise_scale": 0.0, "hold_probability": 0.0, "friction_scale": 4.0}
    table = sync(record(trial, **rig), clock=clock).streams[""]
    scene = pick_and_move.perform(0, trial, pick_and_move.PickRig(**rig))  # type: ignore[arg-type]
    true_ns = table.column("t_ns").to_numpy() - pick_and_move.START_NS - trial * pick_and_move.TRIAL_NS
    fingers = []
    for finger, skin in enumerate(scene.skins):
        signal = taxels.signal(skin, pick_and_move.touch(scene, finger, true_ns)).reshape(len(true_ns), -1)
        names = [name for name in table.column_names if name.startswith(f"xela{finger + 1}_taxel")]
        counts = np.column_stack([table.column(name).to_numpy() for name in names])
        residual = counts - np.asarray(skin.base_count).reshape(1, -1) - signal
        fingers.append(np.abs(residual).ravel() / (signal - signal[0]).std())
    arm = []
    for i, axis in enumerate("xyz"):
        path = np.interp(true_ns, scene.path.t_ns, scene.path.position_m[:, i])
        if path.std() > 1e-3:  # an axis that moves
            arm.append(np.abs(table.column(f"robot_position_{axis}_m").to_numpy() - path) / path.std())
    return fingers, arm


def test_signals_are_near_the_truth_with_the_fitted_and_with_the_estimated_clock() -> None:
    errors_by_clock = {clock: [errors(trial, clock) for trial in range(8)] for clock in ("auto", "arrival")}
    fingers, arms = (
        {
            clock: np.percentile(np.concatenate([values for trial_errors in trials for values in trial_errors[i]]), 99)
            for clock, trials in errors_by_clock.items()
        }
        for i in (0, 1)
    )
    assert fingers["auto"] < 0.01
    assert fingers["arrival"] < 0.02
    assert max(arms.values()) < 0.0005


def test_held_frames_are_found() -> None:
    hits = marked_rows = repeated_rows = 0
    for trial, probability in ((0, 0.07), (1, 0.07), (2, 0.75)):
        streams = dict(record(trial, hold_probability=0.0).streams)
        kinds = [kind for kind in streams["xela1"].schema if "taxel" in kind.name]
        counts = np.column_stack([streams["xela1"].column(kind.name).to_numpy() for kind in kinds])
        counts, repeated = faults.hold(counts, probability, np.random.default_rng(trial))
        first = streams["xela1"].select(["t_ns", "t_device_ns", "seq"])
        repeated_stream = schema.stream(first.column("t_ns").to_numpy(), counts.T, kinds)
        for name in ("t_device_ns", "seq"):
            repeated_stream = repeated_stream.append_column(first.schema.field(name), first.column(name))
        table = sync(RecordingOutput({**streams, "xela1": repeated_stream}), grid="logged").streams[""]
        rows = np.searchsorted(first.column("seq").to_numpy(), table.column("xela1_seq").to_numpy())
        marked = flags(table, "xela1_held")
        hits, marked_rows, repeated_rows = (
            hits + (marked & repeated[rows]).sum(),
            marked_rows + marked.sum(),
            repeated_rows + repeated[rows].sum(),
        )
    assert hits / marked_rows >= 0.99
    assert hits / repeated_rows >= 0.99
