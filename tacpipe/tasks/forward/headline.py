"""Summarize how forecasters compare with their baselines, in the unit of the tactile channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.scores import intervals
from tacpipe.scores.pairing import Measure
from tacpipe.scores.table import ScoreTable

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.tasks.forward.params import ForwardConfig

COUNT, COUNTS = "count", "counts"  # unit in column names and in text
MIXED = "own units"  # unit if channels or models differ


def unit_of_channels(schema: pa.Schema, channels: Sequence[str]) -> str:
    """Return the unit of tactile columns, or `MIXED` if they have several units."""
    units = {(schema.field(name).metadata or {}).get(b"unit", b"").decode() or COUNT for name in channels}
    return units.pop() if len(units) == 1 else MIXED


def unit_of_model(config: ForwardConfig) -> str:
    """Return the unit in a model's configuration, in the form used in text; counts if the configuration has no unit.

    >>> unit_of_model({"inputs": {}}), unit_of_model({"inputs": {"unit": "kPa"}})
    ('counts', 'kPa')
    """
    return str(config.get("inputs", {}).get("unit", COUNTS))


def common_unit(configs: Iterable[ForwardConfig]) -> str:
    """Return the common unit of the models, or `MIXED` if their units differ."""
    units = {unit_of_model(config) for config in configs} or {COUNTS}
    return units.pop() if len(units) == 1 else MIXED


TASK, MODEL, BASELINE = "forward", "model", "persistence"
STEPS = (1, 3, 5, 10)  # displayed steps, if the model predicts them
Errors = AnyFloats | tuple[AnyFloats, AnyFloats]  # sums of a recording's squared and absolute errors, each (step,)
GEOMETRIC = "mae_counts_geometric"  # skill in ``metrics.json`` that is not pooled over recordings
RECORDINGS, OBJECTS = "recordings", "objects"  # resampling units of the confidence interval
PARTS = {True: "known objects", False: "unseen objects", None: ""}


def is_baseline(predictor: str) -> bool:
    """Return whether a predictor is a baseline, i.e. neither a variant of the model nor a predictor that uses its codec.

    >>> [is_baseline(name) for name in ("ridge", "persistence", "model_anchored", "codec", "codec_persistence")]
    [True, True, False, False, False]
    """
    return not predictor.startswith((MODEL, "codec"))


def headline_steps(steps: Sequence[int]) -> tuple[int, ...]:
    """Return the steps of a model that a headline includes.

    >>> headline_steps(range(1, 11)), headline_steps((1, 2, 3)), headline_steps((2, 4))
    ((1, 3, 5, 10), (1, 3), (4,))
    """
    return tuple(step for step in STEPS if step in steps) or (max(steps),)


def look_ahead_notes(config: ForwardConfig) -> list[str]:
    """Return notes on how far the model's training rows look ahead; an empty list if they do not."""
    ahead = config.get("look_ahead")
    if not ahead or not ahead["max_ms"]:
        return []
    return [
        f"The rows of the training recordings look ahead by {ahead['mean_ms']:g} ms on average and at most "
        f"{ahead['max_ms']:g} ms, so errors are smaller than a live session's. Synchronize without --values interpolate for "
        f"models to act on."
    ]


@dataclass(frozen=True)
class Parts:
    """Sums over recordings, each (..., step), and the number of values."""

    squared: AnyFloats
    still_squared: AnyFloats  # squared errors of persistence
    absolute: AnyFloats
    logs: AnyFloats  # log ratio of the model's to persistence's absolute error, summed over recordings
    counted: AnyFloats  # number of recordings in which persistence has an error
    values: AnyFloats  # (...), number of windows times number of channels

    @classmethod
    def from_sums(cls, sums: AnyFloats) -> Parts:
        """Create the parts from the output of `sums` (..., part)."""
        steps = (sums.shape[-1] - 1) // 5
        squared, persistence, absolute, logs, counted = (sums[..., at * steps : (at + 1) * steps] for at in range(5))
        return cls(squared, persistence, absolute, logs, counted, sums[..., -1])

    @property
    def skill(self) -> AnyFloats:
        """1 minus the geometric mean over recordings of the absolute error relative to persistence's (..., step)."""
        return np.where(self.counted > 0, -np.expm1(self.logs / np.maximum(self.counted, 1)) + 0.0, np.nan)

    @property
    def mean_skill(self) -> AnyFloats:
        """`skill` with the geometric mean over both recordings and steps (...)."""
        counted = self.counted.sum(axis=-1)
        return np.where(counted > 0, -np.expm1(self.logs.sum(axis=-1) / np.maximum(counted, 1)) + 0.0, np.nan)

    @property
    def squared_skill(self) -> AnyFloats:
        """Mean over steps (...) of 1 minus the ratio of squared errors, both pooled over recordings, to persistence."""
        ratio = intervals.skill(self.squared, self.still_squared)
        has_errors = ~np.isnan(ratio)
        mean = np.where(has_errors, ratio, 0).sum(axis=-1) / np.maximum(has_errors.sum(axis=-1), 1)
        return np.where(has_errors.any(axis=-1), mean, np.nan)


def sums(errors: Errors, persistence: Errors, values: float) -> AnyFloats:
    """Return the additive parts (`Parts`) of one recording's errors at the displayed steps.

    ``values`` is the number of summed values, i.e. windows times channels.
    """
    (squared, absolute), (still_squared, still_absolute) = errors, persistence
    logs, counted = intervals.weighted_log_ratios(absolute, still_absolute)
    return np.concatenate([squared, still_squared, absolute, logs, counted, [values]])


def score_table(
    steps: Sequence[int],
    sums_by_predictor: Mapping[str, Mapping[str, AnyFloats]],
    unit: str = COUNTS,
    objects: Mapping[str, str] | None = None,
) -> ScoreTable:
    """Return the table of scores from the `sums` of each predictor and recording; ``unit`` is that of absolute errors.

    If ``objects`` (object by recording) is passed, the interval is over objects.
    """
    declaration = measure(steps, unit, OBJECTS if objects else RECORDINGS)
    baselines = {name: name for name in sums_by_predictor if is_baseline(name)}
    return ScoreTable(declaration, sums_by_predictor, objects, baselines)


def measure(steps: Sequence[int], unit: str = COUNTS, cluster: str = RECORDINGS) -> Measure:
    """Return the measure that computes errors from `sums` at ``steps``; ``unit`` is that of the mean absolute errors."""
    step_names = [f"t+{step}" for step in steps]

    def error(sums: AnyFloats) -> AnyFloats:
        return 1 - Parts.from_sums(sums).mean_skill

    def values(sums: AnyFloats) -> tuple[float, ...]:
        parts = Parts.from_sums(sums)
        mae = parts.absolute / parts.values if parts.values else np.full(len(steps), np.nan)
        return (*map(float, mae), float(parts.squared_skill), float(parts.mean_skill))

    # The ranking score has its own column, because errors by step do not rank predictors.
    all_steps = " and ".join(filter(None, (", ".join(step_names[:-1]), step_names[-1])))
    return Measure(
        (*(f"MAE {step}" for step in step_names), "squared vs persistence", "vs persistence"),
        unit,
        f"the mean absolute error as a fraction of persistence's, the geometric mean over recordings and over {all_steps} "
        f"(squared errors are pooled over recordings)",
        "skill",
        cluster,
        error,
        intervals.skill,
        values,
        lambda errors: 1 - errors,
        "skill over persistence",
        rises=True,
        weight=lambda draws: Parts.from_sums(draws).counted.sum(axis=1),
        reference=BASELINE,
    )
