"""Params of `tacpipe train regress`, one class per architecture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from tacpipe.plugins.constraints import Names, NonNegativeFloat, Unit
from tacpipe.plugins.params import Panels
from tacpipe.tasks.learning.params import (
    SHARED_PANELS,
    SIZES,
    AutoEstimator,
    BoostingEstimator,
    LearningParams,
    LinearEstimator,
    NetworkEstimator,
    TreesEstimator,
)


@dataclass(frozen=True)
class RegressParams(LearningParams):
    """Params of all models of quantities."""

    ARCHITECTURES: ClassVar[str] = "regress"  # name of the task in entry points
    PANELS: ClassVar[Panels] = {"Model": ("architecture", "target", "horizon_s", "context_s", *SIZES), **SHARED_PANELS}
    KIND: ClassVar[Literal["quantity"]] = "quantity"
    target: Names = ""  # patterns of the columns, or labels of recordings, to estimate, as ft_*
    horizon_s: Annotated[NonNegativeFloat, Unit("s")] = 0.0  # how far ahead a column is estimated


@dataclass(frozen=True)
class RegressAuto(AutoEstimator, RegressParams):
    """The estimator that cross-validation chooses."""

    # auto: the simplest of linear, trees and boosting within one standard error, or a baseline that is better
    architecture: Literal["auto"] = "auto"


@dataclass(frozen=True)
class RegressLinear(LinearEstimator, RegressParams):
    """Ridge regression."""

    # linear: ridge regression
    architecture: Literal["linear"] = "linear"


@dataclass(frozen=True)
class RegressTrees(TreesEstimator, RegressParams):
    """Extremely randomised trees."""

    # trees: extremely randomised trees
    architecture: Literal["trees"] = "trees"


@dataclass(frozen=True)
class RegressBoosting(BoostingEstimator, RegressParams):
    """Gradient-boosted trees of least absolute error."""

    # boosting: gradient-boosted trees of least absolute error
    architecture: Literal["boosting"] = "boosting"


@dataclass(frozen=True)
class RegressNetwork(NetworkEstimator, RegressParams):
    """A causal convolutional network."""

    # network: a causal convolutional network on the windows
    architecture: Literal["network"] = "network"


Params = RegressParams  # params of any architecture
