"""Measure recorded live sessions against the recordings: equality, errors and latencies.

Times are those of rows of the live grid. The truth is the recording after the model's own stages, offline; counts between
two of its rows are interpolated. Counts here include the level at rest, because that of a session and that of the whole
recording may differ by some counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Float32s, Floats, Int64s, Times
from tacpipe.live.messages import summarize_latencies
from tacpipe.tasks.forward.headline import LiveMeasures


@dataclass(frozen=True)
class Equality:
    """Published values against those that `tacpipe predict --causal` gives, row by row."""

    published: int  # rows
    recomputed: int  # rows
    compared: int  # rows that are in both
    equal: int  # compared rows whose values are all equal, bit for bit
    largest_difference: float  # largest difference of the other rows, in the unit of the channels; 0: no such row


def equality(
    published_ns: Times, published: Float32s, recomputed_ns: Times, recomputed: Float32s
) -> tuple[Equality, Bools]:
    """Compare rows (row, step, channel) by time; return the counts, and which published rows are equal (row,)."""
    _, published_rows, recomputed_rows = np.intersect1d(published_ns, recomputed_ns, return_indices=True)
    sent, predicted_again = (
        np.ascontiguousarray(values, np.float32) for values in (published[published_rows], recomputed[recomputed_rows])
    )
    same = (
        (sent.view(np.int32) == predicted_again.view(np.int32)).all(axis=(1, 2))
        if len(published_rows)
        else np.zeros(0, bool)
    )
    largest = float(np.abs(sent[~same] - predicted_again[~same]).max()) if (~same).any() else 0.0
    equal = np.zeros(len(published_ns), bool)
    equal[published_rows] = same
    result = Equality(len(published_ns), len(recomputed_ns), len(published_rows), int(same.sum()), largest)
    return result, equal


def interpolate(t_ns: Times, values: AnyFloats, groups: Int64s, usable: Bools, target_ns: Times) -> Floats:
    """Return values (target, channel) at ``target_ns``, interpolated between rows ``values`` (time, channel).

    A value is NaN unless the rows before and after it are ``usable`` (time,) and in the same of ``groups`` (time,).

    >>> t_ns, values = np.array([0, 10, 20]), np.array([[0.0], [5.0], [7.0]])
    >>> groups, usable = np.array([0, 0, 1]), np.array([True, True, True])
    >>> interpolate(t_ns, values, groups, usable, np.array([5, 10, 15, 20, 21])).T.tolist()
    [[2.5, 5.0, nan, 7.0, nan]]
    """
    interpolated = np.full((len(target_ns), values.shape[1]), np.nan)
    if not len(t_ns):
        return interpolated
    after = np.clip(np.searchsorted(t_ns, target_ns, side="left"), 0, len(t_ns) - 1)
    before = np.where(t_ns[after] == target_ns, after, np.maximum(after - 1, 0))
    inside = (target_ns >= t_ns[0]) & (target_ns <= t_ns[-1])
    inside &= usable[before] & usable[after] & (groups[before] == groups[after])
    first, last = before[inside], after[inside]
    span = np.maximum(t_ns[last] - t_ns[first], 1)
    weight = ((target_ns[inside] - t_ns[first]) / span)[:, None]
    interpolated[inside] = values[first] * (1 - weight) + values[last] * weight
    return interpolated


def targets(rows_ns: Times, row: Times, steps: tuple[int, ...], period_ns: float | None) -> Times:
    """Return the times (row, step) that are predicted at some ``row`` times: so many periods, or ``rows_ns``, later.

    Without a period a step is a row of the grid; -1 where the grid ends before.

    >>> targets(np.array([0, 7, 20]), np.array([0, 7]), (1, 2), None).tolist()
    [[7, 20], [20, -1]]
    """
    target_ns: Times
    if period_ns is not None:
        target_ns = row[:, None] + np.rint(np.array(steps) * period_ns).astype(np.int64)
        return target_ns
    target_rows = np.searchsorted(rows_ns, row)[:, None] + np.array(steps)
    target_ns = np.append(rows_ns, -1)[np.minimum(target_rows, len(rows_ns))]
    return target_ns


def sums(predicted: AnyFloats, truth: AnyFloats) -> tuple[Floats, Floats]:
    """Return the sums of squared and absolute errors (step,) over rows and channels of values (row, step, channel)."""
    errors = predicted.astype(np.float64) - truth
    return np.square(errors).sum(axis=(0, 2)), np.abs(errors).sum(axis=(0, 2))


LIVE, LIVE_STILL, OFFLINE, STILL = "live", "live_persistence", "offline", "persistence"
PREDICTORS = (LIVE, LIVE_STILL, OFFLINE, STILL)
Sums = dict[str, tuple[Floats, Floats]]  # squared and absolute errors (step,) by predictor


class Session(NamedTuple):
    """Measures of one recorded live session."""

    equality: Equality
    explained: int  # published rows that differ after a sample that came too late
    rows: int  # rows whose errors count
    sums: Sums
    latency_ms: Floats
    skipped: int
    late: int


def summed(sessions: Sequence[Session], steps: Sequence[int], channels: int) -> LiveMeasures:
    """Return the metrics of some sessions together; mean absolute errors are in the unit of the channels."""
    rows = sum(session.rows for session in sessions)
    mae: dict[str, dict[str, float]] = {}
    for name in PREDICTORS if rows else ():
        absolute: Any = sum(session.sums[name][1] for session in sessions if session.sums) / rows / channels  # (step,)
        mae[name] = {f"t{step}": float(f"{absolute[index]:.9g}") for index, step in enumerate(steps)}
    equalities = [session.equality for session in sessions]
    return {
        "rows": {
            "published": sum(session.published for session in equalities),
            "recomputed": sum(session.recomputed for session in equalities),
            "compared": sum(session.compared for session in equalities),
            "equal": sum(session.equal for session in equalities),
            "differ_after_late_samples": sum(session.explained for session in sessions),
            "largest_difference": max((session.largest_difference for session in equalities), default=0.0),
            "late_samples": sum(session.late for session in sessions),
            "skipped": sum(session.skipped for session in sessions),
            "of_errors": rows,
        },
        "mae": mae,
        "latency": summarize_latencies(np.concatenate([session.latency_ms for session in sessions])),
    }


def sentences(live: LiveMeasures) -> list[str]:
    """Return what is to be known of live sessions in words: equality, rows left out, latency."""
    rows, latency = live["rows"], live["latency"]
    counted = f"{rows['equal']} of {rows['compared']} published forecasts"
    same = f"{counted} are what `tacpipe predict --causal` gives, bit for bit"
    differ = rows["compared"] - rows["equal"]
    if differ:
        same += (
            f"; of the {differ} others {rows['differ_after_late_samples']} follow samples that came too late "
            f"({rows['late_samples']} samples), and the largest difference is {rows['largest_difference']:.3g}"
        )
    lines = [f"{same}. {rows['skipped']} rows were skipped under overload."]
    if latency["count"]:
        lines.append(
            f"Latency of {latency['count']} forecasts: median {latency['median_ms']:.1f} ms, 99 % "
            f"{latency['p99_ms']:.1f} ms, largest {latency['largest_ms']:.1f} ms."
        )
    return lines


def table(live: LiveMeasures, steps: Sequence[int]) -> bytes:
    """Return the errors of live and offline forecasts and of persistence as CSV."""
    lines = ["predictor," + ",".join(f"mae_t{step}" for step in steps)]
    for name in PREDICTORS:
        errors = live["mae"].get(name)
        if errors:
            lines.append(f"{name}," + ",".join(f"{errors[f't{step}']:.6g}" for step in steps))
    return ("\n".join(lines) + "\n").encode()
