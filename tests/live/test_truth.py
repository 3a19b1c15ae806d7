"""Compare published values with the later measurements: rows, times and errors, computed by hand."""

from __future__ import annotations

import numpy as np

from tacpipe.live import messages
from tacpipe.tasks.forward.live import measures as truth


def test_rows_are_compared_bit_for_bit_and_only_where_both_have_them() -> None:
    published = np.array([[[1.0]], [[2.0]], [[3.0]], [[np.nan]]], np.float32)
    recomputed = np.array([[[2.0]], [[3.0 + 2**-20]], [[np.nan]], [[9.0]]], np.float32)
    result, equal = truth.equality(np.array([10, 20, 30, 40]), published, np.array([20, 30, 40, 50]), recomputed)
    assert (result.published, result.recomputed, result.compared, result.equal) == (4, 4, 3, 2)
    assert equal.tolist() == [False, True, False, True]
    assert 0 < result.largest_difference < 1e-6


def test_minus_zero_is_not_zero() -> None:
    zero, minus_zero = np.zeros((1, 1, 1), np.float32), -np.zeros((1, 1, 1), np.float32)
    assert truth.equality(np.array([0]), zero, np.array([0]), minus_zero)[0].equal == 0


def test_nothing_is_interpolated_over_a_gap_or_an_unusable_row() -> None:
    t_ns, values = np.arange(5) * 10, np.arange(5.0)[:, None]
    groups, usable = np.array([0, 0, 1, 1, 1]), np.array([True, True, True, False, True])
    result = truth.at(t_ns, values, groups, usable, np.array([-1, 0, 4, 15, 20, 25, 40, 41]))[:, 0]
    assert np.array_equal(result, [np.nan, 0, 0.4, np.nan, 2, np.nan, 4, np.nan], equal_nan=True)


def test_steps_are_periods_on_a_uniform_grid_and_rows_on_another() -> None:
    rows = np.array([0, 21, 39, 60])
    assert truth.targets(rows, np.array([0, 39]), (1, 3), 20.0).tolist() == [[20, 60], [59, 99]]
    assert truth.targets(rows, np.array([0, 39]), (1, 3), None).tolist() == [[21, 60], [60, -1]]


def test_errors_are_summed_over_rows_and_channels() -> None:
    predicted = np.array([[[1.0, 2.0]], [[3.0, 5.0]]])
    squared, absolute = truth.sums(predicted, np.zeros((2, 1, 2)))
    assert squared.tolist() == [39.0] and absolute.tolist() == [11.0]


def test_latencies_of_no_forecast_are_a_count() -> None:
    assert messages.summarize_latencies(np.array([np.nan])) == {"count": 0}
