"""Metrics and tables of several predictors' errors on the same windows."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Int64s
from tacpipe.io.parquet import to_parquet
from tacpipe.scores import intervals, regression
from tacpipe.scores.intervals import Interval
from tacpipe.scores.table import Question, ScoreTable
from tacpipe.tasks.forward import headline as headlines
from tacpipe.tasks.forward.headline import (
    BASELINE,
    COUNTS,
    MODEL,
    ForwardScores,
    IntervalsByStep,
    PredictorScores,
    WindowCounts,
)

if TYPE_CHECKING:  # this module imports torch
    from tacpipe.tasks.forward.predictors import Prediction

Masks = Mapping[str, Bools]  # mask (channel,) by name of the channel group

_COLUMNS = pa.schema(
    {
        "recording": pa.string(),
        "object": pa.string(),
        "known": pa.bool_(),
        "seen": pa.bool_(),
        "predictor": pa.string(),
        "group": pa.string(),
        "step": pa.int32(),
        "windows": pa.int64(),
        "channels": pa.int32(),
        "squared": pa.float64(),
        "absolute": pa.float64(),
    }
)


@dataclass
class ForecastErrorSums:
    """Sums of one predictor's errors over a recording's windows, each (step, feature) or (step, channel)."""

    latent_squared: AnyFloats | None
    feature_squared: AnyFloats | None
    count_squared: AnyFloats
    count_absolute: AnyFloats

    @classmethod
    def from_predictions(cls, predicted: Prediction, truth: Prediction, feature_half: AnyFloats) -> ForecastErrorSums:
        """Compute the errors of ``predicted``; ``feature_half`` (feature,) is the divisor in the paper's scaling."""
        latent = feature = None
        if predicted.latent is not None and truth.latent is not None:
            latent = regression.squared_error_sums(predicted.latent, truth.latent)
            feature = latent / feature_half**2
        return cls(
            latent,
            feature,
            regression.squared_error_sums(predicted.count, truth.count),
            regression.absolute_error_sums(predicted.count, truth.count),
        )

    def __add__(self, further: ForecastErrorSums) -> ForecastErrorSums:
        """Return the summed errors over the windows of both."""

        def summed(name: str) -> Any:
            first, second = getattr(self, name), getattr(further, name)
            return None if first is None else first + second

        return ForecastErrorSums(*(summed(name) for name in self.__dataclass_fields__))


@dataclass
class Trial:
    """Errors on one recording by predictor; empty if the recording contains no window."""

    name: str
    seen: bool  # whether the model was trained or validated on the recording
    object: str | None = None
    known: bool = True  # whether the model was trained on the same object; also True if the object is not labelled
    windows: int = 0
    errors: dict[str, ForecastErrorSums] = field(default_factory=dict)

    def add_errors(self, name: str, predicted: Prediction, truth: Prediction, feature_half: AnyFloats) -> None:
        """Add one predictor's errors on some windows. Does not change the number of windows."""
        errors = ForecastErrorSums.from_predictions(predicted, truth, feature_half)
        self.errors[name] = self.errors[name] + errors if name in self.errors else errors


def channel_groups(layout: Sequence[Mapping[str, str]]) -> dict[str, Bools]:
    """Return masks (channel,) of all channels, each sensor (``sensor1``, ``sensor2``, … in column order) and each axis."""
    groups = {"both": np.ones(len(layout), dtype=bool)}
    streams = list(dict.fromkeys(channel["stream"] for channel in layout if "stream" in channel))
    for number, stream in enumerate(streams, 1):
        groups[f"sensor{number}"] = np.array([channel.get("stream") == stream for channel in layout])
    for axis in sorted({channel["axis"] for channel in layout if "axis" in channel}):
        groups[axis] = np.array([channel.get("axis") == axis for channel in layout])
    return groups


def divide(trials: Sequence[Trial]) -> tuple[list[Trial], dict[str, list[Trial]]]:
    """Return the recordings that the model has not seen, and the parts ``known``, ``unseen`` and ``seen`` of all.

    Without recordings of both known and new objects, the only part is ``seen``.
    """
    fresh = [trial for trial in trials if not trial.seen]
    by_object = {
        "known": [trial for trial in fresh if trial.known],
        "unseen": [trial for trial in fresh if not trial.known],
    }
    return fresh, {**(by_object if all(by_object.values()) else {}), "seen": [trial for trial in trials if trial.seen]}


def summary(
    trials: Sequence[Trial], groups: Masks, horizon: int, channel_scale: AnyFloats
) -> tuple[ForwardScores, dict[str, ForwardScores]]:
    """Return the scores of all predictors on recordings that the model has not seen, and those of the parts of `divide`.

    ``channel_scale`` (channel,) is each channel's standard deviation in training. Parts without recordings are left out.
    """
    fresh, parts = divide(trials)
    by_part = {name: _scores(part, groups, horizon, channel_scale) for name, part in parts.items() if part}
    return _scores(fresh, groups, horizon, channel_scale), by_part


def score_tables(trials: Sequence[Trial], horizon: int, unit: str = COUNTS) -> dict[Question, ScoreTable]:
    """Return the tables of scores of recordings that the model has not seen, of known and of unseen objects.

    Recordings without labelled objects are in one table.
    """
    fresh = [trial for trial in trials if not trial.seen and trial.windows]
    steps = headlines.headline_steps(range(1, horizon + 1))
    step_indices = [step - 1 for step in steps]

    def errors_of(trial: Trial, predictor: str) -> tuple[AnyFloats, AnyFloats]:
        sums = trial.errors[predictor]
        return sums.count_squared.sum(axis=1)[step_indices], sums.count_absolute.sum(axis=1)[step_indices]

    def sums_by_recording(predictor: str, part_trials: Sequence[Trial]) -> dict[str, AnyFloats]:
        sums = {}
        for trial in part_trials:
            values = trial.windows * trial.errors[predictor].count_squared.shape[1]
            sums[trial.name] = headlines.sums(errors_of(trial, predictor), errors_of(trial, BASELINE), values)
        return sums

    has_objects = any(trial.object is not None for trial in fresh)
    tables = {}
    for part in (True, False) if has_objects else (None,):
        part_trials = [trial for trial in fresh if part is None or trial.known == part]
        sums = {name: sums_by_recording(name, part_trials) for name in (part_trials[0].errors if part_trials else ())}
        objects = {trial.name: str(trial.object) for trial in part_trials} if part is False else None
        tables[Question(headlines.PARTS[part])] = headlines.score_table(steps, sums, unit, objects)
    return tables


def horizons_csv(scores_by_predictor: Mapping[str, PredictorScores], rate_hz: float) -> bytes:
    """Return a CSV file of errors by predictor and step."""
    rows = [
        (
            name,
            step,
            round(1000 * step / rate_hz, 3) if rate_hz else "",
            scores["mse_counts"]["both"][f"t{step}"],
            scores["mae_counts"]["both"][f"t{step}"],
            scores["mse_standard"][f"t{step}"],
        )
        for name, scores in scores_by_predictor.items()
        for step in range(1, len(scores["mse_standard"]))
    ]
    return _csv(("predictor", "step", "horizon_ms", "mse_counts", "mae_counts", "mse_standard"), rows)


def errors_parquet(trials: Sequence[Trial], groups: Masks, channel_scale: AnyFloats) -> bytes:
    """Return the error sums as a Parquet table, so that results can be pooled by recording.

    There is one row per recording, predictor, channel group and step, with the ``squared`` and ``absolute`` error sums and
    the numbers of ``windows`` and ``channels`` that they were summed over. Errors of channel groups are in counts. The
    group ``standard`` is all channels in units of their standard deviation in training; ``feature`` and ``latent`` are the
    features of the representation with and without the paper's scaling.
    """
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS.names}
    for trial in trials:
        for predictor, errors in trial.errors.items():
            for group, squared, absolute, channels in _pool_groups(errors, groups, channel_scale):
                steps = len(squared)
                row = (trial.name, trial.object, trial.known, trial.seen, predictor, group)
                for name, value in zip(columns, row, strict=False):
                    columns[name] += [value] * steps
                columns["step"] += range(1, steps + 1)
                columns["windows"] += [trial.windows] * steps
                columns["channels"] += [channels] * steps
                columns["squared"] += [_round(value) for value in squared]
                columns["absolute"] += [None if value is None else _round(value) for value in absolute]
    return to_parquet(pa.table(columns, schema=_COLUMNS))


def _pool_groups(
    errors: ForecastErrorSums, groups: Masks, channel_scale: AnyFloats
) -> Iterator[tuple[str, Any, Any, int]]:
    """Yield each group's name, sums of squared and absolute errors (step,) and number of channels."""
    for group, mask in groups.items():
        yield (
            group,
            errors.count_squared[:, mask].sum(axis=1),
            errors.count_absolute[:, mask].sum(axis=1),
            int(mask.sum()),
        )
    squared, absolute = errors.count_squared / channel_scale**2, errors.count_absolute / channel_scale
    yield "standard", squared.sum(axis=1), absolute.sum(axis=1), len(channel_scale)
    for group, sums in (("feature", errors.feature_squared), ("latent", errors.latent_squared)):
        if sums is not None:
            yield group, sums.sum(axis=1), [None] * len(sums), sums.shape[1]


def trials_csv(trials: Sequence[Trial]) -> bytes:
    """Return a CSV file with a line per recording: windows, mean absolute errors in counts, and skill."""
    rows = []
    for trial in trials:
        errors: list[float | str] = ["", "", ""]
        if trial.windows:
            model, baseline = (float(trial.errors[name].count_absolute.mean()) for name in (MODEL, BASELINE))
            gain = float(intervals.skill(np.array([model]), np.array([baseline]))[0])
            values = (model / trial.windows, baseline / trial.windows, gain)
            errors = [_round(value) if math.isfinite(value) else "" for value in values]
        rows.append(
            (
                trial.name,
                trial.object or "",
                *(str(flag).lower() for flag in (trial.known, trial.seen)),
                trial.windows,
                *errors,
            )
        )
    return _csv(
        ("recording", "object", "known", "seen", "windows", "mae_counts_model", "mae_counts_persistence", "skill"), rows
    )


def _scores(trials: Sequence[Trial], groups: Masks, horizon: int, channel_scale: AnyFloats) -> ForwardScores:
    """Return the errors of each predictor, the model's skill, and counts, over the recordings that contain windows."""
    evaluated = [item for item in trials if item.windows]
    windows = np.array([item.windows for item in evaluated], dtype=np.int64)
    counts: WindowCounts = {
        "windows": int(windows.sum()),
        "recordings": len(evaluated),
        "recordings_without_window": len(trials) - len(evaluated),
        "effective_windows": int(windows.sum()) // horizon,
    }
    if not evaluated:
        return ForwardScores(counts, {}, {})
    predictors: dict[str, PredictorScores] = {}
    for name in evaluated[0].errors:
        errors = [item.errors[name] for item in evaluated]
        squared = np.stack([item.count_squared for item in errors])  # (recording, step, channel)
        predictors[name] = {
            "mse_counts": _group_errors(squared, windows, groups),
            "mae_counts": _group_errors(np.stack([item.count_absolute for item in errors]), windows, groups),
            "mse_standard": _steps(squared / channel_scale**2, windows),
        }
        latent = [item.latent_squared for item in errors if item.latent_squared is not None]
        if latent:
            predictors[name]["mse_latent"] = _steps(np.stack(latent), windows)
        feature = [item.feature_squared for item in errors if item.feature_squared is not None]
        if feature:
            predictors[name]["mse_feature"] = _steps(np.stack(feature), windows)
    units = np.array([trial.name if trial.known else trial.object for trial in evaluated])
    skill = {
        measure: skill_by_step(
            interval,
            _error_sums_by_step(evaluated, MODEL, attribute),
            _error_sums_by_step(evaluated, BASELINE, attribute),
            units,
        )
        for measure, attribute, interval in (
            ("mse_counts", "count_squared", intervals.skill_interval),
            ("mae_counts", "count_absolute", intervals.skill_interval),
            ("mse_feature", "feature_squared", intervals.skill_interval),
            (headlines.GEOMETRIC, "count_absolute", intervals.geometric_skill_interval),
        )
    }
    return ForwardScores(counts, predictors, skill)


def _steps(sums: AnyFloats, windows: Int64s) -> dict[str, float]:
    """Return the mean error by step and over all steps; ``sums`` is (recording, step, channel)."""
    return by_step(regression.mean_error(sums, windows))


def by_step(errors: AnyFloats) -> dict[str, float]:
    """Return errors (step,) by the names of their steps, and their mean."""
    return {f"t{step}": _round(value) for step, value in enumerate(errors, 1)} | {"mean": _round(errors.mean())}


def _group_errors(sums: AnyFloats, windows: Int64s, groups: Masks) -> dict[str, dict[str, float]]:
    """Return the mean error by channel group and step."""
    return {name: _steps(sums[:, :, mask], windows) for name, mask in groups.items()}


def _error_sums_by_step(trials: Sequence[Trial], predictor: str, attribute: str) -> AnyFloats:
    """Return the error sums in an attribute of a predictor's errors over all channels, shape (recording, step)."""
    return np.stack([getattr(trial.errors[predictor], attribute).sum(axis=1) for trial in trials])


def skill_by_step(
    interval: Callable[..., Interval], model: AnyFloats, baseline: AnyFloats, clusters: AnyArray | None = None
) -> IntervalsByStep:
    """Return skill with intervals over clusters by step and over all steps, from sums (recording, step).

    ``interval`` is a function of `tacpipe.scores.intervals`, and ``clusters`` (recording,) are the units that are
    resampled, by default recordings. Undefined values are omitted.
    """
    with_total = [np.hstack([sums, sums.sum(axis=1, keepdims=True)]) for sums in (model, baseline)]
    skill = interval(*with_total, clusters)
    names = [f"t{step}" for step in range(1, len(skill.mean))] + ["mean"]
    tree: IntervalsByStep = {}
    for index, name in enumerate(names):
        ends = {part: float(getattr(skill, part)[index]) for part in ("mean", "low", "high")}
        tree[name] = {part: _round(value) for part, value in ends.items() if math.isfinite(value)}
    return {name: ends for name, ends in tree.items() if ends}


def _round(value: float) -> float:
    """Round ``value`` to 9 digits, because further digits differ between machines."""
    return float(f"{value:.9g}")


def _csv(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    """Return the content of a CSV file with ``header``."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
