"""Conformal prediction over groups: how far a bound must be moved so that it holds in a new recording.

Windows of a recording depend on each other, so recordings are what is exchangeable, and each counts the same however
long it is. Two answers are given for the quantile of scores of calibration recordings:

- **pooled** (Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer hierarchical models, JASA 2022,
  section 3.1, pooling CDFs): the quantile of all scores, each weighted by one over the number of scores of its group.
  Coverage tends to the level as groups become many; with few it has no guarantee.
- **promised** (Lee, Barber and Willett, Distribution-free inference with hierarchical data, 2023, HCP; with one score a
  group it is split conformal prediction, Vovk et al., Algorithmic Learning in a Random World, 2005): as many groups and
  one more, whose scores are infinite. A score of a new exchangeable group lies at or below it with a probability of at
  least the level, averaged over draws of all groups. With K groups no level above K / (K + 1) can be promised.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyFloats, Ints
from tacpipe.errors import TacpipeError


def most_promised(groups: int) -> float:
    """Return the highest level that can be promised with this number of calibration groups.

    >>> most_promised(4)
    0.8
    """
    return groups / (groups + 1)


def quantile(scores: AnyFloats, groups: Ints, level: float, *, promised: bool = False) -> float:
    """Return the smallest score at or below which ``level`` of the weight lies, each group weighing the same.

    ``scores`` and ``groups`` (score,) are of calibration recordings. With ``promised`` one more group of infinite scores is
    among them; the result is infinite where the level cannot be promised. Raises `TacpipeError` without scores, for other
    shapes, and for a level that is not between 0 and 1.

    >>> quantile(np.array([1.0, 2.0, 3.0, 9.0]), np.array([0, 0, 0, 1]), 0.5)
    3.0
    >>> quantile(np.arange(9.0), np.arange(9), 0.9, promised=True)
    8.0
    """
    if not 0 < level < 1:
        raise TacpipeError(f"The level {level:g} is not between 0 and 1. Give one like 0.9.")
    if scores.ndim != 1 or scores.shape != groups.shape or not len(scores):
        raise TacpipeError(
            f"Scores of {scores.shape} and groups of {groups.shape} have no quantile; both must be (score,), one or more."
        )
    _, codes = np.unique(groups, return_inverse=True)
    sizes = np.bincount(codes)
    order = np.argsort(scores, kind="stable")
    weights = 1 / (sizes[codes[order]] * (len(sizes) + promised))
    reached = np.cumsum(weights) >= level - 1e-9  # sums of as many as there are scores round
    return float(scores[order[int(np.argmax(reached))]]) if reached.any() else float("inf")
