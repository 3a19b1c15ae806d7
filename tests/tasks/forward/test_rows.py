"""Rows of several recordings one after the other, and the windows that are picked from them."""

import numpy as np
import pytest
import torch

from tacpipe.errors import TacpipeError
from tacpipe.tasks.forward.networks import ACTIONS, Rows, rows_of_tracks, with_actions
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import CONTEXT, HORIZON, LENGTH, track

TRACKS = [track(motion(seed, rows=count).content) for seed, count in ((0, 30), (1, 8), (2, 20))]
STARTS = [recorded.starts(CONTEXT, HORIZON) for recorded in TRACKS]


def join_parts(actions: str = "planned") -> Rows:
    return rows_of_tracks(TRACKS, STARTS, CONTEXT, HORIZON, actions=actions)


def test_windows_are_rows_of_one_recording_each() -> None:
    rows = join_parts()
    assert [len(starts) for starts in STARTS] == [22, 0, 12]
    assert rows.part.count == 34
    picked, ahead = rows.pick(rows.starts)
    expected = [(recorded, first) for recorded, starts in zip(TRACKS, STARTS, strict=True) for first in starts]
    for index, (recorded, first) in enumerate(expected):
        past, future = slice(first, first + CONTEXT), slice(first + CONTEXT, first + LENGTH)
        assert np.array_equal(picked.touch[:, index].numpy(), recorded.latent[past])
        assert np.array_equal(picked.arm[:, index].numpy(), recorded.arm[first : first + LENGTH])
        assert np.array_equal(picked.finger[:, index].numpy(), recorded.finger[past])
        assert np.array_equal(ahead[:, index].numpy(), recorded.latent[future])


def test_some_are_spread_evenly_and_no_more_than_asked_for() -> None:
    rows = join_parts()
    assert torch.equal(rows.evenly_spread(100), rows.starts)
    assert rows.evenly_spread(10).tolist() == rows.starts[::4].tolist()
    assert len(rows.evenly_spread(10)) <= 10


def test_no_recordings_and_no_windows_make_no_rows() -> None:
    assert rows_of_tracks([], [], CONTEXT, HORIZON).part.count == 0
    assert rows_of_tracks(TRACKS[1:2], STARTS[1:2], CONTEXT, HORIZON).part.count == 0


def test_a_model_is_told_the_plan_that_its_actions_say() -> None:
    windows = join_parts().pick(join_parts().starts)[0]
    assert with_actions(windows, "planned") is windows
    arm = with_actions(windows, "none").arm
    assert torch.equal(arm[CONTEXT:], arm[CONTEXT - 1].expand(HORIZON, -1, -1))
    torch.manual_seed(0)
    first = with_actions(windows, "shuffled").arm
    torch.manual_seed(0)
    assert torch.equal(with_actions(windows, "shuffled").arm, first)
    assert torch.equal(first[:CONTEXT], windows.arm[:CONTEXT])
    assert not torch.allclose(first[CONTEXT:], windows.arm[CONTEXT:], atol=1e-3)


def test_actions_that_do_not_exist_are_named_with_those_that_do() -> None:
    with pytest.raises(TacpipeError, match=f"no actions 'guessed'; there are {', '.join(ACTIONS)}"):
        join_parts("guessed")
