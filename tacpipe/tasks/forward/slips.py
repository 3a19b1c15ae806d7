"""Measure whether forecasts warn of a slip before it begins, from the load along the skin (shear).

The shear of an object that is about to slip increases until friction is overcome, and then drops. The score of a
forecast is therefore the predicted increase of a sensor's shear load from now to a step plus the predicted decrease
afterwards, at the step at which this sum is largest. It is relative to the load that currently presses on the sensor,
because friction is proportional to it. A forecast of no change has the score 0.

The shear load of a sensor is the norm of the mean of its taxels along the axes x and y, and the pressing load is the
magnitude of their mean along z. The pressing load of a sensor that is hardly touched is close to zero, so the divisor
has a lower bound, which `floors` computes from the standard deviations of the same channels in training. Numerator,
divisor and bound have the same unit, so the score has none, and sensors with different units can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Int64s, Times
from tacpipe.tasks.forward import alarms
from tacpipe.tasks.forward.alarms import WATCHED
from tacpipe.tasks.forward.tracks import Track

if TYPE_CHECKING:
    from tacpipe.tasks.forward.forecaster import Forecaster

Layout = Sequence[Mapping[str, str]]

ALONG = ("x", "y")  # axes along the skin
PRESSING = "z"  # axis normal to the skin


def skins(layout: Layout) -> tuple[str, ...]:
    """Return the streams that have channels along the skin, in channel order.

    >>> skins([{"stream": "left", "axis": "x"}, {"stream": "pad", "axis": "z"}, {"stream": "left", "axis": "z"}])
    ('left',)
    """
    return tuple(dict.fromkeys(channel.get("stream", "") for channel in layout if channel.get("axis") in ALONG))


def shear(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the shear load (…, skin) of ``levels`` (…, channel) above rest, whose channels have this layout.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xxyz"]
    >>> shear(np.array([[2.0, 4.0, -4.0, 100.0]]), layout).tolist()
    [[5.0]]
    """
    parts = [[_mean(levels, layout, skin, axis) for axis in ALONG] for skin in skins(layout)]
    return np.stack([np.hypot(*axes) for axes in parts], axis=-1) if parts else np.zeros((*levels.shape[:-1], 0))


def pressing(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the pressing load of each skin (…, skin), or 0 if the sensor does not measure it."""
    loads = [np.abs(_mean(levels, layout, skin, PRESSING)) for skin in skins(layout)]
    return np.stack(loads, axis=-1) if loads else np.zeros((*levels.shape[:-1], 0))


def floors(spread: AnyFloats, layout: Layout) -> Floats:
    """Return the minimum divisor of each skin (skin,), from each channel's standard deviation in training (channel,).

    It is the mean standard deviation of the pressing channels, or of the channels along the skin if there are none.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xyzz"]
    >>> floors(np.array([1.0, 3.0, 10.0, 30.0]), layout).tolist(), floors(np.array([1.0, 3.0]), layout[:2]).tolist()
    ([20.0], [2.0])
    """
    divisors = []
    for skin in skins(layout):
        sizes = [
            (channel.get("axis"), float(size))
            for channel, size in zip(layout, spread, strict=True)
            if _on(channel, skin)
        ]
        presses = [size for axis, size in sizes if axis == PRESSING]
        divisors.append(np.mean(presses or [size for axis, size in sizes if axis in ALONG]))
    return np.array(divisors, dtype=np.float64)


def rise_and_fall(ahead: AnyFloats, now: AnyFloats, layout: Layout, divisors: AnyFloats) -> Floats:
    """Return the score (window,) of forecasts ``ahead`` (window, step, channel) at levels ``now`` (window, channel).

    The score is the maximum over skins. ``divisors`` (skin,) are the output of `floors`. The score is NaN if a forecast
    is not finite, or if no channel is along a skin.
    """
    if not skins(layout):
        return np.full(len(now), np.nan)
    predicted, present = shear(ahead, layout), shear(now, layout)[:, None]  # (window, step, skin)
    lowest = np.minimum.accumulate(predicted[:, ::-1], axis=1)[:, ::-1]  # minimum of each step and the later ones
    moved = ((predicted - present) + (predicted - lowest)).max(axis=1)
    score: Floats = (moved / np.maximum(pressing(now, layout), divisors)).max(axis=1)
    return np.maximum(score, 0.0)


def _mean(levels: Any, layout: Layout, skin: str, axis: str) -> Floats:
    """Return the mean (…,) of a skin's channels along an axis, or 0 if it has none."""
    chosen = [index for index, channel in enumerate(layout) if _on(channel, skin) and channel.get("axis") == axis]
    if not chosen:
        return np.zeros(levels.shape[:-1])
    mean: Floats = np.asarray(levels[..., chosen], dtype=np.float64).mean(axis=-1)
    return mean


def _on(channel: Mapping[str, str], skin: str) -> bool:
    return channel.get("stream", "") == skin


GAP_NS = 500_000_000  # minimum time between two events; closer events are merged


@dataclass(frozen=True)
class Leads:
    """Score of an alarm on labelled events."""

    events: int  # events with an alarm state throughout the time before
    leads_ms: tuple[float, ...]  # time from alarm to event, for events with an alarm
    false_alarms: int  # number of alarms that no event followed
    hours: float  # time with an alarm state and without a nearby event


def events(t_ns: Times, active: Bools) -> Times:
    """Return first and last time of each event (event, 2); ``active`` marks the rows at ``t_ns`` (time,) in an event.

    Events that are closer than `GAP_NS` are merged.
    """
    starts = np.flatnonzero(active & ~np.concatenate([[False], active[:-1]]))
    ends = np.flatnonzero(active & ~np.concatenate([active[1:], [False]]))
    new = np.ones(len(starts), dtype=bool)
    new[1:] = t_ns[starts[1:]] - t_ns[ends[:-1]] >= GAP_NS
    last = np.append(new[1:], True)[: len(ends)]
    return np.stack([t_ns[starts[new]], t_ns[ends[last]]], axis=1).astype(np.int64)


def near(t_ns: Times, events: Times, horizon_ns: int) -> Bools:
    """Return which rows at ``t_ns`` (time,) are near an event in ``events`` (event, 2).

    Alarms in these rows are not false. A row is near an event from ``horizon_ns`` before its start until
    `GAP_NS` after its end.
    """
    rows = np.zeros(len(t_ns), dtype=bool)
    for begins_ns, ends_ns in events.tolist():
        rows |= (t_ns >= begins_ns - horizon_ns) & (t_ns < ends_ns + GAP_NS)
    return rows


def leads(t_ns: Times, states: Int64s, events: Times, horizon_ns: int, period_ns: int) -> Leads:
    """Score an alarm with ``states`` (time,) at ``t_ns`` (time,) on the events ``events`` (event, 2).

    An alarm leads an event by the time from its first active row within the preceding ``horizon_ns``. A false alarm is
    one that is not `near` an event, and it represents the whole horizon.
    """
    led: list[float] = []
    counted = 0
    for begins_ns in events[:, 0].tolist():
        before = (t_ns >= begins_ns - horizon_ns) & (t_ns < begins_ns)
        if not before.any() or (states[before] < 0).any():
            continue
        counted += 1
        on = t_ns[before & (states > 0)]
        led += [(begins_ns - int(on[0])) / 1e6] if len(on) else []
    quiet = ~near(t_ns, events, horizon_ns)
    false, until_ns = 0, np.iinfo(np.int64).min
    for at_ns in t_ns[(states > 0) & quiet].tolist():
        if at_ns > until_ns:
            false, until_ns = false + 1, at_ns + horizon_ns
    hours = float(((states >= 0) & quiet).sum()) * period_ns / 3.6e12
    return Leads(counted, tuple(led), false, hours)


class LeadSums(TypedDict):
    """Score of alarms over several recordings."""

    events: int
    led: int
    median_lead_ms: float | None
    false_alarms: int
    false_alarms_per_hour: float | None
    minutes: float


def summed(parts: Sequence[Leads]) -> LeadSums:
    """Return the combined score of alarms; rates and medians without data are None.

    >>> both = summed([Leads(3, (40.0, 120.0), 1, 0.25), Leads(1, (), 0, 0.25)])
    >>> both["events"], both["led"], both["median_lead_ms"], both["false_alarms_per_hour"], both["minutes"]
    (4, 2, 80.0, 2.0, 30.0)
    """
    leads_ms = [lead for part in parts for lead in part.leads_ms]
    false, hours = sum(part.false_alarms for part in parts), sum(part.hours for part in parts)
    return {
        "events": sum(part.events for part in parts),
        "led": len(leads_ms),
        "median_lead_ms": round(float(np.median(leads_ms)), 3) if leads_ms else None,
        "false_alarms": false,
        "false_alarms_per_hour": round(false / hours, 3) if hours else None,
        "minutes": round(60 * hours, 4),
    }


PER_HOUR = 60.0  # false alarm rate for which `evaluate` sets levels
PARTS = 5  # number of folds of the recordings; the level of each fold is set on the other folds


@dataclass(frozen=True)
class SlipRows:
    """Rows of one recording."""

    t_ns: Times  # (time,)
    slips: Bools | None  # (time,)
    scores: dict[str, Floats] = field(default_factory=dict)  # (time,) by predictor; NaN without a forecast

    @property
    def period_ns(self) -> int:
        """Median time between rows."""
        return int(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 1

    def events(self) -> Times:
        """Return first and last time of each slip (event, 2)."""
        return events(self.t_ns, np.zeros(len(self.t_ns), bool) if self.slips is None else self.slips)


class SlipScore(LeadSums):
    """Score of a slip alarm."""

    recall: float | None  # fraction of slips preceded by an alarm


@dataclass
class SlipAlarms:
    """Slip scores (`tacpipe.tasks.forward.slips`) of predictors, collected from one recording after another."""

    layout: Layout
    floors: AnyFloats  # (skin,), computed from the model's training
    horizon: int
    recordings: list[SlipRows] = field(default_factory=list)

    @classmethod
    def of(cls, forecaster: Forecaster) -> Self:
        """Create the slip alarms of a model, without recordings."""
        layout = forecaster.codec.layout
        return cls(layout, floors(forecaster.channel_scale, layout), forecaster.horizon)

    def begin(self, track: Track) -> None:
        """Add a recording's rows, without predictions."""
        self.recordings.append(SlipRows(track.t_ns, track.slips))

    def add_one(self, name: str, now: Int64s, present: AnyFloats, counts: AnyFloats) -> None:
        """Add one predictor's forecasts ``counts`` (window, step, channel) for windows with the last rows ``now``.

        The windows are in the recording started last; ``present`` (window, channel) contains its levels in the rows
        ``now``.
        """
        if name in WATCHED:
            last = self.recordings[-1]
            scores = last.scores.setdefault(name, np.full(len(last.t_ns), np.nan))
            scores[now] = rise_and_fall(counts, present, self.layout, self.floors)

    def level(self, name: str, per_hour: float, selected: Sequence[int] | None = None) -> float:
        """Return a predictor's alarm level for this rate of false alarms, set on all or the selected recordings.

        An alarm is false if it is not near a slip. Every alarm in a recording without slip labels counts as false. The
        level is infinite if there are no forecasts.
        """
        chosen = [self.recordings[place] for place in (range(len(self.recordings)) if selected is None else selected)]
        chosen = [recording for recording in chosen if name in recording.scores]
        if not chosen:
            return math.inf
        free = [~near(recording.t_ns, recording.events(), self.horizon * recording.period_ns) for recording in chosen]
        return alarms.level(
            np.concatenate([recording.scores[name] for recording in chosen]),
            np.concatenate(free),
            np.repeat(np.arange(len(chosen)), [len(recording.t_ns) for recording in chosen]),
            horizon=self.horizon,
            rate_hz=1e9 / float(np.median([recording.period_ns for recording in chosen])),
            per_minute=per_hour / 60,
        )

    def scored(self, per_hour: float = PER_HOUR) -> dict[str, SlipScore]:
        """Score each predictor's alarm on the recordings with slip labels.

        Levels are set for ``per_hour`` false alarms. The level of each fifth of the recordings is set on the others, so
        that no recording sets its own. Returns an empty dict if fewer than two recordings have labels, or none has a
        slip.
        """
        labelled = [place for place, recording in enumerate(self.recordings) if recording.slips is not None]
        if len(labelled) < 2 or not any(
            recording.slips is not None and recording.slips.any() for recording in self.recordings
        ):
            return {}
        parts = [part for part in (labelled[first::PARTS] for first in range(PARTS)) if part]
        scores: dict[str, SlipScore] = {}
        for name in dict.fromkeys(name for place in labelled for name in self.recordings[place].scores):
            lead_parts: list[Leads] = []
            for part in parts:
                level = self.level(name, per_hour, [place for place in labelled if place not in part])
                lead_parts += [self._worth(self.recordings[place], name, level) for place in part]
            worth = summed(lead_parts)
            scores[name] = {**worth, "recall": round(worth["led"] / worth["events"], 9) if worth["events"] else None}
        return scores

    def _worth(self, recording: SlipRows, name: str, level: float) -> Leads:
        scores = recording.scores.get(name, np.full(len(recording.t_ns), np.nan))
        has_state = np.isfinite(scores) & math.isfinite(level)
        states = np.where(has_state, (scores > level).astype(np.int64), -1)
        return leads(
            recording.t_ns, states, recording.events(), self.horizon * recording.period_ns, recording.period_ns
        )
