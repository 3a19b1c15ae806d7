"""Test the mean-level baseline against scikit-learn, and that it ignores all other information."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from tacpipe.errors import TacpipeError
from tacpipe.models.readout import Level


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
