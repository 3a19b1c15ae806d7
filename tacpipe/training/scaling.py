"""Scaling of each dimension to [-1, 1] by what the training rows held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]


@dataclass(frozen=True)
class MinMax:
    """The lowest and highest training value of each dimension, float64, shape (dimension,)."""

    low: Floats
    high: Floats

    @property
    def half(self) -> Floats:
        """Half the range of each dimension, and 1 for one that never moved."""
        half = (self.high - self.low) / 2
        return np.where(half > 0, half, 1.0)

    @property
    def centre(self) -> Floats:
        """The middle of each dimension's range."""
        return (self.high + self.low) / 2

    def scale(self, values: Floats) -> Floats:
        """Return ``values`` (…, dimension) as float32, training data within [-1, 1], others maybe beyond."""
        return ((values - self.centre) / self.half).astype(np.float32)

    def restore(self, scaled: Floats) -> Floats:
        """Return scaled values (…, dimension) in their own unit, as float64."""
        return scaled.astype(np.float64) * self.half + self.centre

    def to_json(self) -> dict[str, list[float]]:
        """Return what `from_json` reads."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    @classmethod
    def from_json(cls, stored: Mapping[str, Sequence[float]]) -> MinMax:
        """Return the scaling that `to_json` wrote."""
        return cls(np.array(stored["low"], dtype=np.float64), np.array(stored["high"], dtype=np.float64))


def fit(values: Floats) -> MinMax:
    """Return the scaling fitted on training rows ``values``, shape (time, dimension).

    Raises `TacpipeError` where there is no row or a value is not finite.
    """
    if not len(values):
        raise TacpipeError("A scaling cannot be fitted on 0 rows. Give training recordings that hold windows.")
    if not np.isfinite(values).all():
        at = int(np.argwhere(~np.isfinite(values))[0, 1])
        raise TacpipeError(f"Dimension {at} of the training rows holds a value that is not finite. Mask it as a gap.")
    return MinMax(values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64))
