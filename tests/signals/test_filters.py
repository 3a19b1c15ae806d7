"""Filters against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage, signal

from tacpipe.errors import TacpipeError
from tacpipe.signals.filters import butterworth, envelope, median, trailing_median

signals = hnp.arrays(np.float64, st.integers(10, 120), elements=st.floats(-1e4, 1e4))


@pytest.mark.parametrize(("cutoff_hz", "rate_hz"), [(5.0, 50.0), (24.9, 50.0), (0.01, 1000.0)])
def test_the_coefficients_are_those_of_scipy(cutoff_hz: float, rate_hz: float) -> None:
    b, a = signal.butter(2, cutoff_hz, fs=rate_hz)
    coefficients = butterworth(cutoff_hz, rate_hz)
    np.testing.assert_allclose(coefficients.b, b, rtol=1e-9)
    np.testing.assert_allclose((1.0, *coefficients.a), a, rtol=1e-9)


@given(signals)
def test_forwards_it_is_lfilter_that_starts_from_a_constant(values: np.ndarray) -> None:
    b, a = signal.butter(2, 5.0, fs=50.0)
    expected, _ = signal.lfilter(b, a, values, zi=signal.lfilter_zi(b, a) * values[0])
    np.testing.assert_allclose(butterworth(5.0, 50.0).causal(values), expected, atol=1e-8)


@given(signals)
def test_both_ways_it_is_filtfilt(values: np.ndarray) -> None:
    expected = signal.filtfilt(*signal.butter(2, 5.0, fs=50.0), values)
    np.testing.assert_allclose(butterworth(5.0, 50.0).both_ways(values), expected, atol=1e-7)


@pytest.mark.parametrize("rows", [0, 1, 2, 5])
def test_few_rows_that_are_alike_stay_as_they_are(rows: int) -> None:
    filtered = butterworth(5.0, 50.0)
    for smoothed in (filtered.causal(np.full(rows, 3.0)), filtered.both_ways(np.full(rows, 3.0))):
        np.testing.assert_allclose(smoothed, np.full(rows, 3.0))


@given(signals, st.sampled_from([1, 3, 5, 9]))
def test_the_median_is_that_of_ndimage(values: np.ndarray, rows: int) -> None:
    np.testing.assert_array_equal(median(values, rows), ndimage.median_filter(values, rows, mode="nearest"))
    so_far = [np.median(np.r_[np.full(rows, values[0]), values[: i + 1]][-rows:]) for i in range(len(values))]
    np.testing.assert_array_equal(trailing_median(values, rows), so_far)
    assert median(values[:0], rows).tolist() == []


@pytest.mark.parametrize("cutoff_hz", [0.0, 25.0, -1.0, float("nan")])
def test_a_cutoff_beyond_half_the_rate_is_refused(cutoff_hz: float) -> None:
    with pytest.raises(TacpipeError, match="25 Hz"):
        butterworth(cutoff_hz, 50.0)


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
