"""Define the interface between tacpipe and a task: its targets, its recordings and its evaluation.

A package adds a task with an entry point in the group ``tacpipe.tasks`` that refers to a subclass of `Task`. The
commands ``tacpipe train``, ``evaluate``, ``predict``, ``calibrate``, ``report``, ``live`` and ``demo`` work for every
such task.

The module of the subclass is imported for the help of ``tacpipe train NAME`` and on cache hits, so it must import
torch, pandas and pyarrow only inside its methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from tacpipe.errors import UsageError
from tacpipe.plugins import registry
from tacpipe.plugins.model import CalibrationRequest as CalibrationRequest
from tacpipe.plugins.model import Files as Files
from tacpipe.plugins.model import LoadedModel as LoadedModel
from tacpipe.plugins.model import ModelConfig as ModelConfig
from tacpipe.plugins.model import PredictionRequest as PredictionRequest
from tacpipe.plugins.requirements import Requirements
from tacpipe.plugins.stage import AnyStage, Result

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.clouds.cloud import Cloud
    from tacpipe.clouds.grasp import Grasp
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.recordings import OpenedChain

GraspPredictor = Callable[[Any, "Cloud", "Grasp"], dict[str, float]]


@dataclass(frozen=True)
class Calibration:
    """How the models of a task are calibrated."""

    states: Literal["quantiles", "probabilities"]  # the field of `PredictionRequest` that calibrated models support
    # Returns the files of the given model, extended by its uncertainty. This is measured on two datasets, with the
    # recordings of the role train and of the role val.
    calibrate: Callable[[Files, CalibrationRequest, Dataset, Dataset], dict[str, bytes]]


class Demo(NamedTuple):
    """A task's part of `tacpipe demo`."""

    commands: list[list[str]]  # commands in order, without the leading ``tacpipe``
    results: list[str]  # paths of the results on the page
    # commands from the emulated rig's ``recordings`` below the output to ``results``; empty if there are none
    recorded: Sequence[list[str]] = ()
    simulated: Sequence[str] = ()  # the simulation, without its output, whose recordings the emulated rig replays
    shortened: Sequence[str] = ()  # models that are trained for a fraction of their schedule, each with that fraction


class Task(ABC):
    """A task. Abstract members are required; each property that a subclass does not override is an absent capability."""

    name: ClassVar[str]  # name of the entry point
    # streams, quantities and labels that recordings must have; None if the task does not declare them
    requirements: ClassVar[Requirements | None] = None
    # A stage whose function is in the module of the subclass. Its signature, params and version are those of ``tacpipe
    # train NAME``. Its result contains ``config.json`` with ``task``, which is `name`, and ``trained_on``, the digests by
    # name of the training recordings.
    train: ClassVar[AnyStage]

    @property
    def params(self) -> Any:
        """Dataclass of the options of ``tacpipe train``, or a union with one dataclass per architecture."""
        return self.train.params

    @abstractmethod
    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return ``metrics.json``, errors by recording, and the headline of a model and its baselines."""

    @abstractmethod
    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of predictions per recording, or one table for all recordings."""

    @abstractmethod
    def load(self, files: Files, chain: OpenedChain | None = None) -> LoadedModel:
        """Return the model in ``files``, which may be untrusted, with the preprocessing stages in ``chain``."""

    @property
    def short_names(self) -> Mapping[str, str]:
        """Short names in ``summary.json`` of parts and targets of headlines; other names are written in full."""
        return {}

    @property
    def calibration(self) -> Calibration | None:
        """Calibration of uncertainty; None if the task has none."""
        return None

    @property
    def recentre(self) -> Callable[[Files, Dataset], Result] | None:
        """Function of a model's files and recordings of a session that returns the model with the levels of the session.

        None if its models do not read levels of sessions.
        """
        return None

    @property
    def live(self) -> LiveTask | None:
        """The task's part of live sessions; None if its models do not run live."""
        return None

    @property
    def report(self) -> TaskReport | None:
        """Comparison and drawing of results; None to compare headlines only. Its package must not import torch."""
        return None

    @property
    def grasp_predictor(self) -> GraspPredictor | None:
        """Function of a loaded model, a cloud and a grasp that returns predicted values by column, with units.

        It is called by ``tacpipe candidates``; None if the models predict only recordings.
        """
        return None

    def demo(self, output: Path) -> Demo | None:
        """Return the task's part of ``tacpipe demo``, which writes below ``output``; None if it has none."""
        return None


def task_of_model(files: Files, place: str = "This") -> Task:
    """Return the task of the model among ``files``.

    Raises `UsageError`, which names ``place``, if there is no model, `TacpipeError` if it is invalid.
    """
    from tacpipe.datasets import model_files

    task: Task = registry.load_task(model_files.task_name(files, place))
    return task


def percents(levels: AnyFloats) -> tuple[int, ...]:
    """Return levels, which are fractions, in percent.

    >>> import numpy as np
    >>> percents(np.array([0.1, 0.5, 0.9]))
    (10, 50, 90)
    """
    return tuple(round(float(100 * level)) for level in levels)


def quantile_places(available: Sequence[int], requested: Sequence[int]) -> list[int]:
    """Return the places of ``requested`` quantiles in percent among those that a model has.

    Raises `UsageError` if the model has no uncertainty or lacks one of these quantiles.
    """
    if requested and not available:
        raise UsageError(
            "The model has no quantiles. Run `tacpipe calibrate MODEL DATASET --split SPLIT -o CALIBRATED` and give "
            "that one."
        )
    for percent in requested:
        if percent not in available:
            raise UsageError(
                f"The model has the quantiles {','.join(map(str, available))}, not {percent}. Give --quantiles of "
                "these, or run `tacpipe calibrate` with others."
            )
    return [available.index(percent) for percent in requested]
