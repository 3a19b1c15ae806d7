"""Alarms of a live session: a score of each forecast, a level beyond which it is on, and "unknown" without a forecast.

Two scores. *Load*: by how much the mean count of an axis of a sensor is predicted to change within the horizon, over the
level of that axis; the largest of all axes counts. *Slip*: the same of what is predicted along the skin alone (axes x and
y), because an object that slides changes what pulls along the skin, and one that is gripped harder what presses on it.

Levels are set on validation recordings, as `tacpipe evaluate` sets its own (`tacpipe.signals.anticipation`): the least that
gives no more than a number of false alarms an hour where nothing changes. Of several axes each gets its part of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.signals.loads import axes, loads

LOAD, SLIP = "load", "slip"
NAMES = (LOAD, SLIP)
ALONG = ("x", "y")  # axes along the skin
LEAST = 1e-9  # that a level counts as, so that a forecast of no change is never beyond it
WORDS = {UNKNOWN: "unknown", OFF: "off", ON: "on"}


@dataclass(frozen=True)
class State:
    """One alarm at one grid point."""

    state: int  # `UNKNOWN`, `OFF` or `ON`
    score: float  # times its level; above 1 the alarm is on; NaN where it is unknown

    @property
    def word(self) -> str:
        """The state as a word."""
        return WORDS[self.state]


NOTHING_KNOWN = {name: State(UNKNOWN, math.nan) for name in NAMES}


@dataclass(frozen=True)
class Alarms:
    """The levels of a model's alarms, by sensor and axis."""

    axes: tuple[tuple[str, str], ...]  # stream and axis of each load
    levels: Mapping[str, tuple[float, ...]]  # alarm to the level of each load, infinite where it has none
    per_hour: float = math.nan  # false alarms that they were set for

    @classmethod
    def unset(cls, layout: Sequence[Mapping[str, str]]) -> Self:
        """Return alarms without levels, which are always unknown."""
        return cls(axes(layout), {})

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return what `to_json` gave."""
        levels = {
            name: tuple(math.inf if one is None else float(one) for one in values)
            for name, values in content["levels"].items()
        }
        return cls(tuple((stream, axis) for stream, axis in content["axes"]), levels, float(content["per_hour"]))

    def states(self, ahead: AnyFloats, now: AnyFloats, layout: Sequence[Mapping[str, str]]) -> dict[str, State]:
        """Return the state of each alarm, of counts predicted (step, channel) and the last ones (channel,)."""
        if not self.levels:
            return dict(NOTHING_KNOWN)
        last, present = (loads(np.asarray(one, np.float64), layout)[0] for one in (ahead[-1:], now[None]))
        moved = np.abs(last - present)
        found = {}
        for name in NAMES:
            levels = np.array(self.levels[name])
            set_for = np.isfinite(levels)
            score = float((moved[set_for] / np.maximum(levels[set_for], LEAST)).max(initial=0.0))  # NaN stays one
            known = bool(set_for.any()) and math.isfinite(score)
            found[name] = State(UNKNOWN if not known else ON if score > 1 else OFF, score if known else math.nan)
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the levels as JSON can hold them: null where there is none."""
        levels = {name: [one if math.isfinite(one) else None for one in values] for name, values in self.levels.items()}
        return {"axes": [list(one) for one in self.axes], "levels": levels, "per_hour": self.per_hour}


def set_on(
    truth: AnyFloats,
    ahead: AnyFloats,
    groups: Int64s,
    slips: Any,
    layout: Sequence[Mapping[str, str]],
    *,
    horizon: int,
    rate_hz: float,
    per_hour: float,
) -> Alarms:
    """Return alarms with levels for ``per_hour`` false alarms each.

    ``truth`` and ``ahead`` (time, load) are loads and what was predicted of them at the last step, NaN without a forecast,
    of rows whose ``groups`` (time,) are equal where they follow one another. ``slips`` (time,) is where the object slips,
    None where no recording states that: slip is then set where no load changes, as load is.
    """
    from tacpipe.signals import anticipation

    places = axes(layout)
    sd = anticipation.difference_sd(truth, groups, horizon=horizon)
    levels: dict[str, tuple[float, ...]] = {}
    for name in NAMES:
        chosen = [index for index, (_, axis) in enumerate(places) if name == LOAD or axis in ALONG]
        found = np.full(len(places), math.inf)
        if chosen:
            quiet = (
                ahead
                if name == LOAD or slips is None
                else np.where(_near(slips, groups, horizon)[:, None], np.nan, ahead)
            )
            found[chosen] = anticipation.calibrate(
                truth[:, chosen],
                quiet[:, chosen],
                groups,
                horizon=horizon,
                sd=sd[chosen],
                rate_hz=rate_hz,
                per_minute=per_hour / 60 / len(chosen),
            )
        levels[name] = tuple(found.tolist())
    return Alarms(places, levels, per_hour)


def _near(slips: Any, groups: Int64s, horizon: int) -> Any:
    """Return the rows (time,) in which an object slips, or will within the horizon."""
    rows = np.flatnonzero(slips)
    found = np.zeros(len(groups), dtype=bool)
    for row in rows:
        first = max(0, row - horizon)
        found[first : row + 1] |= groups[first : row + 1] == groups[row]
    return found
