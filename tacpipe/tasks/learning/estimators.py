"""Estimators of values or of classes from windows of touch, which are stored as arrays.

An estimator returns outputs (example, output): values, or one score per class whose softmax, divided by a temperature, is
its probability. All arithmetic is per example, so that an example gives the same bits by itself as among others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol, cast, get_args

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats
from tacpipe.models.boosting import BINS, BoostedTrees, TreeSizes
from tacpipe.models.forest import Forest
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.features import SMALLEST_DEVIATION, FeatureKind, Kind, standardise

if TYPE_CHECKING:
    from tacpipe.models.minirocket import MinirocketClassifier

ALPHAS = tuple(10.0**power for power in range(-3, 6))  # penalties of ridge regression for standardised features
PENALTY = 0.01  # L2 penalty of logistic regression, relative to the mean error of an example
MANY_FEATURES, FEW_BINS = 256, 63  # features above which boosted trees have so few bins, which takes half the time
SMALLEST_PROBABILITY = 1e-4  # smallest probability of a class by trees


class OutputEstimator(Protocol):
    """A fitted estimator."""

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        ...

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the model's file."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the values that ``config.json`` has next to the arrays."""
        ...


@dataclass(frozen=True)
class FittedConstant:
    """The same outputs for all examples of a group; those of unknown groups are those of all examples."""

    by_group: Floats  # (1 + group, output), those of all examples first
    groups: tuple[str, ...] = ()

    @classmethod
    def fit(cls, examples: Examples, outputs: Floats, kind: Kind, *, by_group: bool = False) -> FittedConstant:
        """Return the median of values, or the log of the frequencies of classes; with ``by_group`` also of each group."""
        own_groups, weights = np.array(examples.example_groups), examples.training_weights
        groups = tuple(sorted(set(own_groups.tolist()))) if by_group else ()
        parts = [np.ones(len(outputs), bool), *(own_groups == group for group in groups)]
        if kind == "quantity":
            return cls(np.stack([np.median(outputs[part], axis=0) for part in parts]), groups)
        shares = [np.average(outputs[part], axis=0, weights=weights[part]) for part in parts]
        return cls(np.stack([_log_frequencies(share) for share in shares]), groups)

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        places = {group: number for number, group in enumerate(self.groups, 1)}
        return self.by_group[[places.get(group, 0) for group in examples.example_groups]]

    def arrays(self) -> dict[str, AnyArray]:
        """Return the outputs by group."""
        return {"by_group": self.by_group}

    def describe(self) -> dict[str, Any]:
        """Return the names of the groups."""
        return {"estimator": "constant", "groups": list(self.groups)}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedConstant:
        """Return the stored constants. Raises `ValueError` if they do not fit one another."""
        groups = tuple(map(str, described["groups"]))
        if arrays["by_group"].shape != (1 + len(groups), outputs):
            raise ValueError(f"constants of {arrays['by_group'].shape} for {len(groups)} groups and {outputs} outputs")
        return cls(arrays["by_group"].astype(np.float64), groups)


@dataclass(frozen=True)
class FittedLinear:
    """Ridge regression, or logistic regression of classes, on standardised features; missing ones count as their mean."""

    features: FeatureKind
    means: Floats  # (feature,)
    deviations: Floats  # (feature,)
    weights: Floats  # (output, feature)
    base: Floats  # (output,)

    @classmethod
    def fit(
        cls, examples: Examples, outputs: Floats, kind: Kind, *, features: FeatureKind = "statistics"
    ) -> FittedLinear:
        """Return the regression; ridge regression chooses its penalty by leave-one-out errors (scikit-learn's RidgeCV)."""
        rows = examples.features(features)
        present = np.isfinite(rows)
        counts = np.maximum(present.sum(axis=0), 1)
        means = np.where(present, rows, 0.0).sum(axis=0) / counts
        deviations = np.sqrt(np.where(present, np.square(rows - means), 0.0).sum(axis=0) / counts)
        deviations = np.where(deviations > SMALLEST_DEVIATION * (1 + np.abs(means)), deviations, np.inf)
        standard = standardise(rows, means, deviations)
        if kind == "quantity":
            from sklearn.linear_model import RidgeCV

            ridge = RidgeCV(ALPHAS, alpha_per_target=True).fit(standard, outputs)
            return cls(features, means, deviations, np.atleast_2d(ridge.coef_), np.atleast_1d(ridge.intercept_))
        from sklearn.linear_model import LogisticRegression

        labels, example_weights = outputs.argmax(axis=1), examples.training_weights
        if len(np.unique(labels)) == 1:  # a fold of a class that one group has
            weights = np.zeros((outputs.shape[1], rows.shape[1]))
            return cls(features, means, deviations, weights, _log_frequencies(outputs.mean(axis=0)))
        model = LogisticRegression(C=1 / (PENALTY * example_weights.sum()), max_iter=1000)
        model.fit(standard, labels, sample_weight=example_weights)
        weights, base = np.zeros((outputs.shape[1], rows.shape[1])), np.full(outputs.shape[1], -np.inf)
        if len(model.classes_) == 2:  # scikit-learn fits only their difference
            signs = np.array([-0.5, 0.5])
            weights[model.classes_], base[model.classes_] = signs[:, None] * model.coef_, signs * model.intercept_
        else:
            weights[model.classes_], base[model.classes_] = model.coef_, model.intercept_
        return cls(features, means, deviations, weights, np.maximum(base, np.log(SMALLEST_PROBABILITY)))

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        rows = standardise(examples.features(self.features), self.means, self.deviations)
        return np.stack([(rows * weights).sum(axis=1) for weights in self.weights], axis=1) + self.base

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the regression; the deviation of a constant feature is the largest number."""
        deviations = np.minimum(self.deviations, np.finfo(np.float64).max)
        return {"means": self.means, "deviations": deviations, "weights": self.weights, "base": self.base}

    def describe(self) -> dict[str, Any]:
        """Return the kind of the features."""
        return {"estimator": "linear", "features": self.features}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedLinear:
        """Return the stored regression. Raises `ValueError` if its parts do not fit one another."""
        parts = {name: arrays[name].astype(np.float64) for name in ("means", "deviations", "weights", "base")}
        count = len(parts["means"])
        expected = {"means": (count,), "deviations": (count,), "weights": (outputs, count), "base": (outputs,)}
        if {name: part.shape for name, part in parts.items()} != expected:
            raise ValueError(f"a regression of {count} features for {outputs} outputs")
        return cls(_feature_kind(described), **parts)


@dataclass(frozen=True)
class FittedTrees:
    """Extremely randomised trees on features; the scores of classes are the logs of their frequencies in the leaves."""

    features: FeatureKind
    kind: Kind
    forest: Forest

    @classmethod
    def fit(
        cls,
        examples: Examples,
        outputs: Floats,
        kind: Kind,
        *,
        features: FeatureKind = "statistics",
        trees: int = 100,
        leaf: int = 2,
        seed: int = 0,
    ) -> FittedTrees:
        """Return trees with at least ``leaf`` examples per leaf."""
        rows = np.nan_to_num(examples.features(features))
        return cls(features, kind, Forest.fit(rows, outputs, trees=trees, leaf=leaf, seed=seed))

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        means = self.forest.predict(np.nan_to_num(examples.features(self.features)))
        return means if self.kind == "quantity" else _log_frequencies(means)

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the trees."""
        return {field.name: np.ascontiguousarray(getattr(self.forest, field.name)) for field in fields(self.forest)}

    def describe(self) -> dict[str, Any]:
        """Return the kind of the features."""
        return {"estimator": "trees", "features": self.features, "kind": self.kind}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedTrees:
        """Return the stored trees. Raises `ValueError` if their parts do not fit one another."""
        forest = Forest(**{field.name: arrays[field.name] for field in fields(Forest)})
        forest.validate(int(forest.features.max(initial=0)) + 1, outputs)
        return cls(_feature_kind(described), _kind(described), forest)


@dataclass(frozen=True)
class FittedBoosting:
    """Gradient-boosted trees on features, one sequence of trees per output, or one for two classes."""

    features: FeatureKind
    trees: tuple[BoostedTrees, ...]
    two_classes: bool = False  # True if the only sequence scores the second of two classes

    @classmethod
    def fit(
        cls,
        examples: Examples,
        outputs: Floats,
        kind: Kind,
        *,
        features: FeatureKind = "statistics",
        trees: int = 200,
        leaves: int = 31,
        leaf: int = 20,
        learning_rate: float = 0.1,
        l2: float = 0.0,
        seed: int = 0,
    ) -> FittedBoosting:
        """Return trees of least absolute error, or of one class against the others."""
        rows = examples.features(features)
        rows = np.where(np.isnan(rows).all(axis=0), 0.0, rows)  # scikit-learn bins no column without values
        bins = BINS if rows.shape[1] <= MANY_FEATURES else FEW_BINS
        sizes = TreeSizes(trees, leaves, leaf, learning_rate, l2, seed, bins)
        if kind == "quantity":
            grown = [BoostedTrees.fit_values(rows, column, sizes) for column in outputs.T]
        else:
            grown = []
            weights = examples.training_weights
            for column in outputs.T[-1:] > 0.5 if outputs.shape[1] == 2 else outputs.T > 0.5:
                if column.any() and not column.all():
                    grown.append(BoostedTrees.fit(rows, column, weights, sizes))
                else:
                    share = np.clip(column.mean(), SMALLEST_PROBABILITY, 1 - SMALLEST_PROBABILITY)
                    grown.append(BoostedTrees.constant(float(share)))
        return cls(features, tuple(grown), kind == "class" and outputs.shape[1] == 2)

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        rows = examples.features(self.features)
        scores = [trees.scores(rows) for trees in self.trees]
        return np.stack([-scores[0] / 2, scores[0] / 2] if self.two_classes else scores, axis=1)

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of all trees."""
        return {
            f"{number}.{name}": values
            for number, trees in enumerate(self.trees)
            for name, values in trees.arrays().items()
        }

    def describe(self) -> dict[str, Any]:
        """Return the kind of the features and the number of outputs."""
        return {"estimator": "boosting", "features": self.features, "two_classes": self.two_classes}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedBoosting:
        """Return the stored trees. Raises `ValueError` if their parts do not fit one another."""
        count = 1 + max(int(name.partition(".")[0]) for name in arrays)
        two_classes = bool(described["two_classes"])
        if count != outputs and not (two_classes and (count, outputs) == (1, 2)):
            raise ValueError(f"trees of {count} outputs for {outputs}")
        trees = []
        for number in range(count):
            own = {name.partition(".")[2]: values for name, values in arrays.items() if name.startswith(f"{number}.")}
            trees.append(BoostedTrees.from_arrays(own, int(own["features"].max(initial=0)) + 1))
        return cls(_feature_kind(described), tuple(trees), two_classes)


@dataclass(frozen=True)
class FittedMinirocket:
    """Random convolutions of the windows and a linear readout, for classes (`tacpipe.models.minirocket`)."""

    classifier: MinirocketClassifier

    @classmethod
    def fit(cls, examples: Examples, outputs: Floats, *, seed: int = 0) -> FittedMinirocket:
        """Return the classifier of windows, whose streams must have equally many rows."""
        from tacpipe.models.minirocket import MinirocketClassifier

        return cls(MinirocketClassifier.fit(_stacked(examples), outputs.argmax(axis=1), seed=seed))

    def outputs(self, examples: Examples) -> Floats:
        """Return the scores of the classes (example, output)."""
        return self.classifier.scores(_stacked(examples)).astype(np.float64)

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the classifier."""
        return self.classifier.to_tensors()

    def describe(self) -> dict[str, Any]:
        """Return the name of the estimator."""
        return {"estimator": "minirocket"}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedMinirocket:
        """Return the stored classifier. Raises `ValueError` if it has another number of classes."""
        from tacpipe.models.minirocket import MinirocketClassifier

        classifier = MinirocketClassifier.from_tensors(arrays)
        if len(classifier.classes) != outputs:
            raise ValueError(f"a classifier of {len(classifier.classes)} classes for {outputs}")
        return cls(classifier)


@dataclass(frozen=True)
class ColumnsEstimator:
    """An estimator that reads some columns of the features alone."""

    columns: tuple[int, ...]
    inner: FittedLinear | FittedBoosting

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output)."""
        return self.inner.outputs(examples.with_columns(self.inner.features, self.columns))

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the estimator."""
        return self.inner.arrays()

    def describe(self) -> dict[str, Any]:
        """Return what the estimator states, and the columns."""
        return {**self.inner.describe(), "columns": list(self.columns)}


def _load_network(arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> OutputEstimator:
    from tacpipe.tasks.learning.network import FittedNetwork

    return FittedNetwork.load(arrays, described, outputs)


ESTIMATORS: Mapping[str, Callable[[Mapping[str, AnyArray], Mapping[str, Any], int], OutputEstimator]] = {
    "constant": FittedConstant.load,
    "linear": FittedLinear.load,
    "trees": FittedTrees.load,
    "boosting": FittedBoosting.load,
    "minirocket": FittedMinirocket.load,
    "network": _load_network,
}


def load(arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> OutputEstimator:
    """Return a stored estimator of so many outputs. Raises `ValueError` or `LookupError` if its parts do not fit."""
    estimator = ESTIMATORS[str(described["estimator"])](arrays, described, outputs)
    if "columns" not in described:
        return estimator
    if not isinstance(estimator, FittedLinear | FittedBoosting):
        raise ValueError(f"columns of a {described['estimator']}")
    return ColumnsEstimator(tuple(map(int, described["columns"])), estimator)


def _log_frequencies(frequencies: AnyFloats) -> Floats:
    return np.log(np.maximum(frequencies, SMALLEST_PROBABILITY))


def _stacked(examples: Examples) -> Float32s:
    """Return the windows of all streams side by side (example, time, channel)."""
    return np.concatenate(examples.windows(), axis=2).astype(np.float32)


def _feature_kind(described: Mapping[str, Any]) -> FeatureKind:
    if described["features"] not in get_args(FeatureKind):
        raise ValueError(f"features of the kind {described['features']}")
    return cast(FeatureKind, described["features"])


def _kind(described: Mapping[str, Any]) -> Kind:
    if described["kind"] not in get_args(Kind):
        raise ValueError(f"outputs of the kind {described['kind']}")
    return cast(Kind, described["kind"])
