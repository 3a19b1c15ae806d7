"""Params of `tacpipe train classify`, one class per architecture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

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

if TYPE_CHECKING:
    from tacpipe.tasks.learning.selection import Fit


@dataclass(frozen=True)
class ClassifyParams(LearningParams):
    """Params of all models of a label."""

    ARCHITECTURES: ClassVar[str] = "classify"  # name of the task in entry points
    PANELS: ClassVar[Panels] = {"Model": ("architecture", "label", "context_s", *SIZES), **SHARED_PANELS}
    KIND: ClassVar[Literal["class"]] = "class"
    label: str = ""  # label of recordings, column, or kind of labelled intervals, to learn


@dataclass(frozen=True)
class ClassifyAuto(AutoEstimator, ClassifyParams):
    """The estimator that cross-validation chooses."""

    # auto: the simplest of linear, trees and boosting within one standard error, or a baseline that is better
    architecture: Literal["auto"] = "auto"


@dataclass(frozen=True)
class ClassifyLinear(LinearEstimator, ClassifyParams):
    """Logistic regression."""

    # linear: logistic regression
    architecture: Literal["linear"] = "linear"


@dataclass(frozen=True)
class ClassifyTrees(TreesEstimator, ClassifyParams):
    """Extremely randomised trees."""

    # trees: extremely randomised trees
    architecture: Literal["trees"] = "trees"


@dataclass(frozen=True)
class ClassifyBoosting(BoostingEstimator, ClassifyParams):
    """Gradient-boosted trees."""

    # boosting: gradient-boosted trees
    architecture: Literal["boosting"] = "boosting"


@dataclass(frozen=True)
class ClassifyMinirocket(ClassifyParams):
    """Random convolutions of the window and a linear readout."""

    # minirocket: random convolutions of the window and a linear readout
    architecture: Literal["minirocket"] = "minirocket"

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the classifier."""
        from tacpipe.tasks.learning.estimators import FittedMinirocket

        return {"minirocket": lambda examples, outputs, part: FittedMinirocket.fit(examples, outputs, seed=self.seed)}


@dataclass(frozen=True)
class ClassifyNetwork(NetworkEstimator, ClassifyParams):
    """A causal convolutional network."""

    # network: a causal convolutional network on the windows
    architecture: Literal["network"] = "network"


Params = ClassifyParams  # params of any architecture
