"""Measure whether forecasts warn of a slip before it begins, by the load along the skin (shear).

An object that is about to slip pulls harder and harder along the skin, until friction gives way and the pull drops. So the
score of a forecast is how far the shear load of a sensor is predicted to rise from now to a step, plus how far it is
predicted to fall afterwards, at the step where the sum is largest; as a fraction of the load that presses on that sensor
now, because friction holds in proportion to it. A forecast of no change has the score 0.

The shear load of a sensor is the length of the mean of its taxels along the axes x and y, the pressing load the size of
their mean along z. A sensor that is hardly touched presses with next to nothing: the divisor is at least a floor, which
`floors` makes of the spread of the same channels in training. Numerator, divisor and floor are of one unit, so that the
score has none, and sensors of unlike units can be compared.
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
PRESSING = "z"  # the axis into it


def skins(layout: Layout) -> tuple[str, ...]:
    """Return the streams with channels along the skin, in the order of the channels.

    >>> skins([{"stream": "left", "axis": "x"}, {"stream": "pad", "axis": "z"}, {"stream": "left", "axis": "z"}])
    ('left',)
    """
    return tuple(dict.fromkeys(channel.get("stream", "") for channel in layout if channel.get("axis") in ALONG))


def shear(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the shear load (…, skin) of ``levels`` (…, channel) above rest, of channels that lie so.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xxyz"]
    >>> shear(np.array([[2.0, 4.0, -4.0, 100.0]]), layout).tolist()
    [[5.0]]
    """
    parts = [[_mean(levels, layout, skin, axis) for axis in ALONG] for skin in skins(layout)]
    return np.stack([np.hypot(*axes) for axes in parts], axis=-1) if parts else np.zeros((*levels.shape[:-1], 0))


def pressing(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the load that presses on each skin (…, skin), or 0 if a sensor does not measure it."""
    loads = [np.abs(_mean(levels, layout, skin, PRESSING)) for skin in skins(layout)]
    return np.stack(loads, axis=-1) if loads else np.zeros((*levels.shape[:-1], 0))


def floors(spread: AnyFloats, layout: Layout) -> Floats:
    """Return the least divisor of each skin (skin,), of the standard deviation of each channel in training (channel,).

    It is the mean deviation of the channels that press; of a sensor without any, of those along the skin.

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

    The largest of all skins counts; ``divisors`` (skin,) is what `floors` gives. NaN if a forecast is not finite, and for
    channels none of which lies along a skin.
    """
    if not skins(layout):
        return np.full(len(now), np.nan)
    predicted, present = shear(ahead, layout), shear(now, layout)[:, None]  # (window, step, skin)
    lowest = np.minimum.accumulate(predicted[:, ::-1], axis=1)[:, ::-1]  # least of each step and those after it
    moved = ((predicted - present) + (predicted - lowest)).max(axis=1)
    score: Floats = (moved / np.maximum(pressing(now, layout), divisors)).max(axis=1)
    return np.maximum(score, 0.0)


def _mean(levels: Any, layout: Layout, skin: str, axis: str) -> Floats:
    """Return the mean (…,) of the channels of a skin along an axis, or 0 if it has none."""
    chosen = [index for index, channel in enumerate(layout) if _on(channel, skin) and channel.get("axis") == axis]
    if not chosen:
        return np.zeros(levels.shape[:-1])
    mean: Floats = np.asarray(levels[..., chosen], dtype=np.float64).mean(axis=-1)
    return mean


def _on(channel: Mapping[str, str], skin: str) -> bool:
    return channel.get("stream", "") == skin


GAP_NS = 500_000_000  # least time between two events; an earlier one belongs to the event before


@dataclass(frozen=True)
class Leads:
    """The score of an alarm, against labelled events."""

    events: int  # events with an alarm state in all of the time before
    leads_ms: tuple[float, ...]  # time from alarm to event, for events with an alarm
    false_alarms: int  # alarms that no event followed
    hours: float  # time with an alarm state and without an event near


def events(t_ns: Times, active: Bools) -> Times:
    """Return when events begin and when they were last there (event, 2), of whether one is there at ``t_ns`` (time,).

    Those close together are one.
    """
    starts = np.flatnonzero(active & ~np.concatenate([[False], active[:-1]]))
    ends = np.flatnonzero(active & ~np.concatenate([active[1:], [False]]))
    new = np.ones(len(starts), dtype=bool)
    new[1:] = t_ns[starts[1:]] - t_ns[ends[:-1]] >= GAP_NS
    last = np.append(new[1:], True)[: len(ends)]
    return np.stack([t_ns[starts[new]], t_ns[ends[last]]], axis=1).astype(np.int64)


def near(t_ns: Times, events: Times, horizon_ns: int) -> Bools:
    """Return which rows at ``t_ns`` (time,) are near one of the events ``events`` (event, 2): no alarm is false there.

    That is from ``horizon_ns`` before it begins until `GAP_NS` after it was last there.
    """
    rows = np.zeros(len(t_ns), dtype=bool)
    for begins_ns, ends_ns in events.tolist():
        rows |= (t_ns >= begins_ns - horizon_ns) & (t_ns < ends_ns + GAP_NS)
    return rows


def leads(t_ns: Times, states: Int64s, events: Times, horizon_ns: int, period_ns: int) -> Leads:
    """Return what an alarm with ``states`` (time,) at ``t_ns`` (time,) was worth for events ``events`` (event, 2).

    An alarm leads an event by the time from its first row that is on within ``horizon_ns`` before. A false alarm is one that
    is not `near` an event; it represents the horizon.
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
    """The score of alarms over several recordings."""

    events: int
    led: int
    median_lead_ms: float | None
    false_alarms: int
    false_alarms_per_hour: float | None
    minutes: float


def summed(parts: Sequence[Leads]) -> LeadSums:
    """Return what alarms were worth together, or None if there is nothing to divide by.

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


PER_HOUR = 60.0  # false alarms that `evaluate` sets levels for
PARTS = 5  # parts of the recordings; each has the level that was set on the others


@dataclass(frozen=True)
class SlipRows:
    """The rows of one recording."""

    t_ns: Times  # (time,)
    slips: Bools | None  # (time,)
    scores: dict[str, Floats] = field(default_factory=dict)  # (time,) by predictor, NaN without a forecast

    @property
    def period_ns(self) -> int:
        """Time from one row to the next, in the median."""
        return int(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 1

    def events(self) -> Times:
        """Return when slips begin and end (event, 2)."""
        return events(self.t_ns, np.zeros(len(self.t_ns), bool) if self.slips is None else self.slips)


class SlipScore(LeadSums):
    """The score of a slip alarm."""

    recall: float | None  # fraction of the slips that an alarm preceded


@dataclass
class SlipAlarms:
    """The slip alarm's scores (`tacpipe.tasks.forward.slips`) of predictors, on recordings one after another."""

    layout: Layout
    floors: AnyFloats  # (skin,), of the model's training
    horizon: int
    recordings: list[SlipRows] = field(default_factory=list)

    @classmethod
    def of(cls, forecaster: Forecaster) -> Self:
        """Return those of a model, without recordings yet."""
        layout = forecaster.codec.layout
        return cls(layout, floors(forecaster.channel_scale, layout), forecaster.horizon)

    def begin(self, track: Track) -> None:
        """Add the rows of a recording, without predictions yet."""
        self.recordings.append(SlipRows(track.t_ns, track.slips))

    def add_one(self, name: str, now: Int64s, present: AnyFloats, counts: AnyFloats) -> None:
        """Add what one predictor gives, ``counts`` (window, step, channel), for windows whose last rows are ``now``.

        They are of the recording that was begun last; ``present`` (window, channel) is what it has in these rows.
        """
        if name in WATCHED:
            last = self.recordings[-1]
            scores = last.scores.setdefault(name, np.full(len(last.t_ns), np.nan))
            scores[now] = rise_and_fall(counts, present, self.layout, self.floors)

    def level(self, name: str, per_hour: float, selected: Sequence[int] | None = None) -> float:
        """Return the level of a predictor's score for so many false alarms an hour, set on all or some recordings.

        An alarm is false where it is not near a slip. Of a recording that does not state where it slips every alarm
        counts as false. Infinite where there is no forecast.
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
        """Return by predictor what its alarm is worth on the recordings that state where they slip.

        Levels are set for ``per_hour`` false alarms: for each fifth of the recordings on the others, so that no recording
        sets its own. Nothing if fewer than two recordings state it, or none slips.
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
