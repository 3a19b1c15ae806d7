import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tacpipe.errors import TacpipeError
from tacpipe.training import scaling

ROWS = arrays(np.float64, (7, 3), elements=st.floats(-1e4, 1e4, width=32))


@given(ROWS)
def test_training_rows_lie_within_one_and_come_back(values: np.ndarray) -> None:
    fitted = scaling.fit(values)
    scaled = fitted.scale(values)
    assert (np.abs(scaled) <= 1 + 1e-6).all()
    assert np.allclose(fitted.restore(scaled), values, atol=1e-2)


def test_the_ends_of_the_range_are_minus_one_and_one() -> None:
    fitted = scaling.fit(np.array([[2.0, 5.0], [6.0, 5.0]]))
    assert fitted.scale(np.array([[2.0, 5.0], [6.0, 6.0], [4.0, 5.0]])).tolist() == [[-1, 0], [1, 1], [0, 0]]
    assert fitted.restore(np.array([[1.0, 0.0]])).tolist() == [[6.0, 5.0]]


def test_a_scaling_survives_json() -> None:
    fitted = scaling.fit(np.random.default_rng(0).normal(size=(5, 4)))
    restored = scaling.MinMax.from_json(json.loads(json.dumps(fitted.to_json())))
    assert np.array_equal(restored.low, fitted.low)
    assert np.array_equal(restored.high, fitted.high)


def test_no_rows_and_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(TacpipeError, match="0 rows"):
        scaling.fit(np.zeros((0, 3)))
    with pytest.raises(TacpipeError, match="Dimension 1"):
        scaling.fit(np.array([[0.0, np.nan]]))


@pytest.mark.parametrize("kind", scaling.KINDS)
def test_what_an_affine_scaling_applies_it_restores_in_float64(kind: str) -> None:
    values = np.random.default_rng(1).uniform(100, 3800, (9, 4, 3))
    values[..., 1] = 700  # never moves
    fitted = scaling.Affine.fit(values, kind)
    scaled = fitted.apply(values)
    back = fitted.restore(scaled)
    assert (str(scaled.dtype), str(back.dtype)) == ("float32", "float64")
    np.testing.assert_allclose(back, values, rtol=1e-5)
    restored = scaling.Affine.from_tensors(fitted.to_tensors())
    np.testing.assert_array_equal(restored.restore(scaled), back)


def test_an_affine_scaling_restores_by_hand() -> None:
    shares = np.array([[0.0, 1.0], [0.5, -1.0]], np.float32)
    fitted = scaling.Affine(np.array([2500.0, 100.0]), np.array([900.0, 3500.0]))
    assert fitted.restore(shares).tolist() == [[2500.0, 3600.0], [2950.0, -3400.0]]
    heavy = scaling.Affine(np.zeros(1), np.array([2.0]), logarithm=True)
    np.testing.assert_allclose(heavy.restore(np.array([[0.0], [0.5]], np.float32)), [[0.0], [math.e - 1]], rtol=1e-7)
