"""Held frames and what rate is left without them."""

from __future__ import annotations

import numpy as np
import pytest

from tacpipe.signals.repairs import mean_rate_hz, new_frame_rate_hz, repeated_rows


def test_a_frame_is_held_only_if_every_channel_repeats() -> None:
    values = np.array([[1, 1], [1, 1], [1, 2], [1, 2], [2, 2]], dtype=np.uint16)
    assert repeated_rows(values).tolist() == [False, True, False, True, False]


def test_a_recording_of_one_frame_or_none_has_no_held_one() -> None:
    assert repeated_rows(np.zeros((1, 3))).tolist() == [False]
    assert repeated_rows(np.zeros((0, 3))).tolist() == []


def test_nan_is_never_held() -> None:
    assert not repeated_rows(np.full((3, 1), np.nan)).any()


def test_four_frames_at_40_hz_of_which_three_repeat_are_10_hz() -> None:
    t_ns = np.arange(41) * 25_000_000
    repeats = np.arange(41) % 4 != 0
    assert mean_rate_hz(t_ns) == pytest.approx(40.0)
    assert new_frame_rate_hz(t_ns, repeats) == pytest.approx(10.0)


@pytest.mark.parametrize("t_ns", [[], [5], [5, 5]])
def test_a_rate_needs_two_moments(t_ns: list[int]) -> None:
    assert mean_rate_hz(np.array(t_ns, dtype=np.int64)) == 0.0
