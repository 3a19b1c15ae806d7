"""Build the inputs of a codec: levels or increments, for one frame or several in a row.

A stretch is a run of rows without a gap in time. Nothing here looks ahead, and nothing looks across the start of a
stretch: its first row stands in for the rows before it.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.errors import TacpipeError
from tacpipe.signals.windows import breaks as breaks

LEVELS, INCREMENTS = "levels", "increments"


def check(representation: str) -> None:
    """Raise `TacpipeError` unless ``representation`` is levels or increments."""
    if representation not in (LEVELS, INCREMENTS):
        raise TacpipeError(f"representation is {representation!r}; a codec is fitted on {LEVELS} or {INCREMENTS}.")


def inputs(values: AnyFloats, begins: Bools | None, representation: str, frames: int) -> AnyFloats:
    """Return what a codec reads of each row of ``values`` (time, channel): (time, frames * channel), newest frame last.

    ``representation`` is levels, ``values`` as they are, or increments, what was added since the row before. ``begins``
    (time,) marks where a stretch begins; None: at the first row alone. Rows at the start of a stretch repeat its first
    frame, and the increment there is 0. Raises `TacpipeError` for another ``representation``.

    >>> inputs(np.array([[1.0], [4.0], [9.0]]), None, "increments", 2).tolist()
    [[0.0, 0.0], [0.0, 3.0], [3.0, 5.0]]
    """
    check(representation)
    rows = np.arange(len(values))
    first = np.zeros_like(rows) if begins is None else np.maximum.accumulate(np.where(begins, rows, 0))
    if representation == INCREMENTS:
        with np.errstate(
            invalid="ignore"
        ):  # a row that is not finite has no increment, at the start of a stretch either
            values = values - values[np.maximum(rows - 1, first)]
    if frames == 1:
        return values
    return np.hstack([values[np.maximum(rows - lag, first)] for lag in reversed(range(frames))])


class Stacking:
    """Stack rows that come in pieces as `inputs` does; it keeps the last rows of a piece, which the next one reads."""

    def __init__(self, representation: str, frames: int = 1) -> None:
        check(representation)
        self._representation, self._frames = representation, frames
        self._values: AnyFloats | None = None  # the last rows
        self._begins = np.zeros(0, dtype=bool)

    def next(self, values: AnyFloats, begins: Bools) -> AnyFloats:
        """Return what a codec reads of the next rows; ``values`` (time, channel) and ``begins`` (time,) as for `inputs`."""
        before = len(self._begins)
        if self._values is not None:
            values, begins = np.concatenate([self._values, values]), np.concatenate([self._begins, begins])
        self._values, self._begins = values[-self._frames :], begins[-self._frames :]
        return inputs(values, begins, self._representation, self._frames)[before:]
