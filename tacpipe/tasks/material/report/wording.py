"""How numbers of this task are written: percentages, points, p values, and what must be stated next to an accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import provenance
from tacpipe.report.blocks import NONE, Cell, fixed
from tacpipe.tasks.material.report.accuracy import Accuracy

SESSIONS = (
    "Each material was recorded in one session, so texture cannot be distinguished from session in these data: a model that "
    "recognises a session by its drift or its mean level is right as well."
)


def caution(methods: Sequence[Method]) -> str:
    """Return what these slides cannot show, next to every table of accuracies; empty where nothing is known against them."""
    if any(one.simulated for one in methods):
        return provenance.SIMULATED
    held = [result.predictions for one in methods for result in one.details]
    return SESSIONS if held and all(one.one_session_each for one in held) else ""


def percent(fraction: float) -> str:
    """Return a share in percent.

    >>> percent(0.995), percent(float("nan"))
    ('99.5', '–')
    """
    return fixed(100 * fraction, 1)


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
