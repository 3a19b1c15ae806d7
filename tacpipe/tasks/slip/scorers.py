"""Score windows by how likely a slip is: the part of a model that depends on its architecture."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Floats, Indices
from tacpipe.models.boosting import BoostedTrees, TreeSizes
from tacpipe.tasks.learning.features import SMALLEST_DEVIATION, standardise
from tacpipe.tasks.slip.planned import NAMES_OF_PLAN
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack, TrainingWindows

if TYPE_CHECKING:
    from tacpipe.tasks.slip.params import Boosting

LINEAR, BEST_FEATURE = "linear", "best_feature"  # names of the baselines of logistic regression
PENALTY = 0.01  # L2 penalty on the weights of the linear baseline, relative to the mean error of a window


class Scorer(Protocol):
    """A trained part that scores windows; the score of a likelier slip is higher."""

    @property
    def runs_live(self) -> bool:
        """Whether single windows can be scored as they arrive."""
        ...

    def score(self, reader: FingerReader, track: GraspTrack, rows: Indices) -> Floats:
        """Return the scores of rows of a track (row,)."""
        ...

    def score_features(self, features: Floats) -> Floats | None:
        """Return scores (row,) of features (row, feature), the last of which is the time; None if it reads other inputs."""
        ...

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Return the score of one window of `FingerReader.windows`, each (time, channel); the same bits as `score`."""
        ...

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the model's file."""
        ...

    def describe(self) -> dict[str, object]:
        """Return the values that ``config.json`` has next to the arrays."""
        ...


@dataclass(frozen=True)
class FeatureScorer(ABC):
    """A scorer that reads some columns of the features."""

    columns: tuple[int, ...]  # columns of the features, the last of which is the time

    @property
    def runs_live(self) -> bool:
        """True, because features need no other window."""
        return True

    @abstractmethod
    def score_features(self, features: Floats) -> Floats:
        """Return scores (row,) of features (row, feature), the last of which is the time."""

    @abstractmethod
    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the model's file."""

    def score(self, reader: FingerReader, track: GraspTrack, rows: Indices) -> Floats:
        """Return the scores of rows of a track (row,)."""
        return self.score_features(reader.features(track, rows))

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Return the score of one window of `FingerReader.windows`, each (time, channel)."""
        features = reader.window_features([window[None] for window in windows])
        return float(self.score_features(features)[0])

    def describe(self) -> dict[str, object]:
        """Return the columns that are read."""
        return {"columns": list(self.columns)}


@dataclass(frozen=True)
class BoostedScorer(FeatureScorer):
    """Boosted trees on some columns of the features."""

    trees: BoostedTrees

    @classmethod
    def fit(cls, windows: TrainingWindows, params: Boosting, columns: Sequence[int] | None = None) -> BoostedScorer:
        """Return a scorer trained on columns of the features, by default all but the time.

        Columns without two different values are left out.
        """
        chosen = _varying_columns(windows, columns)
        sizes = TreeSizes(params.trees, params.leaves, params.leaf, params.learning_rate, params.l2, params.seed)
        trees = BoostedTrees.fit(windows.features[:, chosen], windows.slips, windows.weights, sizes)
        return cls(chosen, trees)

    def score_features(self, features: Floats) -> Floats:
        """Return scores (row,) of features (row, feature), the last of which is the time."""
        return self.trees.scores(features[:, self.columns])

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the trees."""
        return self.trees.arrays()

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> BoostedScorer:
        """Return the scorer that `arrays` and `describe` wrote. Raises `ValueError` if they do not fit one another."""
        columns = _stored_columns(described, reader)
        return cls(columns, BoostedTrees.from_arrays(arrays, len(columns)))


@dataclass(frozen=True)
class LinearScorer(FeatureScorer):
    """Logistic regression on standardised features."""

    means: Floats  # (column,)
    deviations: Floats  # (column,)
    weights: Floats  # (column,)
    base: Floats  # (1,), the log odds of a window of mean features

    @classmethod
    def fit(cls, windows: TrainingWindows, columns: Sequence[int] | None = None) -> LinearScorer:
        """Return a scorer trained on columns of the features, by default all but the time.

        Missing features count as their mean. Columns without two different values are left out.
        """
        from sklearn.linear_model import LogisticRegression

        columns = _varying_columns(windows, columns)
        counted = windows.weights > 0
        rows = windows.features[counted][:, columns]
        means, deviations = np.nanmean(rows, axis=0), np.maximum(np.nanstd(rows, axis=0), SMALLEST_DEVIATION)
        weights = windows.weights[counted]
        model = LogisticRegression(C=1 / (PENALTY * weights.sum()), max_iter=1000)
        model.fit(standardise(rows, means, deviations), windows.slips[counted], sample_weight=weights)
        return cls(columns, means, deviations, model.coef_[0].astype(np.float64), model.intercept_.astype(np.float64))

    def score_features(self, features: Floats) -> Floats:
        """Return the log odds (row,) of features (row, feature), the last of which is the time."""
        rows = standardise(features[:, self.columns], self.means, self.deviations)
        scores: Floats = (rows * self.weights).sum(axis=1) + self.base[0]
        return scores

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the regression."""
        return {name: getattr(self, name) for name in ("means", "deviations", "weights", "base")}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> LinearScorer:
        """Return the scorer that `arrays` and `describe` wrote. Raises `ValueError` if they do not fit one another."""
        columns = _stored_columns(described, reader)
        parts = {name: np.asarray(arrays[name], np.float64) for name in ("means", "deviations", "weights", "base")}
        shapes = {name: part.shape for name, part in parts.items()}
        if set(shapes.values()) - {(len(columns),)} - {(1,)} or shapes["base"] != (1,):
            raise ValueError(f"a regression of {shapes} for {len(columns)} columns")
        return cls(columns, **parts)


def _stored_columns(described: Mapping[str, Any], reader: FingerReader) -> tuple[int, ...]:
    """Return the columns of the features that a scorer reads. Raises `ValueError` if the reader lacks one."""
    columns = tuple(map(int, described["columns"]))
    available = reader.feature_count + 1
    if not all(0 <= column < available for column in columns):
        raise ValueError(f"columns {columns} of {available} features")
    return columns


def _varying_columns(windows: TrainingWindows, columns: Sequence[int] | None = None) -> tuple[int, ...]:
    """Return the columns, by default all but the time, that have two different values."""
    allowed = range(windows.features.shape[1] - 1) if columns is None else columns
    return tuple(column for column in allowed if _varies(windows.features[:, column]))


def _varies(values: Floats) -> bool:
    finite = values[np.isfinite(values)]
    return bool(len(finite)) and bool(finite.min() < finite.max())


BaselineFit = Callable[[TrainingWindows, str], FeatureScorer]  # windows and the name of a part of them -> baseline


def baseline_fits(reader: FingerReader, sizes: Boosting) -> dict[str, BaselineFit]:
    """Return the function that trains each baseline: trees of these sizes on few columns, and the regressions.

    The regressions are a linear model of all features, and the best feature, whose regression only turns it into log odds.
    """

    def boost(columns: Sequence[int]) -> BaselineFit:
        return lambda windows, name: BoostedScorer.fit(windows, sizes, columns)

    fits = {name: boost(columns) for name, columns in baseline_columns(reader).items()}
    return {
        **fits,
        LINEAR: lambda windows, name: LinearScorer.fit(windows),
        BEST_FEATURE: lambda windows, name: LinearScorer.fit(windows, [best_column(windows)]),
    }


def best_column(windows: TrainingWindows) -> int:
    """Return the column, except the time, that best separates windows with a slip from others, without training.

    It has the largest weighted area under the curve, of its values or of their negatives: whichever are larger on average
    in windows with a slip. A regression on this column has the same direction.
    """
    from sklearn.metrics import roc_auc_score

    counted = windows.weights > 0
    slips, weights = windows.slips[counted], windows.weights[counted]
    areas = {}
    for column in _varying_columns(windows):
        values = windows.features[counted, column]
        values = standardise(values, np.nanmean(values), max(np.nanstd(values), SMALLEST_DEVIATION))
        slipping, stable = (np.average(values[part], weights=weights[part]) for part in (slips, ~slips))
        areas[column] = roc_auc_score(slips, np.sign(slipping - stable) * values, sample_weight=weights)
    return max(areas, key=lambda column: areas[column])


def load_baseline(
    name: str, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader
) -> FeatureScorer:
    """Return a stored baseline. Raises `ValueError` if its parts do not fit one another."""
    kind = LinearScorer if name in (LINEAR, BEST_FEATURE) else BoostedScorer
    return kind.load(arrays, described, reader)


def baseline_columns(reader: FingerReader) -> dict[str, tuple[int, ...]]:
    """Return the feature columns of each baseline of boosted trees. A baseline without existing features is left out.

    The baselines read the time, shear over load (or else the level), the total change, and the plan.
    """
    names = reader.names

    def columns_named(*words: str) -> tuple[int, ...]:
        return tuple(index for index, name in enumerate(names) if name.removeprefix("largest ") in words)

    baselines = {
        "time_only": (len(names),),
        "shear_over_load": columns_named("shear over load", "shear", "level"),
        "total_change": columns_named("motion"),
        "planned_motion": columns_named(*(name.removeprefix("largest ") for name in NAMES_OF_PLAN)),
    }
    return {name: columns for name, columns in baselines.items() if columns}


CONSTANT = "constant"


def score_baselines(scorers: Mapping[str, Scorer], features: Floats) -> dict[str, Floats]:
    """Return the scores of each baseline (row,), those of the constant being 0."""
    scores = {name: np.asarray(scorer.score_features(features)) for name, scorer in scorers.items()}
    return {**scores, CONSTANT: np.zeros(len(features))}
