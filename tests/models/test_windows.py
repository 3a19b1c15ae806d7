"""What a forecaster is told of the arm: the same wherever the base stands, and nothing that it must not know."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tacpipe.models.windows import POSE, Windows, motion, repeats, rotations, with_plans_of, without_plan
from tests.models.window_fakes import CONTEXT, HORIZON, windows


def moved(given: Windows, turn: Rotation, shift: list[float]) -> Windows:
    """The windows of the same arm on a base that is turned and shifted as a whole."""
    arm = given.arm.double().numpy()
    flat = arm.reshape(-1, arm.shape[-1])
    parts = [
        turn.apply(flat[:, :3]) + shift,
        (turn * Rotation.from_quat(flat[:, 3:POSE])).as_quat(),
        turn.apply(flat[:, POSE : POSE + 3]),
        turn.apply(flat[:, POSE + 3 :]),
    ]
    return given._replace(arm=torch.from_numpy(np.hstack(parts).reshape(arm.shape)))


def double(given: Windows) -> Windows:
    """The same windows in double precision."""
    arm = given.arm.double()
    unit = torch.nn.functional.normalize(arm[..., 3:POSE], dim=-1)
    return given._replace(arm=torch.cat([arm[..., :3], unit, arm[..., POSE:]], -1))


def test_rotations_are_those_of_scipy() -> None:
    quaternions = Rotation.random(50, rng=np.random.default_rng(0)).as_quat()
    found = rotations(torch.from_numpy(quaternions))
    assert np.allclose(found.numpy(), Rotation.from_quat(quaternions).as_matrix(), atol=1e-12)
    assert torch.allclose(rotations(-torch.from_numpy(quaternions)), found)


def test_motion_is_that_of_a_loop_over_rows() -> None:
    given = double(windows())
    found, up = motion(given)
    arm = given.arm.numpy()
    for window in range(arm.shape[1]):
        now = Rotation.from_quat(arm[CONTEXT - 1, window, 3:POSE])
        assert np.allclose(up[window].numpy(), now.inv().apply([0, 0, 1]))
        for row in range(len(arm)):
            place, turned = arm[row, window, :3], Rotation.from_quat(arm[row, window, 3:POSE])
            between = (now.inv() * turned).as_rotvec()
            angle = np.linalg.norm(between)
            wanted = [
                now.inv().apply(place - arm[CONTEXT - 1, window, :3]),
                between * (np.sin(angle) / angle if angle else 1.0),
                now.inv().apply(arm[row, window, POSE : POSE + 3]),
                now.inv().apply(arm[row, window, POSE + 3 :]),
            ]
            assert np.allclose(found[row, window].numpy(), np.concatenate(wanted), atol=1e-9)


def test_motion_is_the_same_wherever_the_base_stands_and_heads() -> None:
    given = double(windows())
    there = moved(given, Rotation.from_euler("z", 1.9), [2.0, -3.0, 0.5])
    for one, other in zip(motion(given), motion(there), strict=True):
        assert torch.allclose(one, other, atol=1e-9)


def test_a_base_that_is_tilted_changes_up_and_nothing_else() -> None:
    given = double(windows())
    there = moved(given, Rotation.from_euler("xyz", [0.7, -0.4, 0.2]), [0.1, 0.2, 0.3])
    (steps, up), (steps_there, up_there) = motion(given), motion(there)
    assert torch.allclose(steps, steps_there, atol=1e-9)
    assert not torch.allclose(up, up_there, atol=0.1)


def test_the_sign_of_a_quaternion_does_not_tell() -> None:
    given = double(windows())
    arm = given.arm.clone()
    arm[::2, :, 3:POSE] *= -1
    for one, other in zip(motion(given), motion(given._replace(arm=arm)), strict=True):
        assert torch.allclose(one, other)


def test_a_row_is_repeats_where_every_channel_repeats_and_the_first_is_always_new() -> None:
    touch = torch.tensor([[[1.0, 2.0]], [[1.0, 2.0]], [[1.0, 3.0]], [[1.0, 3.0]]])
    assert repeats(touch).squeeze(1).tolist() == [0, 1, 0, 1]
    assert repeats(touch[:1]).tolist() == [[0]]


def test_without_a_plan_the_arm_stays_where_it_is_now() -> None:
    given = windows()
    found = without_plan(given)
    assert torch.equal(found.arm[:CONTEXT], given.arm[:CONTEXT])
    assert torch.equal(found.arm[CONTEXT:], given.arm[CONTEXT - 1].expand(HORIZON, -1, -1))
    assert found.touch is given.touch and found.finger is given.finger
    assert (found.context, found.horizon) == (CONTEXT, HORIZON)


def test_dealt_out_plans_leave_the_past_and_begin_where_the_hand_is() -> None:
    given = double(windows())
    still = given.arm.clone()
    still[CONTEXT:] = still[CONTEXT - 1]  # a plan that stays begins, and ends, at its own pose
    found = with_plans_of(given._replace(arm=still), torch.roll(torch.arange(6), 1))
    assert torch.equal(found.arm[:CONTEXT], given.arm[:CONTEXT])
    assert torch.equal(found.touch, given.touch)
    assert torch.allclose(found.arm[CONTEXT:, :, :3], given.arm[CONTEXT - 1, :, :3], atol=1e-9)
    now = rotations(given.arm[CONTEXT - 1, :, 3:POSE]).expand(HORIZON, -1, -1, -1)
    assert torch.allclose(rotations(found.arm[CONTEXT:, :, 3:POSE]), now, atol=1e-9)


def test_dealt_out_plans_are_the_others_as_their_own_hands_see_them() -> None:
    given, others = double(windows()), torch.tensor([3, 0, 5, 1, 2, 4])
    found, before = motion(with_plans_of(given, others))[0], motion(given)[0]
    assert torch.allclose(found[CONTEXT:], before[CONTEXT:, others], atol=1e-9)
    assert torch.allclose(found[:CONTEXT], before[:CONTEXT])


def test_everybody_s_own_plan_is_no_change() -> None:
    given = double(windows())
    found = with_plans_of(given, torch.arange(6))
    assert torch.allclose(found.arm, given.arm, atol=1e-9)
