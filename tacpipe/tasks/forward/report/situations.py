"""How good forecasts are while the gripper closes, holds, slips and releases."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.comparison.runs import MODEL, Method
from tacpipe.report.blocks import Cell, Fold, Note, fold, interval, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.headline import BASELINE
from tacpipe.tasks.forward.situations import LOST, PACE_M_S, SITUATIONS, TURNING_RAD_S, WIDTH_M

Tree = Mapping[str, Any]
ABOUT = (
    "A window is named by its last row and the rows to come, the first name that fits: no contact; closing: the gripper "
    f"closes by more than {1000 * WIDTH_M:g} mm or contact begins; releasing: it opens by more than that or contact ends; "
    f"slipping: the load falls by more than {100 * LOST:g} % with the gripper still; holding in motion: the hand is faster "
    f"than {PACE_M_S:g} m/s or {TURNING_RAD_S:g} rad/s; holding still. Errors are means over all steps and channels, "
    "skill is 1 − mean absolute error / that of persistence, the geometric mean over recordings. The interval is over "
    "recordings, given for methods of one run."
)


def folds(context: Context) -> list[Fold]:
    """Return errors and skill by situation of each method; nothing where no result states them."""
    rows: list[list[str | Cell]] = []
    for name in SITUATIONS:
        for method in context.methods:
            found = of_method(method, name)
            if found:
                share = f"{100 * found['part']:.1f} %"
                skill = interval(found["skill"], found["low"], found["high"])
                errors = (number(found[BASELINE]), number(found[MODEL]))
                rows.append([name, method.name, f"{found['windows']:,.0f}", share, *errors, skill])
    heads = ["situation", "method", "windows", "of persistence's error", "MAE of persistence", "MAE", "skill"]
    if not rows:
        return []
    return fold("By situation", table("Errors by what the hand does", heads, rows), Note(ABOUT))


def of_method(method: Method, situation: str) -> dict[str, float] | None:
    """Return windows, errors, skill and what part of persistence's error lies in a situation, pooled over runs.

    Skill is weighted by windows; of one run it has its interval.
    """
    trees = [run.details.metrics.get("situations", {}) for run in method.runs]
    own = [one[situation] for one in trees if situation in one and "mean" in one[situation]["skill"]]
    if not own:
        return None
    weights = [float(one["windows"]) for one in own]

    def mean(values: list[float]) -> float:
        return float(np.average(values, weights=weights))

    whole = sum(one["windows"] * one["mae_counts"][BASELINE]["mean"] for tree in trees for one in tree.values())
    still = mean([one["mae_counts"][BASELINE]["mean"] for one in own])
    ends = own[0]["skill"]["mean"] if len(method.runs) == 1 else {}
    return {
        "windows": sum(weights),
        "part": sum(weights) * still / whole if whole else float("nan"),
        BASELINE: still,
        MODEL: mean([one["mae_counts"][MODEL]["mean"] for one in own]),
        "skill": mean([one["skill"]["mean"]["mean"] for one in own]),
        "low": float(ends.get("low", np.nan)),
        "high": float(ends.get("high", np.nan)),
    }
