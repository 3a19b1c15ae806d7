"""Compare causal rows and planned motion with those of full recordings and with the rules for missing plans."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacpipe.live.plans import PosePlan
from tacpipe.models.windows import POSE
from tacpipe.signals import kinematics
from tacpipe.tasks.forward import causal, tracks
from tacpipe.tasks.forward.causal import Arm
from tests.tasks.forward import trials

T_NS = np.arange(60) * 20_000_000
AHEAD_NS = np.arange(1, 11) * 20_000_000


def test_the_arm_row_by_row_is_that_of_the_whole_recording_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    turned = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (60, 3)), axis=0)).as_quat()
    turned *= rng.choice([-1.0, 1.0], (60, 1)) * rng.uniform(0.5, 2, (60, 1))
    turned[17] = np.nan
    pose = np.hstack([np.cumsum(rng.normal(0, 0.01, (60, 3)), axis=0), turned])
    track = trials.track(trials.table(rng.normal(0, 5, (60, 6)), pose))
    for reference in (turned[0], -turned[0]):
        arm = Arm(reference)
        rows = np.array(
            [arm.row(int(t_ns), pose_row[:3], pose_row[3:]) for t_ns, pose_row in zip(T_NS, pose, strict=True)]
        )
        assert rows.tobytes() == np.ascontiguousarray(tracks.align_quaternions(track.arm, reference)).tobytes()


def test_velocities_come_from_joints_until_the_hand_leaves_the_last_link() -> None:
    pose, columns = trials.panda(60)
    hand_m = pose[:, :3]
    joints, speeds = (
        np.column_stack([values for name, values in columns.items() if ("velocity" in name) is fast])
        for fast in (False, True)
    )
    arm = Arm(np.array([0.0, 0.0, 0.0, 1.0]))
    away = hand_m.copy()
    away[30:] += 0.1
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    rows = [arm.row(int(T_NS[i]), away[i], quaternion, joints[i], speeds[i]) for i in range(60)]
    expected = kinematics.hand_velocity(kinematics.PANDA, joints, speeds, hand_m)
    np.testing.assert_allclose([row[POSE:] for row in rows[:30]], expected[:30], rtol=1e-5, atol=1e-6)
    differences = np.diff(away, axis=0) / 0.02
    np.testing.assert_allclose([row[POSE : POSE + 3] for row in rows[30:]], differences[29:], rtol=1e-4, atol=1e-5)


def test_a_plan_is_interpolated_and_its_end_is_kept() -> None:
    now = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0, *np.zeros(6)])
    points_ns = np.array([0, 100_000_000])
    turn = Rotation.from_rotvec([0, 0, 0.5]).as_quat()
    plan = PosePlan(points_ns, np.array([[0.0, 0, 0.3, 0, 0, 0, 1], [0.1, 0, 0.3, *-turn]]))
    rows = causal.rows(plan, 0, AHEAD_NS, now)
    x = np.minimum(AHEAD_NS / 1e9, 0.1)
    np.testing.assert_allclose(rows[:, 0], x, atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 3:7]).as_rotvec()[:, 2], 5 * x, atol=1e-6)
    np.testing.assert_allclose(rows[:, 7], [1.0] * 5 + [0.0] * 5, atol=1e-5)
    np.testing.assert_allclose(rows[:, 12], [5.0] * 5 + [0.0] * 5, rtol=1e-3, atol=1e-5)
    assert (rows[:, 6] > 0).all()  # the sign of the quaternion goes on


def test_a_plan_that_begins_later_is_reached_from_where_the_hand_is_and_one_that_ended_leaves_it_there() -> None:
    now = np.array([1.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0, *np.ones(6)])
    nowhere = np.full(4, np.nan)
    later = PosePlan(np.array([200_000_000]), np.array([[1.2, 0.0, 0.3, *nowhere]]))
    rows = causal.rows(later, 0, AHEAD_NS, now)
    np.testing.assert_allclose(rows[:, 0], 1 + AHEAD_NS / 1e9, atol=1e-6)
    np.testing.assert_array_equal(rows[:, 3:7], np.tile([0, 0, 0, 1], (10, 1)))
    after_end = causal.rows(later, 300_000_000, 300_000_000 + AHEAD_NS, now)
    np.testing.assert_array_equal(after_end[:, 0], np.ones(10))
    np.testing.assert_array_equal(after_end[:, 7:], np.zeros((10, 6)))


@pytest.mark.parametrize("turning", [0.0, 0.7, 3.0])
def test_without_a_plan_the_hand_moves_and_turns_on_as_it_does(turning: float) -> None:
    start = Rotation.from_euler("xyz", [0.4, -0.2, 0.9])
    now = np.array([0.1, 0.2, 0.3, *start.as_quat(), 0.5, 0.0, -1.0, 0.0, turning, 0.0])
    rows = causal.extrapolate_arm(7, 7 + AHEAD_NS, now)
    after_s = AHEAD_NS / 1e9
    np.testing.assert_allclose(rows[:, :3], now[:3] + after_s[:, None] * now[7:10], atol=1e-6)
    expected = Rotation.from_rotvec(after_s[:, None] * [0, turning, 0]) * start
    assert (expected * Rotation.from_quat(rows[:, 3:7]).inv()).magnitude().max() < 1e-6
    np.testing.assert_array_equal(rows[:, 7:], np.tile(now[7:], (10, 1)).astype(np.float32))


def test_a_recording_of_one_row_has_an_arm_at_rest() -> None:
    row = Arm(np.array([0.0, 0.0, 0.0, 1.0])).row(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 2.0]))
    assert row.tolist() == [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
