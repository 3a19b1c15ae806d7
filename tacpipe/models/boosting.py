"""Gradient boosting of the absolute error, fitted by scikit-learn and kept as arrays.

scikit-learn keeps its trees in a pickle, which may run code when an untrusted one is opened. Kept here are the cuts and the
values of the leaves, of as many nodes a tree as the number of leaves allows, so that the shapes follow from the sizes alone.
The method is that of Friedman, Greedy function approximation: a gradient boosting machine (2001), on histograms (Ke et al.,
LightGBM, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tacpipe.arrays import AnyArray, Float32s
from tacpipe.errors import TacpipeError

LEAVES, DEPTH = 31, 6
RATE = 0.2  # learning rate
SMALLEST = 100  # rows in a leaf, or a twentieth of all if that is less
CHUNK = 1024  # rows predicted at once: their features stay in the processor's cache
TOGETHER = 65_536  # rows times trees that are predicted at once


@dataclass(frozen=True)
class Boosting:
    """Trees of the same number of nodes; the first node of each is its root, and a leaf leads back to itself."""

    features: Tensor  # (tree, node), int32
    cuts: Tensor  # (tree, node), float32; a row goes left where its feature is at most that
    children: Tensor  # (tree, node, left or right), int32, within the tree
    values: Tensor  # (tree, node), float32: of a leaf; 0 elsewhere
    base: Tensor  # (), float32: what is predicted before the first tree

    @classmethod
    def zeros(cls, trees: int, leaves: int = LEAVES) -> Boosting:
        """Return trees that predict 0, of the shapes that fitted ones have."""
        nodes = 2 * leaves - 1
        own = torch.arange(nodes, dtype=torch.int32)[:, None].expand(trees, nodes, 2).clone()
        none = torch.zeros(trees, nodes)
        return cls(none.int(), none, own, none.clone(), torch.zeros(()))

    @classmethod
    def fitted(
        cls, rows: Float32s, values: Float32s, weights: Float32s, *, trees: int, seed: int, leaves: int = LEAVES
    ) -> Boosting:
        """Return trees that predict ``values`` (row,) of ``rows`` (row, feature); errors count by ``weights`` (row,)."""
        from sklearn.ensemble import HistGradientBoostingRegressor

        known = HistGradientBoostingRegressor(
            loss="absolute_error",
            learning_rate=RATE,
            max_iter=trees,
            max_leaf_nodes=leaves,
            max_depth=DEPTH,
            min_samples_leaf=max(1, min(SMALLEST, len(rows) // 20)),
            early_stopping=False,
            random_state=seed,
        )
        return cls.of_estimator(known.fit(rows, values, sample_weight=weights), leaves)

    @classmethod
    def of_estimator(cls, known: object, leaves: int = LEAVES) -> Boosting:
        """Return the trees of a fitted `sklearn.ensemble.HistGradientBoostingRegressor` of at most ``leaves`` a tree.

        Values of features have to be float32 without NaN, and none of them categories.
        """
        found = [one.nodes for (one,) in known._predictors]  # type: ignore[attr-defined]
        made = cls.zeros(len(found), leaves)
        for tree, nodes in enumerate(found):
            count, leaf = len(nodes), nodes["is_leaf"].astype(bool)
            both = np.column_stack([nodes["left"], nodes["right"]]).astype(np.int32)
            children = np.where(leaf[:, None], np.arange(count, dtype=np.int32)[:, None], both)
            made.features[tree, :count] = torch.from_numpy(np.where(leaf, 0, nodes["feature_idx"]).astype(np.int32))
            made.cuts[tree, :count] = torch.from_numpy(rounded_down(np.where(leaf, 0.0, nodes["num_threshold"])))
            made.children[tree, :count] = torch.from_numpy(children)
            made.values[tree, :count] = torch.from_numpy(np.where(leaf, nodes["value"], 0.0).astype(np.float32))
        made.base.fill_(float(np.ravel(known._baseline_prediction)[0]))  # type: ignore[attr-defined]
        return made

    def predict(self, rows: Tensor) -> Tensor:
        """Return the sum over trees of the leaf that each row (row, feature), float32, falls into, (row,)."""
        trees, nodes = self.features.shape
        roots = np.arange(trees, dtype=np.int32)[:, None] * nodes
        children = (self.children.numpy() + roots[..., None]).astype(np.int32).ravel()
        features, cuts, values = (one.numpy().ravel() for one in (self.features, self.cuts, self.values))
        total = np.full(len(rows), float(self.base))
        for first in range(0, len(rows), CHUNK):
            some = np.ascontiguousarray(rows[first : first + CHUNK].numpy().T)  # (feature, row)
            count, own = some.shape[1], np.arange(some.shape[1], dtype=np.int32)
            starts, together = features * np.int32(count), max(1, TOGETHER // count)
            for begins in range(0, trees, together):
                of = roots[begins : begins + together]
                at = np.repeat(of, count, axis=1)  # (tree, row)
                for _ in range(min(DEPTH, nodes - 1)):
                    right = some.take(starts.take(at) + own) > cuts.take(at)
                    at = children.take(2 * at + right)
                total[first : first + count] += values.take(at).sum(axis=0, dtype=np.float64)
        return torch.from_numpy(total.astype(np.float32))

    def tensors(self) -> dict[str, Tensor]:
        """Return what the constructor reads, by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def check(self, features: int) -> None:
        """Raise `TacpipeError` unless all nodes are there, and read one of so many ``features``."""
        nodes = self.features.shape[1]
        kept: dict[str, tuple[Tensor, int]] = {
            "features": (self.features, features),
            "children": (self.children, nodes),
        }
        for name, (values, bound) in kept.items():
            if values.numel() and not bool(((values >= 0) & (values < bound)).all()):
                raise TacpipeError(
                    f"The {name} of the model's trees are not all from 0 to {bound - 1}: the file is damaged. "
                    "Train it again."
                )


def rounded_down(cuts: AnyArray) -> Float32s:
    """Return the largest float32 that is at most each of ``cuts``: a float32 lies on the same side of both.

    >>> float(rounded_down(np.array([0.1]))[0]) <= 0.1 < float(np.nextafter(np.float32(0.1), np.float32(1)))
    True
    """
    near = cuts.astype(np.float32)
    return np.where(near.astype(np.float64) > cuts, np.nextafter(near, np.float32(-np.inf)), near).astype(np.float32)
