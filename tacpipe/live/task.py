"""A task's part of live sessions: its settings, its messages, its engine, and what reads the recordings of sessions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from tacpipe.errors import UsageError

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.engine import Engine
    from tacpipe.live.settings import Settings, TaskSettings
    from tacpipe.plugins.stage import Result
    from tacpipe.recording.rig import Rig
    from tacpipe.sensors.live import Declaration
    from tacpipe.sensors.sensor import Sensor
    from tacpipe.tasks.task import PredictionRequest


@dataclass(frozen=True)
class SessionPlan:
    """A live session that a task has checked against model, rig and settings."""

    rig: Rig  # includes streams that the engine needs beyond those of the rig file
    settings: TaskSettings  # completed
    streams: Mapping[str, Mapping[str, Any]]  # recorded streams with the options of the sensor ``live``
    attributes: Mapping[str, Any] = field(default_factory=dict)  # further attributes of the recording


class LiveTask(ABC):
    """A task's part of live sessions. The module of a subclass imports torch and pyarrow inside of its methods only."""

    settings: ClassVar[
        type[TaskSettings]
    ]  # dataclass of its own settings: options of ``tacpipe live`` and keys of ``[live]``
    declaration: ClassVar[Declaration]  # the values of its messages

    @abstractmethod
    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the plan of a session, from the configuration of the model, without torch.

        Raises `UsageError` for settings that do not suit model or rig, `TacpipeError` where the model was trained on rows
        that look ahead, unless the settings allow it.
        """

    @abstractmethod
    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> Engine:
        """Return the engine that turns the samples of ``sensors``, by stream, into messages, in the model's process.

        Raises `UsageError` where model, rig and settings do not belong together.
        """

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return what a session publishes for recordings as they were recorded (``predict --causal``).

        Raises `UsageError` where the task has no such predictions.
        """
        raise UsageError(f"Models of the task {self.declaration.kind} have no causal predictions; leave --causal out.")

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return metrics of what sessions published in their recordings (``evaluate --live``).

        Raises `UsageError` where the task has no such metrics.
        """
        raise UsageError(f"Sessions of the task {self.declaration.kind} are not evaluated; leave --live out.")
