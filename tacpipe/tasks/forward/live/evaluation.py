"""Evaluate recordings of live sessions: what was published, its latencies, and the errors of the forecasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Times
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.live.stages import extracted_streams, streams_as_recorded
from tacpipe.plugins.stage import Result
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import BASELINE, headline_steps
from tacpipe.tasks.forward.live import replay
from tacpipe.tasks.forward.live.chain import GridForecast
from tacpipe.tasks.forward.live.messages import FORECAST
from tacpipe.tasks.learning.live.evaluation import evaluate as compare_sessions

if TYPE_CHECKING:
    import pyarrow as pa

LIVE = "live"  # the published forecasts among the predictors


def evaluate(model: Model, recordings: Dataset) -> Result:
    """Return rows, equality, latencies, and the errors of published forecasts and of persistence.

    Raises `UsageError` for a recording without a session, or of another model.
    """
    forecaster = Forecaster.load(model.files)
    recomputed: dict[str, list[GridForecast]] = {}

    def predict(recording: Recording) -> pa.Table:
        tables = extracted_streams(recording, model.source.chain, streams_as_recorded(recording))
        percents = () if forecaster.quantiles is None else forecaster.quantiles.percents
        levels = [level for level in percents if f"_q{level}" in "".join(tables[FORECAST].column_names)]
        chain = replay.build_chain(forecaster, model.source.chain, recording, tables, levels, allow_look_ahead=True)
        recomputed[recording.name] = list(replay.iterate_forecasts(chain, tables))
        return replay.forecast_table(forecaster, recomputed[recording.name], range(1, chain.horizon + 1), levels)

    def measure(recording: Recording, times: Times, published: Mapping[str, Any]) -> dict[str, Any]:
        return errors(recomputed[recording.name], times, published, forecaster.codec.channels)

    return compare_sessions(model, recordings, FORECAST, predict, measure)


def errors(
    rows: Sequence[GridForecast], times: Times, published: Mapping[str, Any], channels: Sequence[str]
) -> dict[str, Any]:
    """Return the mean absolute errors by step (``mae``) of forecasts that were published at ``times`` (row,).

    The truth of a step is the level that many ``rows`` of the grid later. Forecasts with a gap then or now are left out, and
    ``errors_of`` counts the others by step.
    """
    grid_ns = np.array([row.t_ns for row in rows], np.int64)
    nothing = np.full(len(channels), np.nan)
    levels = np.array([nothing if row.now is None or row.gaps else row.now for row in rows]).reshape(-1, len(channels))
    places = np.searchsorted(grid_ns, times)
    stored = {name.removeprefix(f"{channels[0]}_t") for name in published if name.startswith(f"{channels[0]}_t")}
    steps = sorted(int(end) for end in stored if end.isdigit())
    mae: dict[str, dict[str, float]] = {LIVE: {}, BASELINE: {}}
    counts: dict[str, int] = {}
    for step in headline_steps(steps):
        inside = np.flatnonzero((places + step < len(grid_ns)) & np.isin(times, grid_ns))
        truth, now = levels[places[inside] + step], levels[places[inside]]
        known = np.isfinite(truth - now).all(axis=1)
        counts[f"t{step}"] = int(known.sum())
        forecast = np.stack([published[f"{channel}_t{step}"][inside] for channel in channels], axis=1)
        for name, predicted in ((LIVE, forecast), (BASELINE, now)) if known.any() else ():
            mae[name][f"t{step}"] = float(f"{np.abs(predicted - truth)[known].mean():.9g}")
    return {"mae": mae, "errors_of": counts}
