"""Convert the stamps of a stream in an XDF file to the clock of the recorder, and repair jumps of the sender's clock.

A clock that jumps and comes back affects only the samples in between: the samples around them continue each other.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s, Times
from tacpipe.channels import lsl
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt
from tacpipe.signals import clocks

if TYPE_CHECKING:
    from tacpipe.formats.xdf_streams import StreamReading

FAR_NS = 600 * 10**9  # maximum time between a stamp and a measurement of its clock's offset, every five seconds
DAY_NS = 86_400 * 10**9
JUMP_PERIODS = 8  # smallest step back of a clock that jumps, in periods; smaller ones are samples out of order
MAX_CANDIDATES = 64  # maximum number of steps forward that a step back is compared with


class RecorderTimes(NamedTuple):
    """The times of a stream's samples on the recorder's clock."""

    t_ns: Times  # (sample,)
    attributes: dict[str, Attribute]  # properties of the fit of the clock offsets
    remarks: list[str]


def recorder_times(stream: StreamReading) -> RecorderTimes | str:
    """Return the times of a stream's samples, or the reason why they cannot be determined."""
    raw_s = np.concatenate(stream.stamps)
    is_time = np.abs(raw_s) < lsl.MAX_TIME_S
    if not is_time.all():
        return f"its stamp {excerpt(float(raw_s[~is_time][0]))} is not a time in seconds"
    raw_ns = lsl.nanoseconds(raw_s)
    measured = _valid_offsets(stream)
    attributes: dict[str, Attribute] = {}
    remarks: list[str] = []
    t_ns = raw_ns
    if len(measured):
        lines = clocks.fit_offsets(measured[:, 0], measured[:, 1])
        starts = [0, *(_reset_row(stream, raw_ns, measured, line.start) for line in lines[1:])]
        t_ns = clocks.convert_by_segment(lines, starts, raw_ns)
        longest = max(lines, key=lambda line: line.stop - line.start)
        attributes = {"lsl_drift_ppm": round(longest.drift * 1e6, 3), "lsl_clock_resets": len(lines) - 1}
    else:
        remarks.append("has no clock offsets: its stamps are taken for the recorder's.")
    jumped = _find_jumps(t_ns, raw_ns, measured)
    if jumped.any():
        repaired_ns = _interpolate(t_ns, jumped)
        apart_ns = int(np.abs(repaired_ns - t_ns).max())
        remarks.append(
            f"has {np.count_nonzero(jumped):,} stamps that jump by up to {apart_ns / 1e9:.6g} s, the first at "
            f"sample {int(jumped.argmax()) + 1:,}: t_ns is interpolated there."
        )
        t_ns = repaired_ns
    back_ns = np.maximum.accumulate(t_ns) - t_ns
    if back_ns.any():
        rows = int(np.count_nonzero(back_ns))
        if not len(measured) and back_ns.max() > clocks.STEP_NS and rows > len(t_ns) // 2:
            row = int(back_ns.argmax())
            return (
                f"its clock went back by {back_ns[row] / 1e9:.6g} s at sample {row + 1}, and no clock offset states by how "
                "much it was set"
            )
        remarks.append(
            f"has {rows:,} stamps before the one above, by up to {back_ns.max() / 1e9:.6g} s: t_ns has that one for them."
        )
    return RecorderTimes(t_ns + back_ns, attributes, remarks)


def _valid_offsets(stream: StreamReading) -> Int64s:
    """Return the finite clock offsets in ns, shape (measurement, reading and offset)."""
    offsets_s = np.array(stream.offsets, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([lsl.nanoseconds(column) for column in offsets_s[is_valid(offsets_s)].T])


def is_valid(offsets_s: Floats) -> AnyArray:
    """Return which clock offsets (measurement, reading and offset) are times."""
    return np.asarray((np.abs(offsets_s) < lsl.MAX_TIME_S).all(axis=1))


def _reset_row(stream: StreamReading, raw_ns: Times, measured: Int64s, first: int) -> int:
    """Return the first sample after the sender's clock was reset. ``first`` is the first measurement after the reset.

    The sample is between that measurement and the previous one or, because samples are written late, just after it.
    """
    valid_rows = np.flatnonzero(is_valid(np.array(stream.offsets, dtype=np.float64)))
    rows = [*(stream.rows_before[row] for row in valid_rows.tolist()), len(raw_ns)]
    low, high = rows[first - 1], min(rows[first + 1], len(raw_ns))
    steps = np.diff(raw_ns[max(low - 1, 0) : high])
    if not len(steps):
        return min(rows[first], len(raw_ns))
    jump = int(np.abs(steps - np.median(steps)).argmax())
    expected = measured[first, 0] - measured[first - 1, 0]
    if abs(int(steps[jump])) < abs(int(expected)) / 2 and (steps >= 0).all():
        return min(rows[first], len(raw_ns))  # no sample shows the reset, because none was sent in between
    return max(low - 1, 0) + jump + 1


def _find_jumps(t_ns: Times, raw_ns: Times, measured: Int64s) -> Bools:
    """Return which samples (sample,) have stamps of a clock that jumped and came back.

    ``raw_ns`` are the stamps of the sender. Its clock was read for each of the offsets in ``measured``, so stamps far
    from all readings are jumps too, unless they are most. Without offsets, they are stamps days from all others.
    """
    near_ns, far_ns = (measured[:, 0], FAR_NS) if len(measured) else (np.quantile(raw_ns, (0.05, 0.95)), DAY_NS)
    jumped: Bools = (raw_ns < near_ns.min() - far_ns) | (raw_ns > near_ns.max() + far_ns)
    jumped &= np.count_nonzero(jumped) < len(jumped) / 2
    rows = np.flatnonzero(~jumped)
    for start, stop in _excursions(t_ns[rows]):
        jumped[rows[start] : rows[stop - 1] + 1] = True
    return jumped


def _excursions(t_ns: Times) -> list[tuple[int, int]]:
    """Return the spans of samples between which the others continue each other.

    Samples are split into runs at steps back and at long steps. A run that precedes the end of the others is the return
    from a jump forward, or the start of a jump back.
    """
    steps_ns = np.diff(t_ns)
    if not (steps_ns < 0).any():
        return []
    period_ns = float(np.median(steps_ns[steps_ns > 0])) if (steps_ns > 0).any() else 1.0
    edges = [0, *(np.flatnonzero((steps_ns < 0) | (steps_ns > 2 * period_ns)) + 1).tolist(), len(t_ns)]
    spans: list[tuple[int, int]] = []
    starts: list[int] = [0]  # first samples of the runs that follow one another
    last_ns = int(t_ns[edges[1] - 1])  # end of these runs
    first_behind: int | None = None  # first sample of the runs that precede the end
    for start, stop in itertools.pairwise(edges[1:]):
        first_ns = int(t_ns[start])

        def continues(begin: int, back_ns: int, first_ns: int = first_ns, start: int = start) -> bool:
            """Return whether the sample at ``start`` continues the one before ``begin``, given the size of the jump."""
            expected_ns = t_ns[begin - 1] + (start - begin + 1) * period_ns
            return back_ns > JUMP_PERIODS * period_ns and abs(first_ns - expected_ns) < back_ns / 8 + 2 * period_ns

        if first_ns < last_ns:
            back_ns = last_ns - first_ns
            begin = next((begin for begin in starts[:0:-1][:MAX_CANDIDATES] if continues(begin, back_ns)), None)
            if begin is None:
                first_behind = start if first_behind is None else first_behind
                continue
            spans.append((begin, start))
            starts = [begin_before for begin_before in starts if begin_before < begin]
        elif first_behind is not None and continues(first_behind, last_ns - int(t_ns[first_behind])):
            spans.append((first_behind, start))
        first_behind, last_ns = None, int(t_ns[stop - 1])
        starts.append(start)
    return spans


def _interpolate(t_ns: Times, jumped: Bools) -> Times:
    """Return the stamps (sample,) with the jumped ones at equal steps between those around them."""
    rows = np.flatnonzero(~jumped)
    since_ns = np.maximum.accumulate(t_ns[rows]) - t_ns[rows[0]]
    filled_ns = np.rint(np.interp(np.arange(len(t_ns)), rows, since_ns)).astype(np.int64)
    period_ns = int(np.median(np.diff(since_ns))) if len(rows) > 1 else 0
    filled_ns[: rows[0]] -= period_ns * np.arange(rows[0], 0, -1)
    filled_ns[rows[-1] :] += period_ns * np.arange(len(t_ns) - rows[-1])
    return np.where(jumped, t_ns[rows[0]] + filled_ns, t_ns)
