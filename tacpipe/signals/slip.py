"""When a held object slips, derived from the distance between hand and object.

The proximity sensor at the wrist looks at the object: while the object is held its reading stays, and where it moves the
object slips. How the label is made, and why:

1. a median over 5 rows takes single bad readings out, and leaves the corners of a ramp where they are;
2. a Butterworth low-pass of second order and 5 Hz, forwards and backwards, then a central difference give the *rate*;
3. the rate's own noise is its root mean square in the half second after the grasp, when nothing has slipped yet;
4. slip begins where the rate is beyond 5 times that noise for 3 rows, and ends where it is below 2 times for 5 rows;
5. the filter spreads a slip of 0.1 s to twice that, and runs two that follow at once together: so a slip is cut where
   the readings themselves rest, and each end is moved to where they leave the level before or reach the one after.

The label that is known at once has no step 5, a median over the last 5 rows, the low-pass forwards only and a backward
difference; it comes on 3 rows late and goes 5 rows late besides.

Published recordings leave the filter, thresholds and units open; the noise of their readings is 0.82 counts.
Readings and rates are in counts and counts a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats
from tacpipe.errors import TacpipeError
from tacpipe.signals.filters import butterworth, median, median_so_far
from tacpipe.signals.runs import in_long_runs, lasting, latched, runs

MEDIAN_ROWS = 5
LEVEL_ROWS = 10  # rows before and after a slip whose median is the level there
CORNER_ROWS = 2  # how far back from the first row that has left its level the end of a slip may lie
LEVEL_SIGMA = 3.0  # times the readings' own noise is at the level still


@dataclass(frozen=True)
class SlipLimits:
    """Limits of slip: rates in multiples of their noise, and least numbers of rows."""

    on_sigma: float = 5.0
    off_sigma: float = 2.0
    on_rows: int = 3
    off_rows: int = 5
    noise_floor: float = 3.0  # counts a second
    level_count: float = 0.75  # counts

    def __post_init__(self) -> None:
        if not 0 < self.off_sigma <= self.on_sigma:
            raise TacpipeError(
                f"A slip that begins at {self.on_sigma:g} sigma and ends below {self.off_sigma:g} flickers; the latter "
                "must lie above 0 and not above the former."
            )
        if min(self.on_rows, self.off_rows) < 1 or not (self.noise_floor > 0 and self.level_count > 0):
            raise TacpipeError(
                f"Slip after {self.on_rows} rows, its end after {self.off_rows}, a noise floor of {self.noise_floor:g} "
                f"and a level of {self.level_count:g} counts cannot be; all must be positive, rows whole numbers."
            )


def filled(readings: AnyArray) -> Floats:
    """Return ``readings`` (time,) with NaN replaced by the last number before it, at the start by the first one.

    So no row is filled from its future but those before the first reading, where nothing can be determined anyway.
    """
    values = readings.astype(np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(len(values))
    rows = np.maximum.accumulate(np.where(finite, np.arange(len(values)), int(finite.argmax())))
    values_by_row: Floats = values[rows]
    return values_by_row


def rate(readings: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
    """Return how fast ``readings`` (time,) move, in counts a second (time,), without a shift in time."""
    if len(readings) < 2:
        return np.zeros(len(readings))
    smooth = butterworth(cutoff_hz, rate_hz).both_ways(median(readings, MEDIAN_ROWS))
    slope: Floats = np.gradient(smooth) * rate_hz
    return slope


def rate_so_far(readings: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
    """Return how fast ``readings`` (time,) move, in counts a second (time,), from each row and those before it."""
    smooth = butterworth(cutoff_hz, rate_hz).causal(median_so_far(readings, MEDIAN_ROWS))
    return np.diff(smooth, prepend=smooth[:1]) * rate_hz


def slip_offline(readings: Floats, rate_hz: float, cutoff_hz: float, rest_rows: int, limits: SlipLimits) -> Bools:
    """Return where the object slips (time,), stated with the whole of ``readings`` (time,) since the grasp at hand.

    In the first ``rest_rows`` rows it is taken to rest; their rate sets the threshold.
    """
    speed = np.abs(rate(readings, rate_hz, cutoff_hz))
    noise = _noise(speed[:rest_rows], limits)
    on = in_long_runs(speed > limits.on_sigma * noise, limits.on_rows)
    off = in_long_runs(speed < limits.off_sigma * noise, limits.off_rows)
    level = max(
        limits.level_count, LEVEL_SIGMA * float(np.std(readings[:rest_rows])) if len(readings[:rest_rows]) else 0.0
    )
    smooth = median(readings, MEDIAN_ROWS)
    return _trimmed(latched(on, off) & ~_resting(smooth, limits.off_rows, level), smooth, level)


def slip_online(readings: Floats, rate_hz: float, cutoff_hz: float, rest_rows: int, limits: SlipLimits) -> Bools:
    """Return where slip is known of (time,) from each row and those before it; never in the first ``rest_rows``."""
    speed = np.abs(rate_so_far(readings, rate_hz, cutoff_hz))
    noise = _noise(speed[:rest_rows], limits)
    on = lasting(speed > limits.on_sigma * noise, limits.on_rows)
    on[:rest_rows] = False
    return latched(on, lasting(speed < limits.off_sigma * noise, limits.off_rows))


def dropped(readings: Floats, rest_rows: int, patch_count: float, saturated_count: float) -> Bools:
    """Return from where on (time,) the object is lost, stated with the whole of ``readings`` (time,) since the grasp.

    That is after the first ``rest_rows`` rows, once the readings, smoothed by a median, are more than ``patch_count`` from
    the median of those rows, or at ``saturated_count`` or below, where the sensor sees no more.
    """
    return _lost(median(readings, MEDIAN_ROWS), readings[:rest_rows], patch_count, saturated_count)


def dropped_online(readings: Floats, rest_rows: int, patch_count: float, saturated_count: float) -> Bools:
    """Return where the same is known of (time,) from each row and those before it."""
    return _lost(median_so_far(readings, MEDIAN_ROWS), readings[:rest_rows], patch_count, saturated_count)


def _lost(smooth: Floats, rest_readings: Floats, patch_count: float, saturated_count: float) -> Bools:
    if not len(rest_readings):
        return np.zeros(len(smooth), dtype=bool)
    lost = (np.abs(smooth - np.median(rest_readings)) > patch_count) | (smooth <= saturated_count)
    lost[: len(rest_readings)] = False
    return np.logical_or.accumulate(lost)


def _noise(speed: Floats, limits: SlipLimits) -> float:
    return max(float(np.sqrt(np.mean(speed**2))) if len(speed) else 0.0, limits.noise_floor)


def _resting(smooth: Floats, rows: int, level_count: float) -> Bools:
    """Return which rows (time,) lie in ``rows`` or more in which ``smooth`` (time,) stays within ``level_count``.

    Between two slips that follow at once the filtered rate does not come down; the readings state that there are two.
    """
    resting = np.zeros(len(smooth), dtype=bool)
    if len(smooth) < rows:
        return resting
    windows = np.lib.stride_tricks.sliding_window_view(smooth, rows)  # (window, rows)
    starts = np.flatnonzero(windows.max(axis=1) - windows.min(axis=1) <= level_count)
    resting[starts[:, None] + np.arange(rows)] = True
    return resting


def _trimmed(slip: Bools, smooth: Floats, level_count: float) -> Bools:
    """Return ``slip`` (time,) with the ends of each run moved to where ``smooth`` (time,) leaves the levels around it.

    A run that leaves its level nowhere goes: what has not moved has not slipped.
    """
    trimmed = np.zeros_like(slip)
    starts, stops = runs(slip)
    free_from = np.append(0, stops)[: len(starts)]
    free_to = np.append(starts, len(slip))[1:]
    for start, stop, lowest, highest in zip(starts, stops, free_from, free_to, strict=True):
        before = float(np.median(smooth[max(lowest, start - LEVEL_ROWS) : start + 1]))
        after = float(np.median(smooth[stop - 1 : min(highest, stop + LEVEL_ROWS)]))
        sign = 1.0 if after >= before else -1.0
        run = sign * smooth[start:stop]
        first, last = _leaves(run - sign * before, level_count), _leaves((sign * after - run)[::-1], level_count)
        if first is not None and last is not None:
            trimmed[max(start + first, lowest) : min(stop - last, highest)] = True
    return trimmed


def _leaves(moved: Floats, level_count: float) -> int | None:
    """Return the row in which ``moved`` (time,) begins to grow beyond ``level_count``, or None if it never does.

    An object sets out from rest, so way grows as time squared: of the first row beyond and the next, ``s`` and ``s'``,
    the former comes ``1 / (sqrt(s' / s) - 1)`` rows after the start. That may lie before the first row of ``moved``.
    """
    beyond = moved > level_count
    if not beyond.any():
        return None
    first = int(beyond.argmax())
    following = float(moved[min(first + 1, len(moved) - 1)])
    grown = (following / float(moved[first])) ** 0.5 - 1 if following > moved[first] else 0.0
    return first - (min(int(1 / grown), CORNER_ROWS) if grown > 0 else 0)
