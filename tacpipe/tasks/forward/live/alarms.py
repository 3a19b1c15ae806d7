"""Alarms of a live session: a score of each forecast, a level beyond which it is on, and "unknown" without a forecast.

Two scores. *Load*: by how much the mean count of an axis of a sensor is predicted to change within the horizon, over the
level of that axis; the largest of all axes counts. *Slip*: how far the load along the skin is predicted to rise and then to
fall again, as a fraction of what presses (`tacpipe.tasks.forward.slips`); one level for all sensors.

Levels are set on validation recordings, as `tacpipe evaluate` sets its own (`tacpipe.tasks.forward.alarms`): the least
that gives no more than a number of false alarms an hour. An alarm of load is false where no load changes. Each axis gets its
part of them; one of slip is false where the object does not slip, and wherever no recording states that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.errors import UsageError
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.tasks.forward.alarms import axes, loads
from tacpipe.tasks.forward.slips import rise_and_fall

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.live.wire import AlarmsJson
    from tacpipe.tasks.forward.alarms import Loads
    from tacpipe.tasks.forward.slips import SlipAlarms

LOAD, SLIP = "load", "slip"
NAMES = (LOAD, SLIP)
MIN_LEVEL = 1e-9  # smallest level: a forecast of no change never exceeds it
WORDS = {UNKNOWN: "unknown", OFF: "off", ON: "on"}


@dataclass(frozen=True)
class State:
    """One alarm at one grid point."""

    state: int  # `UNKNOWN`, `OFF` or `ON`
    score: float  # multiples of the level; above 1 the alarm is on; NaN: unknown

    @property
    def word(self) -> str:
        """The state as a word."""
        return WORDS[self.state]


NOTHING_KNOWN = {name: State(UNKNOWN, math.nan) for name in NAMES}


@dataclass(frozen=True)
class Alarms:
    """The levels of a model's alarms."""

    axes: tuple[tuple[str, str], ...]  # stream and axis of each load
    levels: Mapping[str, tuple[float, ...]]  # one level of ``load`` per axis, one of ``slip``; infinite: none
    per_hour: float = math.nan  # false alarms that they were set for
    floors: tuple[float, ...] = ()  # floor of the score for slips, per skin

    @classmethod
    def unset(cls, layout: Sequence[Mapping[str, str]]) -> Self:
        """Return alarms without levels, which are always unknown."""
        return cls(axes(layout), {})

    @classmethod
    def from_json(cls, content: AlarmsJson) -> Self:
        """Return what `to_json` gave. A level for slips of before these had floors is of another score, and left out."""
        levels = {
            name: tuple(math.inf if level is None else float(level) for level in values)
            for name, values in content["levels"].items()
        }
        if "floors" not in content and SLIP in levels:
            levels[SLIP] = (math.inf,)
        places = tuple((stream, axis) for stream, axis in content["axes"])
        return cls(places, levels, float(content["per_hour"]), tuple(map(float, content.get("floors", ()))))

    def states(self, ahead: AnyFloats, now: AnyFloats, layout: Sequence[Mapping[str, str]]) -> dict[str, State]:
        """Return the state of each alarm, of counts predicted (step, channel) and the last ones (channel,)."""
        if not self.levels:
            return dict(NOTHING_KNOWN)
        scores = {LOAD: self._moved(ahead, now, layout), SLIP: np.full(1, math.nan)}
        if math.isfinite(self.levels[SLIP][0]):
            scores[SLIP] = rise_and_fall(ahead[None], now[None], layout, np.array(self.floors))
        return {name: _state(scores[name], np.array(self.levels[name])) for name in NAMES}

    def _moved(self, ahead: AnyFloats, now: AnyFloats, layout: Sequence[Mapping[str, str]]) -> AnyFloats:
        """Return by how much each load (load,) is predicted to change within the horizon."""
        last, present = (loads(np.asarray(counts, np.float64), layout)[0] for counts in (ahead[-1:], now[None]))
        moved: AnyFloats = np.abs(last - present)
        return moved

    def to_json(self) -> AlarmsJson:
        """Return the levels as JSON can hold them: null where there is none."""
        levels = {
            name: [value if math.isfinite(value) else None for value in values] for name, values in self.levels.items()
        }
        return {
            "axes": [list(axis) for axis in self.axes],
            "levels": levels,
            "floors": list(self.floors),
            "per_hour": self.per_hour,
        }


def _state(scores: AnyFloats, levels: AnyFloats) -> State:
    """Return the state of an alarm with these scores and levels (one,): the largest of those that have a level counts."""
    set_for = np.isfinite(levels)
    score = float((scores[set_for] / np.maximum(levels[set_for], MIN_LEVEL)).max(initial=0.0))  # NaN stays one
    is_known = bool(set_for.any()) and math.isfinite(score)
    return State(UNKNOWN if not is_known else ON if score > 1 else OFF, score if is_known else math.nan)


def set_on(changes: Loads, slipping: SlipAlarms, predictor: str, per_hour: float) -> Alarms:
    """Return alarms with levels for ``per_hour`` false alarms each, set on the recordings that were added."""
    from tacpipe.tasks.forward import alarms

    truth, groups = np.concatenate(changes.truth), np.concatenate(changes.groups)
    places = axes(changes.layout)
    levels = alarms.calibrate(
        truth,
        np.concatenate(changes.ahead[predictor]),
        groups,
        horizon=changes.horizon,
        sd=alarms.difference_sd(truth, groups, horizon=changes.horizon),
        rate_hz=changes.rate_hz,
        per_minute=per_hour / 60 / len(places),
    )
    slip = slipping.level(predictor, per_hour)
    return Alarms(places, {LOAD: tuple(levels.tolist()), SLIP: (slip,)}, per_hour, tuple(slipping.floors.tolist()))


def on_recordings(model: Dataset, recordings: Dataset, per_hour: float) -> Alarms:
    """Return alarms of a model with levels for ``per_hour`` false alarms each on recordings, each row's forecast made."""
    from tacpipe.tasks.forward import predictors
    from tacpipe.tasks.forward.alarms import Loads
    from tacpipe.tasks.forward.forecaster import Forecaster
    from tacpipe.tasks.forward.headline import MODEL
    from tacpipe.tasks.forward.slips import SlipAlarms
    from tacpipe.tasks.recordings import OpenedChain as Stages
    from tacpipe.tasks.recordings import open_for_model

    forecaster = Forecaster.load(model.files)
    changes, slipping = Loads(forecaster.codec.layout, forecaster.horizon), SlipAlarms.of(forecaster)
    for shard in open_for_model(recordings, Stages(model)).recordings.values():
        track = forecaster.track(shard)
        changes.begin(track)
        slipping.begin(track)
        for batch in predictors.forecasts(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
            changes.add_one(MODEL, batch.now, predictors.Prediction(batch.features, batch.count))
            slipping.add_one(MODEL, batch.now, track.tactile[batch.now], batch.count)
    if not changes.truth:
        raise UsageError("There is no validation recording that alarms could be set on; give --alarms-on others.")
    return set_on(changes, slipping, MODEL, per_hour)
