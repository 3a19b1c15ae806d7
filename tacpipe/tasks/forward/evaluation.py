"""Evaluate a forecaster and its quantiles against baselines: metrics, tables and predictions."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Float32s, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.io import Json, terminal
from tacpipe.io.parquet import to_parquet
from tacpipe.io.spill import Gathered, Spill
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.scores import calibration, headline, table
from tacpipe.scores.calibration import COVERAGE_FILE, Sums
from tacpipe.scores.table import Question
from tacpipe.tasks.forward import metrics, rest_shift, situations, tracks
from tacpipe.tasks.forward.forecaster import CONFIG, Forecaster
from tacpipe.tasks.forward.headline import (
    BASELINE,
    MODEL,
    PARTS,
    TASK,
    headline_steps,
    look_ahead_notes,
    unit_of_model,
)
from tacpipe.tasks.forward.metrics import ERRORS_FILE, ErrorSums, Groups, Trial
from tacpipe.tasks.forward.predictors import WindowForecast, iterate_predictions
from tacpipe.tasks.forward.quantiles import CHUNK, ForecastQuantiles
from tacpipe.tasks.forward.situations import BySituation
from tacpipe.tasks.forward.tracks import Track
from tacpipe.tasks.forward.training import HISTORY, check_codec

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

UNCONDITIONAL = "model_unconditional"  # the model's forecast with constant error quantiles from calibration recordings
EXAMPLES = "bands.json"
SHOWN = 2  # number of recordings whose forecast is drawn with its band
MAX_ROWS = 600  # maximum number of drawn rows per recording
STEP = 10  # step that is drawn, or the last one if the model predicts fewer


@dataclass
class QuantileSums:
    """Sums of each predictor's quantiles by recording, and forecasts to draw; empty if the model has no quantiles."""

    forecaster: Forecaster
    sums: dict[str, dict[str, Sums]] = field(default_factory=dict)  # sums by predictor, by recording
    drawn: dict[str, _Drawn] = field(default_factory=dict)  # by recording

    def add(self, track: Track, trial: Trial, forecast: WindowForecast) -> None:
        """Add some windows of a recording; nothing if the model has no quantiles."""
        forecaster = self.forecaster
        uncertainty = forecaster.quantiles
        if uncertainty is None:
            return
        if trial.name not in self.sums and not trial.seen and len(self.drawn) < SHOWN:
            self.drawn[trial.name] = _Drawn(forecaster, track)
        sums = self.sums.setdefault(trial.name, {})
        for first in range(0, len(forecast.count), CHUNK):
            part = slice(first, first + CHUNK)
            truth = track.tactile[forecast.future[part]]
            for name, quantiles_ahead in _predict_quantiles(forecaster, uncertainty, track, forecast, part):
                flat = quantiles_ahead.transpose(0, 2, 1, 3).reshape(-1, truth.shape[1], len(uncertainty.percents))
                true = truth.transpose(0, 2, 1).reshape(-1, truth.shape[1])
                part_sums = Sums.from_predictions(true, flat, uncertainty.errors.levels)
                sums[name] = sums[name] + part_sums if name in sums else part_sums
                if name == MODEL and trial.name in self.drawn:
                    self.drawn[trial.name].add(forecast.now[part], truth, quantiles_ahead)

    def summary(self, trials: Sequence[Trial]) -> Json:
        """Return the part ``quantiles`` of ``metrics.json``: the quantile measures of each predictor.

        They are of recordings that the model has not seen, followed by those of the parts of `metrics.divide`. Empty if
        the model has no quantiles.
        """
        uncertainty = self.forecaster.quantiles
        if uncertainty is None:
            return {}
        fresh, parts = metrics.divide([trial for trial in trials if trial.name in self.sums])
        measures = {name: self._measures(part, uncertainty.percents) for name, part in parts.items() if part}
        unseen = self._measures(fresh, uncertainty.percents) if fresh else {}
        return {**self.forecaster.config["quantiles"], **unseen, **measures}

    def _measures(self, trials: Sequence[Trial], percents: tuple[int, ...]) -> dict[str, dict[str, dict[str, float]]]:
        """Return the measures of each predictor by step, with intervals over recordings, or unseen objects."""
        # sums by predictor, by unit of the interval (recording, or unseen object)
        sums_by_unit: dict[str, dict[str, Sums]] = {}
        for trial in trials:
            sums = self.sums[trial.name]
            unit = trial.name if trial.known else str(trial.object)
            if unit in sums_by_unit:
                sums = {name: sums_by_unit[unit][name] + added for name, added in sums.items()}
            sums_by_unit[unit] = sums
        unit_sums = list(sums_by_unit.values())
        persistence = [sums[BASELINE] for sums in unit_sums]
        return {
            name: calibration.measures_by_step([sums[name] for sums in unit_sums], percents, persistence)
            for name in unit_sums[0]
        }

    def files(self, trials: Sequence[Trial]) -> dict[str, bytes]:
        """Return ``coverage.parquet``, the sums by recording, predictor and step, and ``bands.json``, forecasts to draw.

        Empty if the model has no quantiles.
        """
        uncertainty = self.forecaster.quantiles
        if uncertainty is None:
            return {}
        rows = []
        for trial in trials:
            about = {name: getattr(trial, name) for name in ("object", "known", "seen")}
            for predictor, sums in self.sums.get(trial.name, {}).items():
                for index, values in enumerate(sums.values):
                    row = {
                        "recording": trial.name,
                        **about,
                        "predictor": predictor,
                        "step": index + 1,
                        "values": values,
                    }
                    row |= {
                        "covered": sums.covered[index],
                        "width": sums.width[index],
                        "pinball": sums.pinball[index].mean(),
                    }
                    rows.append(row)
        examples = [drawn.example(uncertainty.percents) for drawn in self.drawn.values()]
        drawn_bytes = (json.dumps(examples) + "\n").encode()
        return {COVERAGE_FILE: to_parquet(pa.Table.from_pylist(rows, _COLUMNS)), EXAMPLES: drawn_bytes}


_COLUMNS = pa.schema(
    {
        **{"recording": pa.string(), "object": pa.string(), "known": pa.bool_(), "seen": pa.bool_()},
        **{"predictor": pa.string(), "step": pa.int32(), "values": pa.float64()},
        **dict.fromkeys(("covered", "width", "pinball"), pa.float64()),
    }
)


def model_quantiles(forecaster: Forecaster, track: Track, forecast: WindowForecast, part: slice) -> Float32s:
    """Return the model's quantiles (window, step, channel, level) for some windows of a forecast.

    The model must have quantiles.
    """
    windows = type(forecast.windows)(*(tensor[:, part] for tensor in forecast.windows))
    return forecaster.forecast_quantiles(windows, track.tactile[forecast.past[part]], forecast.count[part])


def _predict_quantiles(
    forecaster: Forecaster, uncertainty: ForecastQuantiles, track: Track, forecast: WindowForecast, part: slice
) -> Iterator[tuple[str, AnyFloats]]:
    """Yield the quantiles (window, step, channel, level) of each predictor."""
    yield MODEL, model_quantiles(forecaster, track, forecast, part)
    yield UNCONDITIONAL, forecast.count[part][..., None] + uncertainty.unconditional.transpose(2, 1, 0)
    last = track.tactile[forecast.now[part]]
    yield BASELINE, last[:, None, :, None] + uncertainty.persistence.transpose(2, 1, 0)


class _Drawn:
    """The forecast of a recording's most active channel, with its band."""

    def __init__(self, forecaster: Forecaster, track: Track) -> None:
        """Draw the channel of ``track`` whose signal varies most, `STEP` steps ahead or at the model's last step."""
        self._step = min(STEP, forecaster.horizon)
        self._channel = int(np.argmax(tracks.variances(track))) if track.usable.any() else 0
        self._about = {"recording": track.name, "channel": forecaster.codec.channels[self._channel], "step": self._step}
        self._t_ns, self._rows = track.t_ns, list[tuple[Any, ...]]()

    def add(self, now: Int64s, truth: AnyFloats, predicted: AnyFloats) -> None:
        """Add the values of some windows, up to `MAX_ROWS`."""
        now = now[: MAX_ROWS - len(self._rows)]
        at = (slice(len(now)), self._step - 1, self._channel)
        self._rows += zip(self._t_ns[now + self._step] / 1e9, truth[at], *predicted[at].T, strict=True)

    def example(self, percents: Sequence[int]) -> dict[str, str | int | list[float]]:
        """Return recording, channel and step, and the curves: time in s, measured values, and each quantile."""
        columns = np.array(self._rows).T
        names = ("t_s", "measured", *(f"q{percent}" for percent in percents))
        return {
            **self._about,
            **{name: np.round(values, 4).tolist() for name, values in zip(names, columns, strict=True)},
        }


KEPT_BYTES = 1 << 24  # size of predictions in memory; larger ones are written to disk
STORED_STEPS = (1, 3, 5, 10)  # steps whose predictions are stored; the paper's figures show 3, 5 and 10


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return metrics, tables and predictions of a model, given as files, and of its baselines on ``recordings``.

    Every window without a gap counts, in contact or not. Errors in counts are relative to the tactile channels,
    including the codec's loss. Recordings used for training or early stopping are recognized by their digests and
    reported separately, as are known and other objects. Raises `TacpipeError` if the model cannot read the recordings.
    """
    forecaster = Forecaster.load(model)
    check_codec(model, recordings.files)
    levels, shifts = forecaster.config.get("rest_levels"), {}
    seen_digests, objects = set(forecaster.config["trained_on"].values()), set(forecaster.config["objects"])
    trials, outputs = [], {}
    bands = QuantileSums(forecaster)
    by_situation, spill = BySituation(forecaster.horizon, len(forecaster.codec.channels)), Spill(KEPT_BYTES)
    with terminal.progress_bar("evaluate", len(recordings.recordings)) as advance:
        for name, shard in sorted(recordings.recordings.items()):
            track = forecaster.track(shard)
            check_rate(track, forecaster)
            trial = Trial(
                name, shard.digest in seen_digests, track.object, track.object is None or track.object in objects
            )
            attributes = {**shard.attributes, "seen": trial.seen}
            rows = _predictions(forecaster, track, trial, by_situation, bands, spill)
            outputs[name] = RecordingOutput(rows, attributes)
            trials.append(trial)
            shift = levels and rest_shift.measure_shift(rest_shift.rest_level(shard, forecaster.codec.channels), levels)
            if shift and not trial.seen:
                shifts[name] = shift
            del track
            advance(note=name)
    rows_of_errors = metrics.error_rows(trials, Groups.from_model(forecaster))
    further = {"situations": by_situation.summary(), "quantiles": bands.summary(trials), "rest_shift": shifts}
    measured = metrics.summary(trials, rows_of_errors, forecaster.horizon)
    measured |= {name: values for name, values in further.items() if values}
    method = f"{forecaster.config['architecture']} · {forecaster.config['codec']['name']}"
    errors = ErrorSums.from_rows(rows_of_errors[~rows_of_errors["seen"].astype(bool)])
    steps, unit = headline_steps(range(1, forecaster.horizon + 1)), unit_of_model(forecaster.config)
    tables = {Question(PARTS[known_objects]): own for known_objects, own in errors.tables(steps, unit).items()}
    files = {
        headline.FILE: headline.write(table.headlines(TASK, method, tables)),
        "metrics.json": model_files.to_json(measured),
        "horizons.csv": metrics.horizons_csv(errors, forecaster.config["rate_hz"]),
        "trials.csv": metrics.trials_csv(trials, len(forecaster.channel_scale)),
        ERRORS_FILE: metrics.errors_parquet(rows_of_errors),
        **bands.files(trials),
        **{name: model[name] for name in (CONFIG, HISTORY, codecs.DESCRIPTION) if name in model},
    }
    if shifts:
        terminal.report_progress(rest_shift.describe_shifts(shifts))
    unseen = [recordings.recordings[trial.name] for trial in trials if not trial.seen]
    notes = rest_shift.shift_notes(shifts, unseen, forecaster.config.get("sessions", []))
    return Result(outputs, files, [*look_ahead_notes(forecaster.config), *notes])


def _predictions(
    forecaster: Forecaster,
    track: Track,
    trial: Trial,
    by_situation: BySituation,
    bands: QuantileSums,
    spill: Spill,
) -> pa.Table | pa.RecordBatchReader:
    """Return the predictions for all windows of a recording, spilled to ``spill``; adds its errors to ``trial``.

    Adds its quantiles to ``bands`` and, if the model has not seen the recording, its errors by situation to
    ``by_situation``. Only some windows, and of each one predictor, are in memory at a time.
    """
    starts = track.starts(forecaster.context, forecaster.horizon)
    track.count_rows(starts, forecaster.context + forecaster.horizon)
    groups, steps = Groups.from_model(forecaster), [step for step in STORED_STEPS if step <= forecaster.horizon]
    no_windows = np.zeros((len(steps), len(forecaster.codec.latents), 0), np.float32)
    gathered = Gathered(spill, _prediction_table(forecaster, track, starts[:0], steps, no_windows))
    for windows in iterate_predictions(forecaster, track, starts):
        now = windows.forecast.now
        trial.windows += len(now)
        doing = situations.window_situations(track, now, forecaster.horizon)
        if not trial.seen:
            by_situation.count(trial.name, doing)
        truth = windows.truth
        for name, prediction in windows.each_prediction():
            trial.add_errors(name, prediction, truth, groups)
            if not trial.seen:
                by_situation.add(trial.name, doing, name, prediction, truth)
        bands.add(track, trial, windows.forecast)
        stored = windows.forecast.features[:, [step - 1 for step in steps]].transpose(1, 2, 0).astype(np.float32)
        gathered.add(_prediction_table(forecaster, track, now, steps, np.ascontiguousarray(stored)))
        del windows, truth, stored  # frees the memory for the next windows
    return gathered.rows()


def _prediction_table(
    forecaster: Forecaster, track: Track, now: Int64s, steps: Sequence[int], stored: Float32s
) -> pa.Table:
    """Return one row per window: the time when its prediction is available, present features, predicted features.

    ``now`` (window,) are the last input rows; ``stored`` (step, feature, window) becomes the columns without a copy.
    """
    columns = [track.t_ns[now], track.contact[now].astype(np.int32)]
    latent = track.latent[now]
    fields = [
        pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"}),
        pa.field("contact", pa.int32(), metadata={"quantity": "label"}),
    ]
    for index, name in enumerate(forecaster.codec.latents):
        columns += [latent[:, index], *stored[:, index]]
        for step in (0, *steps):
            about = {"quantity": "latent", "step": str(step)}
            fields.append(pa.field(f"{name}_t{step}" if step else name, pa.float32(), metadata=about))
    arrays = [pa.array(values, field.type) for values, field in zip(columns, fields, strict=True)]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def check_rate(track: Track, forecaster: Forecaster) -> None:
    """Raise `TacpipeError` if a track's grid is not the one that the model was trained on."""
    trained, rate_hz = forecaster.config["timeline"], float(forecaster.config["rate_hz"])
    required_option = f"--rate-hz {rate_hz:g}" if trained == "uniform" else f"--grid {trained}"
    if track.timeline != trained:
        raise TacpipeError(
            f"{track.name} has a {track.timeline} grid and the model was trained on a {trained} one, so a step is "
            f"another time. Synchronize it with {required_option}."
        )
    track_rate_hz = tracks.rate_hz([track]) if trained == "uniform" else 0.0
    if track_rate_hz and rate_hz and abs(track_rate_hz - rate_hz) > 0.01 * rate_hz:
        raise TacpipeError(
            f"{track.name} has {track_rate_hz:g} rows a second and the model was trained at {rate_hz:g}. "
            f"Synchronize it with {required_option}."
        )
