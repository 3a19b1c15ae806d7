"""Fit extremely randomised trees (Geurts et al., Extremely randomized trees, 2006) with scikit-learn, stored as arrays.

scikit-learn stores a forest as a pickle, which may run code when an untrusted one is opened. The arrays of thresholds
and leaf means give the same values, to the seven digits of a float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyArray, Float32s, Floats, Int32s

if TYPE_CHECKING:
    from torch import Tensor

FEATURES = 0.4  # fraction of all features that is tried at a split
LEAF = -1  # the child of a node without children


@dataclass(frozen=True)
class Forest:
    """All nodes of all trees in shared arrays; each tree starts at one of ``roots``."""

    roots: Int32s  # (tree,)
    children: Int32s  # (node, left or right); LEAF at a leaf
    features: Int32s  # (node,)
    cuts: Floats  # (node,); a row goes left if its feature is at most this
    values: Float32s  # (node, value)

    @classmethod
    def fit(
        cls, rows: Floats, values: Floats, *, trees: int, leaf: int, seed: int, features: float = FEATURES
    ) -> Forest:
        """Fit a forest that predicts ``values`` (row, value) from ``rows`` (row, feature).

        Each leaf has at least ``leaf`` rows.
        """
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(trees, min_samples_leaf=leaf, max_features=features, random_state=seed)
        forest.fit(rows.astype(np.float32), values if values.shape[1] > 1 else values[:, 0])
        fitted_trees = [tree.tree_ for tree in forest.estimators_]
        starts = np.cumsum([0, *(tree.node_count for tree in fitted_trees)])[:-1]
        children = []
        for tree, start in zip(fitted_trees, starts, strict=True):
            pairs = np.column_stack([tree.children_left, tree.children_right])
            children.append(np.where(pairs == LEAF, LEAF, pairs + start))
        return cls(
            starts.astype(np.int32),
            np.concatenate(children).astype(np.int32),
            np.concatenate([np.maximum(tree.feature, 0) for tree in fitted_trees]).astype(np.int32),
            np.concatenate([tree.threshold for tree in fitted_trees]),
            np.concatenate([tree.value[:, :, 0] for tree in fitted_trees]).astype(np.float32),
        )

    @staticmethod
    def out_of_bag_error(
        rows: Floats, values: Floats, *, leaf: int, seed: int, trees: int = 100, features: float = FEATURES
    ) -> float:
        """Return the out-of-bag mean squared error of a forest whose trees are fitted on bootstrap samples.

        It is the mean over all rows and values, in the squared unit of the values (Breiman, Out-of-bag estimation,
        1996).
        """
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(
            trees, min_samples_leaf=leaf, max_features=features, random_state=seed, bootstrap=True, oob_score=True
        )
        forest.fit(rows.astype(np.float32), values if values.shape[1] > 1 else values[:, 0])
        return float(np.mean((forest.oob_prediction_.reshape(values.shape) - values) ** 2))

    def predict(self, rows: Floats) -> Floats:
        """Return the mean over trees of the leaf of each row, (row, value), for one or more rows (row, feature)."""
        features = rows.astype(np.float32)
        node = np.broadcast_to(self.roots, (len(features), len(self.roots))).copy()  # (row, tree)
        row = np.arange(len(features))[:, None]
        while True:
            right = (features[row, self.features[node]] > self.cuts[node]).astype(np.int32)
            child = self.children[node, right]
            if (child == LEAF).all():
                break
            node = np.where(child == LEAF, node, child)
        return np.stack([self.values[leaves].mean(axis=0, dtype=np.float64) for leaves in node])

    def scaled(self, unit: Floats) -> Forest:
        """Return a forest whose predictions are multiplied by ``unit`` (value,), for example to convert their unit."""
        return replace(self, values=(self.values * unit).astype(np.float32))

    def to_tensors(self) -> dict[str, Tensor]:
        """Return the arrays that `from_tensors` reads."""
        arrays: dict[str, AnyArray] = {"roots": self.roots, "children": self.children, "features": self.features}
        arrays |= {"cuts": self.cuts, "values": self.values}
        import torch

        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}

    def validate(self, features: int, values: int) -> None:
        """Raise `ValueError` unless the trees read ``features`` features, predict ``values`` values, and have no cycles.

        Children of a grown tree come after their parent. Nodes that lead back to each other would cause an endless
        loop.
        """
        nodes = len(self.values)
        checks = node_checks(self.roots, self.children, self.features, self.cuts, nodes, features)
        checks |= {"roots": checks["roots"] and len(self.roots) > 0, "values": self.values.shape == (nodes, values)}
        if invalid := next((name for name, is_valid in checks.items() if not is_valid), ""):
            raise ValueError(f"the {invalid} of a forest of {nodes} nodes are out of range")

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Forest:
        """Return the forest that `to_tensors` stored."""
        names: Sequence[str] = ("roots", "children", "features", "cuts", "values")
        return cls(*(tensors[name].numpy() for name in names))


def node_checks(
    roots: Int32s, children: Int32s, features: Int32s, cuts: Floats, nodes: int, feature_count: int
) -> dict[str, bool]:
    """Return whether arrays of ``nodes`` nodes, by name, are trees that read at most ``feature_count`` features.

    Children of a grown tree come after their parent, so no path leads back, and a node has two children or none.
    """
    numbers, is_leaf = np.arange(nodes)[:, None], children == LEAF
    return {
        "roots": roots.ndim == 1 and bool(((roots >= 0) & (roots < nodes)).all()),
        "children": children.shape == (nodes, 2)
        and bool(((children > numbers) & (children < nodes) | is_leaf).all())
        and bool((is_leaf.sum(axis=1) != 1).all()),
        "features": features.shape == (nodes,) and bool(((features >= 0) & (features < feature_count)).all()),
        "cuts": cuts.shape == (nodes,),
        "numbers of nodes": all(array.dtype.kind == "i" for array in (roots, children, features)),
    }
