"""Params of `tacpipe train slip`, which define how a slip model is built and trained; one class per architecture."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypedDict

from tacpipe.datasets import manifest
from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import (
    Names,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Range,
    Seed,
    Unit,
)
from tacpipe.plugins.params import Panels, added
from tacpipe.tasks.task import ModelConfig

if TYPE_CHECKING:
    from tacpipe.arrays import AnyArray
    from tacpipe.tasks.learning.inputs import StreamConfig
    from tacpipe.tasks.slip.scorers import Scorer
    from tacpipe.tasks.slip.training import SlipTraining
    from tacpipe.tasks.slip.windows import FingerReader


@dataclass(frozen=True)
class SlipModelParams(ABC):
    """Params of all slip models."""

    ARCHITECTURES: ClassVar[str] = "slip"  # name of the task in entry points
    architecture: str = "boosting"
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
    seed: Seed = 0  # random seed
    PANELS: ClassVar[Panels] = {
        "Model": (
            *("architecture", "window_s", "horizon_s", "trees", "leaves", "leaf", "learning_rate", "l2"),
            *("channels", "layers", "forward_model"),
        ),
        "Training": ("stride", "match_time", "labels", "epochs", "batch", "patience", "weight_decay", "seed"),
        "Data": ("streams", "actions", "rest_s", "recovery_s"),
    }

    @property
    def reads_plans(self) -> bool:
        """Whether the model reads planned motion."""
        return self.actions == "planned"

    @abstractmethod
    def fit(self, training: SlipTraining) -> Scorer:
        """Return a scorer trained with ``training``, which has the training windows and a method per kind of scorer."""

    @abstractmethod
    def load_scorer(self, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> Scorer:
        """Return the scorer that `fit` returned, from its stored parts. Raises `ValueError` if they are inconsistent."""


@dataclass(frozen=True)
class Boosting(SlipModelParams):
    """Gradient boosting on features of each finger."""

    # boosting: gradient-boosted trees on features of each finger
    architecture: Literal["boosting"] = "boosting"
    trees: PositiveInt = 100  # number of trees
    leaves: Annotated[int, Range(2)] = 6  # maximum number of leaves of a tree
    leaf: PositiveInt = 200  # minimum number of windows per leaf
    learning_rate: PositiveFloat = 0.08  # weight of each tree
    l2: NonNegativeFloat = 50.0  # L2 penalty on leaf values

    def fit(self, training: SlipTraining) -> Scorer:
        """Grow the trees."""
        return training.boost(self)

    def load_scorer(self, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> Scorer:
        """Return the stored trees."""
        from tacpipe.tasks.slip.scorers import BoostedScorer

        return BoostedScorer.load(arrays, described, reader)


@dataclass(frozen=True)
class ConvolutionParams(SlipModelParams):
    """A causal convolutional network on the channels of all fingers."""

    # convolution: a causal convolutional network on the channels of all fingers
    architecture: Literal["convolution"] = "convolution"
    channels: PositiveInt = 24  # channels of each layer
    layers: Annotated[int, Range(1, 8)] = 4  # layers; each doubles the time between the rows that it combines
    epochs: PositiveInt = 15  # maximum number of passes over the training windows
    batch: PositiveInt = 128  # windows per step of the optimiser
    learning_rate: PositiveFloat = 1e-3  # learning rate of Adam
    weight_decay: NonNegativeFloat = 1e-3  # fraction of each weight that is added to its gradient
    patience: PositiveInt = 3  # epochs without a lower error on held-out training recordings before training stops

    def fit(self, training: SlipTraining) -> Scorer:
        """Train the network by the shared loop."""
        return training.train_network(self)

    def load_scorer(self, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> Scorer:
        """Return the stored network."""
        from tacpipe.tasks.slip.network import ConvolutionScorer

        return ConvolutionScorer.load(arrays, described, reader)


@dataclass(frozen=True)
class ForecastRule(SlipModelParams):
    """A rule on the forecast of a model of the task forward."""

    # forecast-rule: the predicted rise and fall of shear, relative to the normal load
    architecture: Literal["forecast-rule"] = "forecast-rule"
    forward_model: str = ""  # path of a model of the task forward
    forward_digest: str = ""  # digest of that model; computed if omitted

    def __post_init__(self) -> None:
        """Compute the digest of the forward model, which is part of the key.

        Raises `UsageError` if ``forward_digest`` is another digest.
        """
        if not self.forward_model:
            return

        digest = manifest.find(_path(self.forward_model)).digest
        if self.forward_digest not in ("", digest):
            raise UsageError(
                f"{self.forward_model} has the digest {digest}, and forward_digest states {self.forward_digest}. Give the "
                f"model that was used before, or leave forward_digest out."
            )
        object.__setattr__(self, "forward_digest", digest)

    def fit(self, training: SlipTraining) -> Scorer:
        """Return the rule; only its calibration depends on the training windows.

        Raises `UsageError` if ``forward_model`` is empty.
        """
        if not self.forward_model:
            raise UsageError("forward_model names no model. Give the path of a model of the task forward.")
        return training.apply_rule(self)

    def load_scorer(self, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader) -> Scorer:
        """Return the stored rule."""
        from tacpipe.tasks.slip.rule import RuleScorer

        return RuleScorer.load(arrays, described)


def _path(text: str) -> Path:
    return Path(text)


Params = SlipModelParams  # params of any architecture


class CalibrationConfig(TypedDict):
    """A monotone map from scores to probabilities, and the alarm levels that follow from it."""

    scores: list[float]  # (knot,), ascending
    probabilities: list[float]  # (knot,)
    method: str  # recordings that the map was fitted to: validation, or out-of-fold training recordings
    levels: dict[str, float]  # false alarms per minute -> lowest score that raises an alarm
    minutes: float  # duration of stable contact in the recordings that the levels were set on


class SlipConfig(ModelConfig):
    """``config.json`` of a slip model."""

    fingers: list[StreamConfig]
    rate_hz: float  # rate of the first finger's rows, each of which gets a probability
    objects: list[str]  # objects of the training recordings
    counts: dict[str, int]  # numbers of training recordings, windows and slips
    calibration: CalibrationConfig
    scorer: dict[str, object]  # settings of the architecture that are not arrays
    baselines: dict[str, dict[str, object]]  # baseline -> its settings that are not arrays
    baseline_levels: dict[
        str, dict[str, float]
    ]  # baseline -> false alarms per minute -> lowest score that raises an alarm
    base_rate: float  # weighted fraction of training windows with a slip
