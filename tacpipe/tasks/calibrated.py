"""What a calibration asks of a task: params of `tacpipe calibrate` as the tasks read them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Asked:
    """How a trained model is to state its uncertainty."""

    quantiles: tuple[int, ...]  # percent, ascending
    promise: bool  # whether bands must hold in a new recording with at least their level
    false_unknown: float  # fraction of known slides that may be answered unknown
    seed: int
