"""How often rows come: the same for all on a grid, as it may be where rows are as logged."""

from __future__ import annotations

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.tracks import Track, rate_hz


def track(name: str, found_hz: float, *, logged: bool) -> Track:
    t_ns = np.rint(np.arange(40) * 1e9 / found_hz).astype(np.int64)  # (time,)
    rows = np.zeros(40, dtype=np.int64)
    values = np.zeros((40, 1))
    return Track(name, t_ns, rows, rows, rows == 0, values, values, values, logged)


def test_rows_as_logged_may_come_at_different_rates() -> None:
    given = [track(name, found_hz, logged=True) for name, found_hz in (("a", 32.0), ("b", 41.0), ("c", 46.0))]
    assert rate_hz(given) == pytest.approx(41.0, rel=1e-6)


def test_rates_on_a_grid_that_differ_are_named_with_their_recordings() -> None:
    with pytest.raises(TacpipeError, match=r"slow runs at 25\.00 Hz and fast at 50\.00 Hz"):
        rate_hz([track("slow", 25.0, logged=False), track("fast", 50.0, logged=False)])


def test_rows_as_logged_do_not_mix_with_a_grid() -> None:
    with pytest.raises(TacpipeError, match="raw has its rows as logged"):
        rate_hz([track("raw", 50.0, logged=True), track("even", 50.0, logged=False)])
