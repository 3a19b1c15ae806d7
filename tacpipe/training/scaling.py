"""Scale each dimension to [-1, 1] by the range of the training rows, or each channel by an affine map."""

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
    """The minimum and maximum training value of each dimension, float64, shape (dimension,)."""

    low: Floats
    high: Floats

    @property
    def half(self) -> Floats:
        """Half the range of each dimension (dimension,), or 1 if it is constant."""
        half = (self.high - self.low) / 2
        return np.where(half > 0, half, 1.0)

    @property
    def centre(self) -> Floats:
        """The middle of each dimension's range (dimension,)."""
        return (self.high + self.low) / 2

    def scale(self, values: Floats) -> Floats:
        """Return ``values`` (…, dimension) as float32, scaled so that training values are in [-1, 1]."""
        return ((values - self.centre) / self.half).astype(np.float32)

    def restore(self, scaled: Floats) -> Floats:
        """Return scaled values (…, dimension) in their own unit, as float64."""
        return scaled.astype(np.float64) * self.half + self.centre

    def to_json(self) -> dict[str, list[float]]:
        """Return the lists that `from_json` reads."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    @classmethod
    def from_json(cls, stored: Mapping[str, Sequence[float]]) -> MinMax:
        """Return the scaling that `to_json` stored."""
        return cls(np.array(stored["low"], dtype=np.float64), np.array(stored["high"], dtype=np.float64))


def fit(values: Floats) -> MinMax:
    """Fit the scaling on training rows ``values``, shape (time, dimension).

    Raises `TacpipeError` if there are no rows or a value is not finite.
    """
    if not len(values):
        raise TacpipeError("A scaling cannot be fitted on 0 rows. Give training recordings with windows.")
    if not np.isfinite(values).all():
        at = int(np.argwhere(~np.isfinite(values))[0, 1])
        raise TacpipeError(f"Dimension {at} of the training rows has a value that is not finite. Mask it as a gap.")
    return MinMax(values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64))


KINDS = ("none", "standard", "spread", "log")


@dataclass(frozen=True)
class Affine:
    """Offset and scale of each channel, float64 (channel,), optionally after a logarithm."""

    offset: Floats
    scale: Floats
    logarithm: bool = False  # log(1 + x), for counts with a heavy tail

    def apply(self, values: Floats) -> Floats:
        """Return scaled ``values`` (…, channel) as float32.

        Raises `TacpipeError` if a logarithm is undefined (-1 or less).
        """
        if self.logarithm and (values <= -1).any():
            raise TacpipeError(f"The logarithm of 1 + {values.min():g} is not defined. Choose another scaling.")
        linear = np.log1p(values) if self.logarithm else values
        return ((linear - self.offset) / self.scale).astype(np.float32)

    def restore(self, scaled: Floats) -> Floats:
        """Reverse `apply`: return scaled values (…, channel) in their own unit, as float64."""
        values: Floats = scaled.astype(np.float64) * self.scale + self.offset
        return np.expm1(values) if self.logarithm else values

    def to_tensors(self) -> dict[str, Floats]:
        """Return the arrays that `from_tensors` reads."""
        return {"offset": self.offset, "scale": self.scale, "logarithm": np.array([float(self.logarithm)])}

    @classmethod
    def from_tensors(cls, stored: Mapping[str, Floats]) -> Affine:
        """Return the scaling that `to_tensors` stored."""
        return cls(stored["offset"], stored["scale"], bool(stored["logarithm"][0]))

    @classmethod
    def fit(cls, values: Floats, kind: str) -> Affine:
        """Fit the scaling ``kind`` on training ``values`` (…, channel).

        none does not scale; standard scales each channel to mean 0 and standard deviation 1; spread divides all
        channels by one standard deviation, which preserves zero and the proportions of channels; log is spread after
        log(1 + x). Raises `TacpipeError` for another kind.
        """
        channels = values.shape[-1]
        zeros, unscaled = np.zeros(channels), np.ones(channels)
        if kind == "none":
            return cls(zeros, unscaled)
        if kind == "standard":
            flat = values.reshape(-1, channels)
            spread = flat.std(axis=0, dtype=np.float64)
            return cls(flat.mean(axis=0, dtype=np.float64), np.where(spread > 0, spread, 1.0))
        if kind in ("spread", "log"):
            spread = float(np.std(np.log1p(values) if kind == "log" else values, dtype=np.float64))
            return cls(zeros, unscaled * (spread or 1.0), kind == "log")
        raise TacpipeError(f"There is no scaling {kind!r}; there are {', '.join(KINDS)}.")
