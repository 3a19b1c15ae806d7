"""Fit a device's clock to the arrival times of its samples on the host.

The model is ``arrival = offset + (1 + drift) * device + latency``. Latency is never negative and nearly constant for
the fastest samples of a link, so the line is a lower envelope: distances above it are delays. Among all lines below the
samples, it has the smallest sum of vertical distances (Moon, Skelly, Towsley, "Estimation and removal of clock skew
from network delay measurements", INFOCOM 1999). Samples that arrive impossibly early are excluded first. On simulated
links, its drift was two to five times as precise as that of a Theil-Sen line through low quantiles of blocks. The
smallest latency is indistinguishable from an offset and included in it.

The clock of a device that restarts has a step. Steps are detected first, and each segment between them has its own
line. Timestamps are int64 nanoseconds; the first value is subtracted before conversion to float.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s, Times
from tacpipe.errors import TacpipeError

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
STEP_NS = 20_000_000  # smaller steps are latency: no device restarts within 20 ms
STEP_WINDOW_NS = 2_000_000_000  # compared time on both sides of a step; stalls of a host are shorter
STEP_WINDOW_ROWS = (16, 4096)
MAX_STEPS = 64  # maximum number of jumps examined as steps, largest first; with more stalls, small restarts are missed
LOW = 0.1  # quantile that represents the fastest samples; robust against a few wrong timestamps
ROUGH_LOW, ROUGH_BLOCKS, ROUGH_ROWS = 0.05, 64, 8  # quantile, number and smallest size of blocks for the first line
EARLY_NS = 100_000.0  # smallest distance below the first line at which samples are excluded
LINE_ROWS, LINE_NS = 32, 2_000_000_000  # smallest number of rows and duration from which a drift is estimated
HULL_BLOCKS = 512
MAX_SUBSAMPLE = 1 << 14  # rows for medians and the first line; the envelope uses all rows
MAX_DRIFT = 0.1  # RC oscillators are off by a few percent; with a larger drift, timestamps cannot be in nanoseconds


@dataclass(frozen=True)
class Segment:
    """The rows from ``start`` to ``stop`` (exclusive) between two steps, and the line for their device times."""

    start: int
    stop: int
    device_ns: int  # device time of the segment's first row
    host_ns: int  # host time at ``device_ns``
    drift: float  # host seconds per device second, minus 1

    def host_times(self, device_ns: Times) -> Times:
        """Convert device times (time,) to host times."""
        since_ns = device_ns - np.int64(self.device_ns)
        mapped: Times = np.int64(self.host_ns) + since_ns + np.rint(since_ns * self.drift).astype(np.int64)
        return mapped


@dataclass(frozen=True)
class ClockFit:
    """The fitted clock of a device, and the delays of its samples.

    ``residual_ns`` are the quantiles `QUANTILES` of arrival minus fitted time: the latency above that of the fastest
    samples.
    """

    segments: tuple[Segment, ...]
    residual_ns: tuple[float, ...]
    median_residual_ns: float  # median of the absolute residuals

    @property
    def longest(self) -> Segment:
        """The segment with the most rows."""
        return max(self.segments, key=lambda segment: segment.stop - segment.start)

    @property
    def offset_ns(self) -> int:
        """Host minus device time at the first row of the longest segment."""
        return self.longest.host_ns - self.longest.device_ns

    @property
    def drift_ppm(self) -> float:
        """The drift of the longest segment: parts per million by which the host's clock is faster."""
        return self.longest.drift * 1e6


def fit_clock(device_ns: Times, arrival_ns: Times, certain: Bools | None = None) -> ClockFit:
    """Return the fit of a device's clock (time,) to the arrival times of its samples (time,), in row order.

    Only rows marked in ``certain`` (time,) are used, unless none is marked: others arrived while the host was delayed.
    A segment that is too short to estimate its drift uses that of the longest segment, or 0. Raises `TacpipeError` if
    the clock is constant or its rate differs from the host's by more than 10 %, or the numbers of times differ.

    >>> device_ns = np.arange(0, 10_000_000_000, 1_000_000)
    >>> fit = fit_clock(device_ns, 500 + device_ns + device_ns // 20_000)
    >>> fit.offset_ns, round(fit.drift_ppm)
    (500, 50)
    """
    if len(device_ns) != len(arrival_ns) or not len(device_ns):
        raise TacpipeError(
            f"A clock cannot be fitted to {len(device_ns)} device times and {len(arrival_ns)} arrival times; their numbers "
            "must be equal and at least 1."
        )
    if certain is not None and certain.any() and not certain.all():
        rows = np.flatnonzero(certain)
        return _to_all_rows(fit_clock(device_ns[rows], arrival_ns[rows]), rows, len(device_ns))
    if len(device_ns) > 1 and not np.any(device_ns != device_ns[0]):
        raise TacpipeError(
            f"The device's clock is constant, {device_ns[0]} ns in all {len(device_ns)} rows. "
            "Remove t_device_ns, or use arrival times (`--clock arrival`)."
        )
    edges = [0, *clock_steps(device_ns, arrival_ns), len(device_ns)]
    spans = list(pairwise(edges))
    drifts = [_drift(device_ns[start:stop], arrival_ns[start:stop]) for start, stop in spans]
    fitted = [(stop - start, drift) for (start, stop), drift in zip(spans, drifts, strict=True) if drift is not None]
    default_drift = max(fitted)[1] if fitted else 0.0
    segments = tuple(
        _anchor(start, stop, device_ns, arrival_ns, default_drift if drift is None else drift)
        for (start, stop), drift in zip(spans, drifts, strict=True)
    )
    residual_ns = (arrival_ns - _map_times(segments, device_ns)).astype(np.float64)  # (time,)
    quantiles = tuple(float(value) for value in np.quantile(residual_ns, QUANTILES))
    return ClockFit(segments, quantiles, float(np.median(np.abs(residual_ns))))


def _to_all_rows(fit: ClockFit, rows: Int64s, count: int) -> ClockFit:
    """Convert a fit of ``rows`` to a fit of all ``count`` rows. An excluded row belongs to the previous segment."""
    edges = [0, *(int(rows[segment.start]) for segment in fit.segments[1:]), count]
    spans = zip(fit.segments, edges[:-1], edges[1:], strict=True)
    return replace(fit, segments=tuple(replace(segment, start=start, stop=stop) for segment, start, stop in spans))


def host_times(fit: ClockFit, device_ns: Times, arrival_ns: Times) -> Times:
    """Return the sampling times on the host's clock (time,), never decreasing.

    A device time that maps to more than 20 ms after its arrival is wrong and replaced by the arrival; otherwise it would
    delay all later samples.
    """
    mapped = _map_times(fit.segments, device_ns)
    ahead = mapped - arrival_ns > STEP_NS
    host_ns: Times = np.maximum.accumulate(np.where(ahead, arrival_ns, mapped))
    return host_ns


def clock_steps(device_ns: Times, arrival_ns: Times) -> list[int]:
    """Return the sorted rows at which the device's clock steps permanently relative to the host's.

    A late sample also causes a jump, but only for itself. The fastest samples in the two seconds before and after a step
    must therefore differ by at least half the jump. A gap in both clocks is not a step.
    """
    apart = arrival_ns - device_ns
    apart = (apart - apart[0]).astype(np.float64)  # (time,)
    jumps = np.abs(np.diff(apart))
    if not len(jumps) or jumps.max() <= STEP_NS:
        return []
    median_jump = float(np.median(_subsample(jumps)))  # median difference of latencies; steps are much larger
    rows = np.flatnonzero(jumps > max(STEP_NS, 8 * median_jump)) + 1
    rows = rows[np.argsort(-jumps[rows - 1], kind="stable")][:MAX_STEPS]
    period_ns = max(float(np.median(_subsample(np.diff(arrival_ns)))), 1.0)
    reach = int(np.clip(STEP_WINDOW_NS / period_ns, *STEP_WINDOW_ROWS))
    steps: list[int] = [0, len(apart)]
    for row in rows.tolist():  # largest first, so that a step separates the stalls around it
        first = max(max(step for step in steps if step <= row), row - reach)
        stop = min(min(step for step in steps if step >= row), row + reach)
        if first < row < stop:
            shift_ns = _low_quantile(apart[row:stop]) - _low_quantile(apart[first:row])
            if abs(shift_ns) > max(STEP_NS, jumps[row - 1] / 2):
                steps.append(row)
    return sorted(steps[2:])


def _subsample(values: AnyArray) -> AnyArray:
    """Return every n-th of ``values``. n is odd, so that it is not a multiple of a link's batch size."""
    return values[:: len(values) // MAX_SUBSAMPLE | 1]


def _earliest_possible(late_ns: AnyArray) -> float:
    """Return the delay below which a sample arrived impossibly early, so that its timestamp must be wrong."""
    low, middle = np.quantile(_subsample(late_ns), (ROUGH_LOW, 0.5))
    return float(low - max(middle - low, EARLY_NS))


def _low_quantile(values: Floats) -> float:
    rank = int(LOW * (len(values) - 1))
    return float(np.partition(values, rank)[rank])


def _drift(device_ns: Times, arrival_ns: Times) -> float | None:
    """Return the drift of a segment, or None if the segment is too short.

    Raises `TacpipeError` if it exceeds 10 %, or device times are constant.
    """
    since_ns = (device_ns - device_ns[0]).astype(np.float64)  # (time,)
    span_ns = float(since_ns.max())
    if len(since_ns) < LINE_ROWS or max(span_ns, float(arrival_ns[-1] - arrival_ns[0])) < LINE_NS:
        return None
    offset = arrival_ns - device_ns
    apart_ns = (offset - offset[0]).astype(np.float64)
    rough = _rough_drift(_subsample(since_ns), _subsample(apart_ns))
    if rough is None or abs(rough) > MAX_DRIFT:
        rate = "none"
        if rough is not None:
            rate = f"{1 / (1 + rough):.4g}" if rough > -1 else "negative"
        raise TacpipeError(
            f"The rate of the device's clock is {rate} times the host's over {span_ns / 1e9:.4g} s; it must be within 10 % "
            "of it, with t_device_ns in nanoseconds. Correct the timestamps, or use arrival times (`--clock arrival`)."
        )
    level_ns = apart_ns - rough * since_ns
    possible = level_ns >= _earliest_possible(level_ns)
    return rough + _envelope_slope(since_ns[possible], level_ns[possible])


def _rough_drift(since_ns: Floats, apart_ns: Floats) -> float | None:
    """Return the slope of a Theil-Sen line through a low quantile of each block of rows, or None without two times.

    It is computed twice, because a slope within a block affects the quantile.
    """
    rows = max(ROUGH_ROWS, -(-len(since_ns) // ROUGH_BLOCKS))
    whole = len(since_ns) // rows * rows
    rank = int(ROUGH_LOW * (rows - 1))
    centre = np.median(since_ns[:whole].reshape(-1, rows), axis=1)  # (block,)
    first, second = np.triu_indices(len(centre), 1)
    between_ns = centre[second] - centre[first]
    first, second, between_ns = first[between_ns > 0], second[between_ns > 0], between_ns[between_ns > 0]
    if not len(first):
        return None
    slope = 0.0
    for _ in range(2):
        low = np.partition((apart_ns - slope * since_ns)[:whole].reshape(-1, rows), rank, axis=1)[:, rank]
        slope += float(np.median((low[second] - low[first]) / between_ns))
    return slope


def _envelope_slope(since_ns: Floats, level_ns: Floats) -> float:
    """Return the slope of the edge of the lower convex hull at the mean time.

    Only the lowest row of each of `HULL_BLOCKS` blocks is used: for nearly constant values, the hull has no others.
    """
    rows = max(1, len(since_ns) // HULL_BLOCKS)
    full_rows = len(since_ns) // rows * rows
    lowest = level_ns[:full_rows].reshape(-1, rows).argmin(axis=1) + np.arange(0, full_rows, rows)
    lowest = np.append(lowest, np.arange(full_rows, len(since_ns)))
    lowest = lowest[np.lexsort((level_ns[lowest], since_ns[lowest]))]
    hull: list[tuple[float, float]] = []
    for time, level in zip(since_ns[lowest].tolist(), level_ns[lowest].tolist(), strict=True):
        if hull and time == hull[-1][0]:
            continue  # the first of two points at the same time is the lower one
        while len(hull) > 1 and _turns_up(hull[-2], hull[-1], (time, level)):
            hull.pop()
        hull.append((time, level))
    if len(hull) < 2:
        return 0.0
    mean = float(since_ns.mean())
    right = next((index for index, (time, _) in enumerate(hull) if time >= mean and index), len(hull) - 1)
    (time, level), (next_time, next_level) = hull[right - 1], hull[right]
    return (next_level - level) / (next_time - time)


def _turns_up(first: tuple[float, float], middle: tuple[float, float], last: tuple[float, float]) -> bool:
    """Return whether ``middle`` lies on or above the straight line from ``first`` to ``last``."""
    return (middle[1] - first[1]) * (last[0] - first[0]) >= (last[1] - first[1]) * (middle[0] - first[0])


def _anchor(start: int, stop: int, device_ns: Times, arrival_ns: Times, drift: float) -> Segment:
    """Return the segment whose line has ``drift`` and touches the fastest samples."""
    flat = Segment(start, stop, int(device_ns[start]), int(arrival_ns[start]), drift)
    late_ns = arrival_ns[start:stop] - flat.host_times(device_ns[start:stop])
    fastest_ns = int(late_ns[late_ns >= _earliest_possible(late_ns)].min())
    return Segment(start, stop, flat.device_ns, flat.host_ns + fastest_ns, drift)


def _map_times(segments: tuple[Segment, ...], device_ns: Times) -> Times:
    return np.concatenate([segment.host_times(device_ns[segment.start : segment.stop]) for segment in segments])


NEIGHBOURS = 3  # measurements before and after a jump that are compared to detect a reset
# smallest number of measurements and duration from which a drift is estimated
LINE_OFFSETS, LINE_OFFSETS_NS = 3, 10_000_000_000
MAX_PAIRED = 512  # maximum number of measurements for pairwise slopes; longer series are subsampled


def fit_offsets(device_ns: Times, offset_ns: Int64s) -> tuple[Segment, ...]:
    """Return one line per segment between two resets, in the order of the measurements.

    The other clock's time is ``device_ns + offset_ns``, both (measurement,). ``start`` and ``stop`` of a segment are
    indices of measurements. Without measurements there is no segment.

    >>> device_ns = np.arange(0, 100_000_000_000, 5_000_000_000)
    >>> (line,) = fit_offsets(device_ns, 7_000_000 + device_ns // 20_000)
    >>> line.host_ns, round(line.drift * 1e6)
    (7000000, 50)
    """
    if not len(device_ns):
        return ()
    edges = [0, *find_resets(device_ns, offset_ns), len(device_ns)]
    return tuple(
        _fit_line(start, stop, device_ns[start:stop], offset_ns[start:stop]) for start, stop in pairwise(edges)
    )


def find_resets(device_ns: Times, offset_ns: Int64s) -> list[int]:
    """Return the index of the first measurement after each reset or replacement of the clock.

    There, time decreases, or the offset jumps by more than any drift and does not jump back. A single outlier is not a
    reset, nor is the last measurement alone.
    """
    steps_ns = np.diff(device_ns)
    jumps_ns = np.diff(offset_ns)
    suspected = (steps_ns < 0) | (np.abs(jumps_ns) > STEP_NS + MAX_DRIFT * np.abs(steps_ns))
    rows: list[int] = []
    for row in (np.flatnonzero(suspected) + 1).tolist():
        before = offset_ns[max(rows[-1] if rows else 0, row - NEIGHBOURS) : row]
        after = offset_ns[row : row + NEIGHBOURS]
        apart_ns = abs(float(np.median(after)) - float(np.median(before)))
        stays = apart_ns > abs(float(jumps_ns[row - 1])) / 2 and len(after) > 1
        if stays or (steps_ns[row - 1] < 0 and apart_ns > STEP_NS):
            rows.append(row)
    return rows


def convert_by_segment(segments: tuple[Segment, ...], starts: list[int], device_ns: Times) -> Times:
    """Convert device times (time,) to the host's clock, each row with its segment; ``starts`` are their first rows.

    Rows before the first segment are converted with it.
    """
    edges = [0, *starts[1:], len(device_ns)]
    mapped = [
        segment.host_times(device_ns[start:stop])
        for segment, start, stop in zip(segments, edges[:-1], edges[1:], strict=True)
    ]
    return np.concatenate(mapped)


def _fit_line(start: int, stop: int, device_ns: Times, offset_ns: Int64s) -> Segment:
    """Return a segment with the median slope of all pairs and the median offset."""
    since_ns = (device_ns - device_ns[0]).astype(np.float64)  # (measurement,)
    apart_ns = (offset_ns - offset_ns[0]).astype(np.float64)
    drift = 0.0
    if len(since_ns) >= LINE_OFFSETS and since_ns.max() - since_ns.min() >= LINE_OFFSETS_NS:
        step = -(-len(since_ns) // MAX_PAIRED)
        first, second = np.triu_indices(len(since_ns[::step]), 1)
        between_ns = since_ns[::step][second] - since_ns[::step][first]
        rises_ns = apart_ns[::step][second] - apart_ns[::step][first]
        drift = float(np.median(rises_ns[between_ns > 0] / between_ns[between_ns > 0]))
    level_ns = round(float(np.median(apart_ns - drift * since_ns)))
    return Segment(start, stop, int(device_ns[0]), int(device_ns[0] + offset_ns[0]) + level_ns, drift)
