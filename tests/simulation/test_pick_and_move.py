"""Test the simulated rig against Newton's laws, and against expected counts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import to_parquet
from tacpipe.signals.contact import rest_level
from tacpipe.signals.repairs import repeated_rows
from tacpipe.simulation import taxels
from tacpipe.simulation.mechanics import GRAVITY_M_S2
from tacpipe.simulation.pick_and_move import (
    MASSES_KG,
    START_NS,
    TRIAL_NS,
    PickRig,
    PickScene,
    perform,
    simulate_trial,
    touch,
)
from tests.fake_recordings import column

CLEAN = PickRig(
    hold_probability=0.0,
    drop_probability=0.0,
    noise_scale=0.0,
    tactile_jitter_ms=0.0,
    robot_jitter_ms=0.0,
    clock_offset_ms=0.0,
    clock_skew_ppm=0.0,
)
STUCK = replace(CLEAN, friction_scale=4.0)


def aloft(scene: PickScene) -> np.ndarray:
    in_air: np.ndarray = scene.path.rise_m > 0.01
    return in_air


def tactile(table: pa.Table) -> np.ndarray:
    """Return the counts of a stream (time, channel)."""
    names = [name for name in table.column_names if name.startswith("taxel")]
    counts: np.ndarray = np.column_stack([table.column(name).to_numpy() for name in names]).astype(float)
    return counts


def decode(scene: PickScene, recording: Any, finger: int) -> np.ndarray:
    """Return the force on a finger (time, axis) from its counts, with base, gains and cross-talk known."""
    force = taxels.forces(scene.skins[finger], tactile(recording.streams[f"xela{finger + 1}"]))
    summed: np.ndarray = force.sum(axis=1)
    return summed


@pytest.mark.parametrize(("protocol", "seed"), [("controlled", 4), ("kinaesthetic", 0), ("kinaesthetic", 1)])
def test_the_counts_tell_weight_and_inertia(protocol: str, seed: int) -> None:
    rig = replace(STUCK, protocol=protocol, duration_s=20.0, tactile_rate_hz=1000.0)
    scene, recording = perform(seed, 0, rig), simulate_trial(seed, 0, rig)
    mass = scene.grasp.mass_kg
    t_ns = column(recording.streams["xela1"], "t_ns"), column(recording.streams["xela2"], "t_ns")
    ours, theirs = decode(scene, recording, 0)[:, 1], decode(scene, recording, 1)[:, 1]
    vertical = ours + np.interp(t_ns[0], t_ns[1], theirs)
    truth = recording.streams["truth"]
    acceleration = np.interp(t_ns[0], column(truth, "t_ns"), column(truth, "gt_acceleration_z_m_s2"))
    up = np.interp(t_ns[0], column(truth, "t_ns"), aloft(scene)) == 1
    slope, intercept = np.polyfit(acceleration[up], vertical[up], 1)
    assert slope == pytest.approx(mass, rel=0.02)
    assert intercept / slope == pytest.approx(GRAVITY_M_S2, rel=0.02)
    error = vertical[up] - mass * (GRAVITY_M_S2 + acceleration[up])
    assert np.sqrt(np.mean(error**2)) < 0.02 * mass * GRAVITY_M_S2


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_counts_of_the_fingers_differ_by_what_moves_the_object_sideways(seed: int) -> None:
    rig = replace(STUCK, protocol="kinaesthetic")
    scene = perform(seed, 0, rig)
    taken_ns = scene.path.t_ns[aloft(scene)][::10]
    pressures = [touch(scene, finger, taken_ns)[:, :, 2].sum(axis=1) for finger in (0, 1)]
    sideways = scene.path.hand_acceleration_m_s2[aloft(scene)][::10, 1]
    slope, intercept = np.polyfit(sideways, pressures[0] - pressures[1], 1)
    assert slope == pytest.approx(scene.grasp.mass_kg, rel=0.03)
    assert abs(intercept) < 0.01
    np.testing.assert_allclose(pressures[0] + pressures[1], 2 * scene.grasp.grip_n[-1], rtol=0.01)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_contact_that_stays_spans_six_dimensions(seed: int) -> None:
    rig = replace(STUCK, protocol="kinaesthetic", tactile_rate_hz=50.0)
    scene = perform(seed, 0, rig)
    taken_ns = scene.path.t_ns[scene.grasp.grip_n > 0][::20]
    parts = []
    for finger, skin in enumerate(scene.skins):
        counts = taxels.digitise(skin.base_count + taxels.signal(skin, touch(scene, finger, taken_ns)))
        parts.append(counts.astype(float))
    counts_of_both = np.hstack(parts)  # (time, channel)
    power = np.linalg.svd(counts_of_both - counts_of_both.mean(axis=0), compute_uv=False) ** 2
    unexplained = 1 - np.cumsum(power) / power.sum()
    assert unexplained[5] < 0.01
    assert (np.diff(unexplained[:20]) <= 1e-12).all()
    scaled = (counts_of_both - counts_of_both.mean(axis=0)) / np.maximum(counts_of_both.std(axis=0), 1e-9)
    power = np.linalg.svd(scaled, compute_uv=False) ** 2
    assert power[:6].sum() / power.sum() > 0.99


def test_nothing_is_borne_before_the_grasp_or_on_the_table() -> None:
    scene = perform(2, 0)
    assert not scene.contact.normal_n[scene.grasp.grip_n == 0].any()
    assert not scene.contact.force_n[scene.path.rise_m <= 0][:, 2].any()


def test_with_friction_enough_nothing_ever_slips() -> None:
    scenes = [perform(0, index, PickRig(duration_s=6.0, friction_scale=4.0)) for index in range(100)]
    assert not any(scene.contact.slip.any() or scene.contact.displacement_m.any() for scene in scenes)


def test_by_default_some_trials_slip_some_drop_and_most_hold() -> None:
    scenes = [perform(0, index) for index in range(60)]
    slipped, dropped = (
        np.mean([getattr(scene.contact, name).any() for scene in scenes]) for name in ("slip", "dropped")
    )
    assert 0.15 < slipped < 0.4
    assert 0.1 < dropped < slipped
    controlled = [scene for scene in scenes if scene.protocol == "controlled"]
    assert any(scene.contact.slip.any() for scene in controlled)
    assert {scene.protocol for scene in scenes} == {"controlled", "kinaesthetic"}


@pytest.mark.parametrize(("effort", "slips"), [(0.95, 0), (1.05, 12)])
def test_effort_decides_whether_the_plan_makes_the_object_slip(effort: float, slips: int) -> None:
    scenes = [perform(1, index, PickRig(effort=effort)) for index in range(12)]
    assert sum(scene.contact.slip.any() for scene in scenes) == slips


def test_a_grip_that_gives_way_is_what_makes_the_object_slip() -> None:
    rig = PickRig(effort=0.9, grip_loss_probability=1.0, grip_loss=0.3)
    late_ms = []
    for index in range(20):
        scene = perform(1, index, rig)
        assert scene.loss_ns is not None
        lost = int(scene.loss_ns // 1_000_000)
        assert scene.grasp.grip_n[-1] == pytest.approx(0.7 * scene.grasp.grip_n[lost])
        if scene.contact.onset is not None:
            late_ms.append(scene.contact.onset - lost)
    assert min(late_ms) > 0
    assert np.mean(np.array(late_ms) < 50) > 0.8
    assert perform(1, 0, replace(rig, grip_loss_probability=0.0)).loss_ns is None


def test_a_hand_that_is_still_gives_constant_counts_and_white_noise() -> None:
    rig = replace(CLEAN, still=True, noise_scale=5.0, duration_s=60.0)
    counts = tactile(simulate_trial(0, 0, rig).streams["xela1"])
    sigma2 = (5 * np.tile(taxels.NOISE_COUNT, 16)) ** 2 + 1 / 12  # rounding adds 1 / 12
    for ahead in (1, 10):
        error = np.mean((counts[ahead:] - counts[:-ahead]) ** 2, axis=0)
        assert np.mean(error / (2 * sigma2)) == pytest.approx(1.0, rel=0.05)
    quiet = tactile(simulate_trial(0, 0, replace(rig, noise_scale=0.0)).streams["xela1"])
    assert not np.ptp(quiet, axis=0).any()


def test_the_spread_of_the_counts_is_near_the_published_one() -> None:
    tared = []
    for index in range(12):
        table = simulate_trial(0, index).streams["xela1"]
        counts = tactile(table)
        tared.append(counts - rest_level(counts, column(table, "t_ns"), 0.2))
    spread = np.concatenate(tared).reshape(-1, 16, 3).std(axis=(0, 1))
    for axis, published in enumerate((279, 190, 1219)):
        assert published / 1.5 < spread[axis] < published * 1.5


def test_the_slope_of_the_proximity_is_the_relative_velocity() -> None:
    rig = replace(CLEAN, effort=1.1, protocol="controlled")
    slip_rows = 0
    for index in range(6):
        streams = simulate_trial(2, index, rig).streams
        t_ns, counts = column(streams["proximity"], "t_ns"), column(streams["proximity"], "distance").astype(float)
        truth_ns = column(streams["truth"], "t_ns")
        moved = np.interp(t_ns, truth_ns, column(streams["truth"], "gt_displacement_z_m"))
        speed = np.interp(t_ns, truth_ns, column(streams["truth"], "gt_velocity_z_m_s"))
        slip = np.interp(t_ns, truth_ns, column(streams["truth"], "gt_slip")) == 1
        step = 8  # samples, 20 ms
        slope = (counts[step:] - counts[:-step]) / (t_ns[step:] - t_ns[:-step]) * 1e9 / 8000
        mean = np.convolve(speed, [0.5, *[1.0] * (step - 1), 0.5], "valid") / step
        inside = (moved[step:] > -0.024) & (moved[:-step] > -0.024)
        assert np.abs(slope - mean)[inside].max() < 0.01  # a count in 20 ms is 6 mm/s
        slip_rows += int(slip.sum())
    assert slip_rows > 50


def test_slip_is_when_the_object_moves_and_a_dropped_one_touches_nothing() -> None:
    recording = simulate_trial(0, 7)
    truth = recording.streams["truth"]
    slip, dropped = column(truth, "gt_slip") == 1, column(truth, "gt_dropped") == 1
    assert recording.attributes["dropped"] is True
    assert recording.attributes["gt_slip_onset_ns"] == column(truth, "t_ns")[slip.argmax()]
    assert not (slip & dropped).any()
    moving = column(truth, "gt_velocity_m_s") > 0
    assert (moving[~dropped] == slip[~dropped]).all()
    for name in ("gt_force_x_n", "gt_force_y_n", "gt_force_z_n", "gt_finger1_normal_n", "gt_finger2_normal_n"):
        assert not column(truth, name)[dropped].any()
    counts = tactile(recording.streams["xela1"])
    assert np.abs(counts[-1] - np.median(counts[:10], axis=0)).mean() < 10
    assert column(recording.streams["proximity"], "distance").min() == 544


def test_every_stream_has_its_own_rate_and_the_clocks_of_host_and_device() -> None:
    rig = PickRig(duration_s=20.0)
    recording = simulate_trial(0, 2, rig)
    rates = {"xela1": 50, "xela2": 50, "robot": 1000, "proximity": 400}
    assert set(recording.streams) == {*rates, "truth"}
    truth_ns = column(recording.streams["truth"], "t_ns")
    for name, rate_hz in rates.items():
        table = recording.streams[name]
        t_ns, device_ns, seq = (column(table, clock) for clock in ("t_ns", "t_device_ns", "seq"))
        assert table.column_names[:3] == ["t_ns", "t_device_ns", "seq"]
        assert (np.diff(t_ns) >= 0).all()
        assert t_ns[0] >= truth_ns[0]
        offset, skew = (recording.attributes[f"gt_{name}_clock_{part}"] for part in ("offset_ns", "skew"))
        assert isinstance(offset, int)
        assert isinstance(skew, float)
        assert abs(offset) <= 80e6
        assert abs(skew) <= 50e-6
        period_ns = 1e9 / rate_hz * (1 + skew)
        since_ns = device_ns - device_ns[0] - (seq - seq[0]) * period_ns
        assert np.abs(since_ns).max() <= 2  # Without jitter, the number gives the count of periods.
        true_ns = (device_ns - offset - truth_ns[0]) / (1 + skew)
        late_ms = (t_ns - truth_ns[0] - true_ns) / 1e6
        assert late_ms.min() > -0.001
        assert late_ms.mean() == pytest.approx(2 if rate_hz == 50 else 0.5, rel=0.4)
        lost = seq[-1] - seq[0] + 1 - len(seq)
        assert lost == (np.diff(seq) - 1).sum()
        assert lost == pytest.approx(0.002 * 20 * rate_hz, abs=4 + 0.001 * 20 * rate_hz)
    assert len({recording.attributes[f"gt_{name}_clock_offset_ns"] for name in rates}) == 4


def test_the_clock_of_the_device_leaves_the_stamps_of_the_host_alone() -> None:
    near, far = (simulate_trial(0, 1, PickRig(clock_offset_ms=offset)).streams["xela1"] for offset in (0.0, 80.0))
    assert near.column("t_ns").equals(far.column("t_ns"))
    assert not near.column("t_device_ns").equals(far.column("t_device_ns"))


@pytest.mark.parametrize("probability", [0.07, 0.75])
def test_held_frames_repeat_values_and_have_stamps_of_their_own(probability: float) -> None:
    streams = simulate_trial(0, 0, PickRig(duration_s=40.0, hold_probability=probability)).streams
    for name in ("xela1", "xela2"):
        assert repeated_rows(tactile(streams[name])).mean() == pytest.approx(probability, abs=0.03)
        assert (np.diff(column(streams[name], "t_device_ns")) > 0).all()
        assert (np.diff(column(streams[name], "seq")) > 0).all()


def test_what_goes_wrong_with_the_log_changes_nothing_of_what_happens() -> None:
    noisy = replace(CLEAN, noise_scale=5.0, drop_probability=0.1, hold_probability=0.75, clock_offset_ms=80.0)
    clean, noisy_truth = (simulate_trial(3, 1, rig).streams["truth"] for rig in (CLEAN, noisy))
    assert clean.equals(noisy_truth)


def test_the_same_seed_and_trial_give_the_same_bytes() -> None:
    first, repeat = simulate_trial(5, 2), simulate_trial(5, 2)
    assert first.attributes == repeat.attributes
    assert all(to_parquet(table) == to_parquet(repeat.streams[name]) for name, table in first.streams.items())
    assert not first.streams["truth"].equals(simulate_trial(5, 3).streams["truth"])
    assert not first.streams["truth"].equals(simulate_trial(6, 2).streams["truth"])


def test_without_faults_the_arm_is_where_the_truth_has_it() -> None:
    recording = simulate_trial(7, 0, CLEAN)
    height = column(recording.streams["robot"], "position_z_m")
    assert len(height) == 12_000
    acceleration = column(recording.streams["truth"], "gt_acceleration_z_m_s2")
    np.testing.assert_allclose(height[-1] - height[0], np.cumsum(np.cumsum(acceleration))[-1] / 1e6, atol=5e-4)


def test_plans_announce_where_the_hand_will_be_and_change_no_other_stream() -> None:
    without, planned = (simulate_trial(3, 1, PickRig(duration_s=5.0, plan_rate_hz=rate_hz)) for rate_hz in (0.0, 10.0))
    assert set(planned.streams) == {*without.streams, "plan"}
    for name, stream in without.streams.items():
        assert stream.equals(planned.streams[name]), name
    plans = planned.streams["plan"].to_pandas()
    start_ns = START_NS + TRIAL_NS
    path = perform(3, 1, PickRig(duration_s=5.0)).path
    rows = ((plans["t_target_ns"] - start_ns) // 1_000_000).to_numpy()
    positions = plans[[f"position_{axis}_m" for axis in "xyz"]].to_numpy()
    np.testing.assert_allclose(positions, path.position_m[rows], atol=1e-9)
    ahead_ns = plans["t_target_ns"] - plans["t_ns"]
    assert ahead_ns.min() == 0
    assert ahead_ns.max() == 1_000_000_000
    assert plans["t_ns"].nunique() == 50


def test_ground_truth_is_marked_as_such() -> None:
    recording = simulate_trial(0, 0)
    truth = recording.streams["truth"]
    assert all(name.startswith("gt_") for name in truth.column_names[1:])
    measured = [name for stream, table in recording.streams.items() if stream != "truth" for name in table.column_names]
    assert not any(name.startswith("gt_") for name in measured)
    assert recording.attributes["simulated"] is True
    assert recording.attributes["gt_mass_kg"] in MASSES_KG
    assert {"gt_xela1_clock_offset_ns", "gt_robot_clock_skew"} <= set(recording.attributes)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"trial of 1\.0 s"):
        simulate_trial(0, 0, PickRig(duration_s=1.0))
    with pytest.raises(TacpipeError, match="'free'"):
        simulate_trial(0, 0, PickRig(protocol="free"))


def test_every_trial_of_four_seconds_has_a_lift() -> None:
    for index in range(100):
        assert perform(9, index, PickRig(duration_s=4.0)).path.rise_m.max() > 0
