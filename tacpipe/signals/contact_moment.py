"""The moment at which a hand has closed: all its fingers press, and what they measure has come to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tacpipe.arrays import Floats, Times
from tacpipe.errors import TacpipeError
from tacpipe.signals.contact import rest_level
from tacpipe.signals.runs import in_long_runs, runs

NOISES = 3.0  # standard deviations of a finger's pressure at rest, beyond which it is touched


@dataclass(frozen=True)
class Limits:
    """What counts as pressing, and as rest."""

    rest_s: float  # seconds at the start, whose median is each finger's level without load
    on_count: float  # device counts of pressure above that level, from which on a finger presses
    settle_s: float  # seconds that all fingers must press, and that the reading is taken of
    settled_count: float  # device counts by which the pressure may vary in so many seconds, and still rests


def contact_row(pressure: Floats, t_ns: Times, limits: Limits) -> int:
    """Return the first row in which all fingers touch; ``pressure`` is (time, finger).

    They do where all then press for ``settle_s`` or longer. Each has touched since its pressure left rest for the last
    time before that: since it is above a count, or `NOISES` times its noise at rest if that is more. Raises `TacpipeError`
    where the stream is too short, or some finger never presses while the others do.
    """
    rows = _rows(t_ns, limits.settle_s)
    level = rest_level(pressure, t_ns, limits.rest_s)
    rise = pressure - level  # (time, finger)
    pressing = np.logical_and.reduce(rise >= limits.on_count, axis=1)  # (time,)
    held = in_long_runs(pressing, rows)
    if not held.any():
        most = ", ".join(f"{value:g}" for value in rise.max(axis=0))
        raise TacpipeError(
            f"There is no contact: the fingers' pressures rise by {most} counts at most, and must all be "
            f"{limits.on_count:g} or more above rest for {limits.settle_s:g} s. Leave the grasp out, or lower --on-count."
        )
    noise = rise[t_ns - t_ns[0] <= limits.rest_s * 1e9].std(axis=0)  # (finger,)
    touching = rise > np.clip(
        NOISES * noise, 1.0, 0.99 * limits.on_count
    )  # whatever moved at rest, pressing is touching
    since = [int(runs(finger[: held.argmax() + 1])[0][-1]) for finger in touching.T]
    return max(since)


def settled_rows(pressure: Floats, t_ns: Times, contact: int, limits: Limits) -> slice:
    """Return the first ``settle_s`` of rows, from the row ``contact`` on, in which the pressure of each finger rests.

    ``pressure`` is (time, finger). Raises `TacpipeError` where it never does.
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
    """Return how many rows last ``duration_s``, one or more. Raises `TacpipeError` where a stream has no more than these."""
    rows = 1
    if len(t_ns) > 1:
        rows = max(1, round(duration_s * 1e9 / float(np.median(np.diff(t_ns)))))
    if len(t_ns) <= rows:
        raise TacpipeError(
            f"The fingers' stream has {len(t_ns)} rows; at its rate {rows} must be held, and some before that. Record "
            f"from before the hand closes until after."
        )
    return rows
