"""Mean and standard deviation over runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over runs; the latter is NaN for a single one."""

    mean: float
    sd: float


def spread(values: Sequence[float]) -> Spread:
    """Return mean and standard deviation of one value a run.

    >>> spread([1.0, 3.0])
    Spread(mean=2.0, sd=1.4142135623730951)
    """
    return Spread(
        float(np.mean(values)) if values else float("nan"),
        float(np.std(values, ddof=1)) if len(values) > 1 else float("nan"),
    )
