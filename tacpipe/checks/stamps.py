"""Check the stamps of streams: collisions, resolution, jumps, steps back, gaps and rates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from tacpipe.arrays import Times
from tacpipe.channels.schema import declared_period_ns, has_arrivals
from tacpipe.checks.check import Check, CheckFinding, Stream, StreamName, quantity
from tacpipe.datasets.dataset import Dataset

DAY_NS = 86_400 * 10**9
TYPICAL_ROWS = 1 << 18  # first rows whose steps are typical
LATTICE_ROWS, LEAST_ROWS = 1000, 99  # number of first steps that show the resolution, at most and at least
GAP_PERIODS, IRREGULAR_PERIODS, GAP_NS = 5.0, 20.0, 10**8  # shortest gap of regular and irregular streams
RATE_TOLERANCE = 0.05  # relative difference from the declared rate
COMMON_SHARE, COMMON_S = 0.9, 0.5  # smallest common fraction of the longest stream; less time outside of it is ignored
RATE_FACTOR, FEWEST = 1.5, 5  # factor between a recording's rate and that of most, and fewest recordings to compare


class Stamps(Check):
    """Find stamps that cannot be sampling times, and streams with missing time."""

    sentences: ClassVar = {
        "resolution": (
            "The stamps of {subject} are multiples of {worst:g} s, which is coarser than the samples' period.",
            "[streams.{subject}] time: batch = true spreads equal stamps, rate_hz = RATE replaces stamps",
        ),
        "equal-stamps": (
            "{cases:,} rows of {subject} have the stamp of the row before.",
            "[streams.{subject}] time: batch = true if samples came in batches, or rate_hz = RATE",
        ),
        "jump": (
            "The stamps of {subject} jump by up to {worst:,.1f} days.",
            "[streams.{subject}] time: drop_first = {row}, or split_at_reset = true",
        ),
        "steps-back": (
            "Times or counters of {subject} step back {cases:,} times: {channels}.",
            "[streams.{subject}] time: wrap = RANGE of the counter, sort = true, or split_at_reset = true",
        ),
        "gap": (
            "{subject} has {cases:,} gaps of up to {worst:.2f} s without samples.",
            "no window crosses a gap; `tacpipe synchronize --without` leaves the stream out",
        ),
        "little-common-time": (
            "Up to {worst:.2f} s of a recording are not in all streams; {subject} is the shortest.",
            "[streams.{subject}] time, or `tacpipe synchronize --without {subject}`",
        ),
        "rate": ("{subject} has {worst:g} Hz and declares {usual} Hz.", "[streams.{subject}] time: rate_hz = RATE"),
        "other-rate": (
            "{subject} has {worst:g} Hz here and {usual} Hz in most recordings.",
            "[streams.{subject}] time: unit or rate_hz of these recordings",
        ),
    }

    def __init__(self) -> None:
        super().__init__()
        self._rates: dict[str, dict[StreamName, float]] = {}
        self._clocked: list[Stream] = []  # streams with times of the recording under examination

    def examine(self, stream: Stream) -> None:
        """Examine the times of the rows, the counters, and the device's clock."""
        for column in stream.columns.schema:
            if column.name != "t_ns" and quantity(column) in ("time", "sequence"):
                self._examine_counter(stream, column.name)
        if stream.t_ns is None or len(stream.t_ns) < 2:
            return
        time = stream.columns.schema.field("t_ns")
        steps_ns = stream.steps_ns
        typical_ns = typical_step_ns(steps_ns[:TYPICAL_ROWS])
        # stamps next to a counter or a device's clock are arrivals
        is_arrival = has_arrivals(time) or not {"seq", "t_device_ns"}.isdisjoint(stream.columns.column_names)
        if not is_arrival and self._examine_resolution(stream):
            return
        self._clocked.append(stream)
        self._examine_jumps(stream, typical_ns)
        span_ns = int(steps_ns[np.abs(steps_ns) < DAY_NS].sum())
        mean_ns = span_ns / len(steps_ns)
        declared_ns = declared_period_ns(time)
        if declared_ns and mean_ns > 0:
            actual_ns = mean_ns if has_arrivals(time) else typical_ns
            if abs(actual_ns / declared_ns - 1) > RATE_TOLERANCE:
                self.note("rate", stream, value=1e9 / actual_ns, count=round(1e9 / declared_ns))
        if typical_ns:
            self._rates.setdefault(stream.name, {})[stream.identity] = 1e9 / typical_ns

    def finish(self, recording: str) -> None:
        """Compare the time that all streams have in common with that of the longest stream."""
        ranges_ns = np.array([(stream.t_ns[0], stream.t_ns[-1]) for stream in self._clocked if stream.t_ns is not None])
        if len(ranges_ns) > 1:
            common_ns = ranges_ns[:, 1].min() - ranges_ns[:, 0].max()
            longest_ns = np.ptp(ranges_ns, axis=1).max()
            outside_ns = longest_ns - max(0, common_ns)
            if outside_ns > max(COMMON_S * 1e9, (1 - COMMON_SHARE) * longest_ns):
                shortest = self._clocked[int(np.ptp(ranges_ns, axis=1).argmin())]
                self.note("little-common-time", shortest, value=outside_ns / 1e9, count=1)
        self._clocked = []

    def _examine_counter(self, stream: Stream, name: str) -> None:
        """Find steps back of a counter or of another clock."""
        values = stream.columns.column(name).to_numpy()
        back = np.flatnonzero(np.diff(values) < 0) + 1
        if len(back):
            self.note("steps-back", stream, back, channel=name)

    def _examine_jumps(self, stream: Stream, typical_ns: float) -> None:
        """Find steps of days, steps back and gaps."""
        steps_ns = stream.steps_ns
        far = np.flatnonzero(np.abs(steps_ns) > DAY_NS) + 1
        if len(far):
            self.note("jump", stream, far, value=float(np.abs(steps_ns).max()) / DAY_NS)
        back = np.flatnonzero((steps_ns < 0) & (steps_ns > -DAY_NS)) + 1
        if len(back):
            self.note("steps-back", stream, back, channel="t_ns")
        is_regular = np.mean(np.abs(steps_ns[:TYPICAL_ROWS] - typical_ns) < typical_ns / 2) > 0.9
        least_ns = max((GAP_PERIODS if is_regular else IRREGULAR_PERIODS) * typical_ns, GAP_NS)
        is_gap = (steps_ns > least_ns) & (steps_ns <= DAY_NS)
        if "seq" in stream.columns.column_names:  # A late arrival without a lost sample is no gap
            is_gap &= np.diff(stream.columns.column("seq").to_numpy()) > 1
        gaps = np.flatnonzero(is_gap) + 1
        if len(gaps):
            self.note("gap", stream, gaps, value=float(steps_ns[gaps - 1].max()) / 1e9)

    def _examine_resolution(self, stream: Stream) -> bool:
        """Find stamps on a coarse lattice, and equal stamps; return whether the lattice is coarse."""
        assert stream.t_ns is not None
        equal = np.flatnonzero(stream.steps_ns == 0) + 1
        lattice_ns = resolution_ns(stream.t_ns[:LATTICE_ROWS])
        if lattice_ns:
            self.note("resolution", stream, equal, value=lattice_ns / 1e9, count=stream.columns.num_rows)
        elif len(equal):
            self.note("equal-stamps", stream, equal)
        return lattice_ns > 0

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the findings, with the recordings whose rate differs from that of most."""
        for streams in self._rates.values():
            usual = float(np.median(list(streams.values())))
            for stream, rate in streams.items() if len(streams) >= FEWEST else ():
                if max(rate / usual, usual / rate) > RATE_FACTOR:
                    self.note("other-rate", stream, value=rate, count=round(usual))
        yield from super().conclude(dataset)


def typical_step_ns(steps_ns: Times) -> float:
    """Return the median of the positive steps, or 0 if there are none.

    >>> typical_step_ns(np.array([0, 0, 10, 12, 14]))
    12.0
    """
    positive_ns = steps_ns[steps_ns > 0]
    return float(np.median(positive_ns)) if len(positive_ns) else 0.0


def resolution_ns(t_ns: Times) -> int:
    """Return the resolution of stamps if it is coarser than a quarter of the period, else 0.

    Stamps that a coarse clock rounded stay within one multiple of an even line. Lost samples do not.

    >>> resolution_ns(np.arange(0, 2 * 10**9, 8_000_000) // 10_000_000 * 10_000_000), resolution_ns(np.arange(0, 900, 8))
    (10000000, 0)
    """
    steps_ns = np.diff(t_ns)
    lattice_ns = int(np.gcd.reduce(steps_ns)) if len(steps_ns) else 0
    sizes_ns, counts = np.unique(steps_ns, return_counts=True)
    usual_ns = sizes_ns[counts.argmax()] if len(steps_ns) else 0
    if len(steps_ns) < LEAST_ROWS or not lattice_ns or (usual_ns and counts.max() > 0.9 * len(steps_ns)):
        return 0
    index = np.arange(len(t_ns))
    offsets_ns = (t_ns - t_ns[0]).astype(np.float64)
    slope_ns = offsets_ns[-1] / index[-1]
    if lattice_ns < slope_ns / 4:
        return 0
    residuals_ns = offsets_ns - np.polyval(np.polyfit(index, offsets_ns, 1), index)
    return lattice_ns if np.ptp(residuals_ns) <= 1.5 * lattice_ns else 0
