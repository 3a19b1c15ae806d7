"""Resample signals: grids, interpolation, distance to samples, and gaps.

Time is int64 nanoseconds throughout. Only differences of stamps become floats, so that stamps near 1.6e18 (UTC today)
lose nothing: as float64 they would be rounded to 256 ns. Stamps must not run backwards; equal ones are allowed, and the
last of them counts. Beyond the first and the last sample a signal keeps its end value; `in_gap` states where that is.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats, Indices, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.kinematics import continuous

GAP_NS = 50_000_000  # longest time between two samples without a gap, of sensors of 20 Hz or more
GAP_PERIODS = 2.5  # the same of slower sensors, in their periods
PARALLEL = 1e-6  # rad; below this angle the sine weights of slerp divide by zero and linear ones are exact to 1e-13


def uniform_grid(first_ns: int, last_ns: int, rate_hz: float) -> Times:
    """Return ``first_ns + round(k * 1e9 / rate_hz)`` for k = 0, 1, … as far as ``last_ns``, int64 (time,).

    Empty if ``last_ns`` lies before ``first_ns``. Raises `TacpipeError` for a rate that is not positive.

    >>> uniform_grid(0, 70_000_000, 30.0).tolist()
    [0, 33333333, 66666667]
    """
    span_ns = int(last_ns) - int(first_ns)
    offsets_ns = uniform_offsets(0, max(0, int(span_ns * rate_hz / 1e9) + 2) if np.isfinite(rate_hz) else 0, rate_hz)
    return np.int64(first_ns) + offsets_ns[offsets_ns <= span_ns]


def uniform_offsets(first: int, count: int, rate_hz: float) -> Times:
    """Return ``round(k * 1e9 / rate_hz)`` for the ``count`` whole numbers k from ``first``, int64 (time,).

    Raises `TacpipeError` for a rate that is not positive.

    >>> uniform_offsets(1, 2, 30.0).tolist()
    [33333333, 66666667]
    """
    if not (np.isfinite(rate_hz) and 0 < rate_hz <= 1e9):
        raise TacpipeError(f"A rate of {rate_hz} Hz gives no grid; it must lie above 0 and at most at 1e9 Hz.")
    offsets_ns: Times = np.rint(np.arange(first, first + count, dtype=np.float64) * 1e9 / rate_hz).astype(np.int64)
    return offsets_ns


def linear(t_ns: Times, values: AnyArray, grid_ns: Times) -> Floats:
    """Return ``values`` (time, channel) at the times ``grid_ns``, interpolated linearly, as float64 (grid, channel).

    A NaN spreads to the points between it and its neighbours and no further.
    """
    lower, upper, weight = _neighbours(t_ns, grid_ns)
    start: Floats = np.take(values, lower, axis=0).astype(np.float64, copy=False)  # (grid, channel)
    step: Floats = np.take(values, upper, axis=0) - start
    step *= weight[:, None]
    step += start
    return step


def slerp(t_ns: Times, quaternions: Floats, grid_ns: Times) -> Floats:
    """Return unit quaternions at ``grid_ns`` (grid, 4), turned at constant speed along the shorter arc between samples.

    ``quaternions`` (time, 4) are xyzw; they are normalised and their signs made continuous first, so neither scale nor
    sign of a sample matters, and the result has no jump of sign either.
    """
    ends = continuous(quaternions)
    lower, upper, weight = _neighbours(t_ns, grid_ns)
    start, stop = ends[lower], ends[upper]  # (grid, 4)
    angle = np.arccos(np.clip((start * stop).sum(axis=1), -1.0, 1.0))  # (grid,)
    near = ~(angle > PARALLEL)
    sine = np.where(near, 1.0, np.sin(angle))
    first = np.where(near, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    second = np.where(near, weight, np.sin(weight * angle) / sine)
    turned: Floats = first[:, None] * start + second[:, None] * stop
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return turned


def median_around(t_ns: Times, values: AnyArray, grid_ns: Times, half_ns: int) -> Floats:
    """Return the median of the samples at most ``half_ns`` from each grid point, float64 (grid, channel).

    ``values`` are (time, channel). Where no sample is that near, the value is that of `linear`.
    """
    medians = linear(t_ns, values, grid_ns)
    first = np.searchsorted(t_ns, grid_ns - half_ns, side="left")
    count = np.searchsorted(t_ns, grid_ns + half_ns, side="right") - first
    for samples in np.unique(count[count > 0]).tolist():  # few different ones: about as many come in each window
        points = np.flatnonzero(count == samples)
        windows = values[first[points, None] + np.arange(samples)]  # (point, sample, channel)
        medians[points] = np.median(windows, axis=1)
    return medians


def bracketing_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return, sorted, the rows that `linear` and `slerp` look at: with those alone they give the same.

    A stream of 1 kHz on a grid of 50 Hz is gathered from a tenth of its rows.
    """
    lower, upper, _ = _neighbours(t_ns, grid_ns)
    bracketing = np.zeros(len(t_ns), dtype=bool)
    bracketing[lower] = bracketing[upper] = True
    return np.flatnonzero(bracketing)


def nearest_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return for each grid point the row of the nearest sample (grid,); the earlier one where two are as near."""
    _require_samples(t_ns)
    after = np.clip(np.searchsorted(t_ns, grid_ns, side="right"), 1, max(len(t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(t_ns) - 1)
    return np.where(t_ns[after] - grid_ns < grid_ns - t_ns[before], after, before)


def nearest(t_ns: Times, values: AnyArray, grid_ns: Times) -> AnyArray:
    """Return the nearest sample of ``values`` (time, …) at each grid point (grid, …), its type kept."""
    return values[nearest_rows(t_ns, grid_ns)]


def nearest_distance_ns(t_ns: Times, grid_ns: Times) -> Times:
    """Return the distance from each grid point to the nearest sample, int64 nanoseconds (grid,), never negative."""
    distance_ns: Times = np.abs(t_ns[nearest_rows(t_ns, grid_ns)] - grid_ns)
    return distance_ns


def newest_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return for each grid point the row of the newest sample that is not after it (grid,); of equal stamps the last.

    -1 where there is none yet.

    >>> newest_rows(np.array([10, 20, 20]), np.array([5, 10, 30])).tolist()
    [-1, 0, 2]
    """
    return np.searchsorted(t_ns, grid_ns, side="right") - 1


def is_overdue(newest_ns: Times, grid_ns: Times, gap_ns: int) -> Bools:
    """Return where the newest sample, of ``newest_ns``, is older than ``gap_ns`` at a grid point (grid,).

    That is what `in_gap` can state of a gap before the sample that ends it has come.
    """
    overdue: Bools = grid_ns - newest_ns > gap_ns
    return overdue


def median_before(t_ns: Times, values: AnyArray, grid_ns: Times, span_ns: int) -> Floats:
    """Return the median of the samples at most ``span_ns`` before each grid point, float64 (grid, channel).

    ``values`` are (time, channel). Where none is that near, the value is the newest sample's. Each grid point needs one
    sample that is not after it.
    """
    newest = newest_rows(t_ns, grid_ns)
    medians: Floats = values[newest].astype(np.float64)
    first = np.searchsorted(t_ns, grid_ns - span_ns, side="left")
    for point in np.flatnonzero(newest > first):
        medians[point] = np.median(values[first[point] : newest[point] + 1].astype(np.float64), axis=0)
    return medians


def default_gap_ns(t_ns: Times) -> int:
    """Return the longest time between two samples of a stream without a gap: 50 ms, below 20 Hz 2.5 of its periods.

    The period is the median step between its stamps.

    >>> default_gap_ns(np.arange(5) * 10_000_000), default_gap_ns(np.arange(5) * 73_000_000)
    (50000000, 182500000)
    """
    period_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    return GAP_NS if period_ns <= GAP_NS else round(GAP_PERIODS * period_ns)


def in_gap(t_ns: Times, grid_ns: Times, gap_ns: int) -> Bools:
    """Return where a grid point has no trustworthy value (grid,).

    That is strictly between two samples further apart than ``gap_ns``, or outside the range of the samples.
    """
    lower, upper, _ = _neighbours(t_ns, grid_ns)
    outside = (grid_ns < t_ns[0]) | (grid_ns > t_ns[-1])
    inside: Bools = outside | (t_ns[upper] - t_ns[lower] > gap_ns)
    return inside


def _neighbours(t_ns: Times, grid_ns: Times) -> tuple[Indices, Indices, Floats]:
    """Return the sample rows before and after each grid point and the weight of the latter, each (grid,).

    At a sample both rows are that sample, so that what lies behind it has no state.
    """
    _require_samples(t_ns)
    last = len(t_ns) - 1
    lower = np.clip(np.searchsorted(t_ns, grid_ns, side="right") - 1, 0, last)
    upper = np.where(grid_ns > t_ns[lower], np.minimum(lower + 1, last), lower)
    span_ns = t_ns[upper] - t_ns[lower]
    weight = (grid_ns - t_ns[lower]) / np.maximum(span_ns, 1)
    return lower, upper, np.where(span_ns > 0, weight, 0.0)


def _require_samples(t_ns: Times) -> None:
    if not len(t_ns):
        raise TacpipeError("A signal has no samples. Leave the stream out, or record it again.")
