"""Params of `tacpipe train slip`, one class per architecture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypedDict

from tacpipe.plugins.constraints import (
    Names,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Range,
    Unit,
)
from tacpipe.plugins.params import Panels, added
from tacpipe.tasks.learning.params import (
    SCHEDULE,
    SIZES,
    BoostingEstimator,
    EstimatorParams,
    LinearEstimator,
    NetworkEstimator,
)
from tacpipe.tasks.task import ModelConfig

if TYPE_CHECKING:
    from tacpipe.tasks.learning.inputs import StreamConfig
    from tacpipe.tasks.learning.selection import CandidateLoss, Fit


@dataclass(frozen=True)
class SlipParams(EstimatorParams):
    """Params of all slip models."""

    ARCHITECTURES: ClassVar[str] = "slip"  # name of the task in entry points
    KIND: ClassVar[Literal["class"]] = "class"
    streams: Names = ""  # names of tactile streams to read; empty: all
    # time that the model looks back; 0: only the current row, whose channels are the features
    window_s: Annotated[float, Range(0, 60), Unit("s")] = 1.0
    # how far ahead a slip is predicted; 0: predict a slip in the current row, such as an unstable grasp
    horizon_s: Annotated[NonNegativeFloat, Unit("s")] = 1.0
    # duration at the start of a recording whose mean is the rest level; 0: values are already relative to rest
    rest_s: Annotated[NonNegativeFloat, Unit("s")] = 0.2
    # duration after a slip that counts as neither slip nor stable contact
    recovery_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5
    stride: PositiveInt = 1  # rows between two training windows
    # weight training windows so that slip and stable contact have the same times since the start
    match_time: bool = True
    # labels of each training recording: its own, or another recording's, to measure the score with wrong labels
    labels: Literal["own", "shuffled"] = "own"
    # planned: also read plans from the stream plan, from their arrival on; none: read only touch
    actions: Literal["none", "planned"] = added("none")
    PANELS: ClassVar[Panels] = {
        "Model": ("architecture", "window_s", "horizon_s", *SIZES),
        "Training": ("stride", "match_time", "labels", *SCHEDULE, "seed"),
        "Data": ("streams", "actions", "rest_s", "recovery_s"),
    }

    @property
    def reads_plans(self) -> bool:
        """Whether the model reads planned motion."""
        return self.actions == "planned"


@dataclass(frozen=True)
class SlipAuto(SlipParams):
    """The estimator that cross-validation chooses."""

    # auto: the simplest of linear and boosting within one standard error, or a baseline that is better
    architecture: Literal["auto"] = "auto"

    def candidates(self, workspace: Path) -> Mapping[str, Fit]:
        """Return the regression and the boosted trees."""
        parts = (SlipLinear(seed=self.seed), SlipBoosting(seed=self.seed))
        return {name: fit for part in parts for name, fit in part.candidates(workspace).items()}


@dataclass(frozen=True)
class SlipLinear(LinearEstimator, SlipParams):
    """Logistic regression on features of each finger."""

    # linear: logistic regression on features of each finger
    architecture: Literal["linear"] = "linear"


@dataclass(frozen=True)
class SlipBoosting(BoostingEstimator, SlipParams):
    """Gradient boosting on features of each finger."""

    # boosting: gradient-boosted trees on features of each finger
    architecture: Literal["boosting"] = "boosting"
    trees: PositiveInt = 100  # number of trees
    leaves: Annotated[int, Range(2)] = 6  # maximum number of leaves of a tree
    leaf: PositiveInt = 200  # minimum number of windows per leaf
    learning_rate: PositiveFloat = 0.08  # weight of each tree
    l2: NonNegativeFloat = 50.0  # L2 penalty on leaf values


@dataclass(frozen=True)
class SlipNetwork(NetworkEstimator, SlipParams):
    """A causal convolutional network on the channels of all fingers."""

    # network: a causal convolutional network on the channels of all fingers
    architecture: Literal["network"] = "network"


Params = SlipParams  # params of any architecture


class CalibrationConfig(TypedDict):
    """A monotone map from scores to probabilities, and the alarm levels that follow from it."""

    scores: list[float]  # (knot,), ascending
    probabilities: list[float]  # (knot,)
    method: str  # recordings that the map was fitted to: validation, or out-of-fold training recordings
    levels: dict[str, float]  # false alarms per minute -> lowest score that raises an alarm
    minutes: float  # duration of stable contact in the recordings that the levels were set on


class SlipConfig(ModelConfig):
    """``config.json`` of a slip model."""

    inputs: list[StreamConfig]
    objects: list[str]  # objects of the training recordings
    counts: dict[str, int]  # numbers of training recordings, windows and slips
    chosen: str  # name of the candidate
    chosen_is_baseline: bool
    candidates: list[CandidateLoss]
    calibration: CalibrationConfig
    estimator: dict[str, Any]  # settings of the estimator that are not arrays
    baselines: dict[str, dict[str, Any]]  # baseline -> its settings that are not arrays
