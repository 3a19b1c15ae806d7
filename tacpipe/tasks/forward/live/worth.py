"""What recordings of live sessions show, over all of them: metrics, a table, and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.signals import leads
from tacpipe.signals.leads import Leads
from tacpipe.tasks.forward.live import truth

LIVE, LIVE_STILL, OFFLINE, STILL = "live", "live_persistence", "offline", "persistence"
PREDICTORS = (LIVE, LIVE_STILL, OFFLINE, STILL)
Sums = dict[str, tuple[Floats, Floats]]  # squared and absolute errors (step,) by predictor


class Session(NamedTuple):
    """What a recording shows of a live session."""

    equality: truth.Equality
    explained: int  # published rows that differ after a sample that came too late
    rows: int  # that errors are of
    sums: Sums
    alarms: dict[str, dict[str, Leads]]  # alarm and event, to live and offline
    latency_ms: Floats
    skipped: int
    late: int


def summed(sessions: Sequence[Session], steps: Sequence[int], channels: int) -> dict[str, Any]:
    """Return the metrics of some sessions together; mean absolute errors are in the unit of the channels."""
    rows = sum(one.rows for one in sessions)
    mae = {
        name: {
            f"t{step}": float(f"{sum(one.sums[name][1][place] for one in sessions if one.sums) / rows / channels:.9g}")
            for place, step in enumerate(steps)
        }
        for name in PREDICTORS
        if rows
    }
    of = [one.equality for one in sessions]
    return {
        "rows": {
            "published": sum(one.published for one in of),
            "recomputed": sum(one.recomputed for one in of),
            "compared": sum(one.compared for one in of),
            "equal": sum(one.equal for one in of),
            "differ_after_late_samples": sum(one.explained for one in sessions),
            "largest_difference": max((one.largest_difference for one in of), default=0.0),
            "late_samples": sum(one.late for one in sessions),
            "skipped": sum(one.skipped for one in sessions),
            "of_errors": rows,
        },
        "mae": mae,
        "latency": truth.quantiles(np.concatenate([one.latency_ms for one in sessions])),
        "alarms": _pooled([one.alarms for one in sessions]),
    }


def _pooled(several: Sequence[Mapping[str, Mapping[str, Leads]]]) -> dict[str, Any]:
    """Return what alarms were worth over sessions."""
    found: dict[str, Any] = {}
    for kind in dict.fromkeys(kind for one in several for kind in one):
        for who in dict.fromkeys(who for one in several for who in one.get(kind, {})):
            parts = [one[kind][who] for one in several if who in one.get(kind, {})]
            found.setdefault(kind, {})[who] = leads.summed(parts)
    return found


def sentences(live: Mapping[str, Any]) -> list[str]:
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
    found = [f"{same}. {rows['skipped']} rows were skipped under overload."]
    if latency["count"]:
        found.append(
            f"Latency of {latency['count']} forecasts: median {latency['median_ms']:.1f} ms, 99 % "
            f"{latency['p99_ms']:.1f} ms, largest {latency['largest_ms']:.1f} ms."
        )
    return found


def table(live: Mapping[str, Any], steps: Sequence[int]) -> bytes:
    """Return the errors of live and offline forecasts and of persistence as CSV."""
    lines = ["predictor," + ",".join(f"mae_t{step}" for step in steps)]
    for name in PREDICTORS:
        errors = live["mae"].get(name)
        if errors:
            lines.append(f"{name}," + ",".join(f"{errors[f't{step}']:.6g}" for step in steps))
    return ("\n".join(lines) + "\n").encode()
