"""Runs and states, row by row."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.signals.runs import in_long_runs, in_long_runs_online, latch, runs

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
