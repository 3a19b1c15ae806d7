"""Read when a held object slips, and when it is touched, from the labels of a recording.

Slips are rows of a label column (``slip`` of `tacpipe segment slips`, `tacpipe segment losses` or a published dataset,
``gt_slip`` of the simulator), or the intervals of the recording label ``slip_intervals``, which `tacpipe label
--interval` sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Times
from tacpipe.datasets.dataset import Recording
from tacpipe.datasets.intervals import intervals_of
from tacpipe.signals.runs import runs

COLUMNS = ("slip", "slip_slip", "gt_slip")  # columns of stages, synchronized label streams and the simulator
# columns of `segment contacts` and `segment losses`, and of the simulator; negative without contact
CONTACT = ("contact", "gt_contact")
MERGED_NS = 200_000_000  # slips that are closer than this are one event


@dataclass(frozen=True)
class SlipLabels:
    """The slips of a recording."""

    events: Times  # (event, 2), first and last time of each slip
    contact: tuple[Times, Bools] | None  # times and whether the object is touched (time,); None if unlabelled


def read_labels(recording: Recording) -> SlipLabels | None:
    """Return the slips of a recording, or None if it has no label of slips, or one that is unknown."""
    contact = _contact(recording)
    intervals = intervals_of(recording.attributes, "slip")
    if intervals is not None:
        start_ns = min(
            int(_times(recording, stream)[0]) for stream in recording.streams if _times(recording, stream).size
        )
        events = [(start_ns + round(begin * 1e9), start_ns + round(end * 1e9)) for begin, end in intervals]
        return SlipLabels(np.array(events, np.int64).reshape(-1, 2), contact)
    labels = _columns(recording, COLUMNS)
    if not labels:
        return None
    if any((values < 0).any() for _, values in labels):
        return None
    return SlipLabels(merge_events([run_times(t_ns, values > 0) for t_ns, values in labels]), contact)


def run_times(t_ns: Times, active: Bools) -> Times:
    """Return first and last time of each run of active rows (run, 2).

    >>> run_times(np.array([0, 1, 2, 3]), np.array([True, False, True, True])).tolist()
    [[0, 0], [2, 3]]
    """
    starts, stops = runs(active)
    return np.stack([t_ns[starts], t_ns[stops - 1]], axis=1).astype(np.int64)


def merge_events(parts: Sequence[Times]) -> Times:
    """Return the union of intervals (event, 2). Intervals less than `MERGED_NS` apart are merged."""
    events: list[list[int]] = []
    for begin, end in sorted(tuple(row) for part in parts for row in part.tolist()):
        if events and begin - events[-1][1] < MERGED_NS:
            events[-1][1] = max(events[-1][1], end)
        else:
            events.append([begin, end])
    return np.array(events, np.int64).reshape(-1, 2)


def _contact(recording: Recording) -> tuple[Times, Bools] | None:
    """Return times (time,) and whether the object is touched (time,), or None if no column states it."""
    columns = _columns(recording, CONTACT)
    if not columns:
        return None
    t_ns, values = columns[0]
    return t_ns, values >= 0


def _columns(recording: Recording, names: Sequence[str]) -> list[tuple[Times, Any]]:
    """Return times and values of the first of these columns that a stream has, for each stream that has one."""
    found = []
    for stream in recording.streams:
        existing = recording.columns(stream).column_names
        name = next((name for name in names if name in existing), None)
        if name is not None:
            table = recording.table(stream, ["t_ns", name])
            found.append((table["t_ns"].to_numpy(), table[name].to_numpy()))
    return found


def _times(recording: Recording, stream: str) -> Times:
    times: Times = recording.table(stream, ["t_ns"])["t_ns"].to_numpy()
    return times
