"""Extremely randomised trees (Geurts et al., Extremely randomized trees, 2006), fitted by scikit-learn and kept as arrays.

What scikit-learn keeps of a forest is a pickle, which may run code when an untrusted one is opened. Kept here are the
cuts and the means of the leaves, from which the same values follow, to the seven digits of a float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tacpipe.arrays import AnyArray, Float32s, Floats, Int32s

FEATURES = 0.4  # fraction of all features that is tried at a cut
LEAF = -1  # the child of a node without children


@dataclass(frozen=True)
class Forest:
    """Trees side by side in arrays of all nodes, each tree beginning at one of ``roots``."""

    roots: Int32s  # (tree,)
    children: Int32s  # (node, left or right); LEAF at a leaf
    features: Int32s  # (node,)
    cuts: Floats  # (node,); a row goes left where its feature is at most that
    values: Float32s  # (node, value)

    @classmethod
    def fitted(
        cls, rows: Floats, values: Floats, *, trees: int, leaf: int, seed: int, features: float = FEATURES
    ) -> Forest:
        """Return a forest that predicts ``values`` (row, value) of ``rows`` (row, feature); a leaf has ``leaf`` or more."""
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(trees, min_samples_leaf=leaf, max_features=features, random_state=seed)
        forest.fit(rows.astype(np.float32), values if values.shape[1] > 1 else values[:, 0])
        grown = [tree.tree_ for tree in forest.estimators_]
        starts = np.cumsum([0, *(tree.node_count for tree in grown)])[:-1]
        children = [
            np.where((pair := np.column_stack([tree.children_left, tree.children_right])) == LEAF, LEAF, pair + start)
            for tree, start in zip(grown, starts, strict=True)
        ]
        return cls(
            starts.astype(np.int32),
            np.concatenate(children).astype(np.int32),
            np.concatenate([np.maximum(tree.feature, 0) for tree in grown]).astype(np.int32),
            np.concatenate([tree.threshold for tree in grown]),
            np.concatenate([tree.value[:, :, 0] for tree in grown]).astype(np.float32),
        )

    @staticmethod
    def out_of_bag_error(
        rows: Floats, values: Floats, *, leaf: int, seed: int, trees: int = 100, features: float = FEATURES
    ) -> float:
        """Return the mean squared error on rows that a tree was not grown on, each tree having a draw of the rows.

        It is over all rows and values at once, in the unit of the values squared (Breiman, Out-of-bag estimation, 1996).
        """
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(
            trees, min_samples_leaf=leaf, max_features=features, random_state=seed, bootstrap=True, oob_score=True
        )
        forest.fit(rows.astype(np.float32), values if values.shape[1] > 1 else values[:, 0])
        return float(np.mean((forest.oob_prediction_.reshape(values.shape) - values) ** 2))

    def predict(self, rows: Floats) -> Floats:
        """Return the mean over trees of the leaf that each row (row, feature) falls into, (row, value); of 1 row or more."""
        features = rows.astype(np.float32)
        node = np.broadcast_to(self.roots, (len(features), len(self.roots))).copy()  # (row, tree)
        row = np.arange(len(features))[:, None]
        while True:
            right = (features[row, self.features[node]] > self.cuts[node]).astype(np.int32)
            child = self.children[node, right]
            if (child == LEAF).all():
                break
            node = np.where(child == LEAF, node, child)
        return np.stack([self.values[at].mean(axis=0, dtype=np.float64) for at in node])

    def times(self, unit: Floats) -> Forest:
        """Return the forest that predicts the same values (value,) in another unit: each multiplied by its ``unit``."""
        return replace(self, values=(self.values * unit).astype(np.float32))

    def tensors(self) -> dict[str, Tensor]:
        """Return what `from_tensors` reads."""
        arrays: dict[str, AnyArray] = {"roots": self.roots, "children": self.children, "features": self.features}
        arrays |= {"cuts": self.cuts, "values": self.values}
        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}

    def check(self, features: int, values: int) -> None:
        """Raise `ValueError` unless trees of so many ``features`` predict so many ``values``, and each way down them ends.

        As they are grown a child stands behind its parent: nodes that lead back to one another would be gone round for ever.
        """
        nodes = len(self.values)
        numbers = np.arange(nodes)[:, None]
        down = (self.children > numbers) & (self.children < nodes) | (self.children == LEAF)
        shapes = {
            "roots": self.roots.ndim == 1 and len(self.roots) > 0,
            "children": self.children.shape == (nodes, 2) and bool(down.all()),
            "features": self.features.shape == (nodes,)
            and bool(((self.features >= 0) & (self.features < features)).all()),
            "cuts": self.cuts.shape == (nodes,),
            "values": self.values.shape == (nodes, values),
        }
        are_integers = all(array.dtype.kind == "i" for array in (self.roots, self.children, self.features))
        wrong = next((name for name, fine in shapes.items() if not fine), "" if are_integers else "numbers of nodes")
        if wrong or not ((self.roots >= 0) & (self.roots < nodes)).all():
            raise ValueError(f"the {wrong or 'roots'} of a forest of {nodes} nodes are out of range")

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Forest:
        """Return the forest that `tensors` wrote."""
        names: Sequence[str] = ("roots", "children", "features", "cuts", "values")
        return cls(*(tensors[name].numpy() for name in names))
