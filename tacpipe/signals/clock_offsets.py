"""A clock whose offset to another one was measured now and then, as Lab Streaming Layer does every 5 s.

Unlike arrivals (`tacpipe.signals.clocks`), which are never early, such a measurement goes there and back, and is wrong to
either side. So the line of a stretch without a reset is a Theil-Sen line: a wrong measurement does not move it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tacpipe.arrays import Int64s, Times
from tacpipe.signals.clocks import MAX_DRIFT, STEP_NS, Segment

NEIGHBOURS = 3  # measurements on either side of a jump that must lie apart for a reset
LINE_ROWS, LINE_NS = (
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


def host_times(segments: tuple[Segment, ...], starts: list[int], device_ns: Times) -> Times:
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
    if len(since_ns) >= LINE_ROWS and since_ns.max() - since_ns.min() >= LINE_NS:
        step = -(-len(since_ns) // MAX_PAIRED)
        first, second = np.triu_indices(len(since_ns[::step]), 1)
        between_ns = since_ns[::step][second] - since_ns[::step][first]
        rises_ns = apart_ns[::step][second] - apart_ns[::step][first]
        drift = float(np.median(rises_ns[between_ns > 0] / between_ns[between_ns > 0]))
    level_ns = round(float(np.median(apart_ns - drift * since_ns)))
    return Segment(start, stop, int(device_ns[0]), int(device_ns[0] + offset_ns[0]) + level_ns, drift)
