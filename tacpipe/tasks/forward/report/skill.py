"""Errors and skill of a method, pooled over its runs and their recordings, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.engine import Row
from tacpipe.comparison.runs import Method
from tacpipe.metrics import intervals, pairing
from tacpipe.metrics.intervals import Interval
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell
from tacpipe.tasks.forward.headline import Parts
from tacpipe.tasks.forward.report import reading

if TYPE_CHECKING:
    from tacpipe.metrics.pairing import Sums


def sums_of(row: Row, steps: Sequence[int], known: bool | None, group: str = "both") -> Sums:
    """Return the sums of a row's predictor at some steps in a group of channels, by seed and recording."""
    return sums(row.method, row.predictor.split(" ")[0], steps, known, group)


def sums(method: Method, predictor: str, steps: Sequence[int], known: bool | None, group: str = "both") -> Sums:
    """Return the sums of a method's predictor at some steps in a group of channels, by seed and recording.

    Those of unseen objects are by seed and object.
    """
    parts = []
    for run in method.runs:
        clusters = reading.clusters(run.details, known) or {}
        sums = reading.sums(run.details, predictor, steps, known, group)
        parts += [((run.seed, clusters.get(name, name)), errors) for name, errors in sums.items()]
    return pairing.added(parts)


def at_steps(draws: AnyFloats) -> AnyFloats:
    """Return the skill over persistence at each step and over all, from sums (draw, part) to (draw, step + 1)."""
    parts = Parts.of_sums(draws)
    return np.hstack([parts.skill, parts.mean_skill[:, None]])


def skills(sums: Sums) -> Interval:
    """Return the skill over persistence at each step and over all, with intervals."""
    return intervals.skill_of_log_ratio(pairing.value_intervals(sums, lambda draws: np.log1p(-at_steps(draws))))


def _total(sums: Sums) -> Parts:
    return Parts.of_sums(np.sum(list(sums.values()), axis=0))


def mae(sums: Sums) -> list[float]:
    """Return the mean absolute error at each step."""
    total = _total(sums)
    return [float(value) for value in total.absolute / total.values]


def mse(sums: Sums) -> float:
    """Return the mean squared error over all steps; NaN without sums."""
    if not sums:
        return float("nan")
    total = _total(sums)
    return float((total.squared / total.values).mean())


def cell(found: Interval | None, at: int) -> Cell:
    """Return a value with its interval; a dash where there is none."""
    if found is None:
        return Cell(NONE)
    return blocks.interval(float(found.mean[at]), float(found.low[at]), float(found.high[at]))
