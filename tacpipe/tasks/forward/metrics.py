"""Sums of several predictors' errors on the same windows, and the metrics and tables of scores that are made of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Int64s
from tacpipe.datasets.model_files import to_csv
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import from_parquet, to_parquet
from tacpipe.scores import intervals, regression
from tacpipe.scores.intervals import Interval
from tacpipe.scores.table import ScoreTable
from tacpipe.tasks.forward import headline as headlines
from tacpipe.tasks.forward.headline import BASELINE, MODEL

if TYPE_CHECKING:  # the first imports torch
    import pandas as pd

    from tacpipe.tasks.forward.forecaster import Forecaster
    from tacpipe.tasks.forward.predictors import Prediction

ERRORS_FILE = "errors.parquet"
ALL_CHANNELS, STANDARD, FEATURE, LATENT = "both", "standard", "feature", "latent"  # groups; others are of some channels
SCALED = (STANDARD, FEATURE, LATENT)  # groups whose errors are not in counts
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


@dataclass(frozen=True)
class Groups:
    """The groups of channels, and the scales of channels and features, in which errors are summed."""

    masks: Mapping[str, Bools]  # mask (channel,) by name of the channel group
    channel_scale: AnyFloats  # (channel,), each channel's standard deviation in training
    feature_half: AnyFloats  # (feature,), the divisor in the paper's scaling

    @classmethod
    def from_model(cls, forecaster: Forecaster) -> Groups:
        """Return the groups of a model's channels."""
        return cls(channel_groups(forecaster.codec.layout), forecaster.channel_scale, forecaster.feature_half)

    def width(self, group: str) -> int:
        """Return the number of channels or features of a group."""
        if group in self.masks:
            return int(self.masks[group].sum())
        return len(self.channel_scale if group == STANDARD else self.feature_half)

    def error_sums(self, predicted: Prediction, truth: Prediction) -> dict[str, AnyFloats]:
        """Return the sums of squared and of absolute errors (2, step) by group.

        Errors of channel groups are in counts. The group ``standard`` is all channels in units of their standard deviation
        in training; ``feature`` and ``latent`` are the features of the representation with and without the paper's scaling,
        without absolute errors (NaN).
        """
        both = np.stack([
            regression.squared_error_sums(predicted.count, truth.count),
            regression.absolute_error_sums(predicted.count, truth.count),
        ])  # (2, step, channel)  # fmt: skip
        sums = {group: both[:, :, mask].sum(axis=2) for group, mask in self.masks.items()}
        sums[STANDARD] = (both / np.stack([self.channel_scale**2, self.channel_scale])[:, None]).sum(axis=2)
        if predicted.latent is not None and truth.latent is not None:
            latent = regression.squared_error_sums(predicted.latent, truth.latent)
            for group, squared in ((FEATURE, latent / self.feature_half**2), (LATENT, latent)):
                sums[group] = np.stack([squared.sum(axis=1), np.full(len(squared), np.nan)])
        return sums


@dataclass
class Trial:
    """Errors on one recording by predictor and group; empty if the recording contains no window."""

    name: str
    seen: bool  # whether the model was trained or validated on the recording
    object: str | None = None
    known: bool = True  # whether the model was trained on the same object; also True if the object is not labelled
    windows: int = 0
    errors: dict[tuple[str, str], AnyFloats] = field(default_factory=dict)  # `Groups.error_sums`

    def add_errors(self, name: str, predicted: Prediction, truth: Prediction, groups: Groups) -> None:
        """Add one predictor's errors on some windows. Does not change the number of windows."""
        for group, sums in groups.error_sums(predicted, truth).items():
            self.errors[name, group] = self.errors.get((name, group), 0.0) + sums


@dataclass(frozen=True)
class ErrorSums:
    """Sums of errors over windows and channels by recording, of which metrics, tables of scores and reports are made."""

    recordings: tuple[str, ...]
    steps: tuple[int, ...]
    known: Bools  # (recording,): whether other recordings of its object were used for training
    windows: Int64s  # (recording,): number of windows
    objects: Mapping[str, str]  # recording -> its object, if it has one
    named: bool  # True if any recording has an object; otherwise there are neither known nor unseen objects
    channels: Mapping[str, int]  # group -> number of channels
    # (predictor, group) -> squared and absolute sums (2, recording, step); without predictors that lack the group
    sums: Mapping[tuple[str, str], AnyFloats]

    @classmethod
    def from_rows(cls, rows: pd.DataFrame) -> ErrorSums:
        """Return the sums in rows of `error_rows`.

        Raises `TacpipeError` if a column is missing, or predictors were evaluated on different windows.
        """
        missing = [name for name in _COLUMNS.names if name not in rows and name != "object"]
        if missing:
            raise TacpipeError(f"{ERRORS_FILE} has no column {' and no '.join(missing)}. Evaluate the model again.")
        first_rows = rows.drop_duplicates("recording").set_index("recording")
        uneven = rows[rows["windows"] != rows["recording"].map(first_rows["windows"])]
        if len(uneven):
            raise TacpipeError(
                f"In {ERRORS_FILE}, predictors were evaluated on different windows of {uneven['recording'].iloc[0]}, so "
                f"they cannot be compared. Evaluate the model again."
            )
        steps = sorted(rows["step"].unique().tolist())
        sums = {}
        for (predictor, group), part in rows.groupby(["predictor", "group"], sort=False):
            both = np.stack([
                part.pivot(index="recording", columns="step", values=name)
                .reindex(first_rows.index, columns=steps)
                .to_numpy(np.float64)
                for name in ("squared", "absolute")
            ])  # fmt: skip
            if not np.isnan(both[0]).any():
                sums[str(predictor), str(group)] = both
        objects = dict(first_rows["object"].dropna()) if "object" in first_rows else {}
        return cls(
            tuple(first_rows.index),
            tuple(steps),
            first_rows["known"].to_numpy(bool),
            first_rows["windows"].to_numpy(np.int64),
            objects,
            bool(len(objects)) or "object" not in rows or not len(rows),
            dict(zip(rows["group"], rows["channels"].astype(int), strict=True)),
            sums,
        )

    @classmethod
    def from_parquet(cls, content: bytes) -> ErrorSums:
        """Return the sums in a Parquet file with the bytes ``content``, without those of training recordings.

        Raises as `from_rows`.
        """
        rows = from_parquet(content).to_pandas()
        return cls.from_rows(rows[~rows["seen"]] if "seen" in rows else rows)

    @property
    def predictors(self) -> tuple[str, ...]:
        """The predictors with errors."""
        return tuple(dict.fromkeys(predictor for predictor, _ in self.sums))

    def means(self, predictor: str, group: str) -> AnyFloats:
        """Return the mean squared and absolute errors (2, step) over all windows and channels of a group."""
        means: AnyFloats = self.sums[predictor, group].sum(axis=1) / (int(self.windows.sum()) * self.channels[group])
        return means

    def by_recording(
        self, predictor: str, steps: Sequence[int], known_objects: bool | None = None, group: str = ALL_CHANNELS
    ) -> dict[str, AnyFloats]:
        """Return the `headline.sums` of a predictor by recording, or an empty dict if it has no errors for ``group``.

        Recordings without windows, or whose object is not ``known_objects``, are left out.
        """
        if not {(predictor, group), (BASELINE, group)} <= set(self.sums):
            return {}
        at = [self.steps.index(step) for step in steps]
        own, persistence = (self.sums[name, group][:, :, at] for name in (predictor, BASELINE))
        return {
            name: headlines.sums(
                own[:, index], persistence[:, index], float(self.windows[index]) * self.channels[group]
            )
            for index, name in enumerate(self.recordings)
            if self.windows[index] and known_objects in (None, bool(self.known[index]))
        }

    def clusters(self, known_objects: bool | None) -> dict[str, str] | None:
        """Return the object of each recording, the cluster for unseen objects; None for other recordings."""
        if known_objects is not False or not self.objects:
            return None
        return {name: self.objects.get(name, name) for name in self.recordings}

    def tables(self, steps: Sequence[int], unit: str) -> dict[bool | None, ScoreTable]:
        """Return the tables of scores of recordings of known and of unseen objects, or of all if no object is labelled."""
        tables = {}
        for known_objects in (True, False) if self.named else (None,):
            sums = {name: self.by_recording(name, steps, known_objects) for name in self.predictors}
            if any(sums.values()):
                present = {name: by_recording for name, by_recording in sums.items() if by_recording}
                tables[known_objects] = headlines.score_table(steps, present, unit, self.clusters(known_objects))
        return tables


def error_rows(trials: Sequence[Trial], groups: Groups) -> pd.DataFrame:
    """Return the error sums of recordings: a row per recording, predictor, group and step (`Groups.error_sums`).

    The columns are those of ``errors.parquet``.
    """
    import pandas as pd

    rows = [
        (trial.name, trial.object, trial.known, trial.seen,
         predictor, group, step, trial.windows, groups.width(group), *sums)
        for trial in trials
        for (predictor, group), both in trial.errors.items()
        for step, sums in enumerate(both.T, 1)
    ]  # fmt: skip
    return pd.DataFrame.from_records(rows, columns=_COLUMNS.names)


def channel_groups(layout: Sequence[Mapping[str, str]]) -> dict[str, Bools]:
    """Return masks (channel,) of all channels, each sensor (``sensor1``, ``sensor2``, … in column order) and each axis."""
    groups = {ALL_CHANNELS: np.ones(len(layout), dtype=bool)}
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


def summary(trials: Sequence[Trial], rows: pd.DataFrame, horizon: int) -> dict[str, Any]:
    """Return ``metrics.json``: scores on recordings that the model has not seen, and those of the parts of `divide`.

    ``rows`` are those of `error_rows`. Parts without recordings are left out.
    """
    fresh, parts = divide(trials)
    by_part = {name: _scores(part, rows, horizon) for name, part in parts.items() if part}
    return {**_scores(fresh, rows, horizon), **by_part}


def horizons_csv(errors: ErrorSums, rate_hz: float) -> bytes:
    """Return a CSV file of errors by predictor and step."""
    rows = [
        (name, step, round(1000 * step / rate_hz, 3) if rate_hz else "", *map(_round, means))
        for name in errors.predictors
        for step, *means in zip(
            errors.steps, *errors.means(name, ALL_CHANNELS), errors.means(name, STANDARD)[0], strict=True
        )
    ]
    return to_csv(("predictor", "step", "horizon_ms", "mse_counts", "mae_counts", "mse_standard"), rows)


def errors_parquet(rows: pd.DataFrame) -> bytes:
    """Return the rows of `error_rows` as a Parquet file, so that results can be pooled by recording."""
    rounded = rows.assign(**{name: rows[name].map(_round) for name in ("squared", "absolute")})
    return to_parquet(pa.Table.from_pandas(rounded, _COLUMNS, preserve_index=False).replace_schema_metadata())


def trials_csv(trials: Sequence[Trial], width: int) -> bytes:
    """Return a CSV file with a line per recording: windows, mean absolute errors in counts, and skill.

    ``width`` is the number of channels.
    """
    rows = []
    for trial in trials:
        errors: list[float | str] = ["", "", ""]
        if trial.windows:
            model, baseline = (float(trial.errors[name, ALL_CHANNELS][1].mean()) / width for name in (MODEL, BASELINE))
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
    return to_csv(
        ("recording", "object", "known", "seen", "windows", "mae_counts_model", "mae_counts_persistence", "skill"), rows
    )


def _scores(trials: Sequence[Trial], rows: pd.DataFrame, horizon: int) -> dict[str, Any]:
    """Return the errors of each predictor, the model's skill, and counts, over the recordings that contain windows."""
    evaluated = {item.name: item for item in trials if item.windows}
    windows = sum(item.windows for item in evaluated.values())
    counts = {
        "windows": windows,
        "recordings": len(evaluated),
        "recordings_without_window": len(trials) - len(evaluated),
        "effective_windows": windows // horizon,  # number of windows with non-overlapping horizons
    }
    if not evaluated:
        return {"counts": counts}
    errors = ErrorSums.from_rows(rows[rows["recording"].isin(evaluated)])
    predictors: dict[str, Any] = {}
    for name in errors.predictors:
        means = {group: errors.means(name, group) for group in errors.channels if (name, group) in errors.sums}
        of_channels = {group: both for group, both in means.items() if group not in SCALED}
        predictors[name] = {
            "mse_counts": {group: by_step(squared) for group, (squared, _) in of_channels.items()},
            "mae_counts": {group: by_step(absolute) for group, (_, absolute) in of_channels.items()},
            "mse_standard": by_step(means[STANDARD][0]),
        }
        if LATENT in means:
            predictors[name] |= {"mse_latent": by_step(means[LATENT][0]), "mse_feature": by_step(means[FEATURE][0])}
    units = np.array([item.name if item.known else item.object for item in evaluated.values()])
    skill = {}
    for measure, group, part, interval in (
        ("mse_counts", ALL_CHANNELS, 0, intervals.skill_interval),
        ("mae_counts", ALL_CHANNELS, 1, intervals.skill_interval),
        ("mse_feature", FEATURE, 0, intervals.skill_interval),
        (headlines.GEOMETRIC, ALL_CHANNELS, 1, intervals.geometric_skill_interval),
    ):
        model, baseline = (errors.sums[name, group][part] for name in (MODEL, BASELINE))
        skill[measure] = skill_by_step(interval, model, baseline, units)
    return {"counts": counts, **predictors, "skill": skill}


def by_step(errors: AnyFloats) -> dict[str, float]:
    """Return errors (step,) by the names of their steps, and their mean."""
    return {f"t{step}": _round(value) for step, value in enumerate(errors, 1)} | {"mean": _round(errors.mean())}


def skill_by_step(
    interval: Callable[..., Interval], model: AnyFloats, baseline: AnyFloats, clusters: AnyArray | None = None
) -> dict[str, dict[str, float]]:
    """Return skill with intervals over clusters by step and over all steps, from sums (recording, step).

    ``interval`` is a function of `tacpipe.scores.intervals`, and ``clusters`` (recording,) are the units that are
    resampled, by default recordings. Undefined values are omitted.
    """
    with_total = [np.hstack([sums, sums.sum(axis=1, keepdims=True)]) for sums in (model, baseline)]
    skill = interval(*with_total, clusters)
    names = [f"t{step}" for step in range(1, len(skill.mean))] + ["mean"]
    tree = {}
    for index, name in enumerate(names):
        ends = {part: float(getattr(skill, part)[index]) for part in ("mean", "low", "high")}
        tree[name] = {part: _round(value) for part, value in ends.items() if math.isfinite(value)}
    return {name: ends for name, ends in tree.items() if ends}


def _round(value: float) -> float:
    """Round ``value`` to 9 digits, because further digits differ between machines."""
    return float(f"{value:.9g}")
