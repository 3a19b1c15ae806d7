"""Detect contacts: the rest level and the load of a sensor, and the intervals and first rows of contact."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.repairs import repeated_rows
from tacpipe.signals.runs import in_long_runs, latch, runs

NOISE_MIN, NOISE_USUAL = 10.0, 40.0  # minimum and default start threshold, as multiples of the noise at rest
PEAK_MIN, PEAK_MAX = 0.05, 0.25  # minimum and maximum start threshold, as fractions of the maximum load
NO_ROWS = "The recording has no rows, so its rest level cannot be determined."
# Yields the channels of a recording (time, channel) in blocks of one row or more, from the first row on.
Blocks = Callable[[], Iterable[AnyArray]]
OFF_FRACTION = 2 / 3  # end threshold as a fraction of the start threshold
PEAK_QUANTILE = 0.99  # quantile that serves as the maximum load; robust against single wrong frames


class Thresholds(NamedTuple):
    """The loads at which a contact starts and ends, in the unit of the load."""

    on: float  # contact starts when the load reaches this value
    off: float  # contact ends when the load is below this value


def rest_level(values: AnyArray, t_ns: Times, rest_s: float) -> Floats:
    """Return the median of each channel of ``values`` (time, channel) over the first ``rest_s`` seconds (channel,).

    The median is robust against single bad frames. The first row is always included. Raises `TacpipeError` without rows.
    """
    if not len(t_ns):
        raise TacpipeError(NO_ROWS)
    rows = int(np.searchsorted(t_ns, t_ns[0] + round(rest_s * 1e9), side="right"))
    return np.median(values[: max(rows, 1)], axis=0).astype(np.float64)


def lowest_rows(total: AnyArray, t_ns: Times, rest_s: float) -> Bools:
    """Return a mask (time,) of the ``rest_s`` seconds with the lowest mean of ``total`` (time,), the sum of all channels.

    It is for recordings that start in contact, from sensors whose values increase under load. Rows with an infinite
    total are never included.

    >>> lowest_rows(np.array([9, 9, 1, 2, 9]), np.arange(5) * 10**9, rest_s=1.0).tolist()
    [False, False, True, True, False]
    """
    stop = np.searchsorted(t_ns, t_ns + round(rest_s * 1e9), side="right")
    complete = np.flatnonzero(t_ns + round(rest_s * 1e9) <= t_ns[-1]) if len(t_ns) else np.zeros(0, int)
    if not len(complete):
        return np.ones(len(t_ns), bool)
    means = np.fromiter((np.mean(total[first : stop[first]]) for first in complete), np.float64, len(complete))
    first = int(complete[int(np.argmin(means))])
    rows = np.zeros(len(t_ns), bool)
    rows[first : stop[first]] = True
    return rows


def measure_rest(rest_rows: str, blocks: Blocks, t_ns: Times, rest_s: float) -> tuple[Floats, Bools]:
    """Return the rest level of each channel (channel,), and the mask of its rows (time,).

    ``rest_rows`` is ``start``, for the first ``rest_s`` seconds, or ``lowest``, for `lowest_rows`. Raises `TacpipeError`
    without rows.
    """
    if not len(t_ns):
        raise TacpipeError(NO_ROWS)
    if rest_rows == "start":
        first_rows: list[AnyArray] = []
        for values in blocks():
            first_rows.append(values)
            count = sum(map(len, first_rows))
            if t_ns[count - 1] > t_ns[0] + round(rest_s * 1e9):
                break
        values = np.concatenate(first_rows)
        return rest_level(values, t_ns[: len(values)], rest_s), t_ns <= t_ns[0] + round(rest_s * 1e9)
    totals = [np.where(np.isfinite(values).all(axis=1), values.sum(axis=1), np.inf) for values in blocks()]
    rows = lowest_rows(np.concatenate(totals), t_ns, rest_s)
    rest_values, first = [], 0
    for values in blocks():
        rest_values.append(values[rows[first : first + len(values)]])
        first += len(values)
    level: Floats = np.median(np.concatenate(rest_values), axis=0).astype(np.float64)
    return level, rows


def tare_level(method: Literal["median", "first", "axis_mean"], values: AnyArray, level: Floats, axes: int) -> Floats:
    """Return the level to subtract from each channel (channel,) of ``values`` (time, channel).

    With ``median`` it is ``level``, with ``first`` the first row, and with ``axis_mean`` the result of
    `axis_mean_level` for taxels with ``axes`` channels.
    """
    if method == "median":
        return level
    if method == "first":
        first: Floats = values[0].astype(np.float64)
        return first
    return axis_mean_level(values, axes)


def axis_mean_level(values: AnyArray, axes: int = 3) -> Floats:
    """Return the level (channel,) to subtract from ``values`` (time, channel) for equal first values of all taxels.

    The first value of each axis is then its mean over the taxels, truncated to an integer, as in the authors'
    notebooks. Channels are ordered by taxel, with ``axes`` per taxel. Raises `TacpipeError` if there are no rows.

    >>> axis_mean_level(np.array([[10, 1, 13, 2]]), axes=2).tolist()
    [-1.0, 0.0, 2.0, 1.0]
    """
    _require_taxels(values, axes)
    if not len(values):
        raise TacpipeError(NO_ROWS)
    first = values[0].astype(np.float64).reshape(-1, axes)  # (taxel, axis)
    level: Floats = (first - np.trunc(first.mean(axis=0))).ravel()
    return level


def load(values: AnyArray, rest_level: Floats, axes: int = 3) -> Floats:
    """Return the mean distance of the taxels from ``rest_level`` (time,), in the unit of ``values``.

    The channels of ``values`` (time, channel) are ordered by taxel, with ``axes`` per taxel. The distance of a taxel is
    the norm of its vector. Raises `TacpipeError` if the number of channels is not a multiple of ``axes``.

    >>> load(np.array([[3.0, 4.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros(6)).tolist()
    [3.0]
    """
    _require_taxels(values, axes)
    time, channels = values.shape
    taxels = (values - rest_level).reshape(time, channels // axes, axes)  # (time, taxel, axis)
    distance: Floats = np.sqrt(np.einsum("tna,tna->tn", taxels, taxels)).mean(axis=1)
    return distance


def load_in_blocks(blocks: Blocks, rest_level: Floats, axes: int) -> tuple[Floats, Bools]:
    """Return the `load` of channels in blocks, and a mask of rows that repeat the previous row; both (time,)."""
    loads: list[Floats] = []
    repeated: list[Bools] = []
    last: AnyArray | None = None
    for values in blocks():
        loads.append(load(values, rest_level, axes))
        repeated.append(repeated_rows(values if last is None else np.concatenate([last, values]))[-len(values) :])
        last = values[-1:]
    return np.concatenate(loads), np.concatenate(repeated)


def noise_thresholds(repeated: Bools, load: Floats, rest: Bools) -> Thresholds:
    """Return thresholds from the noise of a sensor at rest, in any unit.

    The noise is the upper quartile of ``load`` (time,) over the rows ``rest`` (time,), without
    rows that repeat the previous one (``repeated``). The start threshold is 40 times the noise, but at most 25 %
    and at least 5 % of the largest load, and at least 10 times the noise. The end threshold is two thirds of it. On 52
    published trials of a XELA uSkin, the start threshold is 70 to 230 counts; the authors chose 120. Without load, the
    thresholds are infinite.
    """
    finite = np.isfinite(load)
    largest = float(np.quantile(load[finite], PEAK_QUANTILE)) if finite.any() else 0.0
    if largest <= 0:
        return Thresholds(np.inf, np.inf)
    at_rest = finite & ~repeated & rest
    noise = float(np.quantile(load[at_rest], 0.75)) if at_rest.any() else 0.0
    usual = min(NOISE_USUAL * noise, PEAK_MAX * largest)
    on = max(NOISE_MIN * noise, PEAK_MIN * largest, usual)
    return Thresholds(on, OFF_FRACTION * on)


def contact_mask(load: Floats, on: float | Floats, off: float | Floats) -> Bools:
    """Return a mask of contact (time,), before `contact_intervals` merges, removes and extends contacts.

    Raises `TacpipeError` for invalid thresholds.
    """
    loads, ons, offs = np.atleast_2d(load), np.reshape(on, (-1, 1)), np.reshape(off, (-1, 1))  # (sensor, time or 1)
    if not ((offs >= 0) & (offs <= ons)).all():
        raise TacpipeError(
            f"The start threshold of contact is {on} and the end threshold {off}, which must be 0 to {on}."
        )
    starting: Bools = np.any(loads >= ons, axis=0) & ~np.isnan(loads).any(axis=0)  # (time,)
    ending: Bools = np.all(loads < offs, axis=0)  # (time,)
    return latch(starting, ending)


def contact_intervals(
    load: Floats,
    t_ns: Times,
    on: float | Floats,
    off: float | Floats,
    min_s: float,
    merge_s: float,
    pad_s: float,
) -> Int64s:
    """Return the row ranges of contacts (contact, 2), stop exclusive, sorted and without overlap.

    Contact starts when ``load`` (time,) reaches ``on`` and ends when it falls below ``off``. For several sensors,
    ``load`` is (sensor, time) and the thresholds may be (sensor,): contact starts when any load reaches its threshold
    and ends when all are below theirs. It neither starts nor ends at NaN. Contacts at most ``merge_s`` apart are merged,
    contacts shorter than ``min_s`` removed, and the others extended by ``pad_s`` on both sides, at most to the middle
    between two contacts. Raises `TacpipeError` unless 0 <= off <= on.
    """
    starts, stops = runs(contact_mask(load, on, off))
    if not len(starts):
        return np.zeros((0, 2), dtype=np.int64)
    is_separate = t_ns[starts[1:]] - t_ns[stops[:-1] - 1] > round(merge_s * 1e9)  # (contact - 1,)
    starts, stops = starts[np.append(True, is_separate)], stops[np.append(is_separate, True)]
    is_long = t_ns[stops - 1] - t_ns[starts] >= round(min_s * 1e9)
    starts, stops = starts[is_long], stops[is_long]
    pad_ns = round(pad_s * 1e9)
    first = np.searchsorted(t_ns, t_ns[starts] - pad_ns, side="left")
    last = np.searchsorted(t_ns, t_ns[stops - 1] + pad_ns, side="right")
    middle = (stops[:-1] + starts[1:]) // 2
    first[1:] = np.maximum(first[1:], middle)
    last[:-1] = np.minimum(last[:-1], middle)
    return np.stack([first, last], axis=1).astype(np.int64)


def _require_taxels(values: AnyArray, axes: int) -> None:
    """Raise `TacpipeError` unless there are channels, a multiple of ``axes``."""
    channels = values.shape[1]
    if not channels or channels % axes:
        raise TacpipeError(
            f"There are {channels} tactile channels; taxels of {axes} axes need a multiple. Check the columns."
        )


NOISES = 3.0  # contact threshold, as a multiple of the standard deviation of a finger's pressure at rest


@dataclass(frozen=True)
class ContactLimits:
    """Thresholds of contact and of steady pressure."""

    rest_s: float  # time at the start whose median is the rest level of each finger
    on_count: float  # pressure above the rest level, in counts, at which a finger presses
    settle_s: float  # time for which all fingers must press, and duration of the averaged reading
    settled_count: float  # maximum range of a steady pressure within ``settle_s``, in counts


def contact_row(pressure: Floats, t_ns: Times, limits: ContactLimits) -> int:
    """Return the first row in which all fingers are in contact; ``pressure`` is (time, finger).

    It is before the first ``settle_s`` in which all fingers press. A finger is in contact from the last row before that in
    which its pressure rises above 1 count or `NOISES` times its noise at rest. Raises `TacpipeError` if the stream is too
    short, or the fingers never press together.
    """
    rows = _count_rows(t_ns, limits.settle_s)
    level = rest_level(pressure, t_ns, limits.rest_s)
    rise = pressure - level  # (time, finger)
    pressing = np.logical_and.reduce(rise >= limits.on_count, axis=1)  # (time,)
    pressed = in_long_runs(pressing, rows)
    if not pressed.any():
        largest = ", ".join(f"{value:g}" for value in rise.max(axis=0))
        raise TacpipeError(
            f"There is no contact: the fingers' pressures rise by at most {largest} counts, but all must rise by "
            f"{limits.on_count:g} for {limits.settle_s:g} s. Exclude the grasp, or lower --on-count."
        )
    noise = rise[t_ns - t_ns[0] <= limits.rest_s * 1e9].std(axis=0)  # (finger,)
    touching = rise > np.clip(NOISES * noise, 1.0, 0.99 * limits.on_count)  # a pressing finger is always in contact
    since = [int(runs(finger[: pressed.argmax() + 1])[0][-1]) for finger in touching.T]
    return max(since)


def settled_rows(pressure: Floats, t_ns: Times, contact: int, limits: ContactLimits) -> slice:
    """Return the first ``settle_s`` from row ``contact`` in which the pressure of all fingers (time, finger) is steady.

    Raises `TacpipeError` if there are none.
    """
    rows = _count_rows(t_ns, limits.settle_s)
    windows = sliding_window_view(pressure[contact:], rows, axis=0)  # (start, finger, row)
    ranges = np.ptp(windows, axis=-1).max(axis=1)  # (start,)
    if not (ranges <= limits.settled_count).any():
        raise TacpipeError(
            f"The fingers' pressures are never steady after contact: within {limits.settle_s:g} s they vary by at least "
            f"{ranges.min():g} counts; at most {limits.settled_count:g} are allowed. Hold the grasp longer, or raise "
            f"--settled-count."
        )
    first = contact + int((ranges <= limits.settled_count).argmax())
    return slice(first, first + rows)


def _count_rows(t_ns: Times, duration_s: float) -> int:
    """Return the number of rows in ``duration_s``, at least 1. Raises `TacpipeError` if the stream has no more rows."""
    rows = 1
    if len(t_ns) > 1:
        rows = max(1, round(duration_s * 1e9 / float(np.median(np.diff(t_ns)))))
    if len(t_ns) <= rows:
        raise TacpipeError(
            f"The fingers' stream has {len(t_ns)} rows; at its rate, more than {rows} are needed. Record from before the "
            f"hand closes until after it."
        )
    return rows
