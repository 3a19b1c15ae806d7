"""Compute the skill of forecasts over persistence, by step and by situation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.engine import ComparisonRow
from tacpipe.comparison.runs import MODEL, Method
from tacpipe.metrics import intervals, pairing
from tacpipe.metrics.intervals import Interval
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Fold, SmallPrint, fold, interval, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.headline import BASELINE, Parts
from tacpipe.tasks.forward.report import methods
from tacpipe.tasks.forward.situations import LOST, PACE_M_S, SITUATIONS, TURNING_RAD_S, WIDTH_M

if TYPE_CHECKING:
    from tacpipe.metrics.pairing import Sums


def sums_of_row(row: ComparisonRow, steps: Sequence[int], known_objects: bool | None, group: str = "both") -> Sums:
    """Return the sums of a row's predictor at some steps in a group of channels, by seed and recording."""
    return sums_of_method(row.method, row.predictor.split(" ")[0], steps, known_objects, group)


def sums_of_method(
    method: Method, predictor: str, steps: Sequence[int], known_objects: bool | None, group: str = "both"
) -> Sums:
    """Return the sums of a method's predictor at some steps in a group of channels, by seed and recording.

    Those of unseen objects are by seed and object.
    """
    parts = []
    for run in method.runs:
        clusters = methods.object_clusters(run.details, known_objects) or {}
        sums = methods.sums_by_recording(run.details, predictor, steps, known_objects, group)
        parts += [((run.seed, clusters.get(name, name)), errors) for name, errors in sums.items()]
    return pairing.add_by_key(parts)


def at_steps(draws: AnyFloats) -> AnyFloats:
    """Return the skill over persistence at each step and over all, from sums (draw, part) to (draw, step + 1)."""
    parts = Parts.of_sums(draws)
    return np.hstack([parts.skill, parts.mean_skill[:, None]])


def skill_intervals(sums: Sums) -> Interval:
    """Return the skill over persistence at each step and over all, with intervals."""
    return intervals.skill_of_log_ratio(pairing.value_intervals(sums, lambda draws: np.log1p(-at_steps(draws))))


def _total(sums: Sums) -> Parts:
    return Parts.of_sums(np.sum(list(sums.values()), axis=0))


def mean_absolute(sums: Sums) -> list[float]:
    """Return the mean absolute error at each step."""
    total = _total(sums)
    return [float(value) for value in total.absolute / total.values]


def mean_squared(sums: Sums) -> float:
    """Return the mean squared error over all steps; NaN without sums."""
    if not sums:
        return float("nan")
    total = _total(sums)
    return float((total.squared / total.values).mean())


def skill_cell(intervals: Interval | None, at: int) -> Cell:
    """Return a value with its interval; a dash where there is none."""
    if intervals is None:
        return Cell(NONE)
    return blocks.interval(float(intervals.mean[at]), float(intervals.low[at]), float(intervals.high[at]))


SITUATION_NOTE = (
    "A window is named by its last row and the rows to come, the first name that fits: no contact; closing: the gripper "
    f"closes by more than {1000 * WIDTH_M:g} mm or contact begins; releasing: it opens by more than that or contact ends; "
    f"slipping: the load falls by more than {100 * LOST:g} % with the gripper still; holding in motion: the hand is faster "
    f"than {PACE_M_S:g} m/s or {TURNING_RAD_S:g} rad/s; holding still. Errors are means over all steps and channels, "
    "skill is 1 − mean absolute error / that of persistence, the geometric mean over recordings. The interval is over "
    "recordings, given for methods of one run."
)


def situation_folds(context: Context) -> list[Fold]:
    """Return errors and skill by situation of each method; nothing where no result states them."""
    rows: list[list[str | Cell]] = []
    for name in SITUATIONS:
        for method in context.methods:
            scores = skill_in_situation(method, name)
            if scores:
                share = f"{100 * scores['part']:.1f} %"
                skill = interval(scores["skill"], scores["low"], scores["high"])
                errors = (number(scores[BASELINE]), number(scores[MODEL]))
                rows.append([name, method.name, f"{scores['windows']:,.0f}", share, *errors, skill])
    heads = ["situation", "method", "windows", "of persistence's error", "MAE of persistence", "MAE", "skill"]
    if not rows:
        return []
    return fold("By situation", table("Errors by what the hand does", heads, rows), SmallPrint(SITUATION_NOTE))


def skill_in_situation(method: Method, situation: str) -> dict[str, float] | None:
    """Return windows, errors, skill and what part of persistence's error lies in a situation, pooled over runs.

    Skill is weighted by windows; of one run it has its interval.
    """
    trees = [run.details.metrics.get("situations", {}) for run in method.runs]
    selected = [part[situation] for part in trees if situation in part and "mean" in part[situation]["skill"]]
    if not selected:
        return None
    weights = [float(part["windows"]) for part in selected]

    def mean(values: list[float]) -> float:
        return float(np.average(values, weights=weights))

    total_error = sum(
        part["windows"] * part["mae_counts"][BASELINE]["mean"] for tree in trees for part in tree.values()
    )
    persistence_error = mean([part["mae_counts"][BASELINE]["mean"] for part in selected])
    ends = selected[0]["skill"]["mean"] if len(method.runs) == 1 else {}
    return {
        "windows": sum(weights),
        "part": sum(weights) * persistence_error / total_error if total_error else float("nan"),
        BASELINE: persistence_error,
        MODEL: mean([part["mae_counts"][MODEL]["mean"] for part in selected]),
        "skill": mean([part["skill"]["mean"]["mean"] for part in selected]),
        "low": float(ends.get("low", np.nan)),
        "high": float(ends.get("high", np.nan)),
    }
