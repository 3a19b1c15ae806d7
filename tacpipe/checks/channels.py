"""Check the values of channels: missing, constant, saturated, jumping, repeated and swapped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Indices
from tacpipe.checks.check import EXCLUDE, LOADS, Check, CheckFinding, Stream, StreamName, quantity
from tacpipe.datasets.dataset import Dataset
from tacpipe.signals.runs import runs

if TYPE_CHECKING:
    import pyarrow as pa

LEAST_ROWS, DEAD_ROWS = 50, 1000  # fewest rows of a recording that are examined, and of a channel that is dead
SPIKE_RATIO = 10.0  # smallest jump of a single sample, as a multiple of the 99th percentile of the channel's steps
BLOCK_ROWS = 1 << 20  # rows whose steps are in memory at once
HELD_ROWS = 8  # largest number of rows that hold the value of a single sample
SATURATED_SHARE, SATURATED_ROWS = 0.001, 5  # smallest fraction and number of values at the end of the converter's range
RAILS = [(1 << bits) - 1 for bits in range(8, 33)]  # largest values of converters
# smallest fraction of repeated rows, and number of channels that must repeat
REPEATED_SHARE, REPEATED_CHANNELS = 0.25, 6
FROZEN_S = 1.0  # shortest time for which all channels keep their values
REST_ROWS = 10  # first rows, whose median is the level at rest
SWAP_RECORDINGS, SWAP_RATIO = 5, 30.0  # fewest recordings, and smallest distance from the usual level in deviations


class ChannelValues(Check):
    """Find channels whose values are missing, do not change, or belong to another channel."""

    sentences: ClassVar = {
        "missing-values": (
            "{cases:,} values of {channels} of {subject} are NaN or infinite.",
            f"{EXCLUDE}, or leave the columns out of the layout",
        ),
        "constant-channel": (
            "{channels} of {subject} never change in any recording, though others of their quantity do.",
            "[streams.{subject}] columns: leave them out",
        ),
        "saturated": (
            "{cases:,} values of {channels} of {subject} are at {worst:,.0f}, the end of a converter's range.",
            f"lower the gain; {EXCLUDE}",
        ),
        "spikes": (
            "{cases:,} single samples of {channels} of {subject} jump by up to {worst:,.4g} and return.",
            f"`tacpipe segment slides` replaces spikes; else {EXCLUDE}",
        ),
        "repeated-rows": (
            "Up to {worst:.0%} of the rows of {subject} repeat the row before.",
            "`tacpipe synchronize --grid fresh` leaves repeated rows out",
        ),
        "frozen": ("All channels of {subject} keep their values for up to {worst:.1f} s.", EXCLUDE),
        "swapped-channels": (
            "{channels} of {subject} have each other's level at rest.",
            "[streams.{subject}] columns: name the columns of these recordings in the order of the others",
        ),
    }

    def __init__(self) -> None:
        super().__init__()
        self._repeated: dict[str, tuple[Stream, Bools, int]] = {}  # repeated rows and number of channels, by stream
        # channels that vary in any recording, by stream and quantity
        self._varying: dict[tuple[str, str], set[str]] = {}
        self._constant: dict[tuple[str, str], list[tuple[StreamName, str, int]]] = {}
        # levels at rest, by stream and quantity
        self._levels: dict[tuple[str, str], list[tuple[StreamName, dict[str, float]]]] = {}
        self._tops: dict[tuple[str, str], float] = {}  # largest values
        self._railed: list[tuple[StreamName, tuple[str, str], str, Indices, int, float]] = []
        self._rest: dict[tuple[str, str], dict[str, float]] = {}  # levels in this recording

    def examine_channel(self, stream: Stream, channel: pa.Field, values: AnyArray) -> None:
        """Examine the values of a channel."""
        kind = quantity(channel)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            self.note("missing-values", stream, np.flatnonzero(~np.isfinite(values)), channel=channel.name)
            return
        if len(values) < LEAST_ROWS or values.dtype.kind not in "iuf" or stream.t_ns is None:
            return
        group = (stream.name, kind)
        self._rest.setdefault(group, {})[channel.name] = float(np.median(values[:REST_ROWS]))
        if values.min() == values.max() and kind in (*LOADS, "vibration"):
            self._constant.setdefault(group, []).append((stream.identity, channel.name, len(values)))
        elif values.min() < values.max() and kind in (*LOADS, "vibration"):  # a robot that rests may repeat its state
            self._varying.setdefault(group, set()).add(channel.name)
            _, repeated, count = self._repeated.get(stream.name, (stream, np.ones(len(values) - 1, dtype=bool), 0))
            self._repeated[stream.name] = (stream, repeated & (values[1:] == values[:-1]), count + 1)
        self._examine_range(stream, channel, values)
        for first in range(0, len(values), BLOCK_ROWS):
            rows, heights = spikes(values[first : first + BLOCK_ROWS], SPIKE_RATIO)
            if len(rows):
                self.note("spikes", stream, first + rows, value=heights.max(), channel=channel.name)

    def _examine_range(self, stream: Stream, channel: pa.Field, values: AnyArray) -> None:
        """Remember values at the end of a converter's range, which no recording may exceed."""
        top, group = float(values.max()), (stream.name, quantity(channel))
        self._tops[group] = max(top, self._tops.get(group, top))
        if values.dtype.kind == "f" or top not in RAILS or top == values.min():
            return
        rows = np.flatnonzero(values == top)
        if len(rows) >= max(SATURATED_ROWS, SATURATED_SHARE * len(values)):
            self._railed.append((stream.identity, group, channel.name, rows[:SATURATED_ROWS], len(rows), top))

    def finish(self, recording: str) -> None:
        """Conclude the repeated rows and the levels at rest of a recording."""
        for name, (stream, repeated, count) in self._repeated.items():
            if count < REPEATED_CHANNELS:
                continue
            if repeated.mean() > REPEATED_SHARE:
                self.note("repeated-rows", stream, np.flatnonzero(repeated) + 1, value=float(repeated.mean()))
            starts, stops = runs(repeated)
            spans_ns = np.zeros(0) if stream.t_ns is None else stream.t_ns[stops] - stream.t_ns[starts]
            if len(spans_ns) and spans_ns.max() > FROZEN_S * 1e9:
                frozen = spans_ns > FROZEN_S * 1e9
                self.note("frozen", stream, starts[frozen] + 1, value=float(spans_ns.max()) / 1e9)
            for group, levels in self._rest.items():
                if group[0] == name and len(levels) > 1:
                    self._levels.setdefault(group, []).append((stream.identity, levels))
        self._repeated, self._rest = {}, {}

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the findings, with channels that are constant while others of their quantity vary, and swapped ones."""
        for group, constant in self._constant.items():
            varying = self._varying.get(group, set())
            dead = {name for _, name, _ in constant} - varying
            counts: Counter[str] = Counter()
            for _, name, rows in constant:
                counts[name] += rows
            for stream, name, _ in constant if varying else ():
                if name in dead and counts[name] >= DEAD_ROWS:
                    self.note("constant-channel", stream, channel=name)
        for stream, group, name, railed, count, top in self._railed:
            if self._tops[group] == top:
                self.note("saturated", stream, railed, value=top, count=count, channel=name)
        for levels in self._levels.values():
            self._compare_levels(levels)
        yield from super().conclude(dataset)

    def _compare_levels(self, levels_by_stream: list[tuple[StreamName, dict[str, float]]]) -> None:
        """Find recordings in which two channels have each other's level at rest."""
        names = sorted(levels_by_stream[0][1])
        compared = [(stream, levels) for stream, levels in levels_by_stream if sorted(levels) == names]
        if len(compared) < SWAP_RECORDINGS:
            return
        table = np.array([[levels[name] for name in names] for _, levels in compared])  # (recording, channel)
        usual = np.median(table, axis=0)
        spread = np.median(np.abs(table - usual), axis=0)  # (channel,)
        # few recordings may agree by chance
        spread = np.maximum(spread, max(np.median(spread), 1e-9 * np.abs(usual).max()))
        for (stream, _), levels in zip(compared, table, strict=True):
            distances = np.abs(levels[:, None] - usual)  # (channel, channel whose usual level is compared)
            is_far = np.diagonal(distances) > SWAP_RATIO * spread
            fits = distances < 3 * spread
            is_swapped = (fits & fits.T & is_far).any(axis=1)
            if is_far.any() and is_swapped[is_far].all():  # otherwise the recording begins under load
                swapped = [names[place] for place in np.flatnonzero(is_far)]
                for name in swapped:
                    self.note("swapped-channels", stream, count=1, channel=name)


def spikes(values: AnyArray, ratio: float) -> tuple[Indices, AnyArray]:
    """Return the rows (spike,) of single samples that jump and return, and the height of each.

    Both steps exceed ``ratio`` times the 99th percentile of the channel's steps, and the values before and after agree.
    Repeated values count once.

    >>> rows, heights = spikes(np.array([0.0, 1.0] * 50 + [900.0] + [0.0, 1.0] * 50), ratio=10)
    >>> rows.tolist(), heights.tolist()
    ([100], [899.0])
    """
    changed: Bools = np.ones(len(values), dtype=bool)
    changed[1:] = values[1:] != values[:-1]
    rows = np.flatnonzero(changed)
    steps = np.diff(values[rows].astype(np.float64))
    if len(steps) < 20:
        return rows[:0], steps[:0]
    heights = np.minimum(np.abs(steps[:-1]), np.abs(steps[1:]))
    returns = (steps[:-1] * steps[1:] < 0) & (np.abs(steps[:-1] + steps[1:]) < heights / 4)
    is_spike = returns & (np.diff(rows[1:]) <= HELD_ROWS) & (heights > ratio * np.percentile(np.abs(steps), 99))
    return rows[1:-1][is_spike], heights[is_spike]
