"""Windows against a look at every start."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.signals.runs import window_starts


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
    with pytest.raises(TacpipeError, match="horizon 0"):
        window_starts(np.zeros(3), np.ones(3, dtype=bool), 1, 0)
