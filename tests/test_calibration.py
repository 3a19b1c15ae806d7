"""Temperature, reliability and areas under curves: scikit-learn and worked values as oracles."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from sklearn.linear_model import QuantileRegressor
from sklearn.metrics import log_loss, mean_pinball_loss, roc_auc_score

from tacpipe.errors import TacpipeError
from tacpipe.scores import calibration
from tacpipe.scores.calibration import conformal_quantile, highest_promised_level
from tacpipe.tasks.forward.quantiles import ResidualQuantiles

SCORES = st.lists(st.integers(-5, 5), min_size=1, max_size=30)


@given(SCORES, SCORES)
def test_the_area_is_that_of_scikit_learn(known_scores: list[int], unknown: list[int]) -> None:
    truth = [1] * len(known_scores) + [0] * len(unknown)
    area = calibration.auroc(np.array(known_scores, float), np.array(unknown, float))
    assert area == pytest.approx(roc_auc_score(truth, known_scores + unknown))


def test_the_temperature_by_which_labels_were_drawn_is_found() -> None:
    rng = np.random.default_rng(0)
    scores = rng.normal(0, 2, (20_000, 4))
    drawn = calibration.probabilities(scores, 3.0)
    labels = (drawn.cumsum(axis=1) > rng.random((len(scores), 1))).argmax(axis=1)
    assert calibration.temperature(scores, labels) == pytest.approx(3.0, rel=0.05)
    probabilities = calibration.probabilities(scores, calibration.temperature(scores, labels))
    right = probabilities.argmax(axis=1) == labels
    assert calibration.calibration_error(probabilities.max(axis=1), right) < 0.02
    assert calibration.log_loss(probabilities, labels) == pytest.approx(
        log_loss(labels, probabilities, labels=range(4))
    )


def test_no_error_among_few_slides_is_not_certainty() -> None:
    scores = np.eye(3)[[0, 1, 2, 0, 1, 2]] * 100
    probabilities = calibration.probabilities(scores, calibration.temperature(scores, np.array([0, 1, 2, 0, 1, 2])))
    assert probabilities.max() == pytest.approx(
        1 - 1 / 8 * 2 / 3, abs=1e-3
    )  # 1 - 1 / (n + 2), the rest spread over all classes


def test_a_temperature_changes_no_name_and_a_class_that_was_not_learned_stays_at_zero() -> None:
    scores = np.array([[1.0, 3.0, -np.inf], [0.5, 0.1, -np.inf]])
    probabilities = calibration.probabilities(scores, calibration.temperature(scores, np.array([1, 0])))
    assert probabilities.argmax(axis=1).tolist() == [1, 0] and (probabilities[:, 2] == 0).all()
    assert probabilities.sum(axis=1) == pytest.approx([1, 1])


def test_the_calibration_error_is_that_worked_by_hand() -> None:
    confidence, right = np.array([0.95, 0.95, 0.55, 0.55]), np.array([True, False, True, True])
    rows = calibration.reliability(confidence, right)
    assert [(row["n"], row["accuracy"]) for row in rows] == [(2, 1.0), (2, 0.5)]
    assert calibration.calibration_error(confidence, right) == pytest.approx((0.45 + 0.45) / 2)


def test_a_temperature_without_slides_is_refused() -> None:
    with pytest.raises(TacpipeError, match="no slide"):
        calibration.temperature(np.zeros((0, 2)), np.zeros(0, int))


GROUP_SCORES = st.floats(-1e6, 1e6, allow_nan=False)
GROUPS = st.lists(st.lists(GROUP_SCORES, min_size=1, max_size=6), min_size=2, max_size=8)
LEVELS = st.floats(0.05, 0.95)


def join_groups(groups: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([np.array(group) for group in groups]), np.repeat(
        range(len(groups)), [len(group) for group in groups]
    )


@given(GROUPS, LEVELS)
def test_a_group_left_out_lies_below_the_promised_quantile_of_the_others_as_often_as_promised(
    groups: list[list[float]], level: float
) -> None:
    # Each of exchangeable groups is the new one with the same probability, so this mean is the coverage given the values.
    below = []
    for at, group in enumerate(groups):
        scores, numbers = join_groups(groups[:at] + groups[at + 1 :])
        below.append(np.mean(np.array(group) <= conformal_quantile(scores, numbers, level, promised=True)))
    assert np.mean(below) >= level - 1e-9


@given(st.lists(GROUP_SCORES, min_size=1, max_size=40), LEVELS)
def test_with_one_score_a_group_it_is_split_conformal_prediction(scores: list[float], level: float) -> None:
    rank = math.ceil(level * (len(scores) + 1) - 1e-6)
    expected = sorted(scores)[rank - 1] if rank <= len(scores) else math.inf
    assert conformal_quantile(np.array(scores), np.arange(len(scores)), level, promised=True) == expected


@given(st.lists(GROUP_SCORES, min_size=1, max_size=40), LEVELS)
def test_pooled_scores_of_one_group_have_the_quantile_of_numpy(scores: list[float], level: float) -> None:
    estimate = conformal_quantile(np.array(scores), np.zeros(len(scores), int), level)
    near = [level - 1e-7, level, level + 1e-7]  # Either is right if the level falls between two scores.
    assert estimate in {float(np.quantile(scores, min(near_level, 1), method="inverted_cdf")) for near_level in near}


def test_a_long_recording_weighs_as_much_as_a_short_one() -> None:
    scores, groups = join_groups([[0.0] * 98, [1.0, 2.0]])
    assert conformal_quantile(scores, groups, 0.75) == 1.0


def test_four_recordings_promise_eighty_percent_and_no_more() -> None:
    scores, groups = join_groups([[1.0], [2.0], [3.0], [4.0]])
    assert highest_promised_level(4) == 0.8
    assert conformal_quantile(scores, groups, 0.8, promised=True) == 4.0
    assert conformal_quantile(scores, groups, 0.81, promised=True) == math.inf


def test_bands_of_simulated_recordings_hold_as_often_as_promised() -> None:
    rng = np.random.default_rng(0)

    def recording() -> np.ndarray:  # errors whose spread differs by recording, as those of objects do
        return np.abs(rng.normal(0, rng.lognormal(0, 0.7), rng.integers(5, 60)))

    covered = []
    for _ in range(2000):
        scores, groups = join_groups([list(recording()) for _ in range(9)])
        covered.append(np.mean(recording() <= conformal_quantile(scores, groups, 0.8, promised=True)))
    assert 0.79 < np.mean(covered) < 0.95


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1])
def test_a_level_outside_of_zero_and_one_is_refused(level: float) -> None:
    with pytest.raises(TacpipeError, match="not between 0 and 1"):
        conformal_quantile(np.ones(2), np.arange(2), level)


def test_scores_without_groups_are_refused() -> None:
    with pytest.raises(TacpipeError, match="no quantile"):
        conformal_quantile(np.ones(2), np.arange(3), 0.5)


DECILES = np.array([0.1, 0.5, 0.9])


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
    base = 0.3 * feature[..., None] + np.exp(feature)[..., None] * norm.ppf(DECILES)
    true: np.ndarray = base * np.array([[1.0, 3.0], [10.0, 30.0]])[None, :, :, None]
    return true


def test_pinball_is_that_of_scikit_learn() -> None:
    rng = np.random.default_rng(1)
    truth, predicted = rng.normal(size=(50, 2)), np.sort(rng.normal(size=(50, 2, 3)), axis=-1)
    sums = calibration.Sums.from_predictions(truth, predicted, DECILES)
    for step in range(2):
        for at, level in enumerate(DECILES):
            expected = mean_pinball_loss(truth[:, step], predicted[:, step, at], alpha=level)
            assert sums.pinball[step, at] / 50 == pytest.approx(expected)


def test_coverage_and_width_are_those_counted_by_hand() -> None:
    truth = np.array([[0.0], [1.0], [5.0], [-3.0]])
    predicted = np.broadcast_to([-1.0, 0.0, 1.0], (4, 1, 3))
    tree = calibration.measures_by_step([calibration.Sums.from_predictions(truth, predicted, DECILES)], (10, 50, 90))
    assert tree["coverage"] == {"t1": 0.5, "mean": 0.5}
    assert tree["width"]["t1"] == 2.0
    assert [tree[f"below_q{level}"]["t1"] for level in (10, 50, 90)] == [0.25, 0.5, 0.75]
    assert "coverage_low" not in tree  # There is one recording.


def test_sums_of_two_parts_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(2)
    truth, predicted = rng.normal(size=(20, 3)), np.sort(rng.normal(size=(20, 3, 3)), axis=-1)
    total = calibration.Sums.from_predictions(truth, predicted, DECILES)
    parts = [
        calibration.Sums.from_predictions(truth[rows], predicted[rows], DECILES) for rows in (slice(0, 7), slice(7, 20))
    ]
    total_tree, two = (
        calibration.measures_by_step([total], (10, 50, 90)),
        calibration.measures_by_step([parts[0] + parts[1]], (10, 50, 90)),
    )
    assert total_tree == two


def test_fitted_quantiles_are_near_those_of_the_distribution_that_errors_are_drawn_from() -> None:
    fitted = ResidualQuantiles.fit(*draw_errors(8000, 0), DECILES)
    feature, errors = draw_errors(2000, 1)
    predicted, expected = fitted.predict(feature), true_quantiles(feature)
    spread = np.exp(feature)[..., None] * np.array([[1.0, 3.0], [10.0, 30.0]])[None, :, :, None]
    assert np.abs((predicted - expected) / spread).mean() < 0.1
    below = (errors[..., None] <= predicted).mean(axis=(0, 1, 2))
    assert below == pytest.approx(DECILES, abs=0.02)


def test_fitted_quantiles_lose_no_more_than_linear_quantile_regression() -> None:
    feature, errors = draw_errors(2000, 0)
    fitted = ResidualQuantiles.fit(*draw_errors(8000, 2), DECILES).predict(feature)
    for at, level in enumerate(DECILES):
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
    first, second = (ResidualQuantiles.fit(*draw_errors(200, 0), DECILES, seed=3, passes=20) for _ in range(2))
    assert all((a == b).all() for a, b in zip(first.weights, second.weights, strict=True))


def test_too_few_values_are_refused() -> None:
    with pytest.raises(TacpipeError, match="too few"):
        ResidualQuantiles.fit(*draw_errors(10, 0), DECILES)


@pytest.mark.parametrize("percents", [(10, 90), (10, 50, 80), (50,), (90, 50, 10), (0, 50, 100)])
def test_levels_that_are_not_symmetric_about_the_median_are_refused(percents: tuple[int, ...]) -> None:
    with pytest.raises(TacpipeError, match="symmetric about 50"):
        calibration.check_levels(percents)
