"""The time axis of an array: against numpy's correlation, and on arrays that are made to have one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.formats.roboskin import is_time, lag_one, scramble, unscramble
from tests.formats.slide_files import touched


def walk(seed: int, channels: int = 12, frames: int = 80) -> np.ndarray:
    """Return channels that differ and drift, (channel, time)."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 5, (channels, 1)) + np.cumsum(rng.normal(size=(channels, frames)), axis=1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_autocorrelation_is_that_of_neighbours_as_numpy_has_it(axis: int) -> None:
    values = np.cumsum(np.random.default_rng(0).normal(size=(4, 5, 6)), axis=axis)
    moved = np.moveaxis(values, axis, 0)
    expected = np.corrcoef(moved[:-1].ravel(), moved[1:].ravel())[0, 1]
    assert lag_one(values, axis) == pytest.approx(expected)
    assert lag_one(values, axis - 3) == pytest.approx(expected)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100), st.floats(-1000, 1000))
def test_neither_unit_nor_offset_changes_it(seed: int, scale: float, offset: float) -> None:
    values = walk(seed)
    assert lag_one(values * scale + offset, 1) == pytest.approx(lag_one(values, 1), abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_time_is_the_axis_along_which_readings_drift(seed: int) -> None:
    values = walk(seed)
    assert is_time(values, 1)
    assert is_time(values.T, 0)
    assert not is_time(values, 0)
    assert not is_time(np.random.default_rng(seed).permuted(values, axis=1) - values.mean(axis=1, keepdims=True), 1)


def test_of_two_smooth_axes_the_smoother_is_time() -> None:
    values = np.sin(np.arange(40) / 4)[:, None] + np.sin(np.arange(40) / 9)
    assert 0.5 < lag_one(values, 0) < lag_one(values, 1)
    assert is_time(values, 1)
    assert not is_time(values, 0)


def test_what_does_not_vary_or_is_not_finite_tells_nothing() -> None:
    assert np.isnan(lag_one(np.ones((3, 4)), 1))
    assert np.isnan(lag_one(np.ones((3, 1)), 1))
    assert not is_time(np.ones((3, 4)), 1)
    holed = walk(0)
    holed[2, 3] = np.nan
    assert not is_time(holed, 1)


slides = hnp.arrays(np.float32, hnp.array_shapes(min_dims=3, max_dims=5, max_side=7), elements=st.floats(width=32))


@given(slides)
def test_both_ways_undo_each_other_to_the_bit(given_slides: np.ndarray) -> None:
    for forward, backward in ((scramble, unscramble), (unscramble, scramble)):
        assert backward(forward(given_slides)).tobytes() == np.ascontiguousarray(given_slides).tobytes()
        assert forward(given_slides).shape == given_slides.shape


@given(st.integers(1, 7), st.integers(1, 4), st.integers(1, 9))
def test_each_reading_goes_where_the_formula_says(triangles: int, taxels: int, frames: int) -> None:
    readings = np.random.default_rng(0).random((2, triangles, taxels, frames))
    scrambled = scramble(readings)
    for row in range(triangles):
        for place in range(frames):
            turn = frames * row + place
            assert np.array_equal(scrambled[:, row, :, place], readings[:, turn % triangles, :, turn // triangles])


def test_what_is_scrambled_has_no_time_axis_and_what_is_not_has() -> None:
    for slide in touched(20):
        assert is_time(slide, -1)
        assert not is_time(scramble(slide), -1)
        assert is_time(unscramble(scramble(slide)), -1)
