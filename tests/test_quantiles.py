"""Pinball loss, coverage and fitted quantiles: scikit-learn and a distribution of known quantiles as oracles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.linear_model import QuantileRegressor
from sklearn.metrics import mean_pinball_loss

from tacpipe.errors import TacpipeError
from tacpipe.metrics import calibration
from tacpipe.tasks.forward.quantiles import ResidualQuantiles

LEVELS = np.array([0.1, 0.5, 0.9])


def draw_errors(windows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a feature (window, channel, 1) and errors (window, channel, step) whose spread it sets, known by formula."""
    rng = np.random.default_rng(seed)
    feature = rng.uniform(-1, 1, (windows, 2, 1)).astype(np.float32)
    errors = rng.normal(0.3 * feature, np.exp(feature), (windows, 2, 1)) * np.array(
        [[[1.0, 3.0]], [[10.0, 30.0]]]
    ).reshape(1, 2, 2)
    return feature, errors.astype(np.float32)


def true_quantiles(feature: np.ndarray) -> np.ndarray:
    """Return the quantiles (window, channel, step, level) of what `draw_errors` draws."""
    base = 0.3 * feature[..., None] + np.exp(feature)[..., None] * norm.ppf(LEVELS)
    true: np.ndarray = base * np.array([[1.0, 3.0], [10.0, 30.0]])[None, :, :, None]
    return true


def test_pinball_is_that_of_scikit_learn() -> None:
    rng = np.random.default_rng(1)
    truth, predicted = rng.normal(size=(50, 2)), np.sort(rng.normal(size=(50, 2, 3)), axis=-1)
    sums = calibration.Sums.from_predictions(truth, predicted, LEVELS)
    for step in range(2):
        for at, level in enumerate(LEVELS):
            expected = mean_pinball_loss(truth[:, step], predicted[:, step, at], alpha=level)
            assert sums.pinball[step, at] / 50 == pytest.approx(expected)


def test_coverage_and_width_are_those_counted_by_hand() -> None:
    truth = np.array([[0.0], [1.0], [5.0], [-3.0]])
    predicted = np.broadcast_to([-1.0, 0.0, 1.0], (4, 1, 3))
    tree = calibration.measures_by_step([calibration.Sums.from_predictions(truth, predicted, LEVELS)], (10, 50, 90))
    assert tree["coverage"] == {"t1": 0.5, "mean": 0.5}
    assert tree["width"]["t1"] == 2.0
    assert [tree[f"below_q{level}"]["t1"] for level in (10, 50, 90)] == [0.25, 0.5, 0.75]
    assert "coverage_low" not in tree  # There is one recording.


def test_sums_of_two_parts_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(2)
    truth, predicted = rng.normal(size=(20, 3)), np.sort(rng.normal(size=(20, 3, 3)), axis=-1)
    total = calibration.Sums.from_predictions(truth, predicted, LEVELS)
    parts = [
        calibration.Sums.from_predictions(truth[rows], predicted[rows], LEVELS) for rows in (slice(0, 7), slice(7, 20))
    ]
    total_tree, two = (
        calibration.measures_by_step([total], (10, 50, 90)),
        calibration.measures_by_step([parts[0] + parts[1]], (10, 50, 90)),
    )
    assert total_tree == two


def test_fitted_quantiles_are_near_those_of_the_distribution_that_errors_are_drawn_from() -> None:
    fitted = ResidualQuantiles.fit(*draw_errors(8000, 0), LEVELS)
    feature, errors = draw_errors(2000, 1)
    predicted, expected = fitted.predict(feature), true_quantiles(feature)
    spread = np.exp(feature)[..., None] * np.array([[1.0, 3.0], [10.0, 30.0]])[None, :, :, None]
    assert np.abs((predicted - expected) / spread).mean() < 0.1
    below = (errors[..., None] <= predicted).mean(axis=(0, 1, 2))
    assert below == pytest.approx(LEVELS, abs=0.02)


def test_fitted_quantiles_lose_no_more_than_linear_quantile_regression() -> None:
    feature, errors = draw_errors(2000, 0)
    fitted = ResidualQuantiles.fit(*draw_errors(8000, 2), LEVELS).predict(feature)
    for at, level in enumerate(LEVELS):
        x, y = feature[:, 0], errors[:, 0, 0]
        linear = QuantileRegressor(quantile=level, alpha=0, solver="highs").fit(x, y).predict(x)
        loss = mean_pinball_loss(y, fitted[:, 0, 0, at], alpha=level)
        assert loss < 1.01 * mean_pinball_loss(y, linear, alpha=level)


def test_quantiles_never_cross_and_are_the_same_after_storage() -> None:
    fitted = ResidualQuantiles.fit(*draw_errors(300, 0), np.array([0.05, 0.25, 0.5, 0.75, 0.95]), passes=50)
    far = np.linspace(-100, 100, 50, dtype=np.float32).reshape(25, 2, 1)
    predicted = fitted.predict(far)
    assert (np.diff(predicted, axis=-1) >= 0).all()
    restored = ResidualQuantiles.from_tensors(fitted.to_tensors())
    assert (restored.predict(far) == predicted).all()


def test_the_same_seed_fits_the_same_quantiles() -> None:
    first, second = (ResidualQuantiles.fit(*draw_errors(200, 0), LEVELS, seed=3, passes=20) for _ in range(2))
    assert all((a == b).all() for a, b in zip(first.weights, second.weights, strict=True))


def test_too_few_values_are_refused() -> None:
    with pytest.raises(TacpipeError, match="too few"):
        ResidualQuantiles.fit(*draw_errors(10, 0), LEVELS)


@pytest.mark.parametrize("percents", [(10, 90), (10, 50, 80), (50,), (90, 50, 10), (0, 50, 100)])
def test_levels_that_are_not_symmetric_about_the_median_are_refused(percents: tuple[int, ...]) -> None:
    with pytest.raises(TacpipeError, match="symmetric about 50"):
        calibration.check_levels(percents)
