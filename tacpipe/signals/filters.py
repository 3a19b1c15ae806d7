"""Smooth uniformly sampled signals, with zero phase or causally, and reduce a signal to its envelope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.errors import TacpipeError

PAD_ROWS = 9  # default of scipy.signal.filtfilt for a second-order filter: three times its three coefficients


@dataclass(frozen=True)
class Biquad:
    """A second-order filter: ``y[n] = b0 x[n] + b1 x[n-1] + b2 x[n-2] - a1 y[n-1] - a2 y[n-2]``."""

    b: tuple[float, float, float]
    a: tuple[float, float]  # a1 and a2; a0 is 1

    def causal(self, values: AnyArray) -> Floats:
        """Return ``values`` (time,) filtered forwards, as if the first value had been constant before.

        The filter is in transposed direct form II.
        """
        (b0, b1, b2), (a1, a2) = self.b, self.a
        first = float(values[0]) if len(values) else 0.0
        gain = (b0 + b1 + b2) / (1 + a1 + a2)
        second_state = (b2 - a2 * gain) * first
        first_state = (b1 - a1 * gain) * first + second_state
        filtered = []
        for value in values.tolist():  # Python floats are faster than numpy scalars here
            smooth = b0 * value + first_state
            first_state = b1 * value - a1 * smooth + second_state
            second_state = b2 * value - a2 * smooth
            filtered.append(smooth)
        return np.array(filtered, dtype=np.float64)

    def both_ways(self, values: AnyArray) -> Floats:
        """Return ``values`` (time,) filtered in both directions, with zero phase, padded as scipy.signal.filtfilt."""
        pad = min(PAD_ROWS, len(values) - 1)
        if pad < 1:
            return values.astype(np.float64)
        before = 2.0 * values[0] - values[pad:0:-1]
        after = 2.0 * values[-1] - values[-2 : -pad - 2 : -1]
        forwards = self.causal(np.concatenate([before, values, after]))
        backwards = self.causal(forwards[::-1])[::-1]
        return backwards[pad:-pad].copy()


def butterworth(cutoff_hz: float, rate_hz: float) -> Biquad:
    """Return a second-order Butterworth low-pass with gain 1 at 0 Hz and 1/sqrt(2) at ``cutoff_hz``.

    It is the bilinear transform with prewarped cutoff (Oppenheim and Schafer, "Discrete-Time Signal Processing", 7.2).
    Raises `TacpipeError` unless the cutoff is between 0 and half the rate.
    """
    if not 0 < cutoff_hz < rate_hz / 2:
        raise TacpipeError(
            f"The cutoff is {cutoff_hz:g} Hz; at a sampling rate of {rate_hz:g} Hz it must be above 0 and below half the "
            f"rate, {rate_hz / 2:g} Hz."
        )
    warped = float(np.tan(np.pi * cutoff_hz / rate_hz))
    scale = 1 / (1 + np.sqrt(2.0) * warped + warped**2)
    b0 = float(warped**2 * scale)
    a1, a2 = 2 * (warped**2 - 1) * scale, (1 - np.sqrt(2.0) * warped + warped**2) * scale
    return Biquad((b0, 2 * b0, b0), (float(a1), float(a2)))


def median(values: AnyArray, rows: int) -> Floats:
    """Return the median of the ``rows`` (odd) around each row of ``values`` (time,), with constant padding at both ends.

    >>> median(np.array([1, 9, 1, 1, 2]), 3).tolist()
    [1.0, 1.0, 1.0, 1.0, 2.0]
    """
    return _medians(values, rows // 2, rows // 2)


def trailing_median(values: AnyArray, rows: int) -> Floats:
    """Return the median of each row of ``values`` (time,) and the previous ``rows - 1``.

    >>> trailing_median(np.array([1, 9, 1, 2, 2]), 3).tolist()
    [1.0, 1.0, 1.0, 2.0, 2.0]
    """
    return _medians(values, rows - 1, 0)


def _medians(values: AnyArray, before: int, after: int) -> Floats:
    """Return the median of the rows from ``before`` before to ``after`` after each row (time,), padded with end values."""
    if not len(values):
        return np.zeros(0)
    padded = np.pad(values.astype(np.float64), (before, after), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, before + after + 1)  # (time, rows)
    return np.median(windows, axis=1)


def envelope(t_ns: Times, values: AnyArray, points: int) -> tuple[Times, Floats]:
    """Return times and values of a signal (time, channel) reduced to at most ``points`` rows for a line plot.

    A longer signal is divided into ``points // 2`` intervals of equal duration. Each interval with rows becomes two rows:
    its minima at its first time and its maxima at its middle time. NaN is ignored unless an interval has only NaN.

    >>> t_ns, values = envelope(np.arange(6), np.array([[0], [9], [1], [5], [-7], [6]]), points=4)
    >>> t_ns.tolist(), values.ravel().tolist()
    ([0, 1, 3, 4], [0.0, 9.0, -7.0, 6.0])
    """
    floats = np.asarray(values, dtype=np.float64)
    if len(t_ns) <= points:
        return t_ns, floats
    edges_ns = np.linspace(t_ns[0], t_ns[-1], points // 2 + 1)[:-1]
    starts = np.unique(np.searchsorted(t_ns, edges_ns))
    middles = (starts + np.append(starts[1:], len(t_ns))) // 2
    extremes = np.empty((2 * len(starts), floats.shape[1]))
    extremes[::2] = np.fmin.reduceat(floats, starts, axis=0)
    extremes[1::2] = np.fmax.reduceat(floats, starts, axis=0)
    return np.column_stack([t_ns[starts], t_ns[middles]]).ravel(), extremes
