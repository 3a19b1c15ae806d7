"""Interpolation against numpy.interp and scipy's Slerp, at stamps as large as real ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation, Slerp

from tacpipe.errors import TacpipeError
from tacpipe.signals import resampling

EPOCH_NS = 1_637_771_974_778_354_001  # odd: as float64 it would be rounded to a multiple of 256
stamps = hnp.arrays(np.int64, st.integers(2, 40), elements=st.integers(1, 10**9)).map(lambda steps: np.cumsum(steps))


def test_a_grid_point_is_its_number_over_the_rate_and_rounding_never_adds_up() -> None:
    grid_ns = resampling.uniform_grid(EPOCH_NS, EPOCH_NS + 10_000_000_000, 30.0)
    assert grid_ns.dtype == np.int64
    assert grid_ns.tolist() == [EPOCH_NS + round(k * 1e9 / 30) for k in range(301)]


def test_a_grid_ends_at_the_last_point_that_is_not_late() -> None:
    assert len(resampling.uniform_grid(0, 20_000_000, 50.0)) == 2
    assert len(resampling.uniform_grid(0, 19_999_999, 50.0)) == 1
    assert len(resampling.uniform_grid(0, -1, 50.0)) == 0


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_not_positive_gives_no_grid(rate_hz: float) -> None:
    with pytest.raises(TacpipeError, match="must be above 0 and at most 1e9"):
        resampling.uniform_grid(0, 1, rate_hz)


@given(stamps, st.data())
def test_linear_agrees_with_numpy_interp(t_ns: np.ndarray, data: st.DataObject) -> None:
    values = data.draw(hnp.arrays(np.float64, (len(t_ns), 3), elements=st.floats(-1e6, 1e6)))
    grid_ns = np.array(data.draw(st.lists(st.integers(-10, int(t_ns[-1]) + 10), min_size=1)))
    resampled = resampling.linear(EPOCH_NS + t_ns, values, EPOCH_NS + grid_ns)
    expected = np.column_stack([np.interp(grid_ns, t_ns, channel) for channel in values.T])
    np.testing.assert_allclose(resampled, expected, rtol=1e-9, atol=1e-6)


def test_linear_does_not_lose_nanoseconds_of_today() -> None:
    t_ns = EPOCH_NS + np.array([0, 100])
    resampled = resampling.linear(t_ns, np.array([[0.0], [100.0]]), EPOCH_NS + np.arange(101))
    np.testing.assert_allclose(resampled[:, 0], np.arange(101), atol=1e-12)


@given(stamps, st.data())
def test_the_bracketing_rows_are_all_that_interpolation_looks_at(t_ns: np.ndarray, data: st.DataObject) -> None:
    t_ns = np.sort(np.concatenate([t_ns, t_ns[::3]]))  # some stamps twice
    values = np.random.default_rng(0).normal(size=(len(t_ns), 2))
    grid_ns = np.array(data.draw(st.lists(st.integers(-10, int(t_ns[-1]) + 10), min_size=1)))
    used = resampling.bracketing_rows(t_ns, grid_ns)
    expected = resampling.linear(t_ns, values, grid_ns)
    np.testing.assert_array_equal(resampling.linear(t_ns[used], values[used], grid_ns), expected)


def test_of_equal_stamps_the_last_counts() -> None:
    t_ns = np.array([0, 10, 10, 20])
    resampled = resampling.linear(t_ns, np.array([[0.0], [1.0], [5.0], [6.0]]), np.array([5, 10, 15]))
    assert resampled[:, 0].tolist() == [0.5, 5.0, 5.5]


def test_a_nan_spreads_to_its_neighbours_and_no_further() -> None:
    t_ns = np.array([0, 10, 20, 30])
    resampled = resampling.linear(t_ns, np.array([[0.0], [1.0], [np.nan], [3.0]]), np.array([5, 10, 15, 20, 25, 30]))
    assert np.isnan(resampled[:, 0]).tolist() == [False, False, True, True, True, False]


@given(st.integers(0, 2**32 - 1))
def test_slerp_agrees_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t_ns = np.cumsum(rng.integers(1, 10**8, 12))
    turned = Rotation.from_quat(rng.normal(size=(12, 4)))
    grid_ns = rng.integers(t_ns[0], t_ns[-1] + 1, 50)
    scaled = turned.as_quat() * rng.choice([-2.0, 1.0, 0.5], 12)[:, None]
    resampled = resampling.slerp(EPOCH_NS + t_ns, scaled, EPOCH_NS + grid_ns)
    expected = Slerp(t_ns, turned)(grid_ns)
    np.testing.assert_allclose(np.linalg.norm(resampled, axis=1), 1.0, atol=1e-12)
    assert (Rotation.from_quat(resampled) * expected.inv()).magnitude().max() < 1e-6


def test_slerp_of_equal_rotations_stays_there() -> None:
    rotation = np.array([[0.0, 0.6, 0.0, 0.8]])
    resampled = resampling.slerp(np.array([0, 10]), np.repeat(rotation, 2, axis=0), np.arange(11))
    np.testing.assert_allclose(resampled, np.repeat(rotation, 11, axis=0), atol=1e-15)


def test_slerp_has_no_jump_of_sign() -> None:
    angles = np.linspace(0, 4 * np.pi, 60)
    quaternions = np.column_stack([np.sin(angles / 2), 0 * angles, 0 * angles, np.cos(angles / 2)])
    quaternions[::3] *= -1
    resampled = resampling.slerp(np.arange(60) * 10, quaternions, np.arange(0, 590, 7))
    assert ((resampled[1:] * resampled[:-1]).sum(axis=1) > 0.9).all()


@given(stamps, st.data())
def test_nearest_is_what_a_look_at_every_sample_finds(t_ns: np.ndarray, data: st.DataObject) -> None:
    grid_ns = np.array(data.draw(st.lists(st.integers(-10, int(t_ns[-1]) + 10), min_size=1)))
    distance = np.abs(t_ns[None] - grid_ns[:, None])
    assert resampling.nearest_rows(t_ns, grid_ns).tolist() == distance.argmin(axis=1).tolist()


def test_nearest_keeps_the_type_and_takes_the_earlier_of_two() -> None:
    values = np.array([1, 2], dtype=np.int8)
    resampled = resampling.nearest(np.array([0, 10]), values, np.array([-5, 4, 5, 6, 50]))
    assert resampled.dtype == np.int8
    assert resampled.tolist() == [1, 1, 1, 2, 2]


def test_a_gap_lies_strictly_between_distant_samples_or_outside_all() -> None:
    t_ns = np.array([0, 10, 100, 110])
    grid_ns = np.array([-1, 0, 5, 10, 11, 99, 100, 110, 111])
    assert resampling.in_gap(t_ns, grid_ns, 50).tolist() == [True, False, False, False, True, True, False, False, True]
    assert not resampling.in_gap(t_ns, grid_ns[1:-1], 90).any()


@pytest.mark.parametrize("signal", [resampling.nearest_rows, lambda t, g: resampling.in_gap(t, g, 1)])
def test_a_signal_without_samples_is_refused(signal: object) -> None:
    assert callable(signal)
    with pytest.raises(TacpipeError, match="has no samples"):
        signal(np.zeros(0, dtype=np.int64), np.array([0]))


def test_one_sample_is_its_value_everywhere() -> None:
    assert resampling.linear(np.array([5]), np.array([[2.0]]), np.array([0, 5, 9]))[:, 0].tolist() == [2.0, 2.0, 2.0]
    assert resampling.nearest_rows(np.array([5]), np.array([0, 9])).tolist() == [0, 0]


@given(stamps, st.data())
def test_the_median_around_a_point_is_that_of_all_samples_so_near(t_ns: np.ndarray, data: st.DataObject) -> None:
    t_ns = np.sort(np.concatenate([t_ns, t_ns[::3]]))  # some stamps twice
    values = np.random.default_rng(0).normal(size=(len(t_ns), 2))
    grid_ns = np.array(data.draw(st.lists(st.integers(-10, int(t_ns[-1]) + 10), min_size=1)))
    half_ns = data.draw(st.integers(0, 2 * 10**9))
    medians = resampling.median_around(EPOCH_NS + t_ns, values, EPOCH_NS + grid_ns, half_ns)
    between = resampling.linear(t_ns, values, grid_ns)
    for point, row, line in zip(grid_ns, medians, between, strict=True):
        near = np.abs(t_ns - point) <= half_ns
        expected = np.median(values[near], axis=0) if near.any() else line
        np.testing.assert_array_equal(row, expected)


@given(stamps, st.lists(st.integers(0, 10**9), min_size=1, max_size=20))
def test_the_newest_row_is_the_last_that_is_not_after_the_point(t_ns: np.ndarray, points: list[int]) -> None:
    t_ns, grid_ns = EPOCH_NS + np.repeat(t_ns, 2), EPOCH_NS + np.array(points)
    for point, row in zip(grid_ns, resampling.newest_rows(t_ns, grid_ns), strict=True):
        earlier_rows = [i for i, stamp in enumerate(t_ns) if stamp <= point]
        assert row == (earlier_rows[-1] if earlier_rows else -1)


def test_a_median_of_the_past_has_the_samples_of_its_span_or_the_newest() -> None:
    t_ns = EPOCH_NS + np.array([0, 10, 20, 30, 100])
    values = np.array([[5.0], [1.0], [9.0], [2.0], [4.0]])
    grid_ns = EPOCH_NS + np.array([0, 20, 35, 99, 100])
    medians = resampling.median_before(t_ns, values, resampling.newest_rows(t_ns, grid_ns), grid_ns, 20)
    assert medians[:, 0].tolist() == [5.0, 5.0, 5.5, 2.0, 4.0]


def test_a_stream_is_overdue_once_its_newest_sample_is_older_than_the_gap() -> None:
    newest_ns, grid_ns = EPOCH_NS + np.array([0, 0, 0]), EPOCH_NS + np.array([49, 50, 51])
    assert resampling.is_overdue(newest_ns, grid_ns, 50).tolist() == [False, False, True]


@pytest.mark.parametrize("count", [2, 150, 151])
@pytest.mark.parametrize("longest", [0, 5, 10**12])
def test_the_median_step_of_many_samples_is_that_of_all_steps_at_once(
    monkeypatch: pytest.MonkeyPatch, count: int, longest: int
) -> None:
    t_ns = EPOCH_NS + np.cumsum(np.random.default_rng(0).integers(0, longest + 1, count))
    monkeypatch.setattr(resampling, "STEPS_AT_ONCE", 10)
    assert resampling.median_step_ns(t_ns) == np.median(np.diff(t_ns))
    assert resampling.median_step_ns(t_ns[:1]) == 0


def test_a_grid_over_a_long_gap_is_refused_and_names_it() -> None:
    t_ns = np.array([0, 1, 2, 10_000_000, 10_000_001]) * 10**9
    resampling.expect_grid_of_samples(resampling.GRID_ROWS, 5, t_ns, "here")
    with pytest.raises(
        TacpipeError, match=r"^here: the grid would have 10,000,002 rows, .* 9,999,998 s, after sample 2"
    ):
        resampling.expect_grid_of_samples(10_000_002, 5, t_ns, "here")
