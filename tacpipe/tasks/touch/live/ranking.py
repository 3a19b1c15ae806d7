"""By what candidate grasps are ranked, from the touch that is predicted of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.errors import UsageError
from tacpipe.printable import excerpt
from tacpipe.tasks.touch.predictor import Touch

CONTACT, BALANCE, LEVEL = "contact", "balance", "level"


class Criterion(NamedTuple):
    """What a grasp is ranked by: the higher its score, the better."""

    text: str  # as the user gave it
    score: Callable[[Floats], Floats]  # of levels (grasp, finger) to scores (grasp,)
    fingers: int  # whose touch must be predicted


def criterion(text: str) -> Criterion:
    """Return the criterion that an option names. Raises `UsageError` for one that is none.

    ``contact`` is the mean of both fingers' levels, ``balance`` how little they differ, and ``level:0.4`` how near their
    mean is to 0.4.
    """
    name, colon, value = text.partition(":")
    if name == CONTACT and not colon:
        return Criterion(text, lambda levels: np.nanmean(levels, axis=1), 1)
    if name == BALANCE and not colon:
        return Criterion(text, lambda levels: -np.abs(levels[:, 0] - levels[:, 1]), 2)
    try:
        wanted = float(value) if name == LEVEL else np.nan
    except ValueError:
        wanted = np.nan
    if not np.isfinite(wanted):
        raise UsageError(
            f"--rank {excerpt(text)} is not a criterion; give contact, balance, or level:0.4 with a number."
        )
    return Criterion(text, lambda levels: -np.abs(np.nanmean(levels, axis=1) - wanted), 1)


def levels(touches: Sequence[Touch]) -> Floats:
    """Return how much each finger is touched (grasp, finger), thumb first: the mean of two fractions of fixed ranges.

    They are how far the pressure rises within its range, and how far the electrodes fall within theirs, on average; 0 to 1
    within the ranges of `tacpipe.channels.biotac_sp.RANGES`. What the model does not predict is left out; NaN for nothing.
    """
    found = np.full((len(touches), 2), np.nan)
    for row, touch in enumerate(touches):
        for column, finger in enumerate(("th", "mf")):
            pressed = biotac_sp.normalised(f"pdc_{finger}", np.array([getattr(touch, f"pdc_{finger}")]))
            fallen = 1 - biotac_sp.normalised(f"e_{finger}", getattr(touch, f"e_{finger}"))
            parts = np.array([pressed.mean(), fallen.mean()])
            known = np.isfinite(parts)
            found[row, column] = parts[known].mean() if known.any() else np.nan
    return found


def ranks(scores: Floats) -> list[int]:
    """Return the place of each grasp, 1 for the highest score; of equal scores the first comes first.

    >>> ranks(np.array([0.2, 0.9, 0.2]))
    [2, 1, 3]
    """
    order = np.argsort(-scores, kind="stable")
    found = np.empty(len(scores), np.int64)
    found[order] = np.arange(1, len(scores) + 1)
    return found.tolist()
