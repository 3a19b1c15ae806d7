"""Run touch models live: settings, session plan and engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from tacpipe.live.settings import LiveTask, SessionPlan, Settings, TaskSettings
from tacpipe.sensors.live import Declaration
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.touch.live.messages import COLUMNS, DECLARATION, TOUCH

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.recording.rig import Rig
    from tacpipe.tasks.touch.live.engine import TouchEngine


@dataclass(frozen=True)
class TouchSettings(TaskSettings):
    """Settings of a session with a touch model."""

    rank: str = "contact"  # Criterion of the ranking: contact (default), balance, level:0.4


class TouchLive(LiveTask):
    """Rankings of candidate grasps on request."""

    settings: ClassVar[type[TaskSettings]] = TouchSettings
    declaration: ClassVar[Declaration] = DECLARATION

    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the streams of rankings and latencies."""
        return SessionPlan(rig, settings.task, {TOUCH: {"channels": list(COLUMNS)}, "latency": {}})

    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> TouchEngine:
        """Return the engine that ranks the candidates of each request. Raises `UsageError` for an unknown criterion."""
        from tacpipe.tasks.touch.live.engine import TouchEngine, criterion
        from tacpipe.tasks.touch.predictor import Predictor

        assert isinstance(settings.task, TouchSettings)
        return TouchEngine(sensors, Predictor.load(model.files), criterion(settings.task.rank))
