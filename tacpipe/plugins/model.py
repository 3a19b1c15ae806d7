"""Define what a trained model is to code that knows no task: its configuration, its files and requests to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypedDict

from tacpipe.io import Scalar

Files = Mapping[str, bytes]  # model files by name


class ModelConfig(TypedDict):
    """Fields of ``config.json`` that are common to the models of all tasks."""

    task: str
    architecture: str
    params: dict[str, Scalar]  # stored by `tacpipe.plugins.params`
    trained_on: dict[str, str]  # recording name -> digest


class LoadedModel(Protocol):
    """A model in memory, as returned by `tacpipe.load`."""

    @property
    def predict(self) -> Callable[..., Any]:
        """Function that takes a dataset or a recording and returns the table of ``tacpipe predict``."""
        ...


@dataclass(frozen=True)
class PredictionRequest:
    """Options of a prediction."""

    steps: Sequence[int]  # steps ahead, ascending, for tasks that predict the future
    quantiles: Sequence[int] = ()  # quantile levels in percent, ascending
    probabilities: bool = False  # True to add calibrated probabilities
    allow_look_ahead: bool = False  # for causal predictions: accept a model that was trained on rows with look-ahead


@dataclass(frozen=True)
class CalibrationRequest:
    """Options of the calibration of a trained model."""

    quantiles: tuple[int, ...]  # quantile levels in percent, ascending
    promise: bool  # True if bands must have at least their nominal coverage in a new recording
    false_unknown: float  # allowed fraction of slides of learned classes that are classified as unknown
    seed: int
