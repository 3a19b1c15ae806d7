"""When something is touched: the load on a sensor and the intervals in which there is some."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.errors import TacpipeError

Times = NDArray[np.int64]
Floats = NDArray[np.float64]


def rest_level(values: NDArray[Any], t_ns: Times, rest_s: float) -> Floats:
    """Return the median of each channel of ``values`` (time, channel) over the first ``rest_s`` seconds (channel,).

    A median, because one bad frame must not shift a whole recording. The first row always counts.
    Raises `TacpipeError` if there are no rows.
    """
    if not len(t_ns):
        raise TacpipeError("The level at rest cannot be told from a recording without rows.")
    rows = int(np.searchsorted(t_ns, t_ns[0] + round(rest_s * 1e9), side="right"))
    level: Floats = np.median(values[: max(rows, 1)], axis=0).astype(np.float64)
    return level


def load(values: NDArray[Any], rest: Floats, axes: int = 3) -> Floats:
    """Return how far the taxels are from ``rest`` on average (time,), in the unit of ``values``.

    The channels of ``values`` (time, channel) go taxel by taxel, ``axes`` to a taxel; a taxel's distance is the length
    of the vector of its axes. Raises `TacpipeError` if the channels are not whole taxels.

    >>> load(np.array([[3.0, 4.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros(6)).tolist()
    [3.0]
    """
    time, channels = values.shape
    if not channels or channels % axes:
        raise TacpipeError(f"{channels} tactile channels are not whole taxels of {axes} axes; check the columns.")
    taxels = (values - rest).reshape(time, channels // axes, axes)  # (time, taxel, axis)
    distance: Floats = np.sqrt(np.einsum("tna,tna->tn", taxels, taxels)).mean(axis=1)
    return distance


def contact_intervals(
    load: Floats, t_ns: Times, on: float, off: float, min_s: float, merge_s: float, pad_s: float
) -> NDArray[np.int64]:
    """Return the row ranges (contact, 2) in which there is contact, stop exclusive, sorted and without overlap.

    Contact starts where ``load`` (time,) reaches ``on`` and ends where it falls below ``off``. Two that are at most
    ``merge_s`` apart are one; then those shorter than ``min_s`` go; the rest grow by ``pad_s`` on both sides, and where
    they would meet, the rows between them are shared out at the middle. Raises `TacpipeError` unless 0 <= off <= on.
    """
    if not 0 <= off <= on:
        raise TacpipeError(f"Contact that starts at {on} and ends below {off} flickers; off must lie between 0 and on.")
    starts, stops = _runs(_hysteresis(load, on, off))
    if not len(starts):
        return np.zeros((0, 2), dtype=np.int64)
    apart = t_ns[starts[1:]] - t_ns[stops[:-1] - 1] > round(merge_s * 1e9)  # (contact - 1,)
    starts, stops = starts[np.append(True, apart)], stops[np.append(apart, True)]
    long = t_ns[stops - 1] - t_ns[starts] >= round(min_s * 1e9)
    starts, stops = starts[long], stops[long]
    pad_ns = round(pad_s * 1e9)
    first = np.searchsorted(t_ns, t_ns[starts] - pad_ns, side="left")
    last = np.searchsorted(t_ns, t_ns[stops - 1] + pad_ns, side="right")
    middle = (stops[:-1] + starts[1:]) // 2
    first[1:] = np.maximum(first[1:], middle)
    last[:-1] = np.minimum(last[:-1], middle)
    return np.stack([first, last], axis=1).astype(np.int64)


def _hysteresis(load: Floats, on: float, off: float) -> NDArray[np.bool_]:
    """Return where the state is on (time,): each row takes the state of the last row that decided one."""
    decided = (load >= on) | (load < off)
    rows = np.maximum.accumulate(np.where(decided, np.arange(len(load)), -1))
    state: NDArray[np.bool_] = (rows >= 0) & (load[rows] >= on)
    return state


def _runs(state: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first rows and the stops, exclusive, of the runs of True."""
    edges = np.diff(np.concatenate([[False], state, [False]]).astype(np.int8))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
