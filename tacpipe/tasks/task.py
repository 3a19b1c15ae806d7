"""The interface between tacpipe and a task: what is predicted, from which recordings, and how that is evaluated.

A package brings a task with an entry point of the group ``tacpipe.tasks`` that names a subclass of `Task`. The commands
``tacpipe train``, ``evaluate``, ``predict``, ``calibrate``, ``report``, ``live`` and ``demo`` work for every such task.

The module of the subclass is imported to print the help of ``tacpipe train NAME`` and to answer from the cache. It imports
torch, pandas and pyarrow inside of its methods only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, TypedDict, TypeVar

from tacpipe.errors import TacpipeError
from tacpipe.io import Scalar

if TYPE_CHECKING:
    from pathlib import Path

    from tacpipe.arrays import AnyFloats
    from tacpipe.clouds.cloud import Cloud
    from tacpipe.clouds.grasp import Grasp
    from tacpipe.comparison.runs import TaskReport
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.plugins.stage import AnyStage, Requirements, Result
    from tacpipe.tasks.recordings import OpenedChain

Files = Mapping[str, bytes]  # the files of a model by name
GraspPredictor = Callable[[Any, "Cloud", "Grasp"], dict[str, float]]


class ModelConfig(TypedDict):
    """The parts of ``config.json`` that models of all tasks have."""

    task: str
    architecture: str
    params: dict[str, Scalar]  # as `tacpipe.plugins.params` stores them
    trained_on: dict[str, str]  # digests of recordings by name


class LoadedModel(Protocol):
    """A model in memory, as `tacpipe.load` returns it."""

    @property
    def predict(self) -> Callable[..., Any]:
        """A function of a dataset or a recording that returns the table of ``tacpipe predict``."""
        ...


@dataclass(frozen=True)
class PredictionRequest:
    """The predictions that are requested of a model."""

    steps: Sequence[int]  # steps ahead, ascending, for tasks that predict a future
    quantiles: Sequence[int] = ()  # percent, ascending
    probabilities: bool = False  # True if calibrated probabilities are added
    allow_look_ahead: bool = False  # causal predictions: accept a model that was trained on rows that look ahead


@dataclass(frozen=True)
class Calibration:
    """A task's way to measure how uncertain its models are."""

    states: Literal["quantiles", "probabilities"]  # the field of `PredictionRequest` that a calibrated model answers
    # Returns the files of a model, which are given, with those that state its uncertainty, measured on recordings with the
    # role train and with the role val.
    calibrate: Callable[[Files, CalibrationRequest, Dataset, Dataset], dict[str, bytes]]


class Demo(NamedTuple):
    """The part of `tacpipe demo` that shows a task."""

    commands: list[list[str]]  # commands in their order, each without the leading ``tacpipe``
    results: list[str]  # paths of results that the page shows
    datasets: Sequence[str] = ()  # paths of datasets that the page uses, which are not results
    # commands from the emulated rig's ``recordings`` below the output to ``results``; empty without such a part
    recorded: Sequence[list[str]] = ()
    shortened: Sequence[str] = ()  # models that are trained for a part of their schedule, each with that part


class Task(ABC):
    """A task. The abstract members are required; every property without a body in the subclass is an absent capability."""

    name: ClassVar[str]  # the name in the entry point
    # A stage whose function is in the module of the subclass: its signature, params, version and requirements are those of
    # ``tacpipe train NAME``. Its result holds ``config.json`` with ``task``, `name`, and ``trained_on``, the digests of the
    # recordings that the model has seen by name.
    train: ClassVar[AnyStage]

    @property
    def params(self) -> Any:
        """The dataclass of the options of ``tacpipe train``, or a union with one dataclass per architecture."""
        return self.train.params

    @property
    def requirements(self) -> Requirements | None:
        """The streams, quantities and labels that recordings must have, or None if the task does not state them."""
        return self.train.requirements

    @abstractmethod
    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return ``metrics.json``, errors by recording and the headline of a model next to its baselines."""

    @abstractmethod
    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return a table of predictions for each recording, or one of all."""

    @abstractmethod
    def load(self, files: Files, chain: OpenedChain | None = None) -> LoadedModel:
        """Return the model among ``files``, which may be untrusted, trained behind the stages of ``chain``."""

    @property
    def short_names(self) -> Mapping[str, str]:
        """Names in ``summary.json`` of the parts and targets of headlines; others are written as they are."""
        return {}

    @property
    def calibration(self) -> Calibration | None:
        """How uncertainty is measured, or None if it is not."""
        return None

    @property
    def live(self) -> LiveTask | None:
        """The task's part of a live session, or None if its models do not run live."""
        return None

    @property
    def report(self) -> TaskReport | None:
        """How results are compared and drawn; None: by their headlines. Its package does not import torch."""
        return None

    @property
    def grasp_predictor(self) -> GraspPredictor | None:
        """A function of a loaded model, a cloud and a grasp that returns predicted values by column with their unit.

        ``tacpipe candidates`` calls it, or None if models predict recordings only.
        """
        return None

    def demo(self, output: Path) -> Demo | None:
        """Return the task's part of ``tacpipe demo``, which writes below ``output``, or None if it has no part."""
        return None


@dataclass(frozen=True)
class CalibrationRequest:
    """The uncertainty that a trained model is to state."""

    quantiles: tuple[int, ...]  # percent, ascending
    promise: bool  # True if bands must hold in a new recording with at least their level
    false_unknown: float  # fraction of slides of learned classes that may be answered unknown
    seed: int


class Levelled(Protocol):
    """The uncertainty of a model, as quantiles of some levels."""

    @property
    def percents(self) -> tuple[int, ...]:
        """The levels in percent, ascending."""
        ...  # a protocol has no body


Uncertain = TypeVar("Uncertain", bound=Levelled)


def percents(levels: AnyFloats) -> tuple[int, ...]:
    """Return levels, which are fractions, in percent.

    >>> import numpy as np
    >>> percents(np.array([0.1, 0.5, 0.9]))
    (10, 50, 90)
    """
    return tuple(round(float(100 * level)) for level in levels)


def quantiles_of(uncertainty: Uncertain | None, requested: Sequence[int]) -> tuple[Uncertain, list[int]]:
    """Return the uncertainty of a model, and the indices of the ``requested`` quantiles, in percent.

    Raises `TacpipeError` if the model has none, or not these.
    """
    if uncertainty is None:
        raise TacpipeError(
            "The model has no quantiles. Run `tacpipe calibrate MODEL DATASET --split SPLIT -o CALIBRATED` and give "
            "that one."
        )
    available = uncertainty.percents
    for percent in requested:
        if percent not in available:
            raise TacpipeError(
                f"The model has the quantiles {','.join(map(str, available))}, not {percent}. Give --quantiles "
                f"of these, or run "
                f"`tacpipe calibrate` with others."
            )
    return uncertainty, [available.index(percent) for percent in requested]
