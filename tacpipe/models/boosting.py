"""Gradient-boosted trees (Friedman, 2001), grown by scikit-learn's histograms and kept as arrays.

What scikit-learn keeps of a model is a pickle, which may run code when an untrusted one is opened. Kept here are the cuts
and the values of the leaves, from which the same scores follow. Scoring needs numpy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Floats, Int32s
from tacpipe.models.forest import LEAF, node_checks

BINS = 255  # maximum number of bins of a feature
SAMPLED_ROWS = 200_000  # rows above which scikit-learn bins a sample of them, without weights


@dataclass(frozen=True)
class TreeSizes:
    """How many trees are grown, and how."""

    trees: int
    leaves: int  # maximum number of leaves of a tree
    leaf: int  # minimum number of rows per leaf
    learning_rate: float
    l2: float  # penalty on leaf values
    seed: int
    bins: int = BINS  # maximum number of bins of a feature

    def options(self) -> dict[str, Any]:
        """Return the options of scikit-learn's estimators."""
        return {
            "max_iter": self.trees,
            "max_leaf_nodes": self.leaves,
            "min_samples_leaf": self.leaf,
            "learning_rate": self.learning_rate,
            "l2_regularization": self.l2,
            "early_stopping": False,
            "random_state": self.seed,
            "max_bins": self.bins,
        }


@dataclass(frozen=True)
class BoostedTrees:
    """Trees side by side in arrays of all nodes, each tree beginning at one of ``roots``."""

    roots: Int32s  # (tree,)
    children: Int32s  # (node, left or right); LEAF at a leaf
    features: Int32s  # (node,)
    cuts: Floats  # (node,); a row goes left if its feature is at most this
    missing_left: Int32s  # (node,), 1 if a row without the feature goes left
    values: Floats  # (node,)
    base: Floats  # (1,), the score before the first tree

    @classmethod
    def fit(
        cls,
        rows: AnyFloats,
        labels: Bools,
        weights: AnyFloats,
        sizes: TreeSizes,
    ) -> BoostedTrees:
        """Return trees that score rows (row, feature) by the log odds of their ``labels`` (row,).

        Without features, there is no tree, and the score is that of the weighted fraction of labels.
        """
        if not rows.shape[1]:
            return cls.constant(float(np.average(labels, weights=weights)))
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(**sizes.options())
        edges = [bin_edges(column, weights, sizes.bins) for column in rows.T] if len(rows) <= SAMPLED_ROWS else []
        model.fit(_bin_rows(rows, edges) if edges else rows, labels, sample_weight=weights)
        return cls._of_model(model, edges)

    @classmethod
    def fit_values(
        cls,
        rows: AnyFloats,
        values: AnyFloats,
        sizes: TreeSizes,
    ) -> BoostedTrees:
        """Return trees whose scores of rows (row, feature) estimate ``values`` (row,) with least absolute error."""
        from sklearn.ensemble import HistGradientBoostingRegressor

        model = HistGradientBoostingRegressor(loss="absolute_error", **sizes.options())
        return cls._of_model(model.fit(rows, values), [])

    @classmethod
    def _of_model(cls, model: Any, edges: list[Floats]) -> BoostedTrees:
        """Return the trees of a model of scikit-learn; ``edges`` are those of the bins that its rows had, if any."""
        grown = [stage[0].nodes for stage in model._predictors]
        starts = np.cumsum([0, *map(len, grown)])[:-1]
        nodes = np.concatenate(grown)
        offsets = np.repeat(starts, [len(tree) for tree in grown])
        is_leaf = nodes["is_leaf"].astype(bool)
        cuts = nodes["num_threshold"].copy()
        for feature, values in enumerate(edges):
            chosen = (nodes["feature_idx"] == feature) & ~is_leaf & np.isfinite(cuts)
            cuts[chosen] = values[
                np.ceil(cuts[chosen]).astype(np.intp) - 1
            ]  # a cut is the midpoint between two bin numbers
        pairs = np.column_stack([nodes["left"], nodes["right"]]).astype(np.int64) + offsets[:, None]
        return cls(
            starts.astype(np.int32),
            np.where(is_leaf[:, None], LEAF, pairs).astype(np.int32),
            np.where(is_leaf, 0, nodes["feature_idx"]).astype(np.int32),
            np.where(is_leaf, 0.0, np.minimum(cuts, np.finfo(np.float64).max)),
            nodes["missing_go_to_left"].astype(np.int32),
            nodes["value"].astype(np.float64),
            np.ravel(model._baseline_prediction).astype(np.float64)[:1],
        )

    @classmethod
    def constant(cls, probability: float) -> BoostedTrees:
        """Return no trees, with the log odds of a probability as the score of each row."""
        none = np.zeros(0, np.int32)
        odds = np.log(probability / (1 - probability))
        return cls(none, np.zeros((0, 2), np.int32), none, np.zeros(0), none, np.zeros(0), np.array([odds]))

    def scores(self, rows: AnyFloats) -> Floats:
        """Return the log odds of rows (row, feature): the sum of the leaves that a row falls into."""
        node = np.broadcast_to(self.roots, (len(rows), len(self.roots))).copy()  # (row, tree)
        row = np.arange(len(rows))[:, None]
        while True:
            value = rows[row, self.features[node]]
            left = np.where(np.isnan(value), self.missing_left[node] > 0, value <= self.cuts[node])
            child = self.children[node, np.where(left, 0, 1)]
            if (child == LEAF).all():
                break
            node = np.where(child == LEAF, node, child)
        scores: Floats = self.base[0] + self.values[node].sum(axis=1)
        return scores

    def arrays(self) -> dict[str, AnyArray]:
        """Return what `from_arrays` reads."""
        return {field.name: np.ascontiguousarray(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, AnyArray], features: int) -> BoostedTrees:
        """Return the trees that `arrays` wrote.

        Raises `ValueError` unless they read at most so many features, and each way down them ends.
        """
        trees = cls(**{field.name: arrays[field.name] for field in fields(cls)})
        nodes = len(trees.values)
        checks = node_checks(trees.roots, trees.children, trees.features, trees.cuts, nodes, features)
        checks |= {
            "missing_left": trees.missing_left.shape == (nodes,) and trees.missing_left.dtype.kind == "i",
            "base": trees.base.shape == (1,),
        }
        if invalid := next((name for name, is_valid in checks.items() if not is_valid), ""):
            raise ValueError(f"the {invalid} of boosted trees of {nodes} nodes are out of range")
        return trees


def bin_edges(values: AnyFloats, weights: AnyFloats, bins: int = BINS) -> Floats:
    """Return the ascending upper edges of all bins of a feature but the last, of values (row,) with weights (row,).

    Bins have about equal weight. The edges are those of scikit-learn, which sorts all rows again for each edge.
    """
    counted = ~np.isnan(values) & (weights != 0)
    order = np.argsort(values[counted])
    ordered, mass = values[counted][order], weights[counted][order]
    distinct = np.unique(ordered)
    if len(distinct) <= bins:
        return np.asarray((distinct[:-1] + distinct[1:]) / 2)
    total = np.cumsum(mass)
    targets = np.linspace(0, 100, bins + 1)[1:-1] / 100 * total[-1]
    last = len(ordered) - 1
    crossings = np.minimum(np.searchsorted(total, targets), last)
    between = (ordered[crossings] + ordered[np.minimum(crossings + 1, last)]) / 2
    edges = np.unique(np.where(total[crossings] - targets > np.finfo(np.float64).eps, ordered[crossings], between))
    return np.asarray(np.minimum(edges, np.finfo(np.float64).max))


def _bin_rows(rows: AnyFloats, edges: list[Floats]) -> Floats:
    """Return the number of the bin of each value (row, feature); NaN stays."""
    numbers = np.empty(rows.shape)
    for feature, values in enumerate(edges):
        column = rows[:, feature]
        numbers[:, feature] = np.where(np.isnan(column), np.nan, np.searchsorted(values, column))
    return numbers
