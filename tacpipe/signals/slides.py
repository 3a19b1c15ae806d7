"""Find the slide of a finger within a recording, choose its frames, and check it against the protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Floats
from tacpipe.errors import TacpipeError
from tacpipe.signals.runs import in_long_runs

Rows = tuple[int, int]  # the first, and the one behind the last

CROPS = ("middle", "offset", "none")


@dataclass(frozen=True)
class Protocol:
    """The protocol that each slide of an experiment should follow."""

    speed_m_s: float
    speed_tolerance: float  # fraction of it
    min_s: float
    pressure_low: float  # counts
    pressure_high: float


def trigger_row(pressure: AnyArray, threshold: float) -> int:
    """Return the first row of ``pressure`` (time,) that reaches ``threshold``. Raises `TacpipeError` if none does.

    >>> trigger_row(np.array([12, 39, 40, 17, 80]), 40.0)
    2
    """
    reached = pressure >= threshold
    if not reached.any():
        largest = f"its most is {np.nanmax(pressure):g}" if np.isfinite(pressure).any() else "it has no reading"
        raise TacpipeError(
            f"The pressure never reaches {threshold:g} counts, {largest}; no slide began. Exclude the recording, or lower "
            f"`--pressure-trigger`."
        )
    return int(reached.argmax())


def touched_rows(load: Floats, on: float, off: float, unit: str = "") -> Rows:
    """Return the rows from the first ``load`` (time,) of ``on`` or more to the last of ``off`` or more.

    Raises `TacpipeError` if there is none.

    >>> touched_rows(np.array([0.0, 1.0, 5.0, 3.0, 6.0, 2.0, 0.0]), on=4.0, off=2.0)
    (2, 6)
    """
    reached = load >= on
    if not reached.any():
        largest = f"{np.nanmax(load):.3g}" if np.isfinite(load).any() else "no reading"
        raise TacpipeError(
            f"The load never reaches {on:.3g} {unit}, its most is {largest}; no slide began. Exclude the recording, or "
            f"lower `--load-trigger`."
        )
    return int(reached.argmax()), int(np.flatnonzero(load >= off)[-1]) + 1


def sliding_rows(speed_m_s: Floats, first: int, least_m_s: float, steady_rows: int) -> Rows | None:
    """Return the rows from ``first`` on between which ``speed_m_s`` (time,) begins and ceases to be ``least_m_s``.

    It counts once it lasts for ``steady_rows``, so that a single fast reading of an arm at rest begins nothing. What is
    slower in between belongs to the slide. None if the arm never moves so fast.

    >>> sliding_rows(np.array([0.0, 9.0, 0.0, 3.0, 3.0, 1.0, 3.0, 3.0, 0.0]), 0, least_m_s=2.0, steady_rows=2)
    (3, 8)
    """
    moving = np.flatnonzero(in_long_runs(speed_m_s[first:] >= least_m_s, steady_rows))
    return (first + int(moving[0]), first + int(moving[-1]) + 1) if len(moving) else None


def kept_rows(slide: Rows, frames: int, crop: str, offset_first: int) -> Rows:
    """Return which rows of a slide are kept: all (crop ``none``), or ``frames`` of them.

    With the crop ``middle`` one row fewer lies before than behind them where they cannot be centred, with ``offset`` they
    begin at the row ``offset_first``. Raises `TacpipeError` for another crop, and where there are not that many rows.

    >>> kept_rows((0, 800), 400, "middle", 0), kept_rows((0, 799), 400, "middle", 0), kept_rows((3, 800), 400, "offset", 101)
    ((200, 600), (199, 599), (101, 501))
    """
    if crop not in CROPS:
        raise TacpipeError(f"crop is {crop!r}; it must be {', '.join(CROPS[:-1])} or {CROPS[-1]}.")
    if crop == "none":
        return slide
    begin = slide[0] if crop == "middle" else offset_first
    rows = slide[1] - begin
    if not 0 < frames <= rows:
        raise TacpipeError(
            f"The slide has {max(rows, 0)} rows from row {begin} (counted from 0) on, and {frames} are to be kept. Exclude "
            f"the recording, or give another number with `--frames`."
        )
    first = begin + (rows - frames) // 2 if crop == "middle" else begin
    return first, first + frames


def phases(rows: int, slide: Rows) -> NDArray[np.int8]:
    """Return -1 for each row before the slide, 0 within it and 1 after it, (time,).

    >>> phases(5, (1, 3)).tolist()
    [-1, 0, 0, 1, 1]
    """
    place = np.arange(rows)
    return (place >= slide[1]).astype(np.int8) - (place < slide[0]).astype(np.int8)


def measured(pressure: AnyArray, profile: Mapping[str, Floats]) -> dict[str, float]:
    """Return what the kept rows of a slide were like: the means of pressure and force, the median of the speed.

    All are (time,). Speed and force are left out where they are not known in all rows.

    >>> measured(np.array([10, 20]), {"speed_m_s": np.array([0.02, 0.03]), "force_n": np.array([np.nan, 1.0])})
    {'pressure_mean_count': 15.0, 'speed_m_s': 0.025}
    """
    figures = {"pressure_mean_count": round(float(pressure.mean()), 3)}
    kinds: tuple[tuple[str, Callable[..., Any], int], ...] = (("speed_m_s", np.median, 5), ("force_n", np.mean, 3))
    for name, average, digits in kinds:
        if name in profile and np.isfinite(profile[name]).all():
            figures[name] = round(float(average(profile[name])), digits)
    return figures


def departures(protocol: Protocol, lasts_s: float, measured: Mapping[str, float]) -> list[str]:
    """Return in words each way in which a slide differs from its protocol, or None if it does not.

    >>> wanted = Protocol(0.025, 0.1, 5.0, 2.0, 150.0)
    >>> departures(wanted, 8.0, {"pressure_mean_count": 1.0, "speed_m_s": 0.03})
    ['its speed is 30.0 mm/s and not 25.0', 'its mean pressure is 1.0 counts and not 2 to 150']
    """
    reasons = []
    speed_m_s, pressure_count = measured.get("speed_m_s", protocol.speed_m_s), measured["pressure_mean_count"]
    if abs(speed_m_s - protocol.speed_m_s) > protocol.speed_tolerance * protocol.speed_m_s:
        reasons.append(f"its speed is {1e3 * speed_m_s:.1f} mm/s and not {1e3 * protocol.speed_m_s:.1f}")
    if lasts_s < protocol.min_s:
        reasons.append(f"it lasts {lasts_s:.2f} s and not {protocol.min_s:g} or more")
    if not protocol.pressure_low <= pressure_count <= protocol.pressure_high:
        limits = f"{protocol.pressure_low:g} to {protocol.pressure_high:g}"
        reasons.append(f"its mean pressure is {pressure_count:.1f} counts and not {limits}")
    return reasons
