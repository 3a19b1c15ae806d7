"""Evaluate recordings of live sessions: compare the published forecasts with those of the offline chain and model.

`evaluate` returns the result of `tacpipe evaluate` on the recordings after the model's own stages, and adds what the
session recorded: errors of the published forecasts, latencies, and whether `tacpipe predict --causal` reproduces the
published values bit for bit.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Float32s, Int64s, Times
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.errors import TacpipeError
from tacpipe.live.stages import (
    RecordingsInMemory,
    extracted_streams,
    require_sessions,
    run_stages,
    streams_as_recorded,
)
from tacpipe.plugins.stage import Result
from tacpipe.scores import headline, table
from tacpipe.scores.table import Question
from tacpipe.tasks.forward import evaluation
from tacpipe.tasks.forward import headline as headlines
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.headline import LiveMetrics
from tacpipe.tasks.forward.live import measures, replay
from tacpipe.tasks.forward.live.chain import GridForecast, LiveChain
from tacpipe.tasks.forward.live.measures import LIVE, LIVE_STILL, OFFLINE, STILL, Session, Sums, summed
from tacpipe.tasks.forward.live.messages import FORECAST
from tacpipe.tasks.forward.predictors import forecasts
from tacpipe.tasks.forward.tracks import Levels, Track


class _Offline(NamedTuple):
    """Predictions of a recording by the offline model."""

    now: Int64s  # (window,), rows of the track
    ahead: AnyFloats  # (window, horizon, channel), above rest


def evaluate(model: Model, recordings: Dataset) -> Result:
    """Evaluate recordings of live sessions.

    Raises `UsageError` if one has no stream ``forecast``, or its session ran another model. Errors of a recording begin
    with its name.
    """
    require_sessions(model.digest, recordings, FORECAST)
    forecaster = Forecaster.load(model.files)
    steps = headlines.headline_steps(range(1, forecaster.horizon + 1))
    offline = {}
    sessions: dict[str, Session] = {}
    for name, recording in sorted(recordings.recordings.items()):
        try:
            offline[name] = run_stages(recording, model)
            sessions[name] = _session(forecaster, model, recording, offline[name], steps)
        except TacpipeError as error:
            raise type(error)(f"{name}: {error}") from error
    unstored: Any = RecordingsInMemory(offline, model.files)
    result = evaluation.evaluate(model.files, unstored)
    channels = len(forecaster.codec.channels)
    live: LiveMetrics = {
        **summed(list(sessions.values()), steps, channels),
        "recordings": {name: summed([session], steps, channels) for name, session in sessions.items()},
    }
    offline_metrics = json.loads(result.files["metrics.json"])
    headlines_offline = headline.read(result.files[headline.FILE])
    added = _headline(forecaster, sessions, steps, channels)
    files = {
        **result.files,
        "metrics.json": model_files.to_json({**offline_metrics, "live": live}),
        "live.csv": measures.table(live, steps),
        headline.FILE: headline.write([*headlines_offline, *added]),
    }
    return dataclasses.replace(result, files=files, notes=[*result.notes, *measures.sentences(live)])


def _session(
    forecaster: Forecaster, model: Model, recording: Recording, offline: Any, steps: tuple[int, ...]
) -> Session:
    """Compare the forecasts that a session published with those of the offline chain and model.

    ``offline`` is the recording after the model's stages; errors are summed for ``steps``.
    """
    tables = extracted_streams(recording, model.source.chain, streams_as_recorded(recording))
    levels = () if forecaster.quantiles is None else forecaster.quantiles.percents
    session = Published.from_stream(tables[FORECAST], forecaster.codec.channels, levels)
    chain = replay.build_chain(forecaster, model.source.chain, recording, tables, session.levels, allow_look_ahead=True)
    forecasts = list(replay.iterate_forecasts(chain, tables))
    with_values = [forecast for forecast in forecasts if forecast.count is not None]
    offline_ns = np.array([forecast.t_ns for forecast in with_values], np.int64)
    share_equal, equal = measures.equality(
        session.t_ns, session.values_and_quantiles(), offline_ns, session.matching_rows(with_values)
    )
    latency = tables["latency"]
    track = forecaster.track(offline)
    predicted = _offline(forecaster, track)
    rows, sums = _errors(forecaster, chain, forecasts, session, track, predicted, steps)
    late = latency.column("late").to_numpy()
    lateness_ns = times(latency)[np.flatnonzero(np.diff(late, prepend=0) > 0)]
    return Session(
        share_equal,
        _after(session.t_ns[~equal & np.isin(session.t_ns, offline_ns)], lateness_ns, forecaster),
        rows,
        sums,
        latency.column("latency_ms").to_numpy().astype(np.float64),
        int(latency.column("skipped").to_numpy().max(initial=0)),
        int(late.max(initial=0)),
    )


def _offline(forecaster: Forecaster, track: Track) -> _Offline:
    """Return the offline forecasts of a track: the last input row of each window, and the predicted counts."""
    starts = track.starts(forecaster.context, forecaster.horizon)
    batches = list(forecasts(forecaster, track, starts))
    if not batches:
        empty = np.zeros((0, forecaster.horizon, len(forecaster.codec.channels)))
        return _Offline(np.zeros(0, np.int64), empty)
    return _Offline(
        np.concatenate([batch.now for batch in batches]), np.concatenate([batch.count for batch in batches])
    )


def _errors(
    forecaster: Forecaster,
    chain: LiveChain,
    recomputed: Sequence[GridForecast],
    session: Published,
    track: Track,
    predicted: _Offline,
    steps: tuple[int, ...],
) -> tuple[int, Sums]:
    """Return the number of rows for which all predictors have values, and each predictor's sums of errors over them."""
    row_ns, values = session.t_ns, session.values
    if not set(steps) <= set(session.steps) or chain.rest is None or not len(predicted.now):
        return 0, {}
    uniform = forecaster.config["timeline"] == "uniform"
    period_ns = 1e9 / float(forecaster.config["rate_hz"])
    newest = {forecast.t_ns: forecast.now for forecast in recomputed if forecast.now is not None}
    grid_ns = np.array(sorted(newest), np.int64)
    counts = track.tactile.stored if isinstance(track.tactile, Levels) else np.asarray(track.tactile)
    target_ns = measures.targets(grid_ns, row_ns, steps, period_ns if uniform else None)
    flat = measures.interpolate(track.t_ns, counts.astype(np.float64), track.groups, track.usable, target_ns.ravel())
    ahead = flat.reshape(len(row_ns), len(steps), -1)  # (row, step, channel)
    now_ns = track.t_ns[predicted.now]
    nearest = np.clip(np.searchsorted(now_ns, row_ns - round(period_ns / 2)), 0, len(now_ns) - 1)
    usable = np.isfinite(ahead).all(axis=(1, 2)) & (np.abs(now_ns[nearest] - row_ns) <= period_ns / 2)
    usable &= np.isin(row_ns, grid_ns)
    if not usable.any():
        return 0, {}
    offline_rest = counts[0] - track.tactile[0]
    step_indices = [session.steps.index(step) for step in steps]
    persistence = np.stack([newest[at_ns] for at_ns in row_ns[usable].tolist()])[:, None] + chain.rest
    windows = nearest[usable]
    later = counts[predicted.now[windows][:, None] + np.array(steps)].astype(np.float64)
    now = counts[predicted.now[windows]].astype(np.float64)[:, None]
    errors = {
        LIVE: measures.sums(values[usable][:, step_indices] + chain.rest, ahead[usable]),
        LIVE_STILL: measures.sums(persistence, ahead[usable]),
        OFFLINE: measures.sums(predicted.ahead[windows][:, [step - 1 for step in steps]] + offline_rest, later),
        STILL: measures.sums(now, later),
    }
    return int(usable.sum()), errors


def _after(differing_ns: Times, late_ns: Times, forecaster: Forecaster) -> int:
    """Count the rows that differ within a context after, or one row before, samples that arrived too late."""
    period_ns = 1e9 / float(forecaster.config["rate_hz"])
    reach_ns = (forecaster.context + 1) * period_ns
    if not len(late_ns):
        return 0
    place = np.searchsorted(late_ns, differing_ns + 1.5 * period_ns, side="right") - 1
    return int(((place >= 0) & (differing_ns - late_ns[np.maximum(place, 0)] <= reach_ns)).sum())


def _headline(
    forecaster: Forecaster, sessions: Mapping[str, Session], steps: tuple[int, ...], channels: int
) -> list[Any]:
    """Return the comparison of the published forecasts with persistence on the same rows; empty without such rows."""
    compared = {name: session for name, session in sessions.items() if session.rows}
    if not compared:
        return []

    def sums(name: str) -> Any:
        return {
            recording: headlines.sums(session.sums[name], session.sums[LIVE_STILL], session.rows * channels)
            for recording, session in compared.items()
        }

    method = f"{forecaster.config['architecture']} · {forecaster.config['codec']['name']} · published live"
    by_predictor = {headlines.MODEL: sums(LIVE), headlines.BASELINE: sums(LIVE_STILL)}
    compared_live = headlines.score_table(steps, by_predictor, headlines.unit_of_model(forecaster.config))
    return table.headlines(headlines.TASK, method, {Question(): compared_live})


@dataclass(frozen=True)
class Published:
    """The forecasts of a session, and the quantiles that it published with them."""

    t_ns: Times  # (row,), of the grid points
    steps: tuple[int, ...]
    values: Float32s  # (row, step, channel)
    levels: tuple[int, ...]  # levels of the quantiles in percent; empty if none were published
    quantiles: Float32s  # (row, level x step, channel)

    @classmethod
    def from_stream(cls, forecast: Any, channels: Sequence[str], trained_levels: Sequence[int] = ()) -> Published:
        """Return the forecasts in a stream (an arrow table) of ``channels``, and the quantiles of ``trained_levels``."""
        ends = {name.rpartition("_t")[2] for name in forecast.column_names if name.rpartition("_t")[0] in channels}
        steps = sorted({int(end.partition("_q")[0]) for end in ends})
        levels = [level for level in trained_levels if any(end.endswith(f"_q{level}") for end in ends)]

        def stack_columns(endings: Sequence[str]) -> Float32s:
            stacked = np.empty((forecast.num_rows, len(endings), len(channels)), np.float32)
            for index, ending in enumerate(endings):
                for channel, name in enumerate(channels):
                    stacked[:, index, channel] = forecast.column(f"{name}_{ending}").to_numpy()
            return stacked

        values = stack_columns([f"t{step}" for step in steps])
        quantiles = stack_columns([f"t{step}_q{level}" for level, step in itertools.product(levels, steps)])
        return cls(times(forecast), tuple(steps), values, tuple(levels), quantiles)

    def values_and_quantiles(self) -> Float32s:
        """Return values and quantiles (row, step + level x step, channel)."""
        return np.concatenate([self.values, self.quantiles], axis=1)

    def matching_rows(self, forecasts: Sequence[GridForecast]) -> Float32s:
        """Return the rows of `values_and_quantiles` for ``forecasts``, which must all have values and these quantiles."""
        places = [step - 1 for step in self.steps]
        rows: list[Float32s] = []
        for forecast in forecasts:
            assert forecast.count is not None
            levels: list[Float32s] = []
            if forecast.quantiles is not None:
                levels = list(forecast.quantiles[places].transpose(2, 0, 1))
            rows.append(np.concatenate([forecast.count[places], *levels]))
        return np.stack(rows) if rows else self.values_and_quantiles()[:0]


def times(stream: Any) -> Times:
    """Return the times (row,) of the rows that a stream of a session describes."""
    t_ns: Times = stream.column("t_device_ns").to_numpy()
    return t_ns
