"""Check the load over time: lags between streams, and recordings that begin or end under load."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.checks.check import EXCLUDE, LOADS, Check, CheckFinding, Stream, StreamName, quantity
from tacpipe.datasets.dataset import Dataset
from tacpipe.printable import format_count

if TYPE_CHECKING:
    import pyarrow as pa

MOTIONS = ("position", "joint_position")
REST_ROWS, LEAST_ROWS = 10, 50
MAX_STREAMS = 6  # largest number of streams whose pairs are compared
STEP_NS, POINTS = 10**7, 1 << 16  # smallest step and largest number of points of the common grid
SMOOTH_S, MAX_LAG_S = 0.05, 5.0
LEAST_CORRELATION, LEAST_GAIN = 0.5, 0.1  # smallest peak, and its smallest height above the correlation without lag
LEAST_LAG_S, LEAST_STEPS = 0.03, 2.0
FEWEST = 5  # fewest recordings that show what is usual
CUT_SHARE, USUAL_SHARE = 0.5, 0.2  # final load of a cut recording and of most others, as fractions of the largest load
MAJORITY = 0.8  # smallest fraction of the recordings that counts as most
SHORT = 0.5  # length of a short recording as a fraction of the median, if most have nearly that length


class Lag(NamedTuple):
    """The lag of one stream behind another, with an interval, in s."""

    lag_s: float
    low_s: float
    high_s: float


class Loads(Check):
    """Find streams that lag behind others, and episodes that look cut."""

    sentences: ClassVar = {
        "ends-under-load": (
            "{subject} ends with up to {worst:.0%} of its largest load in {recordings}; most others end at rest.",
            EXCLUDE,
        ),
        "short": ("{subject} has less than half of the usual length of {worst:.1f} s in {recordings}.", EXCLUDE),
    }

    def __init__(self) -> None:
        super().__init__()
        self._curves: dict[str, tuple[Stream, Floats]] = {}  # load or motion over time, by stream
        self._lags: dict[tuple[str, str], dict[str, tuple[Lag, set[str]]]] = {}
        self._pairs: Counter[tuple[str, str]] = Counter()  # number of recordings with both streams
        self._ends: dict[
            str, list[tuple[StreamName, int, float, float]]
        ] = {}  # final fraction of the load and length in s, by stream

    def examine_channel(self, stream: Stream, channel: pa.Field, values: AnyArray) -> None:
        """Add the distance of a channel from its first values to the curve of the stream."""
        is_curve = quantity(channel) in (*LOADS, *MOTIONS) and stream.t_ns is not None and len(values) >= LEAST_ROWS
        if not is_curve or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            return
        deviation = values.std()
        if deviation > 0:
            _, curve = self._curves.get(stream.name, (stream, np.zeros(len(values))))
            self._curves[stream.name] = (stream, curve + np.abs(values - np.median(values[:REST_ROWS])) / deviation)

    def finish(self, recording: str) -> None:
        """Compare the curves of a recording with each other, and remember how each ends."""
        for stream, curve in self._curves.values():
            assert stream.t_ns is not None
            if any(quantity(channel) in LOADS for channel in stream.channels()):
                final = float(np.median(curve[-REST_ROWS:]) / curve.max())
                self._ends.setdefault(stream.name, []).append(
                    (stream.identity, len(curve) - 1, final, float(np.ptp(stream.t_ns)) / 1e9)
                )
        for (first, first_curve), (second, second_curve) in combinations(list(self._curves.values())[:MAX_STREAMS], 2):
            assert first.t_ns is not None and second.t_ns is not None
            self._pairs[first.name, second.name] += 1
            lag = estimate_lag(first.t_ns, first_curve, second.t_ns, second_curve)
            if lag is not None:
                pair = self._lags.setdefault((first.name, second.name), {})
                pair[recording] = (lag, {first.digest, second.digest})
        self._curves = {}

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield lags whose interval excludes 0, and recordings that end unlike most."""
        for pair, lags in self._lags.items():
            lag = pooled_lag([lag for lag, _ in lags.values()])
            is_precise = lag.high_s - lag.low_s <= abs(lag.lag_s)
            if min(abs(lag.low_s), abs(lag.high_s)) > LEAST_LAG_S and is_precise and 2 * len(lags) > self._pairs[pair]:
                yield _lag_finding(pair, lag, lags)
        for ends in self._ends.values():
            self._compare_ends(ends)
        yield from super().conclude(dataset)

    def _compare_ends(self, ends: list[tuple[StreamName, int, float, float]]) -> None:
        """Note the recordings that end under load, or are short, while most do not."""
        if len(ends) < FEWEST:
            return
        finals, lengths_s = np.array([(final, length_s) for *_, final, length_s in ends]).T
        middle_s = float(np.median(lengths_s))
        most_end_at_rest = np.mean(finals < USUAL_SHARE) >= MAJORITY
        equal_lengths = np.mean(np.abs(lengths_s / middle_s - 1) < 1 - MAJORITY) >= MAJORITY
        for stream, last, final, length_s in ends:
            if most_end_at_rest and final > CUT_SHARE:
                self.note("ends-under-load", stream, [last], value=final)
            if equal_lengths and length_s < SHORT * middle_s:
                self.note("short", stream, value=middle_s, count=1)


def _lag_finding(pair: tuple[str, str], lag: Lag, lags: Mapping[str, tuple[Lag, set[str]]]) -> CheckFinding:
    """Return the finding of a lag; ``lags`` are those of single recordings, with the digests of both streams."""
    later, earlier = pair[::-1] if lag.lag_s > 0 else pair
    low_s, high_s = sorted((abs(lag.low_s), abs(lag.high_s)))
    interval = f"{low_s:.2f} to {high_s:.2f} s"
    sentence = (
        f"{later} is {abs(lag.lag_s):.2f} s ({interval}) behind {earlier} in {format_count(len(lags), 'recordings')}."
    )
    repair = f"[streams.{later}] time: offset_s = {-abs(lag.lag_s):.2f}"
    content = [shard for _, shards in lags.values() for shard in shards]
    return CheckFinding("lag", f"{later} behind {earlier}", sentence, repair, dict.fromkeys(lags, ()), content)


def estimate_lag(first_ns: Times, first: Floats, second_ns: Times, second: Floats) -> Lag | None:
    """Return the lag of the second curve behind the first, or None if their changes do not correlate clearly.

    The interval contains the lags whose correlation does not differ from that of the peak.
    """
    step_ns = max(STEP_NS, np.median(np.diff(first_ns)), np.median(np.diff(second_ns)))
    begin_ns, end_ns = max(first_ns[0], second_ns[0]), min(first_ns[-1], second_ns[-1])
    grid_ns = np.arange(begin_ns, min(end_ns, begin_ns + POINTS * step_ns), step_ns)
    if len(grid_ns) < LEAST_ROWS:
        return None
    changes = []
    for times_ns, curve in ((first_ns, first), (second_ns, second)):
        change = np.abs(np.diff(np.interp(grid_ns, times_ns, curve)))
        width = max(1, round(SMOOTH_S * 1e9 / step_ns))
        change = np.convolve(change, np.ones(width) / width, "same")
        change = np.log1p(change / max(np.median(change), 1e-9 * change.max(), 1e-300))
        changes.append((change - change.mean()) / max(change.std(), 1e-12))
    count = len(changes[0])
    longest = min(int(MAX_LAG_S * 1e9 / step_ns), count // 3)
    spectra = [np.fft.rfft(change, 2 * count) for change in changes]
    correlation = np.fft.irfft(np.conj(spectra[0]) * spectra[1], 2 * count) / count
    lags = np.arange(-longest, longest + 1)
    heights = correlation[lags]
    peak = int(heights.argmax())
    if heights[peak] < LEAST_CORRELATION:
        return None
    if heights[peak] < heights[longest] + LEAST_GAIN:
        peak = longest
    independent = count * step_ns / max(2 * SMOOTH_S * 1e9, step_ns)
    near = lags[heights >= heights[peak] - 2 / np.sqrt(independent)] * step_ns / 1e9
    return Lag(float(lags[peak] * step_ns / 1e9), float(near.min()), float(near.max()))


def pooled_lag(lags: list[Lag]) -> Lag:
    """Return the median lag of recordings with an interval: the order statistics of many, else the union of intervals."""
    values = np.sort([lag.lag_s for lag in lags])
    count = len(values)
    if count < FEWEST + 1:
        low_s, high_s = min(lag.low_s for lag in lags), max(lag.high_s for lag in lags)
    else:
        reach = int(np.ceil(0.98 * np.sqrt(count)))  # 95 % interval of a median
        low_s = values[max(0, count // 2 - reach)]
        high_s = values[min(count - 1, (count - 1) // 2 + reach)]
    return Lag(float(np.median(values)), float(low_s), float(high_s))
