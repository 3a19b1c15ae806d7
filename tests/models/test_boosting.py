"""Boosted trees against scikit-learn's, whose cuts and leaves they keep."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from sklearn.ensemble import HistGradientBoostingRegressor

from tacpipe.errors import TacpipeError
from tacpipe.models import boosting
from tacpipe.models.boosting import Boosting, rounded_down


def rows(count: int = 900, wide: int = 7, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of features, values that follow from them, and weights."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, wide)).astype(np.float32)
    features[:, 3] = rng.integers(0, 3, count)
    values = 40 * features[:, 0] * np.abs(features[:, 1]) + 10 * features[:, 3] + rng.normal(size=count)
    return features, values.astype(np.float32), rng.uniform(0.1, 3, count).astype(np.float32)


@pytest.mark.parametrize("count", [30, 900, 3000])
def test_trees_predict_what_scikit_learn_predicts(count: int) -> None:
    features, values, weights = rows(count)
    known = HistGradientBoostingRegressor(
        loss="absolute_error",
        learning_rate=boosting.RATE,
        max_iter=12,
        max_leaf_nodes=9,
        max_depth=boosting.DEPTH,
        min_samples_leaf=min(boosting.SMALLEST, count // 20),
        early_stopping=False,
        random_state=3,
    ).fit(features, values, sample_weight=weights)
    found = Boosting.fitted(features, values, weights, trees=12, seed=3, leaves=9)
    unseen = rows(2500, seed=1)[0]
    predicted = found.predict(torch.from_numpy(unseen)).numpy()
    np.testing.assert_allclose(predicted, known.predict(unseen), rtol=1e-5, atol=1e-4)
    assert np.ptp(predicted) > (0 if count == 30 else 10)


def test_a_value_on_a_cut_goes_the_way_it_goes_in_scikit_learn() -> None:
    features = np.repeat(np.array([[0.1], [0.3]], np.float32), 30, axis=0)
    values = np.repeat(np.array([1.0, 5.0], np.float32), 30)
    known = HistGradientBoostingRegressor(
        loss="absolute_error", max_iter=4, max_leaf_nodes=2, early_stopping=False, min_samples_leaf=1
    ).fit(features, values)
    found = Boosting.of_estimator(known, leaves=2)
    cut = np.float32(found.cuts[0, 0])
    near = np.array([np.nextafter(cut, np.float32(0)), cut, np.nextafter(cut, np.float32(1))])[:, None]
    predicted = found.predict(torch.from_numpy(near)).numpy()
    np.testing.assert_allclose(predicted, known.predict(near), rtol=1e-6)
    assert predicted[0] == predicted[1] < predicted[2]


def test_cuts_are_rounded_to_the_side_on_which_a_float32_stays() -> None:
    cuts = np.random.default_rng(0).normal(size=1000)
    found = rounded_down(cuts)
    assert (found.astype(np.float64) <= cuts).all()
    assert (np.nextafter(found, np.float32(np.inf)).astype(np.float64) > cuts).all()


def test_stored_trees_predict_the_same_and_have_the_shapes_of_trees_of_zeros() -> None:
    features, values, weights = rows()
    found = Boosting.fitted(features, values, weights, trees=5, seed=0)
    again = Boosting(**load(save(found.tensors())))
    given = torch.from_numpy(features)
    assert torch.equal(again.predict(given), found.predict(given))
    zeros = Boosting.zeros(5)
    assert {name: (one.shape, one.dtype) for name, one in zeros.tensors().items()} == {
        name: (one.shape, one.dtype) for name, one in found.tensors().items()
    }
    assert not zeros.predict(given).any()


def test_nodes_that_are_not_there_and_features_that_no_row_has_are_refused() -> None:
    found = Boosting.zeros(2)
    found.check(1)
    found.features[1, 3] = 7
    with pytest.raises(TacpipeError, match="features of the model's trees are not all from 0 to 6"):
        found.check(7)
    found = Boosting.zeros(2)
    found.children[0, 0, 1] = -1
    with pytest.raises(TacpipeError, match="children of the model's trees are not all from 0 to 60"):
        found.check(7)
