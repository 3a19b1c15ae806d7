"""Linear readouts, against scikit-learn and against leaving slides out for real."""

from collections.abc import Callable

import numpy as np
import pytest
from safetensors.numpy import load, save
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import Ridge

from tacpipe.errors import TacpipeError
from tacpipe.models.readout import (
    ALPHAS,
    CHUNK,
    SPREAD,
    VIEWS,
    Level,
    Readout,
    StatisticsClassifier,
    View,
    statistics,
    view_features,
)


def features(count: int = 30, wide: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return features of three classes that overlap, the last feature constant, and labels 2, 5 and 11."""
    rng = np.random.default_rng(seed)
    labels = np.array([2, 5, 11])[np.arange(count) % 3]
    means = np.random.default_rng(99).normal(size=(12, wide))
    rows = 0.5 * means[labels] + rng.normal(size=(count, wide)) * rng.uniform(0.5, 3, wide)
    rows[:, -1] = 0.25
    return rows.astype(np.float32), labels


def standard(rows: np.ndarray, shares: np.ndarray | None = None) -> np.ndarray:
    """Return standardised features whose squares sum to one a slide, on the average."""
    spread = rows.std(axis=0, dtype=np.float64)
    gain = np.where(spread > 1e-6, 1 / np.where(spread > 1e-6, spread, 1), 0)
    gain = gain * np.sqrt(shares) if shares is not None else gain
    standardised: np.ndarray = (rows - rows.mean(axis=0, dtype=np.float64)) * gain
    standardised /= np.sqrt(np.square(standardised).sum(axis=1).mean())
    return standardised


@pytest.mark.parametrize("seed", [0, 1])
def test_alpha_is_the_one_that_errs_least_when_slides_are_left_out_one_by_one(seed: int) -> None:
    rows, labels = features(seed=seed)
    standardised, targets = standard(rows), np.where(labels[:, None] == [2, 5, 11], 1.0, -1.0)
    errors = {}
    for alpha in ALPHAS:
        total = 0.0
        for i in range(len(rows)):
            kept_slides = np.arange(len(rows)) != i
            guess = (
                Ridge(alpha=alpha).fit(standardised[kept_slides], targets[kept_slides]).predict(standardised[i : i + 1])
            )
            total += np.square(guess[0] - targets[i]).sum()
        errors[alpha] = total / targets.size
    readout = Readout.fit(rows, labels)
    assert readout.alpha == min(errors, key=errors.__getitem__)
    assert ALPHAS[0] < readout.alpha < ALPHAS[-1]
    assert readout.leave_one_out_error == pytest.approx(errors[readout.alpha], rel=1e-3)


def test_scores_are_those_of_scikit_learns_ridge_on_standardised_features() -> None:
    rows, labels = features()
    readout = Readout.fit(rows, labels)
    targets = np.where(labels[:, None] == [2, 5, 11], 1.0, -1.0)
    expected = Ridge(alpha=readout.alpha).fit(standard(rows), targets).predict(standard(rows))
    np.testing.assert_allclose(readout.scores(rows), expected, atol=2e-4)


def test_the_nearest_mean_is_linear_discriminant_analysis_with_a_regular_covariance() -> None:
    rows, labels = features(count=300, wide=20)  # enough slides for scikit-learn's own solution
    standardised, readout = standard(rows)[:, :-1], Readout.nearest_mean(rows, labels)
    means = np.stack([standardised[labels == label].mean(axis=0) for label in (2, 5, 11)])
    residuals = standardised - means[np.searchsorted([2, 5, 11], labels)]
    covariance = residuals.T @ residuals / len(standardised) + SPREAD * np.eye(standardised.shape[1])
    distance = [np.einsum("sf,fg,sg->s", standardised - m, np.linalg.inv(covariance), standardised - m) for m in means]
    nearer = -np.array(distance).T / 2 * SPREAD
    scores = readout.scores(rows)
    np.testing.assert_allclose(scores - scores.mean(axis=1, keepdims=True),
                               nearer - nearer.mean(axis=1, keepdims=True), atol=2e-5)  # fmt: skip
    analysis = LinearDiscriminantAnalysis(solver="lsqr").fit(standardised, labels)
    assert np.array_equal(readout.predict(rows), analysis.predict(standardised))


def test_with_more_features_than_slides_the_nearest_mean_knows_its_training_slides_and_tells_new_ones() -> None:
    rows, labels = features(wide=400)
    new, truth = features(count=300, wide=400, seed=7)
    readout = Readout.nearest_mean(rows, labels)
    assert np.array_equal(readout.predict(rows), labels)
    assert np.mean(readout.predict(new) == truth) > 0.8


@pytest.mark.parametrize("kind", [Readout.fit, Readout.nearest_mean])
def test_shares_weigh_features_and_none_is_as_good_as_no_feature(kind) -> None:  # type: ignore[no-untyped-def]
    rows, labels = features()
    half = np.r_[np.ones(30), np.zeros(30)]
    np.testing.assert_allclose(kind(rows, labels, half).scores(rows), kind(rows[:, :30], labels).scores(rows[:, :30]),
                               atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(kind(rows, labels, np.full(60, 7.0)).scores(rows), kind(rows, labels).scores(rows),
                               atol=1e-4)  # fmt: skip


@pytest.mark.parametrize("kind", [Readout.fit, Readout.nearest_mean])
def test_tensors_hold_everything_and_constant_features_count_for_nothing(kind) -> None:  # type: ignore[no-untyped-def]
    rows, labels = features()
    readout = kind(rows, labels)
    assert readout.classes.tolist() == [2, 5, 11]
    restored = Readout.from_tensors(readout.to_tensors())
    assert np.array_equal(restored.scores(rows), readout.scores(rows))
    assert restored.alpha == readout.alpha
    changed = rows.copy()
    changed[:, -1] = 1e3
    assert np.array_equal(readout.scores(changed), readout.scores(rows))


def test_two_classes_are_enough_and_one_is_not() -> None:
    rows, labels = features()
    two = labels != 11
    assert np.array_equal(Readout.nearest_mean(rows[two], labels[two]).predict(rows[two]), labels[two])
    with pytest.raises(TacpipeError, match="1 classes"):
        Readout.fit(rows[labels == 2], labels[labels == 2])


def test_arrays_that_do_not_fit_are_refused() -> None:
    rows, labels = features()
    with pytest.raises(TacpipeError, match="do not match"):
        Readout.fit(rows, labels[1:])
    with pytest.raises(TacpipeError, match=r"\(slide, 60\) was fitted"):
        Readout.fit(rows, labels).scores(rows[:, 1:])
    rows[0, 0] = np.inf
    with pytest.raises(TacpipeError, match="not finite"):
        Readout.nearest_mean(rows, labels)


def slides(count: int = 60, classes: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides (slide, time, channel) whose levels depend on their class, 7, 8 and so on."""
    rng = np.random.default_rng(seed)
    labels = 7 + np.arange(count) % classes
    levels = 100 + 20 * np.random.default_rng(50).normal(size=(20, 4))[labels] + 10 * rng.normal(size=(count, 4))
    return (levels[:, None] + rng.normal(size=(count, 30, 4))).astype(np.float32), labels


@pytest.mark.parametrize("classes", [2, 3])
def test_predictions_are_those_of_scikit_learn_on_standardised_levels(classes: int) -> None:
    x, labels = slides(classes=classes)
    level = x.mean(axis=1, dtype=np.float64)
    standardised = (level - level.mean(axis=0)) / level.std(axis=0)
    analysis = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(standardised, labels)
    fitted = Level.fit(x, labels)
    assert np.array_equal(fitted.predict(x), analysis.predict(standardised))
    scores = fitted.scores(x)
    expected = analysis.predict_log_proba(standardised)
    log_probabilities = scores - np.log(np.exp(scores - scores.max(axis=1, keepdims=True)).sum(axis=1, keepdims=True))
    log_probabilities -= scores.max(axis=1, keepdims=True)
    np.testing.assert_allclose(log_probabilities, expected, atol=1e-4)


def test_it_sees_no_order_in_time_and_no_channel_that_never_changes() -> None:
    x, labels = slides()
    shuffled = x[:, np.random.default_rng(1).permutation(x.shape[1])]
    fitted = Level.fit(x, labels)
    assert np.array_equal(fitted.predict(shuffled), fitted.predict(x))
    with_constant = np.concatenate([x, np.full((*x.shape[:2], 1), 3, np.float32)], axis=2)
    with_still = Level.fit(with_constant, labels)
    np.testing.assert_allclose(with_still.scores(with_constant), fitted.scores(x), atol=1e-3)
    assert (with_still.weight[-1] == 0).all()


def test_a_class_of_one_slide_is_learned_without_a_warning() -> None:
    x, labels = slides()
    chosen = np.r_[np.flatnonzero(labels != 9), np.flatnonzero(labels == 9)[:1]]
    fitted = Level.fit(x[chosen], labels[chosen])
    assert fitted.classes.tolist() == [7, 8, 9]
    assert np.isfinite(fitted.scores(x)).all()


def test_tensors_hold_everything() -> None:
    x, labels = slides()
    fitted = Level.fit(x, labels)
    assert np.array_equal(Level.from_tensors(fitted.to_tensors()).scores(x), fitted.scores(x))


def test_slides_that_cannot_be_told_apart_by_level_say_why() -> None:
    x, labels = slides()
    with pytest.raises(TacpipeError, match="do not match"):
        Level.fit(x, labels[1:])
    with pytest.raises(TacpipeError, match="3 slides of 3 classes do not show"):
        Level.fit(x[:3], labels[:3])
    with pytest.raises(TacpipeError, match="same mean levels"):
        Level.fit(np.ones_like(x), labels)
    with pytest.raises(TacpipeError, match=r"\(slide, time, 4\) was fitted"):
        Level.fit(x, labels).scores(x[:, :, 1:])
    x[0, 0, 0] = np.nan
    with pytest.raises(TacpipeError, match="not finite"):
        Level.fit(x, labels)


ACROSS = 6  # channels that describe all others at one moment


def rippled(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides of one level that ripple by little or by much, and labels 4 and 9."""
    rng = np.random.default_rng(seed)
    labels = np.array([4, 9])[np.arange(count) % 2]
    x = 50 + rng.normal(size=(count, 30, 3)) * np.where(labels == 4, 1, 6)[:, None, None]
    return (x - x.mean(axis=1, keepdims=True) + 50).astype(np.float32), labels


def press(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides that ripple alike at two levels, and labels 4 and 9."""
    rng = np.random.default_rng(seed)
    labels = np.array([4, 9])[np.arange(count) % 2]
    return (rng.normal(size=(count, 30, 3)) + np.where(labels == 4, 50, 80)[:, None, None]).astype(np.float32), labels


def test_every_statistic_of_a_channel_is_that_of_its_root() -> None:
    x = np.array([[[0, 1], [4, 1], [9, 1], [-16, 1], [0, 1], [25, 1]]], np.float32)  # (slide, time, channel)
    root = np.array([0, 2, 3, -4, 0, 5.0])
    steps = np.array([2, 1, 7, 4, 5])  # steps between successive roots, without their sign
    turns = np.array([1, 8, 11, 1])  # +2 +1 -7 +4 +5: changes of the step, without their sign
    expected = [
        root.mean(),
        np.sqrt(np.mean((root - root.mean()) ** 2)),
        steps.mean(),
        -2.0,  # quantile of the sorted -4 0 0 2 3 5, half-way from the first to the second: 0.1 of five steps
        0.0,
        1.0,
        2.75,
        4.0,
        -4.0,
        5.0,
        turns.mean() / steps.mean(),
        2 / 6,
        1.0,
        -0.5,
        2.5,
    ]
    values = statistics(x)[0].reshape(len(expected), 2 + ACROSS)
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(values[:, 1], [1, 0, 0, 1, 1, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1], atol=1e-7)


def test_six_channels_describe_all_others_at_each_moment() -> None:
    x = np.tile(np.array([[1.0, 4.0, 9.0, 16.0]], np.float32), (1, 5, 1))  # roots 1, 2, 3 and 4 at each moment
    means = statistics(x)[0, : 4 + ACROSS]
    np.testing.assert_allclose(means, [1, 2, 3, 4, 2.5, np.sqrt(1.25), 2.5, 3.25, 3.7, 4], rtol=1e-6)


def test_a_slide_has_the_same_statistics_however_many_are_read_at_once() -> None:
    x = np.random.default_rng(0).normal(size=(CHUNK + 3, 9, 2)).astype(np.float32)
    np.testing.assert_array_equal(statistics(x)[-2:], statistics(x[-2:]))


def test_a_slide_without_its_level_reads_alike_wherever_it_is_pressed() -> None:
    x = np.random.default_rng(0).normal(size=(2, 9, 3))
    lifted = x + np.array([0.0, 30.0, 500.0])
    np.testing.assert_allclose(view_features(lifted, "level_removed"), view_features(x, "level_removed"), atol=1e-5)
    assert np.abs(view_features(lifted, "level") - view_features(x, "level")).max() > 1


@pytest.mark.parametrize(("slides", "views"), [(rippled, ("all", "level_removed")), (press, ("all", "level"))])
def test_what_differs_in_level_or_in_ripple_is_classified_by_the_views_that_hold_it(
    slides: Callable[..., tuple[np.ndarray, np.ndarray]], views: tuple[View, ...]
) -> None:
    x, labels = slides(24)
    new, truth = slides(100, seed=1)
    for view in views:
        assert np.mean(StatisticsClassifier.fit(x, labels, view=view).predict(new) == truth) > 0.95


def test_what_differs_in_level_alone_is_not_classified_once_the_level_is_removed() -> None:
    x, labels = press(40)
    new, truth = press(200, seed=1)
    assert np.mean(StatisticsClassifier.fit(x, labels, view="level_removed").predict(new) == truth) < 0.65


@pytest.mark.parametrize("view", VIEWS)
def test_a_stored_classifier_gives_the_same_scores(view: View) -> None:
    x, labels = rippled(20)
    fitted = StatisticsClassifier.fit(x, labels, view=view)
    opened = StatisticsClassifier.from_tensors(load(save(fitted.to_tensors())))
    assert opened.view == view
    assert opened.classes.tolist() == [4, 9]
    np.testing.assert_array_equal(opened.scores(x), fitted.scores(x))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("x", [np.zeros((4, 2, 3)), np.zeros((4, 9, 0)), np.full((4, 9, 3), np.nan), np.zeros((4, 9))])
def test_slides_without_statistics_are_refused(x: np.ndarray, view: View) -> None:
    with pytest.raises(TacpipeError):
        StatisticsClassifier.fit(x, np.array([1, 1, 2, 2]), view=view)
