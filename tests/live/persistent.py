"""A chain that predicts that nothing changes, in the place of a trained model: what is tried is how a session runs.

Run in the place of ``tacpipe``, it has the model's process predict so as well; ``BEHAVIOUR`` of the environment has that
process be slow (``slow:SECONDS`` a grid point) or end by itself (``die:FORECASTS``).
"""

import functools
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import UsageError
from tacpipe.io import Json
from tacpipe.live import preparation, process, session
from tacpipe.live.decoding import likely_schema
from tacpipe.live.preparation import LiveModel
from tacpipe.live.settings import SessionOptions
from tacpipe.plugins import registry
from tacpipe.recording import rig as rigs
from tacpipe.tasks.forward.live.chain import Cause, GridForecast
from tacpipe.tasks.forward.live.engine import ForecastEngine
from tacpipe.tasks.forward.live.task import ForwardSettings

HORIZON = 3
PERIOD_NS = 20_000_000
GAP_NS = 50_000_000
CHANNELS = tuple(f"skin_taxel{number:02d}_{axis}" for number in range(1, 17) for axis in "xyz")


class Persistence:
    """Predicts the last value of each channel of one skin, on a grid of 50 Hz from its first sample on."""

    streams = ("skin",)
    master = "skin"
    rate_hz = 50.0
    horizon = HORIZON
    channels = CHANNELS
    layout = tuple({"stream": "skin", "axis": name[-1], "taxel": name[10:12]} for name in CHANNELS)
    unit = "count"

    def __init__(
        self, layouts: Mapping[str, Any], beginning: Json | None = None, quantiles: Sequence[int] = ()
    ) -> None:
        if "skin" not in layouts:
            raise UsageError(f"The model reads the stream skin, and the rig has {', '.join(layouts)}.")
        names = set(layouts["skin"].names)
        if not {name.removeprefix("skin_") for name in CHANNELS} <= names:
            raise UsageError("The model reads 16 taxels of the stream skin, and the rig's skin has another layout.")
        self.late = {"skin": 0}
        self.rest_rows = "unknown"
        self._samples: list[tuple[int, Any]] = []
        self.beginning, self.quantiles = beginning, np.array(quantiles, np.float32)
        self._next_ns: int | None = None
        self._passed_ns = 0

    def push(self, stream: str, batch: Any) -> None:
        """Keep samples."""
        if stream != "skin":
            return
        t_ns = batch.column("t_ns")
        values = np.column_stack([batch.column(name.removeprefix("skin_")) for name in CHANNELS])
        self.late["skin"] += int((t_ns <= self._passed_ns).sum())
        self._samples += list(zip(t_ns.tolist(), values.astype(np.float32), strict=True))
        if self._next_ns is None and len(t_ns):
            self.beginning = self.beginning or {"origin_ns": int(t_ns[0]), "rest": []}
            origin_ns = self.beginning["origin_ns"]
            since_ns = int(t_ns[0]) - origin_ns
            self._next_ns = origin_ns + -(-since_ns // PERIOD_NS) * PERIOD_NS

    def take_over(self, previous: Any) -> None:
        """It has neither plans nor cameras."""

    def advance(self, t_ns: int, *, newest_only: bool = False) -> list[GridForecast]:
        """Return a forecast for each grid point, on request for the newest alone."""
        forecasts = []
        self._passed_ns = max(self._passed_ns, t_ns)
        while self._next_ns is not None and self._next_ns <= t_ns:
            forecasts.append(self._at(self._next_ns))
            self._next_ns += PERIOD_NS
        if newest_only:
            forecasts[:-1] = [
                replace(forecast, count=None, quantiles=None, cause=forecast.cause | Cause.SKIPPED)
                for forecast in forecasts[:-1]
            ]
        return forecasts

    def _at(self, point_ns: int) -> GridForecast:
        while len(self._samples) > 1 and self._samples[1][0] <= point_ns:
            self._samples.pop(0)
        at_ns, now = self._samples[0]
        if point_ns - at_ns > GAP_NS:
            return GridForecast(point_ns, at_ns, None, now, Cause.GAP, ("skin",))
        ahead = np.repeat(now[None], HORIZON, axis=0)
        band = ahead[..., None] + self.quantiles - 50 if len(self.quantiles) else None
        return GridForecast(point_ns, at_ns, ahead, now, Cause.NONE, quantiles=band)


def model_of(task: str, **config: Any) -> LiveModel:
    """Return a model with this configuration, which states no look-ahead."""
    text = json.dumps({"task": task, "look_ahead": {"mean_ms": 0, "max_ms": 0}, **config}).encode()
    live = registry.load_task(task).live
    assert live is not None
    dataset: Any = FakeModel({"config.json": text})
    return LiveModel(task, live, dataset)


class FakeModel:
    """The dataset of a model, with its configuration alone."""

    digest = "0" * 64
    chain: tuple[Any, ...] = ()

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files, self.source = files, self


def engine(options: SessionOptions) -> ForecastEngine:
    """Return an engine of this chain."""
    forward_settings = options.settings.task
    assert isinstance(forward_settings, ForwardSettings)
    rig = rigs.parse(options.rig)
    sensors = {name: rig.streams[name].sensor for name in options.streams}
    layouts = {name: likely_schema(sensor) for name, sensor in sensors.items()}
    opened: Any = functools.partial(Persistence, layouts, quantiles=forward_settings.quantiles)
    forecast_engine = ForecastEngine(
        sensors, opened, forward_settings.steps or None, quantiles=forward_settings.quantiles
    )
    behaviour, _, value = os.environ.get("BEHAVIOUR", "").partition(":")
    if behaviour:
        _behave(forecast_engine, behaviour, value)
    return forecast_engine


def _behave(forecast_engine: ForecastEngine, behaviour: str, value: str) -> None:
    step, count = forecast_engine.step, [0]

    def step_and_behave(now_ns: int) -> Any:
        messages = step(now_ns)
        count[0] += len(messages)
        if behaviour == "slow" and messages:
            time.sleep(float(value))
        if behaviour == "die" and count[0] >= int(value):
            os._exit(9)
        return messages

    forecast_engine.step = step_and_behave  # type: ignore[method-assign]


def main() -> None:
    """Be ``tacpipe`` with this model, or its model's process."""
    if sys.argv[1:2] and sys.argv[1].isdecimal():
        sys.exit(process.main(sys.argv[1:], engine))
    patch = pytest.MonkeyPatch()
    patch.setattr(session, "MODULE", "tests.live.persistent")
    described = model_of("forward", horizon=HORIZON, inputs={"tactile": CHANNELS}, quantiles={"levels": [10, 50, 90]})
    patch.setattr(preparation, "open_model", lambda path: described)
    from tacpipe.cli import main as cli
    from tests.recording import patient

    patient.relax(patch)
    cli.main()


if __name__ == "__main__":
    main()
