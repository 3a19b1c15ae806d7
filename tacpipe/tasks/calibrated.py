"""Describe a requested calibration, and find requested quantiles of a calibrated model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError


@dataclass(frozen=True)
class CalibrationRequest:
    """The uncertainty that a trained model is to state."""

    quantiles: tuple[int, ...]  # percent, ascending
    promise: bool  # True if bands must hold in a new recording with at least their level
    false_unknown: float  # fraction of slides of learned classes that may be answered unknown
    seed: int


class Levelled(Protocol):
    """The uncertainty of a model, as quantiles of some levels."""

    @property
    def percents(self) -> tuple[int, ...]:
        """The levels in percent, ascending."""
        ...  # a protocol has no body


Uncertain = TypeVar("Uncertain", bound=Levelled)


def percents(levels: AnyFloats) -> tuple[int, ...]:
    """Return levels, which are fractions, in percent.

    >>> import numpy as np
    >>> percents(np.array([0.1, 0.5, 0.9]))
    (10, 50, 90)
    """
    return tuple(round(float(100 * level)) for level in levels)


def quantiles_of(uncertainty: Uncertain | None, requested: Sequence[int]) -> tuple[Uncertain, list[int]]:
    """Return the uncertainty of a model, and the indices of the ``requested`` quantiles, in percent.

    Raises `TacpipeError` where the model has none, or not these.
    """
    if uncertainty is None:
        raise TacpipeError(
            "The model has no quantiles. Run `tacpipe calibrate MODEL DATASET --split SPLIT -o CALIBRATED` and give "
            "that one."
        )
    available = uncertainty.percents
    for percent in requested:
        if percent not in available:
            raise TacpipeError(
                f"The model has the quantiles {','.join(map(str, available))}, not {percent}. Give --quantiles "
                f"of these, or run "
                f"`tacpipe calibrate` with others."
            )
    return uncertainty, [available.index(percent) for percent in requested]
