"""Forests against scikit-learn's, whose cuts they keep."""

import numpy as np
import pytest
from safetensors.torch import load, save
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.tree import DecisionTreeRegressor

from tacpipe.models.forest import LEAF, Forest


def rows(count: int = 40, wide: int = 6, outputs: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of features and values that follow from them, one after a cut."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, wide))
    values = np.column_stack([features[:, 0] ** 2, features[:, 1] > 0, rng.normal(size=count)])[:, :outputs]
    return features, 2500 + 300 * values


def sklearn(trees: int = 12, leaf: int = 2, **options: object) -> ExtraTreesRegressor:
    return ExtraTreesRegressor(trees, min_samples_leaf=leaf, max_features=0.4, random_state=7, **options)


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("leaf", [1, 4])
def test_a_forest_says_what_scikit_learn_says(outputs: int, leaf: int) -> None:
    features, values = rows(outputs=outputs)
    forest = Forest.fit(features, values, trees=12, leaf=leaf, seed=7)
    reference = sklearn(leaf=leaf).fit(features.astype(np.float32), values if outputs > 1 else values[:, 0])
    unseen, _ = rows(25, seed=1)
    predicted = forest.predict(unseen)
    assert predicted.shape == (25, outputs)
    np.testing.assert_allclose(predicted, reference.predict(unseen.astype(np.float32)).reshape(25, outputs), rtol=1e-6)


def test_a_row_on_a_cut_goes_the_way_it_goes_in_scikit_learn() -> None:
    reference = DecisionTreeRegressor().fit([[0.0], [1.0]], [10.0, 20.0])  # cuts in the middle, at 0.5
    tree = reference.tree_
    children = np.column_stack([tree.children_left, tree.children_right]).astype(np.int32)
    forest = Forest(
        *(np.zeros(1, np.int32), children, np.maximum(tree.feature, 0).astype(np.int32), tree.threshold),
        tree.value[:, :, 0].astype(np.float32),
    )
    on = np.array([[0.5], [np.nextafter(np.float32(0.5), np.float32(1))]])
    assert forest.predict(on)[:, 0].tolist() == reference.predict(on).tolist() == [10, 20]


def test_tensors_and_their_bytes_give_back_the_forest() -> None:
    forest = Forest.fit(*rows(), trees=3, leaf=2, seed=0)
    restored = Forest.from_tensors(load(save(forest.to_tensors())))
    for name, tensor in forest.to_tensors().items():
        assert np.array_equal(getattr(restored, name), tensor.numpy())
        assert getattr(restored, name).dtype == getattr(forest, name).dtype
    unseen, _ = rows(5, seed=2)
    assert np.array_equal(restored.predict(unseen), forest.predict(unseen))


def test_a_forest_in_another_unit_tells_the_same_values_in_it() -> None:
    forest, unit = Forest.fit(*rows(), trees=3, leaf=2, seed=0), np.array([2.0, 0.1, -1.0])
    unseen, _ = rows(5, seed=2)
    np.testing.assert_allclose(forest.scaled(unit).predict(unseen), forest.predict(unseen) * unit, rtol=1e-6)


def test_trees_of_a_single_leaf_say_the_mean() -> None:
    features, values = rows(5)
    forest = Forest.fit(features, values, trees=4, leaf=5, seed=0)
    assert len(forest.children) == 4
    np.testing.assert_allclose(forest.predict(features), np.tile(values.mean(axis=0), (5, 1)), rtol=1e-6)


def test_trees_of_unlike_depth_stand_side_by_side() -> None:
    short, long = Forest.fit(*rows(4), trees=2, leaf=4, seed=0), Forest.fit(*rows(), trees=1, leaf=1, seed=1)
    start = len(short.children)
    joined = Forest(
        np.concatenate([short.roots, long.roots + start]),
        np.concatenate([short.children, np.where(long.children == LEAF, LEAF, long.children + start)]),
        *(np.concatenate([getattr(short, name), getattr(long, name)]) for name in ("features", "cuts", "values")),
    )
    unseen, _ = rows(6, seed=5)
    np.testing.assert_allclose(joined.predict(unseen), (2 * short.predict(unseen) + long.predict(unseen)) / 3)


def test_the_same_seed_gives_the_same_trees_and_another_does_not() -> None:
    first, same, reseeded = (Forest.fit(*rows(), trees=2, leaf=2, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.cuts, same.cuts)
    assert not np.array_equal(first.values, reseeded.values)


@pytest.mark.parametrize("outputs", [1, 3])
def test_the_error_out_of_bag_is_that_of_trees_asked_for_rows_they_were_not_shown(outputs: int) -> None:
    features, values = rows(30, outputs=outputs)
    error = Forest.out_of_bag_error(features, values, leaf=2, seed=7, trees=40)
    reference = sklearn(40, bootstrap=True).fit(features.astype(np.float32), values if outputs > 1 else values[:, 0])
    predicted = []
    for row in range(30):
        says = [
            tree.predict(features[row : row + 1].astype(np.float32)).reshape(-1)
            for tree, drawn in zip(reference.estimators_, reference.estimators_samples_, strict=True)
            if row not in drawn
        ]
        predicted.append(np.mean(says, axis=0))
    assert error == pytest.approx(np.mean((np.array(predicted) - values) ** 2), rel=1e-9)
