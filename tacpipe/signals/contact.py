"""Find contacts: the level without load, the load on a sensor, and the intervals and first rows of contact."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tacpipe.arrays import AnyArray, Bools, Floats, Int64s, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.repairs import held
from tacpipe.signals.runs import in_long_runs, latched, runs

NOISE_FEWEST, NOISE_USUAL = 10.0, 40.0  # times the noise at rest: least, and usual, load at which contact starts
PEAK_LEAST, PEAK_MOST = 0.05, 0.25  # least and largest start threshold, as fractions of the largest load
WITHOUT_ROWS = "The level at rest cannot be distinguished from a recording without rows."
# Yields the channels of a recording (time, channel) in blocks of one row or more, from the first row on.
Blocks = Callable[[], Iterable[AnyArray]]
ENDS = 2 / 3  # load at which contact ends, as a fraction of the load at which it starts
PEAK_QUANTILE = 0.99  # quantile of the load that is its largest: a single wrong frame is none


class Thresholds(NamedTuple):
    """The loads at which a contact starts and ends, in the unit of the load."""

    on: float  # contact starts where the load reaches this
    off: float  # load below which a contact ends


def rest_level(values: AnyArray, t_ns: Times, rest_s: float) -> Floats:
    """Return the median of each channel of ``values`` (time, channel) over the first ``rest_s`` seconds (channel,).

    A median, because one bad frame must not shift a whole recording. The first row always counts.
    Raises `TacpipeError` if there are no rows.
    """
    if not len(t_ns):
        raise TacpipeError(WITHOUT_ROWS)
    rows = int(np.searchsorted(t_ns, t_ns[0] + round(rest_s * 1e9), side="right"))
    level: Floats = np.median(values[: max(rows, 1)], axis=0).astype(np.float64)
    return level


def lowest_part(total: AnyArray, t_ns: Times, rest_s: float) -> Bools:
    """Return the rows (time,) of the ``rest_s`` seconds in which ``total`` (time,), of all channels, is lowest.

    For recordings that begin in contact, of sensors that rise under load. Rows whose total is infinite never count.

    >>> lowest_part(np.array([9, 9, 1, 2, 9]), np.arange(5) * 10**9, rest_s=1.0).tolist()
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


def at_rest(rest_rows: str, blocks: Blocks, t_ns: Times, rest_s: float) -> tuple[Floats, Bools | None]:
    """Return each channel's level without load (channel,), and the rows (time,) it is of, None for those of the start.

    ``blocks`` yields the channels. ``rest_rows`` is ``start``, for the first ``rest_s`` seconds, or ``lowest``, for those of
    `lowest_part`. Raises `TacpipeError` if there are no rows.
    """
    if not len(t_ns):
        raise TacpipeError(WITHOUT_ROWS)
    if rest_rows == "start":
        first_rows: list[AnyArray] = []
        for values in blocks():
            first_rows.append(values)
            count = sum(map(len, first_rows))
            if t_ns[count - 1] > t_ns[0] + round(rest_s * 1e9):
                break
        values = np.concatenate(first_rows)
        return rest_level(values, t_ns[: len(values)], rest_s), None
    totals = [np.where(np.isfinite(values).all(axis=1), values.sum(axis=1), np.inf) for values in blocks()]
    rows = lowest_part(np.concatenate(totals), t_ns, rest_s)
    chosen, first = [], 0
    for values in blocks():
        chosen.append(values[rows[first : first + len(values)]])
        first += len(values)
    level: Floats = np.median(np.concatenate(chosen), axis=0).astype(np.float64)
    return level, rows


def tared(method: Literal["median", "first", "axis_mean"], values: AnyArray, level: Floats, axes: int) -> Floats:
    """Return what is taken off each channel (channel,) of ``values`` (time, channel).

    ``median`` is ``level``, that of the channels at rest; ``first`` the first row; ``axis_mean`` that of
    `axis_mean_level`, whose ``axes`` are of a taxel.
    """
    if method == "median":
        return level
    if method == "first":
        first: Floats = values[0].astype(np.float64)
        return first
    return axis_mean_level(values, axes)


def axis_mean_level(values: AnyArray, axes: int = 3) -> Floats:
    """Return what to take off each channel of ``values`` (time, channel) so that all taxels of an axis begin alike.

    In the first row they then have the whole part of that axis' mean over the taxels, not 0, as in the authors'
    notebooks; (channel,). The channels go taxel by taxel, ``axes`` to a taxel.

    >>> axis_mean_level(np.array([[10, 1, 13, 2]]), axes=2).tolist()
    [-1.0, 0.0, 2.0, 1.0]
    """
    _require_taxels(values, axes)
    if not len(values):
        raise TacpipeError(WITHOUT_ROWS)
    first = values[0].astype(np.float64).reshape(-1, axes)  # (taxel, axis)
    level: Floats = (first - np.trunc(first.mean(axis=0))).ravel()
    return level


def load(values: AnyArray, rest_level: Floats, axes: int = 3) -> Floats:
    """Return how far the taxels are from ``rest`` on average (time,), in the unit of ``values``.

    The channels of ``values`` (time, channel) go taxel by taxel, ``axes`` to a taxel; a taxel's distance is the length
    of the vector of its axes. Raises `TacpipeError` if the channels are not whole taxels.

    >>> load(np.array([[3.0, 4.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros(6)).tolist()
    [3.0]
    """
    _require_taxels(values, axes)
    time, channels = values.shape
    taxels = (values - rest_level).reshape(time, channels // axes, axes)  # (time, taxel, axis)
    distance: Floats = np.sqrt(np.einsum("tna,tna->tn", taxels, taxels)).mean(axis=1)
    return distance


def load_in_blocks(blocks: Blocks, rest_level: Floats, axes: int) -> tuple[Floats, Bools]:
    """Return the `load` of channels that come in blocks, and which rows repeat the one before; each (time,)."""
    loads: list[Floats] = []
    repeated: list[Bools] = []
    last: AnyArray | None = None
    for values in blocks():
        loads.append(load(values, rest_level, axes))
        repeated.append(held(values if last is None else np.concatenate([last, values]))[-len(values) :])
        last = values[-1:]
    return np.concatenate(loads), np.concatenate(repeated)


def noise_thresholds(
    repeated: Bools, load: Floats, t_ns: Times, rest_s: float, rest: Bools | None = None
) -> Thresholds:
    """Return thresholds for a sensor of any unit, from its noise at rest.

    The noise is the upper quartile of ``load`` (time,) over the first ``rest_s`` seconds, or the rows ``rest`` (time,);
    samples that repeat the one before in all channels, ``repeated`` (time,), are left out. Contact starts at 40
    times the noise, but at no more than a quarter of the recording's largest load, at least at a twentieth of that, and
    at least at 10 times the noise; it ends at two thirds of that. On 52 published trials of a XELA uSkin this is 70 to
    230 counts, next to the 120 that were set by hand. Without any load the thresholds are infinite.
    """
    finite = np.isfinite(load)
    largest = float(np.quantile(load[finite], PEAK_QUANTILE)) if finite.any() else 0.0
    if largest <= 0:
        return Thresholds(np.inf, np.inf)
    at_rest = finite & ~repeated & (t_ns <= t_ns[0] + round(rest_s * 1e9) if rest is None else rest)
    noise = float(np.quantile(load[at_rest], 0.75)) if at_rest.any() else 0.0
    usual = min(NOISE_USUAL * noise, PEAK_MOST * largest)
    on = max(NOISE_FEWEST * noise, PEAK_LEAST * largest, usual)
    return Thresholds(on, ENDS * on)


def touching(load: Floats, on: float | Floats, off: float | Floats) -> Bools:
    """Return the rows of touch (time,), as `contact_intervals` detects it before it merges, drops and pads contacts."""
    loads, ons, offs = np.atleast_2d(load), np.reshape(on, (-1, 1)), np.reshape(off, (-1, 1))  # (sensor, time or 1)
    if not ((offs >= 0) & (offs <= ons)).all():
        raise TacpipeError(f"Contact that starts at {on} and ends below {off} flickers; off must lie between 0 and on.")
    starting: Bools = np.any(loads >= ons, axis=0) & ~np.isnan(loads).any(axis=0)  # (time,)
    ending: Bools = np.all(loads < offs, axis=0)  # (time,)
    return latched(starting, ending)


def contact_intervals(
    load: Floats,
    t_ns: Times,
    on: float | Floats,
    off: float | Floats,
    min_s: float,
    merge_s: float,
    pad_s: float,
) -> Int64s:
    """Return the row ranges (contact, 2) in which there is contact, stop exclusive, sorted and without overlap.

    Contact starts where ``load`` (time,) reaches ``on`` and ends where it falls below ``off``. Of several sensors
    ``load`` is (sensor, time) and the thresholds may be (sensor,): it starts where any load reaches its own and ends
    where all are below. Where a load is NaN it does neither. Contacts that are at most ``merge_s`` apart are one; then
    those shorter than ``min_s`` go; the rest grow by ``pad_s`` on both sides, and where they would meet, the rows
    between them are shared out at the middle. Raises `TacpipeError` unless 0 <= off <= on.
    """
    starts, stops = runs(touching(load, on, off))
    if not len(starts):
        return np.zeros((0, 2), dtype=np.int64)
    separate = t_ns[starts[1:]] - t_ns[stops[:-1] - 1] > round(merge_s * 1e9)  # (contact - 1,)
    starts, stops = starts[np.append(True, separate)], stops[np.append(separate, True)]
    long = t_ns[stops - 1] - t_ns[starts] >= round(min_s * 1e9)
    starts, stops = starts[long], stops[long]
    pad_ns = round(pad_s * 1e9)
    first = np.searchsorted(t_ns, t_ns[starts] - pad_ns, side="left")
    last = np.searchsorted(t_ns, t_ns[stops - 1] + pad_ns, side="right")
    middle = (stops[:-1] + starts[1:]) // 2
    first[1:] = np.maximum(first[1:], middle)
    last[:-1] = np.minimum(last[:-1], middle)
    return np.stack([first, last], axis=1).astype(np.int64)


def _require_taxels(values: AnyArray, axes: int) -> None:
    channels = values.shape[1]
    if not channels or channels % axes:
        raise TacpipeError(f"{channels} tactile channels are not whole taxels of {axes} axes; check the columns.")


NOISES = 3.0  # standard deviations of a finger's pressure at rest, beyond which it is touched


@dataclass(frozen=True)
class ContactLimits:
    """Limits of pressing and of rest."""

    rest_s: float  # seconds at the start, whose median is each finger's level without load
    on_count: float  # device counts of pressure above that level, from which on a finger presses
    settle_s: float  # seconds that all fingers must press, and that the reading is taken of
    settled_count: float  # device counts by which the pressure may vary in so many seconds, and still rests


def contact_row(pressure: Floats, t_ns: Times, limits: ContactLimits) -> int:
    """Return the first row in which all fingers touch; ``pressure`` is (time, finger).

    They do where all then press for ``settle_s`` or longer. Each has touched since its pressure left rest for the last
    time before that: since it is above a count, or `NOISES` times its noise at rest if that is more. Raises `TacpipeError`
    where the stream is too short, or some finger never presses while the others do.
    """
    rows = _rows(t_ns, limits.settle_s)
    level = rest_level(pressure, t_ns, limits.rest_s)
    rise = pressure - level  # (time, finger)
    pressing = np.logical_and.reduce(rise >= limits.on_count, axis=1)  # (time,)
    pressed = in_long_runs(pressing, rows)
    if not pressed.any():
        largest = ", ".join(f"{value:g}" for value in rise.max(axis=0))
        raise TacpipeError(
            f"There is no contact: the fingers' pressures rise by {largest} counts at most, and must all be "
            f"{limits.on_count:g} or more above rest for {limits.settle_s:g} s. Leave the grasp out, or lower --on-count."
        )
    noise = rise[t_ns - t_ns[0] <= limits.rest_s * 1e9].std(axis=0)  # (finger,)
    touching = rise > np.clip(
        NOISES * noise, 1.0, 0.99 * limits.on_count
    )  # whatever moved at rest, pressing is touching
    since = [int(runs(finger[: pressed.argmax() + 1])[0][-1]) for finger in touching.T]
    return max(since)


def settled_rows(pressure: Floats, t_ns: Times, contact: int, limits: ContactLimits) -> slice:
    """Return the first ``settle_s`` of rows, from the row ``contact`` on, in which the pressure of each finger rests.

    ``pressure`` is (time, finger). Raises `TacpipeError` if it never does.
    """
    rows = _rows(t_ns, limits.settle_s)
    windows = sliding_window_view(pressure[contact:], rows, axis=0)  # (start, finger, row)
    ranges = np.ptp(windows, axis=-1).max(axis=1)  # (start,)
    if not (ranges <= limits.settled_count).any():
        raise TacpipeError(
            f"The fingers' pressures never rest after contact: within {limits.settle_s:g} s they vary by "
            f"{ranges.min():g} counts or more, and may by {limits.settled_count:g}. Hold the grasp still for longer, or "
            f"allow more with --settled-count."
        )
    first = contact + int((ranges <= limits.settled_count).argmax())
    return slice(first, first + rows)


def _rows(t_ns: Times, duration_s: float) -> int:
    """Return how many rows last ``duration_s``, one or more. Raises `TacpipeError` if a stream has no more than these."""
    rows = 1
    if len(t_ns) > 1:
        rows = max(1, round(duration_s * 1e9 / float(np.median(np.diff(t_ns)))))
    if len(t_ns) <= rows:
        raise TacpipeError(
            f"The fingers' stream has {len(t_ns)} rows; at its rate {rows} must be held, and some before that. Record "
            f"from before the hand closes until after."
        )
    return rows
