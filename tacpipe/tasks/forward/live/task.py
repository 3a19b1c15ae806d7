"""Run forecasting models live: their settings, the plan of a session, and the engine."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from tacpipe.datasets import model_files
from tacpipe.errors import UsageError
from tacpipe.live.settings import LiveTask, SessionPlan, Settings, TaskSettings
from tacpipe.plugins.constraints import PositiveInt
from tacpipe.plugins.stage import Attribute, Result
from tacpipe.sensors.live import Declaration
from tacpipe.sensors.plan import MEASURED
from tacpipe.sensors.sensor import Options, Sensor
from tacpipe.tasks import task
from tacpipe.tasks.forward.live.messages import DECLARATION, FORECAST

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.engine import Engine
    from tacpipe.recording.rig import Rig
    from tacpipe.tasks.forward.params import ForwardConfig
    from tacpipe.tasks.task import PredictionRequest


@dataclass(frozen=True)
class ForwardSettings(TaskSettings):
    """Settings of a session with a forecasting model."""

    # Source of plans: measured (motion continues; default), udp::PORT, ws:HOST:PORT, rig:STREAM (its set-points)
    plan: str = MEASURED
    plan_from: str = ""  # IP address whose plans are accepted, for --plan udp:HOST:PORT
    steps: tuple[PositiveInt, ...] = ()  # Steps ahead that are published; all by default
    quantiles: tuple[PositiveInt, ...] = ()  # Quantiles to publish, percent, such as 10,90; none by default

    def steps_up_to(self, horizon: int) -> tuple[int, ...]:
        """Return the steps to publish. Raises `UsageError` for steps beyond the model's horizon."""
        steps = tuple(sorted(set(self.steps))) or tuple(range(1, horizon + 1))
        if steps[-1] > horizon:
            listed = ",".join(map(str, self.steps))
            raise UsageError(f"The steps {listed} are requested, and the model predicts 1 to {horizon} steps ahead.")
        return steps


class ForwardLive(LiveTask):
    """Forecasts at each grid point."""

    settings: ClassVar[type[TaskSettings]] = ForwardSettings
    declaration: ClassVar[Declaration] = DECLARATION

    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the streams of forecasts and latencies, and the rig with a stream of plans if needed."""
        from tacpipe.live import plans
        from tacpipe.live.stages import refuse_look_ahead

        config: ForwardConfig = model_files.tree(
            model.files, model_files.CONFIG, {"horizon": int, "inputs.tactile": list}
        )
        own_settings = _forward_settings(settings)
        if not settings.allow_look_ahead:
            with settings.naming("model"):
                refuse_look_ahead(config, model.source.chain)
        with settings.naming("steps"):
            steps = own_settings.steps_up_to(config["horizon"])
        levels = tuple(sorted(set(own_settings.quantiles)))
        calibrated = config.get("quantiles")
        with settings.naming("quantiles"):
            task.quantile_places(calibrated["levels"] if calibrated else (), levels)
        with settings.naming("plan"):
            planned = plans.with_plan(rig, own_settings.plan, own_settings.plan_from)
        unit = str(config["inputs"].get("unit", "count"))
        forecast: Options = {"channels": config["inputs"]["tactile"], "steps": list(steps), "unit": unit}
        streams: dict[str, Options] = {
            FORECAST: {**forecast, **({"quantiles": list(levels)} if levels else {})},
            "latency": {},
        }
        attributes: dict[str, Attribute] = {"live_plan": own_settings.plan}
        return SessionPlan(planned, replace(own_settings, steps=steps, quantiles=levels), streams, attributes)

    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> Engine:
        """Return the engine with the model's causal chain, after a first forecast."""
        from tacpipe.live import plans
        from tacpipe.live.decoding import likely_schema
        from tacpipe.tasks.forward.forecaster import Forecaster
        from tacpipe.tasks.forward.live.chain import LiveChain
        from tacpipe.tasks.forward.live.engine import ForecastEngine

        own_settings = _forward_settings(settings)
        forecaster = Forecaster.load(model.files)
        open_chain = functools.partial(
            LiveChain.for_model,
            forecaster,
            model.source.chain,
            {name: likely_schema(sensor) for name, sensor in sensors.items()},
            rig.master,
            plan_from=plans.target_stream(rig, own_settings.plan),
            quantiles=own_settings.quantiles,
            allow_look_ahead=settings.allow_look_ahead,
        )

        engine = ForecastEngine(
            sensors,
            open_chain,
            own_settings.steps or None,
            settle_ns=round(settings.settle_ms * 1e6),
            quantiles=own_settings.quantiles,
        )
        forecaster.prepare_single()
        return engine

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of causal forecasts per recording."""
        from tacpipe.tasks.forward.live import replay

        look_ahead = request.allow_look_ahead
        return replay.predict(model, recordings, request.steps, request.quantiles, allow_look_ahead=look_ahead)

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Evaluate recordings of sessions: published forecasts and those of the offline chain."""
        from tacpipe.tasks.forward.live import evaluation

        return evaluation.evaluate(model, recordings)


def _forward_settings(settings: Settings) -> ForwardSettings:
    assert isinstance(settings.task, ForwardSettings)
    return settings.task
