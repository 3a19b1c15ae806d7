"""Run slip models live: settings, session plan and engine, and the evaluation of recorded sessions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tacpipe.datasets import model_files
from tacpipe.errors import UsageError
from tacpipe.live.settings import LiveTask, SessionPlan, Settings, TaskSettings
from tacpipe.plugins.constraints import Range
from tacpipe.plugins.stage import Attribute, Result
from tacpipe.sensors.live import Declaration
from tacpipe.sensors.plan import MEASURED
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.learning.live.task import require_inputs, require_stages
from tacpipe.tasks.slip.live.messages import DECLARATION, SLIP, SlipDescription

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.recording.rig import Rig
    from tacpipe.tasks.slip.live.engine import SlipEngine
    from tacpipe.tasks.task import PredictionRequest


@dataclass(frozen=True)
class SlipSettings(TaskSettings):
    """Settings of a session with a slip model."""

    # False alarms per minute that the alarm was set for: 0.1, 1 or 10 [1]
    alarms_per_minute: Annotated[float, Range(above=0, maximum=60)] = 1.0
    # Source of plans: measured (none, the default), udp::PORT or ws:HOST:PORT
    plan: str = MEASURED
    plan_from: str = ""  # IP address whose plans are accepted, for --plan udp:HOST:PORT


class SlipLive(LiveTask):
    """The probability of a slip and an alarm at each sample."""

    settings: ClassVar[type[TaskSettings]] = SlipSettings
    declaration: ClassVar[Declaration] = DECLARATION

    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the streams of probabilities and latencies.

        Raises `TacpipeError` if the model was trained on the output of a stage, or does not run live; `UsageError` if the
        rig lacks a stream of the model, the model an alarm, or a model that reads plans a source of them.
        """
        from tacpipe.live import plans

        own = _own(settings)
        config = model_files.tree(
            model.files, model_files.CONFIG, {"inputs": list, "calibration.levels": dict, "params": dict}
        )
        require_stages(model.source.chain)
        _level_name(config["calibration"]["levels"], own.alarms_per_minute)
        require_inputs(config, model.source.chain, rig)
        with settings.naming("plan"):
            planned = plans.with_plan(rig, own.plan, own.plan_from)
        if config["params"].get("actions") == "planned" and PLAN not in planned.streams:
            raise UsageError(
                "The model reads planned motion, and this session has no source of plans. Give --plan udp::PORT or "
                "--plan ws:HOST:PORT, and send plans to it."
            )
        attributes: dict[str, Attribute] = {"live_alarms_per_minute": own.alarms_per_minute, "live_plan": own.plan}
        return SessionPlan(planned, own, {SLIP: {}, "latency": {}}, attributes)

    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> SlipEngine:
        """Return the engine of a session, which has scored its first window."""
        from tacpipe.tasks.slip.live.engine import SlipEngine
        from tacpipe.tasks.slip.model import SlipModel

        loaded = SlipModel.load(model.files)  # it scores a window, so that the first sample does not wait
        name = _level_name(loaded.calibration.levels, _own(settings).alarms_per_minute)
        fingers = loaded.reader.streams
        layouts = {finger.stream: _grid(finger.layout) for finger in fingers}
        description = SlipDescription(settings.model, fingers[0].rate_hz, loaded.params.horizon_s, name, layouts)
        streams = [*(finger.stream for finger in fingers), *([PLAN] if loaded.reader.reads_plans else [])]
        return SlipEngine(
            loaded,
            {stream: sensors[stream] for stream in streams},
            description,
            loaded.calibration.levels[name],
            settle_ns=round(settings.settle_ms * 1e6),
        )

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return the probabilities that a session would publish for recordings."""
        from tacpipe.tasks.slip.model import predict

        require_stages(model.source.chain)
        return predict(model.files, recordings)

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the evaluation of recorded sessions."""
        from tacpipe.tasks.slip.live import evaluation

        return evaluation.evaluate(model, recordings)


def _own(settings: Settings) -> SlipSettings:
    assert isinstance(settings.task, SlipSettings)
    return settings.task


def _level_name(levels: Mapping[str, float], per_minute: float) -> str:
    """Return the name of the level for a rate of false alarms. Raises `UsageError` if the model has none."""
    from tacpipe.tasks.slip.calibration import rate_name

    name = rate_name(per_minute)
    if name not in levels:
        raise UsageError(f"The model has alarms at {', '.join(levels)} false alarms per minute. Choose one of these.")
    return name


def _grid(layout: tuple[Mapping[str, Any], ...]) -> list[list[int]]:
    """Return row and column of each taxel, from 0, for drawing; a square grid where the layout does not state them."""
    taxels = list(dict.fromkeys(place.get("taxel", str(number)) for number, place in enumerate(layout)))
    width = max(1, round(len(taxels) ** 0.5))
    return [[number // width, number % width] for number in range(len(taxels))]
