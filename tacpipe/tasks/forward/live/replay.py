"""Replay recordings through a `LiveChain` in the order of arrival, for `tacpipe predict --causal`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.live.stages import arrival_streams, extracted_streams, pieces_by_arrival, streams_as_recorded
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.store.records import Step
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.live.chain import BLOCKING, Cause, GridForecast, LiveChain
from tacpipe.tasks.forward.prediction import check_steps, prediction_table

if TYPE_CHECKING:
    import pyarrow as pa


def predict(
    model: Model,
    recordings: Dataset,
    steps: Sequence[int],
    quantiles: Sequence[int] = (),
    *,
    allow_look_ahead: bool = False,
) -> Result:
    """Return one table of causal forecasts per recording, in the form of `tasks.forward.prediction.predict`.

    Attributes count the grid points without a forecast, by cause. Raises `TacpipeError` if a step is beyond the
    horizon, the model does not have these ``quantiles`` (percent), or a recording's streams are not those that the
    model reads.
    """
    forecaster = Forecaster.load(model.files)
    forecaster.quantile_places(quantiles)
    outputs: dict[str, RecordingOutput] = {}
    notes, unplanned, row_count = [], 0, 0
    with terminal.progress_bar("predict", len(recordings.recordings)) as advance:
        for name, recording in sorted(recordings.recordings.items()):
            try:
                outputs[name], causes = _predict_recording(
                    forecaster, model, recording, steps, quantiles, allow_look_ahead=allow_look_ahead
                )
            except TacpipeError as error:
                raise type(error)(f"{name}: {error}") from error
            if not outputs[name].streams[""].num_rows:
                notes.append(f"{name}: no forecast could be made at any grid point ({_describe_causes(causes)}).")
            unplanned += causes[Cause.NO_PLAN]
            row_count += outputs[name].streams[""].num_rows
            advance(note=name)
    if unplanned:
        notes.append(
            f"{unplanned} of {row_count} forecasts are without a plan (there is no stream {PLAN!r} in the recording by "
            f"then): the hand was assumed to move on as it did."
        )
    return Result(outputs, notes=notes)


def _predict_recording(
    forecaster: Forecaster,
    model: Model,
    recording: Recording,
    steps: Sequence[int],
    quantiles: Sequence[int],
    *,
    allow_look_ahead: bool,
) -> tuple[RecordingOutput, Counter[Cause]]:
    """Return the predictions of a recording, and how many grid points have each cause of a missing forecast.

    Raises `TacpipeError` for a step beyond the horizon, or streams that the model does not read.
    """
    tables = extracted_streams(recording, model.source.chain, streams_as_recorded(recording))
    chain = build_chain(forecaster, model.source.chain, recording, tables, quantiles, allow_look_ahead=allow_look_ahead)
    check_steps(steps, chain.horizon)
    forecasts = list(iterate_forecasts(chain, tables))
    causes = Counter[Cause]()
    for forecast in forecasts:
        causes.update(forecast.cause)
    table = forecast_table(forecaster, forecasts, steps, quantiles)
    described = {f"forecast_{_name(cause)}": causes[cause] for cause in sorted(causes, key=lambda cause: cause.value)}
    return RecordingOutput(table, {"causal": True, "level_at_rest": chain.rest_rows, **described}), causes


def forecast_table(
    forecaster: Forecaster, forecasts: Sequence[GridForecast], steps: Sequence[int], quantiles: Sequence[int]
) -> pa.Table:
    """Return the forecasts with values in the form of `tasks.forward.prediction.predict`."""
    step_indices = [step - 1 for step in steps]
    valued = [forecast for forecast in forecasts if forecast.count is not None]
    shape = len(steps), len(forecaster.codec.channels)
    counts = np.array([forecast.count[step_indices] for forecast in valued if forecast.count is not None], np.float32)
    nothing = np.zeros((*shape, 0), np.float32)
    bands = [nothing if forecast.quantiles is None else forecast.quantiles[step_indices] for forecast in valued]
    stacked = np.stack(bands) if bands else np.zeros((0, *shape, len(quantiles)), np.float32)
    return prediction_table(
        forecaster,
        np.array([forecast.t_ns for forecast in valued], np.int64),
        counts.reshape(-1, *shape).transpose(1, 2, 0).copy(),
        steps,
        dict(zip(quantiles, stacked.transpose(3, 1, 2, 0).copy(), strict=True)),
    )


def build_chain(
    forecaster: Forecaster,
    steps: Sequence[Step],
    recording: Recording,
    tables: Mapping[str, pa.Table],
    quantiles: Sequence[int] = (),
    *,
    allow_look_ahead: bool = False,
) -> LiveChain:
    """Return the chain of a model for the streams ``tables`` of a recording.

    The master stream and the source of plans are in the recording's attributes. The rest is as in
    `LiveChain.for_model`.
    """
    schemas = {name: table.schema for name, table in tables.items()}
    plan = str(recording.attributes.get("live_plan", ""))
    stream = plan.removeprefix("rig:") if plan.startswith("rig:") else ""
    return LiveChain.for_model(
        forecaster,
        steps,
        schemas,
        str(recording.attributes.get("master", "")),
        plan_from=stream if stream in schemas else "",
        quantiles=quantiles,
        allow_look_ahead=allow_look_ahead,
        arrivals=arrival_streams(recording, tables),
    )


def iterate_forecasts(chain: LiveChain, tables: Mapping[str, pa.Table]) -> Iterator[GridForecast]:
    """Yield the forecasts of a recording up to the master's last sample.

    Samples are passed to ``chain`` in chunks, in the order of arrival.
    """
    read = {name: tables[name] for name in chain.streams if name in tables}
    for until_ns, pieces in pieces_by_arrival(read, chain.master):
        for name, piece in pieces.items():
            chain.push(name, piece)
        yield from chain.advance(until_ns)


def _describe_causes(causes: Mapping[Cause, int]) -> str:
    """Return the causes of missing forecasts and their numbers in words."""
    counted = [f"{count} {_name(cause)}" for cause, count in causes.items() if cause & BLOCKING]
    return ", ".join(counted) or "there is none"


def _name(cause: Cause) -> str:
    return str(cause.name).lower()
