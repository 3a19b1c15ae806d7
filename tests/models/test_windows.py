"""Check the arm inputs of a forecaster: the same wherever the base stands, and without later information."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tacpipe.models.windows import POSE, ForecastWindows, motion, repeats, rotations, swap_plans, without_plan
from tests.models.window_fakes import CONTEXT, HORIZON, windows


def move(inputs: ForecastWindows, turn: Rotation, shift: list[float]) -> ForecastWindows:
    """The windows of the same arm on a base that is turned and shifted as a whole."""
    arm = inputs.arm.double().numpy()
    flat = arm.reshape(-1, arm.shape[-1])
    parts = [
        turn.apply(flat[:, :3]) + shift,
        (turn * Rotation.from_quat(flat[:, 3:POSE])).as_quat(),
        turn.apply(flat[:, POSE : POSE + 3]),
        turn.apply(flat[:, POSE + 3 :]),
    ]
    return inputs._replace(arm=torch.from_numpy(np.hstack(parts).reshape(arm.shape)))


def double(inputs: ForecastWindows) -> ForecastWindows:
    """The same windows in double precision."""
    arm = inputs.arm.double()
    unit = torch.nn.functional.normalize(arm[..., 3:POSE], dim=-1)
    return inputs._replace(arm=torch.cat([arm[..., :3], unit, arm[..., POSE:]], -1))


def test_rotations_are_those_of_scipy() -> None:
    quaternions = Rotation.random(50, rng=np.random.default_rng(0)).as_quat()
    matrices = rotations(torch.from_numpy(quaternions))
    assert np.allclose(matrices.numpy(), Rotation.from_quat(quaternions).as_matrix(), atol=1e-12)
    assert torch.allclose(rotations(-torch.from_numpy(quaternions)), matrices)


def test_motion_is_that_of_a_loop_over_rows() -> None:
    inputs = double(windows())
    steps, up = motion(inputs)
    arm = inputs.arm.numpy()
    for window in range(arm.shape[1]):
        now = Rotation.from_quat(arm[CONTEXT - 1, window, 3:POSE])
        assert np.allclose(up[window].numpy(), now.inv().apply([0, 0, 1]))
        for row in range(len(arm)):
            place, turned = arm[row, window, :3], Rotation.from_quat(arm[row, window, 3:POSE])
            between = (now.inv() * turned).as_rotvec()
            angle = np.linalg.norm(between)
            expected = [
                now.inv().apply(place - arm[CONTEXT - 1, window, :3]),
                between * (np.sin(angle) / angle if angle else 1.0),
                now.inv().apply(arm[row, window, POSE : POSE + 3]),
                now.inv().apply(arm[row, window, POSE + 3 :]),
            ]
            assert np.allclose(steps[row, window].numpy(), np.concatenate(expected), atol=1e-9)


def test_motion_is_the_same_wherever_the_base_stands_and_heads() -> None:
    inputs = double(windows())
    moved_inputs = move(inputs, Rotation.from_euler("z", 1.9), [2.0, -3.0, 0.5])
    for original, turned in zip(motion(inputs), motion(moved_inputs), strict=True):
        assert torch.allclose(original, turned, atol=1e-9)


def test_a_base_that_is_tilted_changes_up_and_nothing_else() -> None:
    inputs = double(windows())
    tilted = move(inputs, Rotation.from_euler("xyz", [0.7, -0.4, 0.2]), [0.1, 0.2, 0.3])
    (steps, up), (steps_there, up_there) = motion(inputs), motion(tilted)
    assert torch.allclose(steps, steps_there, atol=1e-9)
    assert not torch.allclose(up, up_there, atol=0.1)


def test_the_sign_of_a_quaternion_does_not_tell() -> None:
    inputs = double(windows())
    arm = inputs.arm.clone()
    arm[::2, :, 3:POSE] *= -1
    for original, negated in zip(motion(inputs), motion(inputs._replace(arm=arm)), strict=True):
        assert torch.allclose(original, negated)


def test_a_row_is_repeats_where_every_channel_repeats_and_the_first_is_always_new() -> None:
    touch = torch.tensor([[[1.0, 2.0]], [[1.0, 2.0]], [[1.0, 3.0]], [[1.0, 3.0]]])
    assert repeats(touch).squeeze(1).tolist() == [0, 1, 0, 1]
    assert repeats(touch[:1]).tolist() == [[0]]


def test_without_a_plan_the_arm_stays_where_it_is_now() -> None:
    inputs = windows()
    unplanned = without_plan(inputs)
    assert torch.equal(unplanned.arm[:CONTEXT], inputs.arm[:CONTEXT])
    assert torch.equal(unplanned.arm[CONTEXT:], inputs.arm[CONTEXT - 1].expand(HORIZON, -1, -1))
    assert unplanned.touch is inputs.touch and unplanned.finger is inputs.finger
    assert (unplanned.context, unplanned.horizon) == (CONTEXT, HORIZON)


def test_dealt_out_plans_leave_the_past_and_begin_where_the_hand_is() -> None:
    inputs = double(windows())
    resting = inputs.arm.clone()
    resting[CONTEXT:] = resting[CONTEXT - 1]  # a plan that stays begins, and ends, at its own pose
    dealt = swap_plans(inputs._replace(arm=resting), torch.roll(torch.arange(6), 1))
    assert torch.equal(dealt.arm[:CONTEXT], inputs.arm[:CONTEXT])
    assert torch.equal(dealt.touch, inputs.touch)
    assert torch.allclose(dealt.arm[CONTEXT:, :, :3], inputs.arm[CONTEXT - 1, :, :3], atol=1e-9)
    now = rotations(inputs.arm[CONTEXT - 1, :, 3:POSE]).expand(HORIZON, -1, -1, -1)
    assert torch.allclose(rotations(dealt.arm[CONTEXT:, :, 3:POSE]), now, atol=1e-9)


def test_dealt_out_plans_are_the_others_as_their_own_hands_see_them() -> None:
    inputs, sources = double(windows()), torch.tensor([3, 0, 5, 1, 2, 4])
    steps, before = motion(swap_plans(inputs, sources))[0], motion(inputs)[0]
    assert torch.allclose(steps[CONTEXT:], before[CONTEXT:, sources], atol=1e-9)
    assert torch.allclose(steps[:CONTEXT], before[:CONTEXT])


def test_everybody_s_own_plan_is_no_change() -> None:
    inputs = double(windows())
    dealt = swap_plans(inputs, torch.arange(6))
    assert torch.allclose(dealt.arm, inputs.arm, atol=1e-9)
