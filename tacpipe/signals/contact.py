"""When something is touched: the level without load, the load on a sensor and the intervals in which there is some."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.errors import TacpipeError
from tacpipe.signals.runs import latched, runs

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


def axis_mean_level(values: NDArray[Any], axes: int = 3) -> Floats:
    """Return what to take off each channel of ``values`` (time, channel) so that all taxels of an axis begin alike.

    In the first row they then have the whole part of that axis' mean over the taxels, not 0, as in the authors'
    notebooks; (channel,). The channels go taxel by taxel, ``axes`` to a taxel.

    >>> axis_mean_level(np.array([[10, 1, 13, 2]]), axes=2).tolist()
    [-1.0, 0.0, 2.0, 1.0]
    """
    _require_taxels(values, axes)
    if not len(values):
        raise TacpipeError("The level at rest cannot be told from a recording without rows.")
    first = values[0].astype(np.float64).reshape(-1, axes)  # (taxel, axis)
    level: Floats = (first - np.trunc(first.mean(axis=0))).ravel()
    return level


def load(values: NDArray[Any], rest: Floats, axes: int = 3) -> Floats:
    """Return how far the taxels are from ``rest`` on average (time,), in the unit of ``values``.

    The channels of ``values`` (time, channel) go taxel by taxel, ``axes`` to a taxel; a taxel's distance is the length
    of the vector of its axes. Raises `TacpipeError` if the channels are not whole taxels.

    >>> load(np.array([[3.0, 4.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros(6)).tolist()
    [3.0]
    """
    _require_taxels(values, axes)
    time, channels = values.shape
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
    starts, stops = runs(latched(load >= on, load < off))
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


def _require_taxels(values: NDArray[Any], axes: int) -> None:
    channels = values.shape[1]
    if not channels or channels % axes:
        raise TacpipeError(f"{channels} tactile channels are not whole taxels of {axes} axes; check the columns.")
