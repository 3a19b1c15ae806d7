"""Params of `tacpipe train regress` and `tacpipe train classify`, and the estimators that both offer.

An architecture of another package extends `RegressParams` or `ClassifyParams` (`tacpipe.tasks.regress.params`,
`tacpipe.tasks.classify.params`): its `candidates` return functions that fit an `OutputEstimator`, and `load_estimator`
reads one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NotRequired

from tacpipe.plugins.constraints import Names, NonNegativeFloat, PositiveFloat, PositiveInt, Range, Seed, Unit
from tacpipe.plugins.params import Panels
from tacpipe.tasks.task import ModelConfig
from tacpipe.training.schedule import Schedule

if TYPE_CHECKING:
    from tacpipe.arrays import AnyArray, Floats
    from tacpipe.tasks.learning.estimators import OutputEstimator
    from tacpipe.tasks.learning.examples import Examples
    from tacpipe.tasks.learning.inputs import StreamConfig
    from tacpipe.tasks.learning.selection import CandidateLoss, CurvePoint, Fit


SIZES = ("trees", "leaf", "leaves", "learning_rate", "l2", "channels", "layers")  # params of the estimators
GRADIENT_CLIP = 1.0  # maximum norm of the gradient of a network
SCHEDULE = ("epochs", "batch", "patience", "weight_decay")  # params of the training of networks
SHARED_PANELS: Panels = {
    "Training": ("group", "curve", "stride", *SCHEDULE, "seed"),
    "Data": ("inputs", "rest_s", "recentre"),
}


@dataclass(frozen=True)
class EstimatorParams(ABC):
    """What all estimators of windows have in common."""

    KIND: ClassVar[Literal["quantity", "class"]]
    architecture: str = "auto"
    seed: Seed = 0  # random seed

    @abstractmethod
    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return functions that fit an estimator, by name in the order of simplicity; cross-validation chooses one.

        ``workspace`` is a folder for checkpoints, so that training can resume.
        """

    def load_estimator(
        self, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int
    ) -> OutputEstimator:
        """Return an estimator of so many outputs from its stored parts. Raises `ValueError` if they do not fit."""
        from tacpipe.tasks.learning import estimators

        return estimators.load(arrays, described, outputs)


@dataclass(frozen=True)
class LearningParams(EstimatorParams):
    """Params of all models of a label or a quantity."""

    inputs: Names = ""  # patterns of the columns to read, as taxel*; empty: all tactile columns
    # time that the model looks back; without it 0.5 s for a column, and the whole recording for its label
    context_s: Annotated[NonNegativeFloat, Unit("s")] | None = None
    # duration at the start of a recording whose mean is the rest level; 0: values are read as they are
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = 0.0
    # label, as session, from each of whose values the median of all rows is subtracted; offline only; empty: none
    recentre: str = ""
    stride: PositiveInt = 1  # rows between two training windows
    # labels whose recordings cross-validation leaves out together; empty: those of the split, else each recording
    group: Names = ""
    curve: bool = False  # also learn from parts of the training recordings, for a learning curve in the report


class AutoEstimator(EstimatorParams):
    """The simplest of linear, trees and boosting within one standard error, or a baseline that is better."""

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the candidates with their default sizes."""
        from tacpipe.tasks.learning.estimators import FittedBoosting, FittedLinear, FittedTrees
        from tacpipe.tasks.learning.selection import fit_with

        return {
            "linear": fit_with(FittedLinear, self.KIND),
            "trees": fit_with(FittedTrees, self.KIND, seed=self.seed),
            "boosting": fit_with(FittedBoosting, self.KIND, seed=self.seed),
        }


class LinearEstimator(EstimatorParams):
    """Ridge regression, or logistic regression of classes, on features of the window."""

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the regression."""
        from tacpipe.tasks.learning.estimators import FittedLinear
        from tacpipe.tasks.learning.selection import fit_with

        return {"linear": fit_with(FittedLinear, self.KIND)}


@dataclass(frozen=True)
class TreesEstimator(EstimatorParams):
    """Extremely randomised trees on features of the window."""

    trees: PositiveInt = 100  # number of trees
    leaf: PositiveInt = 2  # minimum number of windows per leaf

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the trees."""
        from tacpipe.tasks.learning.estimators import FittedTrees
        from tacpipe.tasks.learning.selection import fit_with

        return {"trees": fit_with(FittedTrees, self.KIND, trees=self.trees, leaf=self.leaf, seed=self.seed)}


@dataclass(frozen=True)
class BoostingEstimator(EstimatorParams):
    """Gradient-boosted trees on features of the window."""

    trees: PositiveInt = 200  # number of trees
    leaves: Annotated[int, Range(2)] = 31  # maximum number of leaves of a tree
    leaf: PositiveInt = 20  # minimum number of windows per leaf
    learning_rate: PositiveFloat = 0.1  # weight of each tree
    l2: NonNegativeFloat = 0.0  # L2 penalty on leaf values

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the trees."""
        from tacpipe.tasks.learning.estimators import FittedBoosting
        from tacpipe.tasks.learning.selection import fit_with

        names = ("trees", "leaves", "leaf", "learning_rate", "l2", "seed")
        options = {name: getattr(self, name) for name in names}
        return {"boosting": fit_with(FittedBoosting, self.KIND, **options)}


@dataclass(frozen=True)
class NetworkEstimator(EstimatorParams):
    """A causal convolutional network on the windows."""

    channels: PositiveInt = 24  # channels of each layer
    layers: Annotated[int, Range(1, 8)] = 4  # layers; each doubles the time between the rows that it combines
    epochs: PositiveInt = 15  # maximum number of passes over the training windows
    batch: PositiveInt = 128  # windows per step of the optimiser
    learning_rate: PositiveFloat = 1e-3  # learning rate of Adam
    weight_decay: NonNegativeFloat = 1e-3  # fraction of each weight that is added to its gradient
    patience: PositiveInt = 3  # epochs without a lower error on held-out training recordings before training stops

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the network."""

        def fit(examples: Examples, outputs: Floats, part: str) -> OutputEstimator:
            from tacpipe.tasks.learning.network import FittedNetwork

            schedule = Schedule(
                epochs=self.epochs,
                batch=self.batch,
                learning_rate=self.learning_rate,
                patience=self.patience,
                gradient_clip=GRADIENT_CLIP,
                seed=self.seed,
            )
            return FittedNetwork.fit(
                examples,
                outputs,
                self.KIND,
                schedule,
                workspace / part,
                channels=self.channels,
                layers=self.layers,
                weight_decay=self.weight_decay,
            )

        return {"network": fit}


class LearnedConfig(ModelConfig):
    """``config.json`` of a model of a label or a quantity."""

    inputs: list[StreamConfig]
    master: str  # stream whose samples make the rows of synchronized recordings; empty for others
    whole_recordings: bool  # whether there is one window per recording
    answers: dict[str, Any]  # targets, or label and classes
    chosen: str  # name of the candidate
    chosen_is_baseline: bool
    candidates: list[CandidateLoss]
    curve: list[CurvePoint]  # empty without a learning curve
    estimator: dict[str, Any]  # settings of the estimator that are not arrays
    baselines: dict[str, dict[str, Any]]  # baseline -> its settings that are not arrays
    calibration: dict[str, Any]
    group: list[str]  # labels by which recordings are grouped
    counts: dict[str, int]  # numbers of training recordings, groups and windows
    level_from: NotRequired[list[str]]  # recordings whose median the model subtracts
