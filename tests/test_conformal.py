"""Conformal quantiles over groups: the law that they promise, and numpy as oracle where every group has one score."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.metrics.calibration import conformal_quantile, highest_promised_level

SCORES = st.floats(-1e6, 1e6, allow_nan=False)
GROUPS = st.lists(st.lists(SCORES, min_size=1, max_size=6), min_size=2, max_size=8)
LEVELS = st.floats(0.05, 0.95)


def join_groups(groups: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([np.array(group) for group in groups]), np.repeat(
        range(len(groups)), [len(group) for group in groups]
    )


@given(GROUPS, LEVELS)
def test_a_group_left_out_lies_below_the_promised_quantile_of_the_others_as_often_as_promised(
    groups: list[list[float]], level: float
) -> None:
    # Each of exchangeable groups is the new one with the same probability, so this mean is the coverage given the values.
    below = []
    for at, group in enumerate(groups):
        scores, numbers = join_groups(groups[:at] + groups[at + 1 :])
        below.append(np.mean(np.array(group) <= conformal_quantile(scores, numbers, level, promised=True)))
    assert np.mean(below) >= level - 1e-9


@given(st.lists(SCORES, min_size=1, max_size=40), LEVELS)
def test_with_one_score_a_group_it_is_split_conformal_prediction(scores: list[float], level: float) -> None:
    rank = math.ceil(level * (len(scores) + 1) - 1e-6)
    expected = sorted(scores)[rank - 1] if rank <= len(scores) else math.inf
    assert conformal_quantile(np.array(scores), np.arange(len(scores)), level, promised=True) == expected


@given(st.lists(SCORES, min_size=1, max_size=40), LEVELS)
def test_pooled_scores_of_one_group_have_the_quantile_of_numpy(scores: list[float], level: float) -> None:
    estimate = conformal_quantile(np.array(scores), np.zeros(len(scores), int), level)
    near = [level - 1e-7, level, level + 1e-7]  # Either is right if the level falls between two scores.
    assert estimate in {float(np.quantile(scores, min(near_level, 1), method="inverted_cdf")) for near_level in near}


def test_a_long_recording_weighs_as_much_as_a_short_one() -> None:
    scores, groups = join_groups([[0.0] * 98, [1.0, 2.0]])
    assert conformal_quantile(scores, groups, 0.75) == 1.0


def test_four_recordings_promise_eighty_percent_and_no_more() -> None:
    scores, groups = join_groups([[1.0], [2.0], [3.0], [4.0]])
    assert highest_promised_level(4) == 0.8
    assert conformal_quantile(scores, groups, 0.8, promised=True) == 4.0
    assert conformal_quantile(scores, groups, 0.81, promised=True) == math.inf


def test_bands_of_simulated_recordings_hold_as_often_as_promised() -> None:
    rng = np.random.default_rng(0)

    def recording() -> np.ndarray:  # errors whose spread differs by recording, as those of objects do
        return np.abs(rng.normal(0, rng.lognormal(0, 0.7), rng.integers(5, 60)))

    covered = []
    for _ in range(2000):
        scores, groups = join_groups([list(recording()) for _ in range(9)])
        covered.append(np.mean(recording() <= conformal_quantile(scores, groups, 0.8, promised=True)))
    assert 0.79 < np.mean(covered) < 0.95


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1])
def test_a_level_outside_of_zero_and_one_is_refused(level: float) -> None:
    with pytest.raises(TacpipeError, match="not between 0 and 1"):
        conformal_quantile(np.ones(2), np.arange(2), level)


def test_scores_without_groups_are_refused() -> None:
    with pytest.raises(TacpipeError, match="no quantile"):
        conformal_quantile(np.ones(2), np.arange(3), 0.5)
