"""How numbers of this task are written: percentages, points, p values, and what must be stated next to an accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.report.blocks import NONE, Cell
from tacpipe.report.material.accuracy import Accuracy
from tacpipe.report.material.methods import Method

SESSIONS = (
    "Each material was recorded in one session, so texture cannot be distinguished from session in these data: a model that "
    "recognises a session by its drift or its mean level is right as well."
)
SIMULATED = "These slides were simulated: nothing here is evidence about a real sensor."


def caution(methods: Sequence[Method]) -> str:
    """Return what these slides cannot show, next to every table of accuracies; empty where nothing is known against them."""
    if any(one.simulated for one in methods):
        return SIMULATED
    runs = [run for one in methods for run in one.runs]
    return SESSIONS if runs and all(run.predictions.one_session_each for run in runs) else ""


def form(what: str, text: str, published: bool) -> str:
    """Return a caption or title, as that of a table or figure of the paper where the data are the paper's.

    >>> form("Figure 9", "validation accuracy", True), form("Figure 9", "validation accuracy", False)
    ("Figure 9 in the paper's form: validation accuracy", 'Validation accuracy')
    """
    return f"{what} in the paper's form: {text}" if published else f"{text[:1].upper()}{text[1:]}"


def percent(fraction: float) -> str:
    """Return a share in percent.

    >>> percent(0.995), percent(float("nan"))
    ('99.5', '–')
    """
    return NONE if math.isnan(fraction) else f"{100 * fraction:.1f}"


def points(fraction: float) -> str:
    """Return a difference of shares in percentage points, with its sign.

    >>> points(-0.0245), points(0.0)
    ('−2.5', '+0.0')
    """
    return f"{100 * fraction + 0.0:+.1f}".replace("-", "−")


def p_value(p: float) -> str:
    """Return a p value with two digits.

    >>> p_value(0.00016), p_value(0.0312), p_value(1e-9), p_value(float("nan"))
    ('0.00016', '0.031', '< 0.0001', '–')
    """
    return NONE if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def fraction(found: Accuracy | None) -> Cell:
    """Return an accuracy and its standard deviation over runs, above what it rests on and its interval."""
    return counted(found.correct, found.evaluated, found.low, found.high, found.sd) if found else Cell(NONE)


def counted(correct: int, evaluated: int, low: float, high: float, sd: float) -> Cell:
    """Return a share in percent, with its standard deviation where there is one, above what it rests on.

    >>> counted(190, 200, 0.91, 0.97, float("nan"))
    Cell(text='95.0', below='190/200 · 91.0 to 97.0', value=0.95, copy='')
    """
    spread = "" if math.isnan(sd) else f" ± {percent(sd)}"
    below = f"{correct}/{evaluated} · {percent(low)} to {percent(high)}"
    return Cell(f"{percent(correct / evaluated)}{spread}", below, correct / evaluated)


def points_within(mean: float, low: float, high: float) -> Cell:
    """Return a difference in points above its interval.

    >>> points_within(0.01, -0.02, 0.04)
    Cell(text='+1.0', below='−2.0 to +4.0', value=0.01, copy='')
    """
    return Cell(points(mean), f"{points(low)} to {points(high)}", mean)
