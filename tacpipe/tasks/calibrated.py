"""What a calibration asks of a task, as the tasks read it, and the quantiles that are asked of a calibrated model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError


@dataclass(frozen=True)
class CalibrationRequest:
    """How a trained model is to state its uncertainty."""

    quantiles: tuple[int, ...]  # percent, ascending
    promise: bool  # whether bands must hold in a new recording with at least their level
    false_unknown: float  # fraction of known slides that may be answered unknown
    seed: int


class Levelled(Protocol):
    """What a model knows of its uncertainty, as quantiles of some levels."""

    @property
    def percents(self) -> tuple[int, ...]:
        """The levels in percent, ascending."""
        ...  # a protocol has no body


Known = TypeVar("Known", bound=Levelled)


def percents(levels: AnyFloats) -> tuple[int, ...]:
    """Return levels, which are fractions, in percent.

    >>> import numpy as np
    >>> percents(np.array([0.1, 0.5, 0.9]))
    (10, 50, 90)
    """
    return tuple(round(float(100 * one)) for one in levels)


def quantiles_of(known: Known | None, wanted: Sequence[int]) -> tuple[Known, list[int]]:
    """Return what a model knows of its uncertainty, and where quantiles of the levels ``wanted``, in percent, stand in it.

    Raises `TacpipeError` where the model has none, or not these.
    """
    if known is None:
        raise TacpipeError(
            "The model has no quantiles. Run `tacpipe calibrate MODEL DATASET --split SPLIT -o CALIBRATED` and give "
            "that one."
        )
    there = known.percents
    for one in wanted:
        if one not in there:
            raise TacpipeError(
                f"The model has the quantiles {','.join(map(str, there))}, not {one}. Give --quantiles of these, or run "
                f"`tacpipe calibrate` with others."
            )
    return known, [there.index(one) for one in wanted]
