"""Estimate when samples were measured from when they arrived, causally.

A device measures at a constant rate, and a link delivers each sample some time later. In a plot of arrivals over the
index of the samples, all points therefore lie on or above one line: its slope is the period, its height the smallest
delay (Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). The
line is the edge of the lower convex hull over the middle of the last 20 s. A sample was measured where the line is at
its index, or at its arrival if that was earlier.

Each estimate uses only earlier samples and the sample's own arrival, so neither the size of a burst nor the way in which
reads were cut affects it. Samples that persistently lie above the line follow lost samples, another rate or delay, or a
device that does not measure at a constant rate; the samples of such a device are at their arrivals, and marked.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import Bools, Floats, Int64s, Times

BURST_FRACTION = 0.01  # stamps are those of bursts if a larger fraction equals the previous one
BUCKET_NS = 100_000_000  # duration of a bucket, whose lowest sample is a point of the hull
REFIT_NS = 250_000_000  # smallest time between two fits of the line
WINDOW_NS, WINDOW_PERIODS = 20_000_000_000, 100  # the hull covers the longer of these
STALE = 1.25  # a line whose first point is older than this fraction of the window is fitted again
FIRST_NS, FIRST_POINTS = 500_000_000, 5  # duration and number of points from which a line is fitted
SILENCE_NS, SILENCE_PERIODS = 10_000_000_000, 20  # a line is not continued after a silence of their sum
GROUP_PERIODS, GROUPS = 10, 8  # smallest length of a group of samples, and number of groups that are assessed
LAGGING = 0.5  # smallest lag of a group as a fraction of its median lag, above which all its samples lag
NEGLIGIBLE_NS, NEGLIGIBLE_PERIODS = 1_500_000, 0.05  # median lags below one of these do not show an irregular device
IRREGULAR_NS, IRREGULAR_PERIODS = 5_000_000_000, 50  # a device stays irregular for the longer of these
LOSS_NS, LOSS_PERIODS = 1_000_000_000, 20  # losses are estimated when samples lagged for the longer of these
LOST_NS, LOST_PERIODS = 20_000_000, 1.5  # smallest lag that shows losses, the larger of these
LEVEL_PERIODS = 0.25  # lags are constant if they differ by less than this, plus the error of the line's slope:
# relative error of the slope of a line, and of a line over less than `YOUNG_NS`
SLOPE_ERROR, YOUNG_SLOPE_ERROR, YOUNG_NS = 0.002, 0.02, 5_000_000_000
EARLY_NS, EARLY_PERIODS = 1_000_000, 0.25  # samples that are earlier than the larger of these show another line
HABIT = 3  # lags that were explained as often within the window are those of an irregular device
RESTARTED = 3  # number of consecutive samples with lower counters that show a restart of the device
MAX_DRIFT = 0.1  # largest relative error of a device's clock


class EstimatedLoss(NamedTuple):
    """Losses that were estimated when the sample in ``row`` of a batch arrived; negative if samples were only late."""

    row: int
    samples: int


@dataclass(frozen=True)
class PlacedSamples:
    """Samples in order of arrival, with the times at which they were measured."""

    t_ns: Times  # (time,), increasing, at most `arrival_ns`
    arrival_ns: Times  # (time,), increasing: equal arrivals are spread by 1 ns each
    at_arrival: Bools  # (time,): True if the sampling time is unknown, so that it is the arrival
    late: Bools  # (time,): True for a sample that precedes an earlier one or repeats its counter; `t_ns` is meaningless
    losses: tuple[
        EstimatedLoss, ...
    ] = ()  # estimates; losses that a counter or a device clock shows are not among them
    restarts: int = 0  # number of restarts of the counter or the device's clock


@dataclass(frozen=True, slots=True)
class _Point:
    """A sample, in ns since the stream's first arrival."""

    index: int
    arrival_ns: int
    count: int  # number of samples before it


class _Line(NamedTuple):
    """The line through two points of the hull."""

    left: _Point
    right: _Point
    slope_ns: float  # per index
    height_ns: float  # height of the line at index 0


class SamplingClock:
    """The estimator for one stream. The estimates do not depend on how the samples are divided into batches."""

    _line: _Line | None
    _is_edge: bool  # no point since the fit is below the line
    _fitted_ns: int  # arrival at the latest fit
    _floor_ns: float | None  # height of the line with the declared slope, before a line is known
    _points: deque[_Point]
    _bucket_ns: int | None  # first arrival in the current bucket
    _lowest: _Point | None  # sample of the current bucket with the smallest lag
    _lags: list[Floats]  # lags of the current group
    _group_ns: int | None  # first arrival in the current group
    _groups: deque[tuple[float, float]]  # smallest and median lag of the latest groups
    _recent: deque[tuple[_Point, float]]  # lowest samples of the latest buckets, and their lags
    _lost: int  # estimated losses that may turn out to be late

    def __init__(self, period_ns: float | None = None) -> None:
        """Start without samples; ``period_ns`` is the declared period, which holds until a line is known."""
        self._declared_ns = period_ns
        self._origin_ns: int | None = None  # arrival of the first sample; other times are relative to it
        self._spread_ns = self._sampled_ns = -1  # arrival and sampling time of the newest sample
        self._axis = ""  # unit of an index: a device time ("clock"), a "counter", or a "count" of samples
        self._has_clock = False  # True if device times show which samples are late, also if they are no index
        self._highest: int | None = None  # highest counter or device time
        self._stepped_back: list[int] = []  # those of the latest samples, if they are lower
        self._base: int | None = None  # counter or device time at index 0
        self._index = self._count = 0  # index and number of the next sample, which differ by lost samples
        self._newest_ns = 0  # arrival of the newest sample
        self._lowest_lag_ns = 0.0
        self._irregular: tuple[int, int] | None = None  # since when and until when the device is irregular
        self._explained: deque[int] = deque(maxlen=HABIT)  # times at which lags were explained
        self._start_line()

    def place(self, arrival_ns: Times, counter: Int64s | None = None, device_ns: Times | None = None) -> PlacedSamples:
        """Return the sampling times of the next samples (time,), in order of arrival. Arrivals must not decrease.

        ``counter`` (time,) increases by one per sample, lost ones included. ``device_ns`` (time,) is the device's clock,
        used instead of a counter. Both without wraps, and each given for all batches of a stream or for none.
        """
        late = np.zeros(len(arrival_ns), bool)
        if not len(arrival_ns):
            return PlacedSamples(arrival_ns, arrival_ns, late, late)
        if self._origin_ns is None:
            self._origin_ns = int(arrival_ns[0])
            self._has_clock = device_ns is not None
            self._axis = "clock" if self._has_clock else "counter" if counter is not None else "count"
        arrivals = arrival_ns - self._origin_ns
        spread = spread_times(arrivals, self._spread_ns)
        self._spread_ns = int(spread[-1])
        positions = device_ns if self._has_clock else counter
        restarts: list[int] = []
        if positions is not None:
            restarts = self._find_late(positions, late)
        t_ns, at_arrival, losses = spread.copy(), np.zeros(len(late), bool), []
        for start, stop in pairwise([0, *restarts, len(late)]):
            rows = start + np.flatnonzero(~late[start:stop])
            if not len(rows):
                continue
            if start in restarts:
                self._start_line()
                self._base = None
            placed, at_arrival[rows], found = self._place(
                arrivals[rows], None if positions is None else positions[rows]
            )
            losses += [EstimatedLoss(int(rows[loss.row]), loss.samples) for loss in found]
            t_ns[rows] = placed
        rows = np.flatnonzero(~late)
        if len(rows):
            t_ns[rows] = spread_times(t_ns[rows], self._sampled_ns)
            self._sampled_ns = int(t_ns[rows[-1]])
        return PlacedSamples(
            t_ns + self._origin_ns, spread + self._origin_ns, at_arrival, late, tuple(losses), len(restarts)
        )

    def _find_late(self, positions: Int64s, late: Bools) -> list[int]:
        """Set ``late`` for samples that precede an earlier one; return the rows at which the device restarted.

        ``positions`` (time,) are counters or device times. Several samples can have the same device time.
        """
        previous = np.maximum.accumulate(positions)
        least_step = 0 if self._has_clock else 1
        in_order = bool((np.diff(positions) >= least_step).all())
        if in_order and (self._highest is None or int(positions[0]) >= self._highest + least_step):
            self._highest, self._stepped_back = int(previous[-1]), []
            return []
        restarts = []
        for row, position in enumerate(positions.tolist()):
            if self._highest is None or position >= self._highest + least_step:
                self._highest, self._stepped_back = position, []
                continue
            late[row] = True
            if position == self._highest:
                continue
            follows = self._stepped_back and position > self._stepped_back[-1]
            self._stepped_back = [*self._stepped_back, position] if follows else [position]
            if len(self._stepped_back) == RESTARTED:
                late[row] = False
                restarts.append(row)
                self._highest, self._stepped_back = position, []
        return restarts

    def _place(self, arrivals: Times, positions: Int64s | None) -> tuple[Times, Bools, list[EstimatedLoss]]:
        """Return sampling times, a mask of those that are arrivals, and estimated losses, of samples that are not late."""
        placed, at_arrival, losses = arrivals.astype(np.float64), np.zeros(len(arrivals), bool), []
        indices = np.arange(len(arrivals), dtype=np.float64)
        if positions is not None:
            self._base = int(positions[0]) if self._base is None else self._base
            indices = (positions - self._base).astype(np.float64)
        row = 0
        while row < len(arrivals):
            arrival_ns = int(arrivals[row])
            if arrival_ns - self._newest_ns > SILENCE_NS + SILENCE_PERIODS * self._period_ns:
                self._start_line()
                self._irregular = None
            elif self._bucket_ns is not None and arrival_ns - self._bucket_ns >= BUCKET_NS:
                lost = self._close_bucket(arrival_ns)
                losses += [EstimatedLoss(row, lost)] if lost else []
            if self._bucket_ns is None:
                self._bucket_ns = arrival_ns
            stop = int(arrivals.searchsorted(self._bucket_ns + BUCKET_NS, side="left"))
            bucket = indices[row:stop]
            if self._axis == "count":
                bucket = np.arange(self._index, self._index + stop - row, dtype=np.float64)
            count, returned = self._place_bucket(bucket, placed[row:stop], at_arrival[row:stop])
            row += count
            losses += [EstimatedLoss(row, -returned)] if returned else []
        return np.rint(placed).astype(np.int64), at_arrival, losses

    def _place_bucket(self, indices: Floats, times: Floats, at_arrival: Bools) -> tuple[int, int]:
        """Replace arrivals in ``times`` (time,) of one bucket by sampling times.

        Returns the number of placed samples, and of estimated losses that arrived after all: it stops before the sample
        that shows this.
        """
        line, returned = self._line, 0
        slope_ns = self._declared_slope_ns if line is None else line.slope_ns
        if slope_ns is None:
            lags = np.zeros(len(times))
        elif line is None:
            heights = times - indices * slope_ns
            floor = np.minimum.accumulate(heights if self._floor_ns is None else np.minimum(heights, self._floor_ns))
            lags = heights - floor
            self._floor_ns = float(floor[-1])
        else:
            lags = times - (indices * slope_ns + line.height_ns)
            if self._lost and (early := lags < -0.5 * slope_ns).any():
                first = int(early.argmax())
                returned = min(self._lost, round(-float(lags[first]) / slope_ns))
                indices, times, at_arrival, lags = indices[:first], times[:first], at_arrival[:first], lags[:first]
        count = len(times)
        if count:
            lowest = count - 1 - int(lags[::-1].argmin())
            if self._lowest is None or slope_ns is None or lags[lowest] <= self._lowest_lag_ns:
                self._lowest_lag_ns = float(lags[lowest])
                self._lowest = _Point(int(indices[lowest]), int(times[lowest]), self._count + lowest)
            self._count += count
            self._index = int(indices[-1]) + 1
            self._newest_ns = int(times[-1])
            if line is not None:
                self._lags.append(lags)
            if slope_ns is None or self._irregular is not None:
                at_arrival[:] = True
            else:
                times -= np.maximum(lags, 0.0)
        if returned:
            self._index -= returned
            self._lost -= returned
            self._points = deque(point for point in self._points if point.index < self._index)
            self._lowest = None
            self._recent.clear()
        return count, returned

    @property
    def _declared_slope_ns(self) -> float | None:
        """The slope of a line before one is known, or None."""
        return 1.0 if self._axis == "clock" else self._declared_ns

    @property
    def _period_ns(self) -> float:
        """The period of the samples, as far as it is known."""
        if self._axis != "clock" and self._line is not None:
            return self._line.slope_ns
        if self._axis == "clock" and len(self._points) > 1:
            first, last = self._points[0], self._points[-1]
            return (last.arrival_ns - first.arrival_ns) / max(1, last.count - first.count)
        return self._declared_ns or float(BUCKET_NS) / GROUP_PERIODS

    def _start_line(self) -> None:
        """Forget all samples."""
        self._line = self._floor_ns = self._bucket_ns = self._lowest = self._group_ns = None
        self._is_edge = True
        self._points, self._recent, self._groups = deque(), deque(), deque(maxlen=GROUPS)
        self._lags = []
        self._fitted_ns = self._lost = 0

    def _close_bucket(self, now_ns: int) -> int:
        """Add the current bucket to the estimate before a sample that arrived ``now_ns``; return the new losses."""
        self._bucket_ns = None
        lost = 0
        if self._lowest is not None:
            if not self._points or self._lowest.index > self._points[-1].index:
                self._points.append(self._lowest)
            if self._line is not None:
                self._is_edge &= _is_above(self._lowest, self._line.left, self._line.right)
                self._assess_group(now_ns)
                self._recent.append((self._lowest, self._lowest_lag_ns))
                lost = self._explain_lags(now_ns)
            self._lowest = None
        while self._points and self._points[0].arrival_ns < now_ns - _window_ns(self._period_ns):
            self._points.popleft()
        if self._line is None or now_ns - self._fitted_ns > REFIT_NS:
            self._fit(now_ns)
        return lost

    def _assess_group(self, now_ns: int) -> None:
        """Close the current group of samples if it is long enough, and assess whether the device is irregular."""
        period_ns = self._period_ns
        if self._group_ns is None:
            self._group_ns = now_ns
        if now_ns - self._group_ns >= max(BUCKET_NS, GROUP_PERIODS * period_ns) and self._lags:
            lags = self._lags[0] if len(self._lags) == 1 else np.concatenate(self._lags)
            median = float(np.partition(lags, len(lags) // 2)[len(lags) // 2])
            self._groups.append((max(0.0, float(lags.min())), max(0.0, median)))
            self._lags, self._group_ns = [], now_ns
            smallest, median = (sorted(lags)[len(lags) // 2] for lags in zip(*self._groups, strict=True))
            if median > max(NEGLIGIBLE_NS, NEGLIGIBLE_PERIODS * period_ns) and smallest > LAGGING * median:
                since_ns = now_ns if self._irregular is None else self._irregular[0]
                self._irregular = since_ns, now_ns + round(max(IRREGULAR_NS, IRREGULAR_PERIODS * period_ns))
        if self._irregular is not None and now_ns > self._irregular[1]:
            self._irregular = None

    def _explain_lags(self, now_ns: int) -> int:
        """Estimate losses or start a new line if all latest samples lie above the line or below it; return the losses."""
        period_ns = self._period_ns
        span_ns = max(LOSS_NS, LOSS_PERIODS * period_ns)
        while len(self._recent) > FIRST_POINTS and self._recent[0][0].arrival_ns < now_ns - span_ns:
            self._recent.popleft()
        lags = [lag for _, lag in self._recent]
        if len(lags) < FIRST_POINTS:
            return 0
        early_ns = max(EARLY_NS, EARLY_PERIODS * period_ns)
        if max(lags[-FIRST_POINTS:]) < -early_ns:
            self._keep_points(FIRST_POINTS, now_ns)
            return 0
        smallest = min(lags)
        covers = self._recent[-1][0].arrival_ns - self._recent[0][0].arrival_ns > 0.8 * span_ns
        if not covers or smallest <= early_ns:
            return 0
        line, half = self._line, len(lags) // 2
        assert line is not None
        age_ns = line.right.arrival_ns - line.left.arrival_ns
        error = YOUNG_SLOPE_ERROR if age_ns < YOUNG_NS else SLOPE_ERROR
        is_level = abs(min(lags[half:]) - min(lags[:half])) <= LEVEL_PERIODS * period_ns + error * span_ns / 2
        is_large = smallest > max(LOST_NS, LOST_PERIODS * period_ns)
        is_habit = len(self._explained) == HABIT and now_ns - self._explained[0] < _window_ns(period_ns)
        self._explained.append(now_ns)
        if not is_habit:
            self._irregular = None
        if is_level and is_large and self._axis == "count" and not is_habit:
            lost = round(smallest / period_ns)
            self._index += lost
            self._lost += lost
            self._recent.clear()
            self._groups.clear()
            self._lags = []
            return lost
        self._keep_points(len(lags), now_ns)
        return 0

    def _keep_points(self, count: int, now_ns: int) -> None:
        """Fit a new line to the latest ``count`` points, and forget the others."""
        self._points = deque(list(self._points)[-count:])
        self._recent.clear()
        self._groups.clear()
        self._lags, self._lost, self._line = [], 0, None
        if self._axis != "clock":
            self._declared_ns = None
        self._floor_ns = None
        self._fit(now_ns)

    def _fit(self, now_ns: int) -> None:
        """Fit the line to the edge of the lower hull over the middle of the points, if there are enough."""
        points = self._points
        if len(points) < FIRST_POINTS or points[-1].arrival_ns - points[0].arrival_ns < 0.8 * FIRST_NS:
            return
        self._fitted_ns = now_ns
        middle, line = (points[0].index + points[-1].index) / 2, self._line
        stale_ns = now_ns - STALE * _window_ns(self._period_ns)
        if line is not None and self._is_edge and line.left.arrival_ns > stale_ns and middle <= line.right.index:
            return
        hull: list[_Point] = []
        for point in points:
            while len(hull) > 1 and _is_above(hull[-1], hull[-2], point):
                hull.pop()
            hull.append(point)
        left, right = next(edge for edge in pairwise(hull) if edge[1].index >= middle)
        slope_ns = (right.arrival_ns - left.arrival_ns) / (right.index - left.index)
        if self._axis == "clock" and abs(slope_ns - 1) > MAX_DRIFT:
            self._axis = "count"
            self._start_line()
        elif slope_ns > 0:
            self._line, self._is_edge = _Line(left, right, slope_ns, left.arrival_ns - left.index * slope_ns), True


def _window_ns(period_ns: float) -> float:
    """Return the duration that the hull covers."""
    return max(WINDOW_NS, WINDOW_PERIODS * period_ns)


def _is_above(point: _Point, left: _Point, right: _Point) -> bool:
    """Return whether a point lies on or above the straight line from ``left`` to ``right``."""
    return (point.arrival_ns - left.arrival_ns) * (right.index - left.index) >= (right.arrival_ns - left.arrival_ns) * (
        point.index - left.index
    )


def spread_times(t_ns: Times, before_ns: int | None) -> Times:
    """Return the smallest increasing times (time,) that are at least ``t_ns`` and later than ``before_ns``.

    >>> spread_times(np.array([5, 5, 6, 9]), 4).tolist()
    [5, 6, 7, 9]
    """
    steps = np.arange(len(t_ns))
    least_ns = np.maximum.accumulate(t_ns - steps)
    return (least_ns if before_ns is None else np.maximum(least_ns, before_ns + 1)) + steps


def burst_period_ns(arrival_ns: Times) -> int | None:
    """Return the mean period of samples (time,) from the last one of each burst, or None for fewer than `FIRST_POINTS`.

    >>> burst_period_ns(np.repeat(np.arange(10), 4) * 40)
    10
    """
    last = np.flatnonzero(np.diff(arrival_ns) > 0)
    if len(last) < FIRST_POINTS:
        return None
    return max(1, round(int(arrival_ns[last[-1]] - arrival_ns[last[0]]) / int(last[-1] - last[0])))
