"""The envelope of a long signal."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.signals.filters import envelope


@given(st.integers(0, 2**32 - 1), st.integers(1, 4000), st.integers(2, 300))
def test_the_largest_and_least_values_of_all_channels_remain_and_rows_are_few(
    seed: int, rows: int, points: int
) -> None:
    rng = np.random.default_rng(seed)
    t_ns = np.cumsum(rng.integers(1, 10**9, rows))
    values = rng.normal(size=(rows, 3))

    at_ns, extremes = envelope(t_ns, values, points)

    assert len(extremes) == len(at_ns) <= max(points, 2)
    np.testing.assert_array_equal(extremes.max(axis=0), values.max(axis=0))
    np.testing.assert_array_equal(extremes.min(axis=0), values.min(axis=0))
    assert (np.diff(at_ns) >= 0).all() and set(at_ns.tolist()) <= set(t_ns.tolist())


def test_a_single_spike_of_a_million_rows_is_not_lost_and_comes_at_its_time() -> None:
    t_ns = np.arange(1_000_000)
    values = np.zeros((1_000_000, 1))
    values[623_451] = 7.0

    at_ns, extremes = envelope(t_ns, values, 1000)

    assert extremes.max() == 7.0
    assert abs(int(at_ns[extremes.argmax()]) - 623_451) <= 2000


def test_a_short_signal_stays_as_it_is_and_nan_hides_no_neighbour() -> None:
    values = np.array([[np.nan], [1.0], [2.0], [np.nan], [np.nan], [np.nan]])

    np.testing.assert_array_equal(envelope(np.arange(6), values, 6)[1], values)
    extremes = envelope(np.arange(6), values, 4)[1].ravel()
    np.testing.assert_array_equal(extremes, [1.0, 2.0, np.nan, np.nan])
