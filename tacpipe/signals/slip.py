"""Label slip of a grasped object from the distance between hand and object.

The reading of a proximity sensor at the wrist is constant while the object is held and changes when it slips. Offline
labels are computed in five steps:

1. A median over 5 rows removes outliers and preserves the corners of ramps.
2. A second-order Butterworth low-pass of 5 Hz, forwards and backwards, and a central difference compute the *rate*.
3. The noise of the rate is its root mean square in the half second after the grasp, before any slip.
4. Slip starts when the rate exceeds 5 times the noise for 3 rows, and ends when it is below 2 times for 5 rows.
5. The filter extends a slip of 0.1 s to twice its duration and merges consecutive slips. Slips are therefore split where
   the readings rest, and their ends moved to where readings leave the level before and reach the level after.

Online labels have no step 5, a median over the last 5 rows, a forward low-pass and a backward difference. They
additionally start 3 rows and end 5 rows late.

The published recordings do not specify filter, thresholds and units; the noise of their readings is 0.82 counts.
Readings are in counts, rates in counts per second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Floats, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.filters import butterworth, median, trailing_median
from tacpipe.signals.runs import in_long_runs, in_long_runs_online, latch, runs

MEDIAN_ROWS = 5
LEVEL_ROWS = 10  # rows before and after a slip whose median is the level there
CORNER_ROWS = 2  # maximum distance of the end of a slip from the first row outside the level
LEVEL_SIGMA = 3.0  # distance from the level within which readings rest, as a multiple of their noise


@dataclass(frozen=True)
class SlipLimits:
    """Thresholds of slip: rates as multiples of their noise, and numbers of rows."""

    on_sigma: float = 5.0
    off_sigma: float = 2.0
    on_rows: int = 3
    off_rows: int = 5
    noise_floor: float = 3.0  # minimum noise in counts per second
    level_count: float = 0.75  # counts

    def __post_init__(self) -> None:
        if not 0 < self.off_sigma <= self.on_sigma:
            raise TacpipeError(
                f"The end threshold of slip is {self.off_sigma:g} sigma; it must be above 0 and at most the start "
                f"threshold, {self.on_sigma:g}."
            )
        if min(self.on_rows, self.off_rows) < 1 or not (self.noise_floor > 0 and self.level_count > 0):
            raise TacpipeError(
                f"Slip starts after {self.on_rows} rows and ends after {self.off_rows}, with a noise floor of "
                f"{self.noise_floor:g} and a level of {self.level_count:g} counts; all must be positive."
            )


def fill_missing(readings: AnyArray) -> Floats:
    """Replace each NaN in ``readings`` (time,) by the previous number, at the start by the first number."""
    values = readings.astype(np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(len(values))
    rows = np.maximum.accumulate(np.where(finite, np.arange(len(values)), int(finite.argmax())))
    return values[rows]


def rate(readings: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
    """Return the rate of change of ``readings`` (time,) in counts per second, with zero phase."""
    if len(readings) < 2:
        return np.zeros(len(readings))
    smooth = butterworth(cutoff_hz, rate_hz).both_ways(median(readings, MEDIAN_ROWS))
    return np.gradient(smooth) * rate_hz


def rate_online(readings: Floats, rate_hz: float, cutoff_hz: float) -> Floats:
    """Return the rate of change of ``readings`` (time,) in counts per second, computed causally."""
    smooth = butterworth(cutoff_hz, rate_hz).causal(trailing_median(readings, MEDIAN_ROWS))
    return np.diff(smooth, prepend=smooth[:1]) * rate_hz


def slip_offline(readings: Floats, rate_hz: float, cutoff_hz: float, rest_rows: int, limits: SlipLimits) -> Bools:
    """Return the offline slip label (time,) from ``readings`` (time,) since the grasp.

    The thresholds are from the first ``rest_rows`` rows, in which the object rests.
    """
    speed = np.abs(rate(readings, rate_hz, cutoff_hz))
    noise = _noise(speed[:rest_rows], limits)
    on = in_long_runs(speed > limits.on_sigma * noise, limits.on_rows)
    off = in_long_runs(speed < limits.off_sigma * noise, limits.off_rows)
    level = max(
        limits.level_count, LEVEL_SIGMA * float(np.std(readings[:rest_rows])) if len(readings[:rest_rows]) else 0.0
    )
    smooth = median(readings, MEDIAN_ROWS)
    return _trim(latch(on, off) & ~_rows_at_rest(smooth, limits.off_rows, level), smooth, level)


def slip_online(readings: Floats, rate_hz: float, cutoff_hz: float, rest_rows: int, limits: SlipLimits) -> Bools:
    """Return the online slip label (time,) from ``readings`` (time,); False in the first ``rest_rows`` rows."""
    speed = np.abs(rate_online(readings, rate_hz, cutoff_hz))
    noise = _noise(speed[:rest_rows], limits)
    on = in_long_runs_online(speed > limits.on_sigma * noise, limits.on_rows)
    on[:rest_rows] = False
    return latch(on, in_long_runs_online(speed < limits.off_sigma * noise, limits.off_rows))


def dropped(readings: Floats, rest_rows: int, patch_count: float, saturated_count: float) -> Bools:
    """Return a mask of the rows from the loss of the object (time,), from ``readings`` (time,) since the grasp.

    It is lost, after the first ``rest_rows`` rows, when the median of readings differs by more than ``patch_count`` from
    that of those rows or is at most ``saturated_count``, out of the sensor's range.
    """
    return _detect_loss(median(readings, MEDIAN_ROWS), readings[:rest_rows], patch_count, saturated_count)


def dropped_online(readings: Floats, rest_rows: int, patch_count: float, saturated_count: float) -> Bools:
    """Return the result of `dropped`, computed causally (time,)."""
    return _detect_loss(trailing_median(readings, MEDIAN_ROWS), readings[:rest_rows], patch_count, saturated_count)


def _detect_loss(smooth: Floats, rest_readings: Floats, patch_count: float, saturated_count: float) -> Bools:
    """Return the rows from the loss of the object on (time,), by the rule of `dropped`; none without readings at rest."""
    if not len(rest_readings):
        return np.zeros(len(smooth), dtype=bool)
    lost = (np.abs(smooth - np.median(rest_readings)) > patch_count) | (smooth <= saturated_count)
    lost[: len(rest_readings)] = False
    return np.logical_or.accumulate(lost)


def _noise(speed: Floats, limits: SlipLimits) -> float:
    """Return the root mean square of speeds at rest, or the floor if it is higher."""
    return max(float(np.sqrt(np.mean(speed**2))) if len(speed) else 0.0, limits.noise_floor)


def _rows_at_rest(smooth: Floats, rows: int, level_count: float) -> Bools:
    """Return a mask of rows (time,) in runs of at least ``rows`` in which ``smooth`` (time,) varies by ``level_count``.

    Between two consecutive slips the filtered rate does not decrease, but the readings rest.
    """
    resting = np.zeros(len(smooth), dtype=bool)
    if len(smooth) < rows:
        return resting
    windows = np.lib.stride_tricks.sliding_window_view(smooth, rows)  # (window, rows)
    starts = np.flatnonzero(windows.max(axis=1) - windows.min(axis=1) <= level_count)
    resting[starts[:, None] + np.arange(rows)] = True
    return resting


def _trim(slip: Bools, smooth: Floats, level_count: float) -> Bools:
    """Move the ends of each run of ``slip`` (time,) to where ``smooth`` (time,) leaves the levels around it.

    Runs without a change of level are removed.
    """
    trimmed = np.zeros_like(slip)
    starts, stops = runs(slip)
    free_from = np.append(0, stops)[: len(starts)]
    free_to = np.append(starts, len(slip))[1:]
    for start, stop, previous_stop, next_start in zip(starts, stops, free_from, free_to, strict=True):
        level_before = float(np.median(smooth[max(previous_stop, start - LEVEL_ROWS) : start + 1]))
        level_after = float(np.median(smooth[stop - 1 : min(next_start, stop + LEVEL_ROWS)]))
        sign = 1.0 if level_after >= level_before else -1.0
        run = sign * smooth[start:stop]
        start_offset, stop_offset = (
            _departure_row(run - sign * level_before, level_count),
            _departure_row((sign * level_after - run)[::-1], level_count),
        )
        if start_offset is not None and stop_offset is not None:
            trimmed[max(start + start_offset, previous_stop) : min(stop - stop_offset, next_start)] = True
    return trimmed


def _departure_row(moved: Floats, level_count: float) -> int | None:
    """Return the row in which ``moved`` (time,) starts to grow above ``level_count``, or None if it never does.

    The distance of an object that starts from rest grows with the square of time. With distances ``s`` and ``s'`` in the
    first row above and the next, the start is ``1 / (sqrt(s' / s) - 1)`` rows earlier, possibly before the first row.
    """
    beyond = moved > level_count
    if not beyond.any():
        return None
    first = int(beyond.argmax())
    following = float(moved[min(first + 1, len(moved) - 1)])
    growth = (following / float(moved[first])) ** 0.5 - 1 if following > moved[first] else 0.0
    return first - (min(int(1 / growth), CORNER_ROWS) if growth > 0 else 0)


@dataclass(frozen=True)
class LossOfContact:
    """The motion that ends the last contact of a recording."""

    begin_ns: int  # start of the motion
    end_ns: int  # last contact


@dataclass(frozen=True)
class HoldingPhases:
    """When an object is touched, by the difference from the untouched sensor at the end of a recording."""

    t_ns: Times  # (time,)
    touched: Bools  # (time,)
    loss: LossOfContact | None  # None if nothing is touched, or not for long enough


@dataclass(frozen=True)
class TouchLimits:
    """Criteria for contact and motion, in the unit of the channels."""

    end_rows: int  # number of last rows, whose median shows the untouched sensor
    contact_level: float  # root mean square difference over channels above which there is contact
    contact_fraction: float  # the same threshold as a fraction of the 90th percentile of the level
    contact_s: float  # minimum duration of the contact before a loss
    motion_level: float  # root mean square change between two rows above which the object moves
    quiet_s: float  # time without motion, or without contact, that separates two motions or contacts


def loss_of_contact(streams: Sequence[tuple[Times, AnyFloats]], limits: TouchLimits) -> HoldingPhases:
    """Return when an object is touched, from times (time,) and channels (time, channel) of each stream.

    The largest level and motion over the streams count, at the times of the first stream.
    """
    t_ns = streams[0][0]
    levels, speeds = np.zeros(len(t_ns)), np.zeros(len(t_ns))
    for times, values in streams:
        rows = np.clip(np.searchsorted(times, t_ns, side="right") - 1, 0, len(times) - 1)
        end = np.median(values[-limits.end_rows :], axis=0)
        level = np.sqrt(np.square(values - end).mean(axis=1))
        speed = np.sqrt(np.square(np.diff(values, axis=0, prepend=values[:1])).mean(axis=1))
        levels, speeds = np.maximum(levels, level[rows]), np.maximum(speeds, speed[rows])
    quiet_rows = max(1, round(limits.quiet_s * 1e9 / max(1.0, float(np.median(np.diff(t_ns))))))
    threshold = max(limits.contact_level, limits.contact_fraction * float(np.quantile(levels, 0.9)))
    touched = _close_gaps(levels > threshold, quiet_rows)
    starts, stops = runs(touched)
    if not len(starts) or t_ns[stops[-1] - 1] - t_ns[starts[-1]] < limits.contact_s * 1e9:
        return HoldingPhases(t_ns, touched, None)
    first, last = int(starts[-1]), int(stops[-1]) - 1
    moving = _close_gaps(speeds > limits.motion_level, quiet_rows)
    begin = last
    while begin > first and moving[begin - 1 : begin + 1].any():
        begin -= 1
    return HoldingPhases(t_ns, touched, LossOfContact(int(t_ns[begin]), int(t_ns[last])))


def _close_gaps(active: Bools, rows: int) -> Bools:
    """Return which rows are active, or in a gap of fewer than ``rows`` rows between active ones (time,)."""
    closed = active.copy()
    for begin, stop in zip(*runs(~active), strict=True):
        if stop - begin < rows and begin > 0 and stop < len(active):
            closed[begin:stop] = True
    return closed
