"""Temperature, reliability and areas under curves: scikit-learn and worked values as oracles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import log_loss, roc_auc_score

from tacpipe.errors import TacpipeError
from tacpipe.metrics import calibration

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
