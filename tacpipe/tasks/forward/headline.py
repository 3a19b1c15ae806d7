"""Compare forecasters with their baselines in a headline, in the unit of the tactile channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NotRequired, Self, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.io import Json
from tacpipe.metrics import intervals, pairing
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.pairing import Measure, Sums

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.tasks.forward.alarms import AlarmScore
    from tacpipe.tasks.forward.params import ForwardConfig, QuantileDescription
    from tacpipe.tasks.forward.situations import SituationMeasures
    from tacpipe.tasks.forward.slips import LeadSums, SlipScore

COUNT, COUNTS = "count", "counts"  # the unit in columns and in texts
MIXED = "own units"  # unit of channels, or of models, that differ


def unit_of_channels(schema: pa.Schema, channels: Sequence[str]) -> str:
    """Return the unit of tactile columns, `MIXED` where they have several."""
    units = {(schema.field(name).metadata or {}).get(b"unit", b"").decode() or COUNT for name in channels}
    return units.pop() if len(units) == 1 else MIXED


def unit_of_model(config: ForwardConfig) -> str:
    """Return the unit in a model's configuration, as texts have it; one without is in counts.

    >>> unit_of_model({"inputs": {}}), unit_of_model({"inputs": {"unit": "kPa"}})
    ('counts', 'kPa')
    """
    return str(config.get("inputs", {}).get("unit", COUNTS))


def common_unit(configs: Iterable[ForwardConfig]) -> str:
    """Return the unit that models have in common, `MIXED` where they differ."""
    units = {unit_of_model(config) for config in configs} or {COUNTS}
    return units.pop() if len(units) == 1 else MIXED


TASK, MODEL, BASELINE = "forward", "model", "persistence"
STEPS = (1, 3, 5, 10)  # those shown, as far as a model predicts them
Errors = tuple[AnyFloats, AnyFloats]  # sums of squared and of absolute errors of a recording, each (step,)
GEOMETRIC = "mae_counts_geometric"  # the skill of ``metrics.json`` that is not pooled
RECORDINGS, OBJECTS = "recordings", "objects"  # units of the interval
PARTS = {True: "known objects", False: "unseen objects", None: ""}


def legitimate(predictor: str) -> bool:
    """Return whether a predictor is a baseline: neither the model's own, nor one that goes through its codec.

    >>> [legitimate(name) for name in ("ridge", "persistence", "model_anchored", "codec", "codec_persistence")]
    [True, True, False, False, False]
    """
    return not predictor.startswith((MODEL, "codec"))


def shown(steps: Sequence[int]) -> tuple[int, ...]:
    """Return those of a model's steps that a headline is about.

    >>> shown(range(1, 11)), shown((1, 2, 3)), shown((2, 4))
    ((1, 3, 5, 10), (1, 3), (4,))
    """
    return tuple(step for step in STEPS if step in steps) or (max(steps),)


def look_ahead_notes(config: ForwardConfig) -> list[str]:
    """Return how far the rows that a model was trained on look ahead, or nothing if they do not."""
    ahead = config.get("look_ahead")
    if not ahead or not ahead["max_ms"]:
        return []
    return [
        f"The rows of the training recordings look ahead by {ahead['mean_ms']:g} ms on average and at most "
        f"{ahead['max_ms']:g} ms, so errors are smaller than a live session's. Synchronize without --values interpolate for "
        f"models to act on."
    ]


IntervalsByStep = dict[str, dict[str, float]]  # mean, low and high of a value by step
QuantileMeasures = dict[str, dict[str, float]]  # by measure and step


class WindowCounts(TypedDict):
    """Windows and recordings that errors are about."""

    windows: int
    recordings: int
    recordings_without_window: int
    effective_windows: int  # number that fits without overlap of their horizons


class PredictorScores(TypedDict):
    """Mean errors of a predictor by step, ``t1`` …, and over all steps, ``mean``."""

    mse_counts: dict[str, dict[str, float]]  # by group of channels
    mae_counts: dict[str, dict[str, float]]
    mse_standard: dict[str, float]  # in units of each channel's spread in training
    mse_latent: NotRequired[dict[str, float]]
    mse_feature: NotRequired[dict[str, float]]  # latents scaled to ±1


class LiveRows(TypedDict):
    """Published forecasts of live sessions next to those that ``predict --causal`` gives."""

    published: int
    recomputed: int
    compared: int
    equal: int
    differ_after_late_samples: int
    largest_difference: float
    late_samples: int
    skipped: int
    of_errors: int


class LiveMeasures(TypedDict):
    """Measures of recorded live sessions."""

    rows: LiveRows
    mae: dict[str, dict[str, float]]  # by predictor and step
    latency: dict[str, float]
    alarms: dict[str, dict[str, LeadSums]]  # by alarm and event, and predictor


class LiveMetrics(LiveMeasures):
    """Measures of all recorded live sessions and of each."""

    recordings: dict[str, LiveMeasures]


@dataclass(frozen=True)
class ForwardScores:
    """Errors and skill on some recordings."""

    counts: WindowCounts
    predictors: dict[str, PredictorScores]  # empty if no recording has a window
    skill: dict[str, IntervalsByStep]  # of the model over persistence, by measure

    @classmethod
    def from_json(cls, stored: Json) -> Self:
        """Return the scores in ``metrics.json`` or in one of its parts."""
        scored = {name: value for name, value in stored.items() if name != "skill" and "mse_counts" in value}
        return cls(stored["counts"], scored, stored.get("skill", {}))

    def to_json(self) -> Json:
        """Return what `from_json` reads."""
        return {"counts": self.counts, **self.predictors, **({"skill": self.skill} if self.skill else {})}


@dataclass(frozen=True)
class QuantileMetrics:
    """Measures of a calibrated model's quantiles."""

    description: QuantileDescription
    fresh: dict[str, QuantileMeasures]  # of recordings that the model has not seen, by predictor
    parts: dict[str, dict[str, QuantileMeasures]]

    @classmethod
    def from_json(cls, stored: Json) -> Self:
        """Return what `to_json` wrote."""
        parts = {name: stored[name] for name in METRIC_PARTS if name in stored}
        described = ("levels", "method", "recordings", "most_promised")
        fresh = {name: value for name, value in stored.items() if name not in (*parts, *described)}
        description: QuantileDescription = {
            "levels": stored["levels"],
            "method": stored["method"],
            "recordings": stored["recordings"],
            "most_promised": stored["most_promised"],
        }
        return cls(description, fresh, parts)

    def to_json(self) -> Json:
        """Return the part ``quantiles`` of ``metrics.json``."""
        return {**self.description, **self.fresh, **self.parts}


METRIC_PARTS = ("known", "unseen", "seen")  # of known and of unseen objects, and recordings that the model has seen


@dataclass(frozen=True)
class ForwardMetrics:
    """``metrics.json`` of a result on forecasts."""

    fresh: ForwardScores  # of recordings that the model has not seen
    parts: dict[str, ForwardScores]  # those of `METRIC_PARTS` that hold recordings
    anticipation: dict[str, AlarmScore] = field(default_factory=dict)  # by predictor
    slips: dict[str, SlipScore] = field(default_factory=dict)  # by predictor
    situations: dict[str, SituationMeasures] = field(default_factory=dict)
    quantiles: QuantileMetrics | None = None
    live: LiveMetrics | None = None

    @classmethod
    def from_json(cls, stored: Json) -> Self:
        """Return the metrics that `to_json` wrote."""
        return cls(
            ForwardScores.from_json(stored),
            {name: ForwardScores.from_json(stored[name]) for name in METRIC_PARTS if name in stored},
            stored.get("anticipation", {}),
            stored.get("slips", {}),
            stored.get("situations", {}),
            QuantileMetrics.from_json(stored["quantiles"]) if "quantiles" in stored else None,
            stored.get("live"),
        )

    def to_json(self) -> Json:
        """Return the content of ``metrics.json``; what was not measured is left out."""
        optional = {
            "anticipation": self.anticipation,
            "slips": self.slips,
            "situations": self.situations,
            "quantiles": self.quantiles and self.quantiles.to_json(),
            "live": self.live,
        }
        parts = {name: scores.to_json() for name, scores in self.parts.items()}
        return {**self.fresh.to_json(), **parts, **{name: value for name, value in optional.items() if value}}


@dataclass(frozen=True)
class Parts:
    """The sums over recordings, each (..., step), and the number of values."""

    squared: AnyFloats
    still_squared: AnyFloats  # errors of persistence
    absolute: AnyFloats
    logs: AnyFloats  # logarithms of the ratio to persistence's absolute error, summed over recordings
    counted: AnyFloats  # recordings on which persistence errs
    values: AnyFloats  # (...): windows times channels

    @classmethod
    def of_sums(cls, sums: AnyFloats) -> Parts:
        """Return the parts of `sums` (..., part)."""
        steps = (sums.shape[-1] - 1) // 5
        squared, persistence, absolute, logs, counted = (sums[..., at * steps : (at + 1) * steps] for at in range(5))
        return cls(squared, persistence, absolute, logs, counted, sums[..., -1])

    @property
    def skill(self) -> AnyFloats:
        """1 - the geometric mean over recordings of the ratio to persistence's absolute error, (..., step)."""
        return np.where(self.counted > 0, -np.expm1(self.logs / np.maximum(self.counted, 1)) + 0.0, np.nan)

    @property
    def mean_skill(self) -> AnyFloats:
        """`skill` with the geometric mean over steps too, (...)."""
        counted = self.counted.sum(axis=-1)
        return np.where(counted > 0, -np.expm1(self.logs.sum(axis=-1) / np.maximum(counted, 1)) + 0.0, np.nan)

    @property
    def squared_skill(self) -> AnyFloats:
        """1 - squared error / squared error of persistence, both pooled over recordings, mean over steps, (...)."""
        ratio = intervals.skill(self.squared, self.still_squared)
        errs = ~np.isnan(ratio)
        mean = np.where(errs, ratio, 0).sum(axis=-1) / np.maximum(errs.sum(axis=-1), 1)
        return np.where(errs.any(axis=-1), mean, np.nan)


def sums(errors: Errors, persistence: Errors, values: float) -> AnyFloats:
    """Return what adds up over recordings (`Parts`), from the errors of a recording at the shown steps.

    ``values`` is how many values each was summed over: windows times channels.
    """
    (squared, absolute), (still_squared, still_absolute) = errors, persistence
    logs, counted = intervals.log_ratios(absolute, still_absolute)
    return np.concatenate([squared, still_squared, absolute, logs, counted, [values]])


def headline(
    method: str,
    steps: Sequence[int],
    model: Sums,
    baselines: Mapping[str, Sums],
    part: bool | None,
    runs: int = 1,
    unit: str = COUNTS,
    objects: Mapping[str, str] | None = None,
) -> Headline | None:
    """Return how a method compares with its baselines on known objects, unseen ones or all; `sums` by seed and recording.

    ``unit`` is that of the mean absolute errors. The interval is over ``objects``, by recording, where these are given.
    """
    compared = {name: sums_of_baseline for name, sums_of_baseline in baselines.items() if legitimate(name)}
    cluster = OBJECTS if objects else RECORDINGS
    return pairing.headline(
        TASK, method, measure(steps, unit, cluster), model, compared, part=PARTS[part], clusters=objects, runs=runs
    )


def measure(steps: Sequence[int], unit: str = COUNTS, cluster: str = RECORDINGS) -> Measure:
    """Return how `sums` at some steps become errors; ``unit`` is that of the mean absolute ones."""
    ahead = [f"t+{step}" for step in steps]

    def error(sums: AnyFloats) -> AnyFloats:
        return 1 - Parts.of_sums(sums).mean_skill

    def values(sums: AnyFloats) -> tuple[float, ...]:
        parts = Parts.of_sums(sums)
        mae = parts.absolute / parts.values if parts.values else np.full(len(steps), np.nan)
        return (*map(float, mae), float(parts.squared_skill), float(parts.mean_skill))

    # a column of its own for what ranks: errors by step alone do not rank predictors
    over = " and ".join(filter(None, (", ".join(ahead[:-1]), ahead[-1])))
    return Measure(
        (*(f"MAE {step}" for step in ahead), "squared vs persistence", "vs persistence"),
        unit,
        f"the mean absolute error as a fraction of persistence's, the geometric mean over recordings and over {over} "
        f"(1 less that: vs persistence; squared: 1 less the ratio of squared errors that are pooled over recordings)",
        "skill",
        cluster,
        error,
        intervals.skill,
        values,
        lambda errors: 1 - errors,
        "skill over persistence",
        rises=True,
        weight=lambda draws: Parts.of_sums(draws).counted.sum(axis=1),
        reference=BASELINE,
    )
