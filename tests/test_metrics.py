from __future__ import annotations

import numpy as np
import pytest

from tacpipe.metrics import regression

RNG = np.random.default_rng(0)


def test_sums_are_those_of_plain_loops() -> None:
    predicted, truth = RNG.normal(size=(4, 3, 2)), RNG.normal(size=(4, 3, 2))
    for step in range(3):
        for channel in range(2):
            errors = [predicted[window, step, channel] - truth[window, step, channel] for window in range(4)]
            assert regression.squared_error_sums(predicted, truth)[step, channel] == pytest.approx(
                sum(e * e for e in errors)
            )
            assert regression.absolute_error_sums(predicted, truth)[step, channel] == pytest.approx(
                sum(map(abs, errors))
            )


def test_the_mean_error_weighs_windows_and_not_recordings() -> None:
    errors = [RNG.normal(size=(count, 3, 2)) ** 2 for count in (1, 7)]
    sums = np.stack([squared.sum(axis=0) for squared in errors])
    expected = np.concatenate(errors).mean(axis=(0, 2))
    assert np.allclose(regression.mean_error(sums, np.array([1, 7])), expected)
    assert np.isnan(regression.mean_error(np.zeros((0, 3, 2)), np.zeros(0, dtype=np.int64))).all()
