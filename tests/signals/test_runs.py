"""Runs and states, row by row."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.errors import TacpipeError
from tacpipe.signals.runs import in_long_runs, in_long_runs_online, latch, runs, window_starts

flags = hnp.arrays(np.bool_, st.integers(0, 60))


@given(flags)
def test_runs_cover_what_is_on_and_nothing_else(state: np.ndarray) -> None:
    starts, stops = runs(state)
    covered = np.zeros(len(state), dtype=bool)
    for start, stop in zip(starts, stops, strict=True):
        assert not covered[max(start - 1, 0) : stop].any()
        covered[start:stop] = True
    assert covered.tolist() == state.tolist()


@given(st.lists(st.tuples(st.booleans(), st.booleans())))
def test_a_latch_does_what_a_loop_does(rows: list[tuple[bool, bool]]) -> None:
    state, expected = False, []
    for on, off in rows:
        state = on or (state and not off)
        expected.append(state)
    switches = np.array(rows, dtype=bool).reshape(-1, 2)
    assert latch(switches[:, 0], switches[:, 1]).tolist() == expected


@given(flags, st.integers(1, 6))
def test_what_lasts_is_told_from_the_rows_so_far(state: np.ndarray, rows: int) -> None:
    expected = [i + 1 >= rows and bool(state[i + 1 - rows : i + 1].all()) for i in range(len(state))]
    assert in_long_runs_online(state, rows).tolist() == expected


@given(flags, st.integers(1, 6))
def test_a_long_run_is_one_that_lasts_with_what_led_up_to_it(state: np.ndarray, rows: int) -> None:
    expected = np.zeros(len(state), dtype=bool)
    for i in np.flatnonzero(in_long_runs_online(state, rows)):
        expected[i + 1 - rows : i + 1] = True
    assert in_long_runs(state, rows).tolist() == expected.tolist()


def test_windows_do_not_cross_recordings_or_unusable_rows() -> None:
    groups = np.array([0] * 5 + [1] * 6)
    usable = np.ones(11, dtype=bool)
    assert window_starts(groups, usable, 2, 1).tolist() == [0, 1, 2, 5, 6, 7, 8]
    usable[7] = False
    assert window_starts(groups, usable, 2, 1).tolist() == [0, 1, 2, 8]


def test_the_stride_counts_from_the_start_of_each_run() -> None:
    assert window_starts(np.array([0] * 5 + [1] * 6), np.ones(11, dtype=bool), 1, 1, 2).tolist() == [0, 2, 5, 7, 9]


@given(st.lists(st.tuples(st.integers(0, 1), st.booleans()), max_size=60), st.integers(1, 4), st.integers(1, 4))
def test_the_windows_are_those_that_a_look_at_every_start_finds(
    rows: list[tuple[int, bool]], context: int, horizon: int
) -> None:
    groups, usable = np.array([row[0] for row in rows]), np.array([row[1] for row in rows], dtype=bool)
    length = context + horizon
    expected = [
        start
        for start in range(len(rows) - length + 1)
        if usable[start : start + length].all() and len(set(groups[start : start + length])) == 1
    ]
    assert window_starts(groups, usable, context, horizon).tolist() == expected


def test_a_window_without_length_is_refused() -> None:
    for context, horizon in ((0, 1), (1, -1)):
        with pytest.raises(TacpipeError, match=f"context {context}, horizon {horizon}"):
            window_starts(np.zeros(3), np.ones(3, dtype=bool), context, horizon)
