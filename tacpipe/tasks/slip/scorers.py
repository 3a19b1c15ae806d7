"""Score windows by how likely a slip is: the part of a model that depends on its architecture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Floats, Indices
from tacpipe.tasks.slip.boosting import BoostedTrees
from tacpipe.tasks.slip.features import feature_names
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack, TrainingWindows

if TYPE_CHECKING:
    from tacpipe.tasks.slip.params import Boosting


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
        """Return scores (row,) of features (row, feature) with the time behind them; None if it reads other inputs."""
        ...

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Return the score of one window (time, channel) of each finger, the same bits as `score`."""
        ...

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the model's file."""
        ...

    def describe(self) -> dict[str, object]:
        """Return the values that ``config.json`` has next to the arrays."""
        ...


@dataclass(frozen=True)
class BoostedScorer:
    """Boosted trees on some columns of the features."""

    trees: BoostedTrees
    columns: tuple[int, ...]  # columns of the features with the time behind them
    runs_live: bool = True

    @classmethod
    def fitted(cls, windows: TrainingWindows, params: Boosting, columns: Sequence[int] | None = None) -> BoostedScorer:
        """Return a scorer trained on columns of the features, by default all but the time.

        Columns without two different values are left out.
        """
        allowed = range(windows.features.shape[1] - 1) if columns is None else columns
        chosen = tuple(column for column in allowed if _varies(windows.features[:, column]))
        trees = BoostedTrees.fitted(
            windows.features[:, chosen],
            windows.slips,
            windows.weights,
            trees=params.trees,
            leaves=params.leaves,
            leaf=params.leaf,
            learning_rate=params.learning_rate,
            l2=params.l2,
            seed=params.seed,
        )
        return cls(trees, chosen)

    def score(self, reader: FingerReader, track: GraspTrack, rows: Indices) -> Floats:
        """Return the scores of rows of a track (row,)."""
        return self.score_features(reader.features(track, rows))

    def score_features(self, features: Floats) -> Floats:
        """Return scores (row,) of features (row, feature) with the time behind them."""
        return self.trees.scores(features[:, self.columns])

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Return the score of one window (time, channel) of each finger."""
        features = reader.window_features([window[None] for window in windows])
        return float(self.trees.scores(features[:, self.columns])[0])

    def arrays(self) -> dict[str, AnyArray]:
        """Return the arrays of the trees."""
        return self.trees.arrays()

    def describe(self) -> dict[str, object]:
        """Return the columns that the trees read."""
        return {"columns": list(self.columns)}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> BoostedScorer:
        """Return the scorer that `arrays` and `describe` wrote. Raises `ValueError` if they do not fit one another."""
        columns = tuple(map(int, described["columns"]))
        available = reader.feature_count + 1
        if not all(0 <= column < available for column in columns):
            raise ValueError(f"columns {columns} of {available} features")
        return cls(BoostedTrees.from_arrays(arrays, len(columns)), columns)


def _varies(values: Floats) -> bool:
    finite = values[np.isfinite(values)]
    return bool(len(finite)) and bool(finite.min() < finite.max())


def baseline_columns(reader: FingerReader) -> dict[str, tuple[int, ...]]:
    """Return the columns that each baseline reads: the time, shear over load or else the level, and the total change.

    Windows of one row have no such features, so only the time remains.
    """
    names = feature_names(len(reader.fingers))
    if reader.feature_count != len(names):
        return {"time_only": (reader.feature_count,)}

    def places(*words: str) -> tuple[int, ...]:
        return tuple(index for index, name in enumerate(names) if name.removeprefix("largest ") in words)

    return {
        "time_only": (len(names),),
        "shear_over_load": places("shear over load", "shear", "level"),
        "total_change": places("motion"),
    }


CONSTANT = "constant"


def score_baselines(scorers: Mapping[str, Scorer], features: Floats) -> dict[str, Floats]:
    """Return the scores of each baseline (row,), those of the constant being 0."""
    scores = {name: np.asarray(scorer.score_features(features)) for name, scorer in scorers.items()}
    return {**scores, CONSTANT: np.zeros(len(features))}
