"""Add up training rows for a linear codec piece by piece: their number, means and covariances.

Covariances are kept as the triangle R of a QR decomposition of all rows, [1 | x] = Q R, which has as many rows as columns.
The triangle of more rows is that of R and the new rows below it (Golub, Van Loan, Matrix Computations, 4th ed., 6.5), so
no product of rows is ever summed, and no digits are lost to the means.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.codecs.frame_stacking import LEVELS
from tacpipe.codecs.standard import none_moves

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]
    Flags = np.ndarray[Any, np.dtype[np.bool_]]


class Moments:
    """Number, range and triangle of rows (row, channel)."""

    def __init__(self, width: int) -> None:
        self.count = 0  # rows
        self._low, self._high = np.full(width, np.inf), np.full(width, -np.inf)
        self._triangle: Floats = np.zeros((width + 1, width + 1))

    @classmethod
    def from_pieces(cls, pieces: Iterable[Floats], width: int) -> Moments:
        """Return the moments of rows that come in pieces."""
        moments = cls(width)
        for piece in pieces:
            moments.add(piece)
        return moments

    def add(self, rows: Floats) -> None:
        """Add rows (row, channel)."""
        if len(rows):
            self.count += len(rows)
            self._low, self._high = np.minimum(self._low, rows.min(axis=0)), np.maximum(self._high, rows.max(axis=0))
            self._extend(np.column_stack([np.ones(len(rows)), rows]))

    def merged(self, further: Moments) -> Moments:
        """Return the moments of both sets of rows."""
        merged = Moments(len(self._low))
        merged.count = self.count + further.count
        merged._low, merged._high = np.minimum(self._low, further._low), np.maximum(self._high, further._high)
        merged._triangle = self._triangle
        merged._extend(further._triangle)
        return merged

    @property
    def moves(self) -> Flags:
        """Channels with more than one value: exact, where a standard deviation would leave rounding."""
        return self._high > self._low

    @property
    def centred(self) -> Floats:
        """The triangle of the rows without their means (channel, channel)."""
        triangle: Floats = self._triangle[1:, 1:] * self.moves
        return triangle

    def standard(self, representation: str) -> tuple[Floats, Floats]:
        """Return mean and scale of each channel, (channel,) each, as `tacpipe.codecs.standard.standard` does of the rows."""
        if not self.moves.any():
            raise none_moves(len(self._low), self.count)
        spread = np.sqrt(np.square(self.centred).sum(axis=0) / self.count)
        mean = self._triangle[0, 1:] / self._triangle[0, 0] if representation == LEVELS else np.zeros(len(spread))
        return mean, np.where(self.moves, spread, 1.0)

    def standardised(self, representation: str) -> Floats:
        """Return the triangle of the rows (channel, channel) as `standard` makes channels alike."""
        _, scale = self.standard(representation)
        if representation == LEVELS:
            return self.centred / scale
        return _triangle(self._triangle[:, 1:] / scale)

    def _extend(self, rows: Floats) -> None:
        self._triangle = _triangle(np.concatenate([self._triangle, rows]))


def _triangle(rows: Floats) -> Floats:
    """Return the R of a QR decomposition."""
    triangle: Floats = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle
