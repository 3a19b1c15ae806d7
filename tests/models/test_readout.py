"""Linear readouts, against scikit-learn and against leaving slides out for real."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import Ridge

from tacpipe.errors import TacpipeError
from tacpipe.models.readout import ALPHAS, SPREAD, Readout


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
