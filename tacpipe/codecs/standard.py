"""The level and the spread of each channel on training rows, by which a codec makes channels alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.codecs.frame_stacking import LEVELS
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]


def unmoving_channels(values: Floats, channels: Sequence[str]) -> list[str]:
    """Return the names of the channels that have one value in all rows of ``values`` (time, channel)."""
    return [name for name, moves in zip(channels, _moves(values), strict=True) if not moves]


def standard(values: Floats, representation: str) -> tuple[Floats, Floats]:
    """Return mean and scale of each channel in counts, (channel,) each, of training rows ``values`` (time, channel).

    The scale is the standard deviation, and 1 for a channel that never moves. Increments keep the mean 0, so that rows
    that do not move have latents 0. Raises `TacpipeError` where no channel moves.
    """
    moves = _moves(values)
    if not moves.any():
        raise none_moves(values.shape[1], len(values))
    mean = values.mean(axis=0) if representation == LEVELS else np.zeros(values.shape[1])
    return mean, np.where(moves, values.std(axis=0), 1.0)


def none_moves(channels: int, rows: int) -> TacpipeError:
    """Return the error of training rows in which no channel moves."""
    return TacpipeError(
        f"None of the {channels} tactile channels moves in {rows} training rows, so there is nothing to compress. Give "
        "training recordings with contact."
    )


def _moves(values: Floats) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return whether a channel has more than one value: exact, where a standard deviation would leave rounding."""
    if not len(values):
        return np.zeros(values.shape[1], dtype=bool)
    moves: np.ndarray[Any, np.dtype[np.bool_]] = values.max(axis=0) > values.min(axis=0)
    return moves
