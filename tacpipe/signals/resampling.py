"""Resample signals: grids, interpolation, distance to samples, and gaps.

Time is int64 nanoseconds. Only time differences become floats: UTC times near 1.6e18 as float64 would be rounded to
256 ns. Times must not decrease; of equal times, the last sample counts. Before the first and after the last sample, a
signal is constant; `in_gap` marks these points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats, Indices, Int64s, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.kinematics import make_continuous

GAP_NS = 50_000_000  # longest time between two samples without a gap, for sensors of 20 Hz or more
GAP_PERIODS = 2.5  # the same limit for slower sensors, in periods
STEPS_AT_ONCE = 1 << 20  # number of steps between samples that are in memory at once
GRID_ROWS = 1 << 22  # number of rows that any grid may have
GRID_ROWS_PER_SAMPLE = 100  # maximum of a longer grid
HALF_BITS = 22  # bits of half a step in ns
PARALLEL = 1e-6  # rad; below this angle, slerp divides by almost zero, and linear weights are exact to 1e-13


def uniform_grid(first_ns: int, last_ns: int, rate_hz: float) -> Times:
    """Return ``first_ns + round(k * 1e9 / rate_hz)`` for k = 0, 1, … up to ``last_ns``, int64 (time,).

    It is empty if ``last_ns`` is before ``first_ns``. Raises `TacpipeError` if the rate is not positive.

    >>> uniform_grid(0, 70_000_000, 30.0).tolist()
    [0, 33333333, 66666667]
    """
    span_ns = int(last_ns) - int(first_ns)
    offsets_ns = uniform_offsets(0, max(0, int(span_ns * rate_hz / 1e9) + 2) if np.isfinite(rate_hz) else 0, rate_hz)
    return np.int64(first_ns) + offsets_ns[offsets_ns <= span_ns]


def uniform_offsets(first: int, count: int, rate_hz: float) -> Times:
    """Return ``round(k * 1e9 / rate_hz)`` for ``count`` integers k from ``first``, int64 (time,).

    Raises the errors of `offsets_of_numbers`.

    >>> uniform_offsets(1, 2, 30.0).tolist()
    [33333333, 66666667]
    """
    return offsets_of_numbers(np.arange(first, first + count), rate_hz)


def offsets_of_numbers(numbers: Int64s, rate_hz: float) -> Times:
    """Return ``round(k * 1e9 / rate_hz)`` for each of the ``numbers`` k (time,), int64 (time,).

    Raises `TacpipeError` if the rate is not positive.
    """
    if not (np.isfinite(rate_hz) and 0 < rate_hz <= 1e9):
        raise TacpipeError(f"The rate of a grid is {rate_hz} Hz; it must be above 0 and at most 1e9 Hz.")
    return np.rint(numbers.astype(np.float64) * 1e9 / rate_hz).astype(np.int64)


def expect_grid_of_samples(rows: int, sample_count: int, t_ns: Times, place: str) -> None:
    """Raise `TacpipeError` if a grid of ``rows`` over samples at ``t_ns`` (time,) would mostly repeat them.

    ``sample_count`` is that of the stream with the most samples. The error, which begins with ``place``, names the
    longest gap.
    """
    if rows <= max(GRID_ROWS, GRID_ROWS_PER_SAMPLE * sample_count):
        return
    after = int(np.argmax(np.diff(t_ns))) if len(t_ns) > 1 else 0
    gap_s = float(t_ns[after + 1] - t_ns[after]) / 1e9 if len(t_ns) > 1 else 0.0
    raise TacpipeError(
        f"{place}: the grid would have {rows:,} rows, more than {GRID_ROWS_PER_SAMPLE} for each of {sample_count:,} "
        f"samples. The longest gap is {gap_s:,.0f} s, after sample {after:,}. Give a lower rate, or divide the recording "
        f"there."
    )


def linear(t_ns: Times, values: AnyArray, grid_ns: Times) -> Floats:
    """Return ``values`` (time, channel) interpolated linearly at ``grid_ns``, as float64 (grid, channel).

    A NaN affects only the points between it and its neighbours. Raises `TacpipeError` without samples.
    """
    lower, upper, weight = _neighbours(t_ns, grid_ns)
    start: Floats = np.take(values, lower, axis=0).astype(np.float64, copy=False)  # (grid, channel)
    step: Floats = np.take(values, upper, axis=0) - start
    step *= weight[:, None]
    step += start
    return step


def circular(t_ns: Times, angles: AnyArray, grid_ns: Times, turn: float, bounds: tuple[float, float]) -> Floats:
    """Return ``angles`` (time, channel) interpolated along the shorter arc at ``grid_ns``, as float64 (grid, channel).

    ``turn`` is a full turn in their unit. A result outside ``bounds``, the smallest and the largest angle, moves by a
    turn if it is then within them. Raises `TacpipeError` without samples.

    >>> circular(np.array([0, 10]), np.array([[350.0], [20.0]]), np.array([1, 9]), 360.0, (0.0, 359.0)).tolist()
    [[353.0], [17.0]]
    """
    lower, upper, weight = _neighbours(t_ns, grid_ns)
    start: Floats = angles[lower].astype(np.float64)  # (grid, channel)
    step = (angles[upper] - start + turn / 2) % turn - turn / 2
    result: Floats = np.where(angles[upper] == start, start, start + weight[:, None] * step)
    lowest, highest = bounds
    for shift in (turn, -turn):
        moves = ((result < lowest) | (result > highest)) & (result + shift >= lowest) & (result + shift <= highest)
        result = np.where(moves, result + shift, result)
    return result


def slerp(t_ns: Times, quaternions: Floats, grid_ns: Times) -> Floats:
    """Return ``quaternions`` (time, 4) at ``grid_ns`` (grid, 4), with constant angular speed along the shorter arc.

    Quaternions are x, y, z, w. They are normalised with `kinematics.make_continuous` first, so that scale and sign do
    not matter. Raises `TacpipeError` without samples.
    """
    ends = make_continuous(quaternions)
    lower, upper, weight = _neighbours(t_ns, grid_ns)
    start, stop = ends[lower], ends[upper]  # (grid, 4)
    angle = np.arccos(np.clip((start * stop).sum(axis=1), -1.0, 1.0))  # (grid,)
    is_small = ~(angle > PARALLEL)
    sine = np.where(is_small, 1.0, np.sin(angle))
    first = np.where(is_small, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    second = np.where(is_small, weight, np.sin(weight * angle) / sine)
    interpolated: Floats = first[:, None] * start + second[:, None] * stop
    interpolated /= np.linalg.norm(interpolated, axis=1, keepdims=True)
    return interpolated


def median_around(t_ns: Times, values: AnyArray, grid_ns: Times, half_ns: int) -> Floats:
    """Return the median of the samples within ``half_ns`` of each grid point, float64 (grid, channel).

    ``values`` are (time, channel). Without a sample in the window, the result is that of `linear`. Raises
    `TacpipeError` without samples.
    """
    medians = linear(t_ns, values, grid_ns)
    first = np.searchsorted(t_ns, grid_ns - half_ns, side="left")
    count = np.searchsorted(t_ns, grid_ns + half_ns, side="right") - first
    for samples in np.unique(count[count > 0]).tolist():  # there are few different counts
        points = np.flatnonzero(count == samples)
        windows = values[first[points, None] + np.arange(samples)]  # (point, sample, channel)
        medians[points] = np.median(windows, axis=1)
    return medians


def bracketing_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return the ascending indices of the rows that `linear` and `slerp` read.

    With 1 kHz samples on a 50 Hz grid, these are 10 %.
    """
    lower, upper, _ = _neighbours(t_ns, grid_ns)
    bracketing = np.zeros(len(t_ns), dtype=bool)
    bracketing[lower] = bracketing[upper] = True
    return np.flatnonzero(bracketing)


def nearest_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return the row of the nearest sample for each grid point (grid,), of two equally near ones the earlier.

    Raises `TacpipeError` without samples.
    """
    _require_samples(t_ns)
    after = np.clip(np.searchsorted(t_ns, grid_ns, side="right"), 1, max(len(t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(t_ns) - 1)
    return np.where(t_ns[after] - grid_ns < grid_ns - t_ns[before], after, before)


def nearest(t_ns: Times, values: AnyArray, grid_ns: Times) -> AnyArray:
    """Return the nearest sample of ``values`` (time, …) at each grid point (grid, …), with the same dtype."""
    return values[nearest_rows(t_ns, grid_ns)]


def newest_rows(t_ns: Times, grid_ns: Times) -> Indices:
    """Return the row of the last sample at or before each grid point (grid,), or -1 if there is none.

    >>> newest_rows(np.array([10, 20, 20]), np.array([5, 10, 30])).tolist()
    [-1, 0, 2]
    """
    return np.searchsorted(t_ns, grid_ns, side="right") - 1


def newest_known_rows(arrival_ns: Times, t_ns: Times, row_arrival_ns: Times, row_ns: Times) -> Indices:
    """Return the newest sample that had arrived by each row's arrival and was measured by its time (row,), or -1.

    Arrivals ``arrival_ns`` and times ``t_ns`` of the samples, both (time,), must not decrease.

    >>> arrival_ns, t_ns = np.array([20, 20, 40]), np.array([10, 20, 30])
    >>> newest_known_rows(arrival_ns, t_ns, np.array([20, 39, 40]), np.array([15, 39, 40])).tolist()
    [0, 1, 2]
    """
    return np.minimum(newest_rows(arrival_ns, row_arrival_ns), newest_rows(t_ns, row_ns))


def is_overdue(newest_ns: Times, grid_ns: Times, gap_ns: int) -> Bools:
    """Return a mask of grid points (grid,) at which the newest sample, of ``newest_ns``, is older than ``gap_ns``.

    It is the online counterpart of `in_gap`, before the sample that ends a gap arrives.
    """
    return grid_ns - newest_ns > gap_ns


def median_before(t_ns: Times, values: AnyArray, newest: Indices, grid_ns: Times, span_ns: int) -> Floats:
    """Return the median of the samples in the ``span_ns`` up to each grid point, float64 (grid, channel).

    ``values`` are (time, channel), and ``newest`` (grid,) the row of the newest sample of each grid point. Without a sample
    in the window, the result is the newest sample.
    """
    medians: Floats = values[newest].astype(np.float64)
    first = np.searchsorted(t_ns, grid_ns - span_ns, side="left")
    for point in np.flatnonzero(newest > first):
        medians[point] = np.median(values[first[point] : newest[point] + 1].astype(np.float64), axis=0)
    return medians


def _do_nothing() -> None:
    pass


def default_gap_ns(t_ns: Times, release: Callable[[], None] = _do_nothing) -> int:
    """Return the longest time between two samples without a gap: 50 ms, or 2.5 median periods below 20 Hz.

    ``release`` is called after each part of ``t_ns`` that was read.

    >>> default_gap_ns(np.arange(5) * 10_000_000), default_gap_ns(np.arange(5) * 73_000_000)
    (50000000, 182500000)
    """
    period_ns = median_step_ns(t_ns, release)
    return GAP_NS if period_ns <= GAP_NS else round(GAP_PERIODS * period_ns)


def median_step_ns(t_ns: Times, release: Callable[[], None] = _do_nothing) -> float:
    """Return the median time between two samples, or 0 for fewer than two. Times must not decrease.

    ``release`` is called after each part of ``t_ns`` that was read.
    """
    steps = len(t_ns) - 1
    if steps < 1:
        return 0.0
    if steps <= STEPS_AT_ONCE:
        return float(np.median(np.diff(t_ns)))
    return (_ranked_step_ns(t_ns, (steps - 1) // 2, release) + _ranked_step_ns(t_ns, steps // 2, release)) / 2


def _ranked_step_ns(t_ns: Times, rank: int, release: Callable[[], None]) -> int:
    """Return the step between samples that has ``rank`` if steps are sorted; those above 4 hours count as 4 hours.

    Steps are counted by their upper half and then by their lower half, so that they are not in memory at once.
    """
    half = 1 << HALF_BITS
    upper = -1
    for shift in (HALF_BITS, 0):
        counts = np.zeros(half, np.int64)
        for first in range(0, len(t_ns) - 1, STEPS_AT_ONCE):
            steps_ns = np.minimum(np.diff(t_ns[first : first + STEPS_AT_ONCE + 1]), half * half - 1)
            if not shift:
                steps_ns = steps_ns[steps_ns >> HALF_BITS == upper]
            counts += np.bincount(steps_ns >> shift & half - 1, minlength=half)
            release()
        part = int(np.searchsorted(np.cumsum(counts), rank, side="right"))
        rank -= int(counts[:part].sum())
        if shift:
            upper = part
    return upper * half + part


def in_gap(t_ns: Times, grid_ns: Times, gap_ns: int) -> Bools:
    """Return a mask of grid points (grid,) between samples more than ``gap_ns`` apart, or outside the samples' range."""
    lower, upper, _ = _neighbours(t_ns, grid_ns)
    outside = (grid_ns < t_ns[0]) | (grid_ns > t_ns[-1])
    is_in_gap: Bools = outside | (t_ns[upper] - t_ns[lower] > gap_ns)
    return is_in_gap


def _neighbours(t_ns: Times, grid_ns: Times) -> tuple[Indices, Indices, Floats]:
    """Return the row before each grid point, the row after it, and the weight of the row after it, each (grid,).

    At a sample, both rows are that sample, so that the next sample has no effect. Raises `TacpipeError` without
    samples.
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
        raise TacpipeError("The signal has no samples. Exclude the stream, or record it again.")
