"""A device's own clock next to the times at which its samples reached the host.

The model: ``arrival = offset + (1 + drift) * device + latency``. A latency is never negative, and the fastest samples of
a link take nearly the same time, so the line is a lower envelope: what lies above it is delay, and states nothing about
the clock. Of all lines below the samples it is the one with the least sum of vertical distances (Moon, Skelly, Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999), taken after samples that come
impossibly early are left out. On simulated links its drift was two to five times as precise as that of a Theil-Sen line
through low quantiles of blocks. The least latency itself cannot be distinguished from an offset; it stays in the offset.

A device that restarts steps its clock. Steps are looked for first, and each segment between them has its own line.
Stamps are int64 nanoseconds; first values are subtracted before anything becomes a float.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s, Times
from tacpipe.errors import TacpipeError

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
STEP_NS = 20_000_000  # smaller steps are latency: no device restarts within 20 ms
STEP_WINDOW_NS = 2_000_000_000  # time that the clock must stay on both sides of a step; stalls of a host are shorter
STEP_WINDOW_ROWS = (16, 4096)
STEPS_LOOKED_AT = 64  # the largest jumps; a link that stalls more often than that hides restarts no smaller than these
LOW = 0.1  # quantile that represents the fastest samples of a stretch: a few wrong stamps do not move it
ROUGH_LOW, ROUGH_BLOCKS, ROUGH_ROWS = 0.05, 64, 8  # quantile, number and least length of the blocks of the first line
EARLY_NS = 100_000.0  # least distance below the first line beyond which a sample is left out
LINE_ROWS, LINE_NS = 32, 2_000_000_000  # least rows and time of a line: a shorter one shows jitter, no drift
HULL_BLOCKS = 512
ENOUGH_ROWS = 1 << 14  # rows for a median and for the first line; the envelope itself uses all rows
MAX_DRIFT = 0.1  # an RC oscillator is off by a few percent; beyond, the stamps are not nanoseconds


@dataclass(frozen=True)
class Segment:
    """The rows from ``start`` to ``stop`` (exclusive) between two steps, and the line that maps their device time."""

    start: int
    stop: int
    device_ns: int  # device time of the segment's first row
    host_ns: int  # the host's time at that reading
    drift: float  # host seconds a device second, less 1

    def host_times(self, device_ns: Times) -> Times:
        """Return the host's time (time,) at readings of the device."""
        since_ns = device_ns - np.int64(self.device_ns)
        mapped: Times = np.int64(self.host_ns) + since_ns + np.rint(since_ns * self.drift).astype(np.int64)
        return mapped


@dataclass(frozen=True)
class ClockFit:
    """The fitted clock of a device, and the delays of its samples.

    ``residual_ns`` are the quantiles `QUANTILES` of arrival less mapped time: latency beyond that of the fastest samples.
    """

    segments: tuple[Segment, ...]
    residual_ns: tuple[float, ...]
    median_residual_ns: float  # median of the absolute residuals

    @property
    def longest(self) -> Segment:
        """The segment with the most rows, which speaks for the clock."""
        return max(self.segments, key=lambda segment: segment.stop - segment.start)

    @property
    def offset_ns(self) -> int:
        """Host less device time at the first row of the longest segment."""
        return self.longest.host_ns - self.longest.device_ns

    @property
    def drift_ppm(self) -> float:
        """Parts per million by which the host's clock is faster than the device's, in the longest segment."""
        return self.longest.drift * 1e6


def fit_clock(device_ns: Times, arrival_ns: Times, certain: Bools | None = None) -> ClockFit:
    """Return the fit of a device's clock (time,) against the arrival of its samples (time,), in row order.

    Where ``certain`` (time,) is given, the other rows have arrivals that state nothing, as of a host that was held up,
    and are left out; where no row is certain, all are taken. A segment too short to show a drift takes that of the
    longest one that does, or none. Raises `TacpipeError` for a clock that stands still, or whose rate differs from the
    host's by more than 10 %.

    >>> device_ns = np.arange(0, 10_000_000_000, 1_000_000)
    >>> fit = fit_clock(device_ns, 500 + device_ns + device_ns // 20_000)
    >>> fit.offset_ns, round(fit.drift_ppm)
    (500, 50)
    """
    if len(device_ns) != len(arrival_ns) or not len(device_ns):
        raise TacpipeError(
            f"{len(device_ns)} device stamps and {len(arrival_ns)} arrivals do not define a clock; give equally many "
            "of both, at least one."
        )
    if certain is not None and certain.any() and not certain.all():
        rows = np.flatnonzero(certain)
        return _spread(fit_clock(device_ns[rows], arrival_ns[rows]), rows, len(device_ns))
    if len(device_ns) > 1 and not np.any(device_ns != device_ns[0]):
        raise TacpipeError(
            f"The device's clock stays at {device_ns[0]} ns in all {len(device_ns)} rows. "
            "Leave t_device_ns out, or use the time of arrival (`--clock arrival`)."
        )
    edges = [0, *clock_steps(device_ns, arrival_ns), len(device_ns)]
    spans = list(pairwise(edges))
    drifts = [_drift(device_ns[start:stop], arrival_ns[start:stop]) for start, stop in spans]
    fitted = [(stop - start, drift) for (start, stop), drift in zip(spans, drifts, strict=True) if drift is not None]
    borrowed = max(fitted)[1] if fitted else 0.0
    segments = tuple(
        _anchored(start, stop, device_ns, arrival_ns, borrowed if drift is None else drift)
        for (start, stop), drift in zip(spans, drifts, strict=True)
    )
    late_ns = (arrival_ns - _mapped(segments, device_ns)).astype(np.float64)  # (time,)
    quantiles = tuple(float(value) for value in np.quantile(late_ns, QUANTILES))
    return ClockFit(segments, quantiles, float(np.median(np.abs(late_ns))))


def _spread(fit: ClockFit, rows: Int64s, count: int) -> ClockFit:
    """Return a fit of some ``rows`` as one of all ``count``: a row that was left out belongs to the segment before it."""
    edges = [0, *(int(rows[segment.start]) for segment in fit.segments[1:]), count]
    spans = zip(fit.segments, edges[:-1], edges[1:], strict=True)
    return replace(fit, segments=tuple(replace(segment, start=start, stop=stop) for segment, start, stop in spans))


def host_times(fit: ClockFit, device_ns: Times, arrival_ns: Times) -> Times:
    """Return when samples were taken on the host's clock (time,): device time mapped by ``fit``, never decreasing.

    A stamp that maps to more than 20 ms after its own arrival is wrong, and the arrival stands in for it; otherwise one
    such stamp would hold up all that follow.
    """
    mapped = _mapped(fit.segments, device_ns)
    ahead = mapped - arrival_ns > STEP_NS
    host_ns: Times = np.maximum.accumulate(np.where(ahead, arrival_ns, mapped))
    return host_ns


def clock_steps(device_ns: Times, arrival_ns: Times) -> list[int]:
    """Return, sorted, the rows at which the device's clock steps against the host's for good.

    A late sample jumps too, but the clock behind it is where it was: so the fastest samples of the two seconds before
    and after must lie apart by at least half the jump. Raises nothing; a gap in both clocks is not a step.
    """
    apart = arrival_ns - device_ns
    apart = (apart - apart[0]).astype(np.float64)  # (time,)
    jumps = np.abs(np.diff(apart))
    if not len(jumps) or jumps.max() <= STEP_NS:
        return []
    usual = float(np.median(_some(jumps)))  # median difference of latencies; a step is far beyond
    rows = np.flatnonzero(jumps > max(STEP_NS, 8 * usual)) + 1
    rows = rows[np.argsort(-jumps[rows - 1], kind="stable")][:STEPS_LOOKED_AT]
    period_ns = max(float(np.median(_some(np.diff(arrival_ns)))), 1.0)
    reach = int(np.clip(STEP_WINDOW_NS / period_ns, *STEP_WINDOW_ROWS))
    steps: list[int] = [0, len(apart)]
    for row in rows.tolist():  # largest first, so that a step is derived from the stalls around it
        first = max(max(step for step in steps if step <= row), row - reach)
        stop = min(min(step for step in steps if step >= row), row + reach)
        if first < row < stop:
            moved = _low(apart[row:stop]) - _low(apart[first:row])
            if abs(moved) > max(STEP_NS, jumps[row - 1] / 2):
                steps.append(row)
    return sorted(steps[2:])


def _some(values: AnyArray) -> AnyArray:
    """Return evenly spaced ones of ``values``; the step is odd, so that it keeps time with no link's batches."""
    return values[:: len(values) // ENOUGH_ROWS | 1]


def _earliest(late_ns: AnyArray) -> float:
    """Return the lateness below which a sample came impossibly early: its stamp is wrong."""
    low, middle = np.quantile(_some(late_ns), (ROUGH_LOW, 0.5))
    return float(low - max(middle - low, EARLY_NS))


def _low(values: Floats) -> float:
    rank = int(LOW * (len(values) - 1))
    return float(np.partition(values, rank)[rank])


def _drift(device_ns: Times, arrival_ns: Times) -> float | None:
    """Return the drift of one segment, or None if it is too short to show one."""
    since_ns = (device_ns - device_ns[0]).astype(np.float64)  # (time,)
    span_ns = float(since_ns.max())
    if len(since_ns) < LINE_ROWS or max(span_ns, float(arrival_ns[-1] - arrival_ns[0])) < LINE_NS:
        return None
    apart = arrival_ns - device_ns
    apart_ns = (apart - apart[0]).astype(np.float64)
    rough = _rough_drift(_some(since_ns), _some(apart_ns))
    if rough is None or abs(rough) > MAX_DRIFT:
        rate = "none" if rough is None else f"{1 / (1 + rough):.4g}" if rough > -1 else "negative"
        raise TacpipeError(
            f"The device's clock runs at {rate} times the host's over {span_ns / 1e9:.4g} s; it must run within 10 % of "
            "it, and t_device_ns be in nanoseconds. Fix the stamps, or use the time of arrival (`--clock arrival`)."
        )
    level_ns = apart_ns - rough * since_ns
    possible = level_ns >= _earliest(level_ns)
    return rough + _envelope_slope(since_ns[possible], level_ns[possible])


def _rough_drift(since_ns: Floats, apart_ns: Floats) -> float | None:
    """Return the slope of a Theil-Sen line through a low quantile of each block of rows; None without two times.

    Twice, because within a block a slope spreads the values.
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
    """Return the slope of the edge of the lower convex hull that lies over the mean time.

    Only the lowest row of each of `HULL_BLOCKS` blocks is looked at: of nearly level values the hull has no others.
    """
    rows = max(1, len(since_ns) // HULL_BLOCKS)
    full_rows = len(since_ns) // rows * rows
    lowest = level_ns[:full_rows].reshape(-1, rows).argmin(axis=1) + np.arange(0, full_rows, rows)
    lowest = np.append(lowest, np.arange(full_rows, len(since_ns)))
    lowest = lowest[np.lexsort((level_ns[lowest], since_ns[lowest]))]
    hull: list[tuple[float, float]] = []
    for time, level in zip(since_ns[lowest].tolist(), level_ns[lowest].tolist(), strict=True):
        if hull and time == hull[-1][0]:
            continue  # of two points at one time the first is the lower
        while len(hull) > 1 and _turns_up(hull[-2], hull[-1], (time, level)):
            hull.pop()
        hull.append((time, level))
    if len(hull) < 2:
        return 0.0
    mean = float(since_ns.mean())
    right = next((place for place, (time, _) in enumerate(hull) if time >= mean and place), len(hull) - 1)
    (time, level), (next_time, next_level) = hull[right - 1], hull[right]
    return (next_level - level) / (next_time - time)


def _turns_up(first: tuple[float, float], middle: tuple[float, float], last: tuple[float, float]) -> bool:
    """Return whether ``middle`` lies on or above the straight line from ``first`` to ``last``."""
    return (middle[1] - first[1]) * (last[0] - first[0]) >= (last[1] - first[1]) * (middle[0] - first[0])


def _anchored(start: int, stop: int, device_ns: Times, arrival_ns: Times, drift: float) -> Segment:
    """Return the segment with the line of this drift that touches its fastest samples."""
    flat = Segment(start, stop, int(device_ns[start]), int(arrival_ns[start]), drift)
    late_ns = arrival_ns[start:stop] - flat.host_times(device_ns[start:stop])
    fastest_ns = int(late_ns[late_ns >= _earliest(late_ns)].min())
    return Segment(start, stop, flat.device_ns, flat.host_ns + fastest_ns, drift)


def _mapped(segments: tuple[Segment, ...], device_ns: Times) -> Times:
    return np.concatenate([segment.host_times(device_ns[segment.start : segment.stop]) for segment in segments])


NEIGHBOURS = 3  # measurements on either side of a jump that must lie apart for a reset
LINE_OFFSETS, LINE_OFFSETS_NS = (
    3,
    10_000_000_000,
)  # least measurements and time of a line: a shorter one shows the errors of its measurements, no drift
MAX_PAIRED = 512  # measurements whose pairs are looked at; of more, as many evenly spaced


def fit_offsets(device_ns: Times, offset_ns: Int64s) -> tuple[Segment, ...]:
    """Return a clock's lines, one a stretch between two resets, in the order of the measurements.

    ``offset_ns`` (measurement,) is what was to be added to the clock's reading ``device_ns`` (measurement,) for the other
    clock's time. ``start`` and ``stop`` of a segment count measurements; there is none without a measurement.

    >>> device_ns = np.arange(0, 100_000_000_000, 5_000_000_000)
    >>> (line,) = fit_offsets(device_ns, 7_000_000 + device_ns // 20_000)
    >>> line.host_ns, round(line.drift * 1e6)
    (7000000, 50)
    """
    if not len(device_ns):
        return ()
    edges = [0, *resets(device_ns, offset_ns), len(device_ns)]
    return tuple(_line(start, stop, device_ns[start:stop], offset_ns[start:stop]) for start, stop in pairwise(edges))


def resets(device_ns: Times, offset_ns: Int64s) -> list[int]:
    """Return the measurements that are the first after the clock was reset, or replaced by another one.

    That is where it went back, and where the offset jumps by more than any drift and stays there: one measurement that
    is wrong is not a reset, nor is the very last one alone.
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


def times_by_offsets(segments: tuple[Segment, ...], starts: list[int], device_ns: Times) -> Times:
    """Return readings of the clock (time,) as times of the other one; ``starts`` is the first row of each segment.

    Where the first segment does not start at row 0, it is used for the rows before it too.
    """
    edges = [0, *starts[1:], len(device_ns)]
    mapped = [
        segment.host_times(device_ns[start:stop])
        for segment, start, stop in zip(segments, edges[:-1], edges[1:], strict=True)
    ]
    return np.concatenate(mapped)


def _line(start: int, stop: int, device_ns: Times, offset_ns: Int64s) -> Segment:
    """Return the line of one stretch: median slope of all pairs, and median offset."""
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
