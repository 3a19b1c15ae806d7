"""Find the slide of a finger in a recording, crop it, and check it against the protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Floats
from tacpipe.errors import TacpipeError
from tacpipe.signals.runs import in_long_runs

Rows = tuple[int, int]  # start and exclusive stop

CROPS = ("middle", "offset", "none")


@dataclass(frozen=True)
class Protocol:
    """The protocol that each slide of an experiment should follow."""

    speed_m_s: float
    speed_tolerance: float  # tolerance as a fraction of the speed
    min_s: float
    pressure_low: float  # counts
    pressure_high: float


def trigger_row(pressure: AnyArray, threshold: float) -> int:
    """Return the first row in which ``pressure`` (time,) reaches ``threshold``. Raises `TacpipeError` if there is none.

    >>> trigger_row(np.array([12, 39, 40, 17, 80]), 40.0)
    2
    """
    reached = pressure >= threshold
    if not reached.any():
        largest = f"its maximum is {np.nanmax(pressure):g}" if np.isfinite(pressure).any() else "it has no finite value"
        raise TacpipeError(
            f"The pressure never reaches {threshold:g} counts; {largest}. Exclude the recording, or lower "
            f"`--pressure-trigger`."
        )
    return int(reached.argmax())


def loaded_rows(load: Floats, on: float, off: float, unit: str = "") -> Rows:
    """Return the rows from the first ``load`` (time,) of at least ``on`` to the last of at least ``off``.

    Raises `TacpipeError` if there is none.

    >>> loaded_rows(np.array([0.0, 1.0, 5.0, 3.0, 6.0, 2.0, 0.0]), on=4.0, off=2.0)
    (2, 6)
    """
    reached = load >= on
    if not reached.any():
        largest = f"its maximum is {np.nanmax(load):.3g}" if np.isfinite(load).any() else "it has no finite value"
        raise TacpipeError(
            f"The load never reaches {on:.3g} {unit}; {largest}. Exclude the recording, or lower `--load-trigger`."
        )
    return int(reached.argmax()), int(np.flatnonzero(load >= off)[-1]) + 1


def sliding_rows(speed_m_s: Floats, first: int, least_m_s: float, steady_rows: int) -> Rows | None:
    """Return the rows, from ``first``, between the first and last run in which ``speed_m_s`` (time,) reaches ``least_m_s``.

    A run has at least ``steady_rows`` rows, so that single fast readings of a resting arm do not count. Slower rows
    between runs are included. Returns None without a run.

    >>> sliding_rows(np.array([0.0, 9.0, 0.0, 3.0, 3.0, 1.0, 3.0, 3.0, 0.0]), 0, least_m_s=2.0, steady_rows=2)
    (3, 8)
    """
    moving = np.flatnonzero(in_long_runs(speed_m_s[first:] >= least_m_s, steady_rows))
    if not len(moving):
        return None
    return first + int(moving[0]), first + int(moving[-1]) + 1


def crop_rows(slide: Rows, frames: int, crop: str, offset_first: int) -> Rows:
    """Return the rows of a slide cropped to ``frames`` rows (crop ``middle`` or ``offset``), or all (``none``).

    With ``middle``, if the rows cannot be centred, one row fewer is removed before than after them. With ``offset``,
    they start at row ``offset_first``. Raises `TacpipeError` for another crop, or if there are too few rows.

    >>> crop_rows((0, 800), 400, "middle", 0), crop_rows((0, 799), 400, "middle", 0), crop_rows((3, 800), 400, "offset", 101)
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
            f"The slide has {max(rows, 0)} rows from row {begin} (counted from 0), but {frames} are needed. Exclude the "
            f"recording, or change `--frames`."
        )
    first = begin + (rows - frames) // 2 if crop == "middle" else begin
    return first, first + frames


def phases(rows: int, slide: Rows) -> NDArray[np.int8]:
    """Return the phase of each row (time,): -1 before the slide, 0 during it and 1 after it.

    >>> phases(5, (1, 3)).tolist()
    [-1, 0, 0, 1, 1]
    """
    row = np.arange(rows)
    return (row >= slide[1]).astype(np.int8) - (row < slide[0]).astype(np.int8)


def slide_statistics(pressure: AnyArray, profile: Mapping[str, Floats]) -> dict[str, float]:
    """Return mean pressure, mean force and median speed of a cropped slide.

    All inputs are (time,). Speed and force are omitted unless they are finite in all rows.

    >>> slide_statistics(np.array([10, 20]), {"speed_m_s": np.array([0.02, 0.03]), "force_n": np.array([np.nan, 1.0])})
    {'pressure_mean_count': 15.0, 'speed_m_s': 0.025}
    """
    figures = {"pressure_mean_count": round(float(pressure.mean()), 3)}
    kinds: tuple[tuple[str, Callable[..., Any], int], ...] = (("speed_m_s", np.median, 5), ("force_n", np.mean, 3))
    for name, average, digits in kinds:
        if name in profile and np.isfinite(profile[name]).all():
            figures[name] = round(float(average(profile[name])), digits)
    return figures


def protocol_deviations(protocol: Protocol, lasts_s: float, measured: Mapping[str, float]) -> list[str]:
    """Return a description of each deviation of a slide from its protocol.

    >>> protocol = Protocol(0.025, 0.1, 5.0, 2.0, 150.0)
    >>> protocol_deviations(protocol, 8.0, {"pressure_mean_count": 1.0, "speed_m_s": 0.03})
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
