"""Measure whether predictions warn of a change of load before it begins.

Plots of forecasts at the time at which they were made always look early, also if they overshoot; so warnings are
counted. ``truth`` is (time, feature), and ``ahead`` (time, feature) contains in row t the forecast, made at t, of
``truth`` k rows later, where k is the ``horizon``; NaN if there is none. ``groups`` (time,) numbers recordings or
contacts: equal neighbours belong together, and nothing is computed across groups. Each feature is evaluated separately.

- A *change* is a run of rows t in which |z_t - z_{t-k}| exceeds 3 standard deviations sd of calibration data, until it
  is below 1.5. A run that begins within 2 k rows after the previous one belongs to it: a difference over k rows repeats
  a short push with the opposite sign k rows later, and a warning needs k quiet rows before the change.
- An *event* is the onset of a change: for a run that begins at t, the row after the last of t - k, ..., t - 1 at which
  less than a twentieth of z_t - z_{t-k} has happened. If it were t itself, a forecast that merely follows would look
  early, because a gradual change begins before it exceeds 3 sd.
- An *alarm* is on in a row in which |ahead_t - z_t| > theta. It *leads* an event at T if it is on in one of the rows T
  - k, ..., T - 1, by T minus the first of them: a prediction over k rows cannot lead by more than k rows.
- A *false alarm* is one in a row that is free of events: a row whose forecast is inside the group, and that is before T
  - k - k/5 or after the end of the change for every event T. An alarm represents the k rows that it predicts. If it is
  still on after them, it counts again, so that an alarm that never ends is not a rare one.

Events without a forecast in each of the k rows before them are not counted, because they could not be led by k rows.
Persistence predicts no change, so it never alarms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Indices, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.signals import repairs
from tacpipe.signals.runs import latch, runs
from tacpipe.tasks.forward.headline import BASELINE, MODEL
from tacpipe.tasks.forward.params import AlarmLevels
from tacpipe.tasks.forward.tracks import Track

if TYPE_CHECKING:
    from tacpipe.tasks.forward.predictors import Predicted, Prediction

ON_SD, OFF_SD = 3.0, 1.5  # thresholds at which a change begins and ends, in standard deviations
ONSET_FRACTION = 0.05  # fraction of a change up to which it counts as not begun
EARLY_FRACTION = 0.2  # fraction of the horizon by which an alarm may be early without being false
FALSE_ALARMS_PER_MINUTE = 1.0  # rate per feature in rows without events


@dataclass(frozen=True)
class Anticipation:
    """How well changes were predicted, over all features; NaN if unknown."""

    events: int
    recall: float  # fraction of events led by an alarm
    median_lead_rows: float  # rows from alarm to event
    median_lead_frames: float  # new frames from alarm to event, including that of the event
    false_alarms_per_minute: float  # rate per feature in rows without events


class AlarmScore(TypedDict):
    """The fields of `Anticipation` in ``metrics.json``; None if unknown."""

    events: int
    recall: float | None
    median_lead_rows: float | None
    median_lead_frames: float | None
    false_alarms_per_minute: float | None


def difference_sd(truth: AnyFloats, groups: AnyArray, *, horizon: int) -> AnyFloats:
    """Return the standard deviation of z_t - z_{t-k} of each feature (feature,), over the rows that have one; else 0."""
    _check(truth, horizon, groups=groups)
    moved = _moved(truth.astype(np.float64), _stretches(groups), horizon)
    finite = np.isfinite(moved)
    count = np.maximum(finite.sum(axis=0), 1)
    moved = np.where(finite, moved, 0)
    mean = moved.sum(axis=0) / count
    deviations: AnyFloats = np.sqrt(np.square(np.where(finite, moved - mean, 0)).sum(axis=0) / count)
    return deviations


def changes(truth: AnyFloats, groups: AnyArray, *, horizon: int, sd: AnyFloats) -> list[Indices]:
    """Return onset and end (exclusive) of the changes of each feature, each of shape (change, 2).

    ``sd`` (feature,) comes from `difference_sd`; a feature with sd 0 never changes.
    """
    _check(truth, horizon, groups=groups, sd=sd)
    stretches = _stretches(groups)
    spaced = _spaced(stretches, horizon)
    moved = _moved(truth.astype(np.float64), stretches, horizon)
    return [
        _changes_of(truth[:, feature], moved[:, feature], spaced, horizon, float(sd[feature]))
        for feature in range(truth.shape[1])
    ]


def calibrate(
    truth: AnyFloats,
    ahead: AnyFloats,
    groups: AnyArray,
    *,
    horizon: int,
    sd: AnyFloats,
    rate_hz: float,
    per_minute: float = FALSE_ALARMS_PER_MINUTE,
) -> AnyFloats:
    """Return theta (feature,): the lowest level with at most ``per_minute`` false alarms per minute in these data.

    ``rate_hz`` is the rate of rows. The level is infinite for a feature without rows free of events, because no alarm
    can then be shown to be rare.
    """
    _check(truth, horizon, groups=groups, ahead=ahead, sd=sd)
    stretches = _stretches(groups)
    spaced = _spaced(stretches, horizon)
    theta = np.full(truth.shape[1], np.inf)
    for feature, spans in enumerate(changes(truth, groups, horizon=horizon, sd=sd)):
        deviation = np.abs(ahead[:, feature] - truth[:, feature])
        free = _free(deviation, spans, stretches, horizon)
        theta[feature] = _lowest_level(deviation, free, spaced, horizon, per_minute * _minutes(free, rate_hz))
    return theta


def level(
    scores: AnyFloats, free: Bools, groups: AnyArray, *, horizon: int, rate_hz: float, per_minute: float
) -> float:
    """Return the least level of ``scores`` (time,) that gives no more than ``per_minute`` false alarms a minute.

    ``free`` (time,) are the rows in which an alarm is false; of them those count that have a score. An alarm represents
    ``horizon`` rows. Infinite where no row counts.

    >>> scores, alike = np.array([1.0, 9.0, 2.0, 8.0, 3.0, 7.0]), np.zeros(6)
    >>> level(scores, scores < 9, alike, horizon=1, rate_hz=0.1, per_minute=1.2)  # one alarm in the 50 s that are free
    7.0
    """
    counted = free & np.isfinite(scores)
    spaced = _spaced(_stretches(groups), horizon)
    return _lowest_level(scores, counted, spaced, horizon, per_minute * _minutes(counted, rate_hz))


def _lowest_level(deviation: AnyFloats, free: Bools, spaced: Indices, horizon: int, allowed: float) -> float:
    """Return the lowest level that ``deviation`` (time,) exceeds in at most ``allowed`` alarms; infinite without rows."""
    if not free.any():
        return float("inf")
    levels = np.unique(deviation[free])
    # the highest level is never exceeded, and a value above one level is above all lower ones
    low, high = 0, len(levels) - 1
    while low < high:
        middle = (low + high) // 2
        if _count(spaced[free & (deviation > levels[middle])], horizon, allowed) > allowed:
            low = middle + 1
        else:
            high = middle
    return float(levels[low])


def score(
    truth: AnyFloats,
    ahead: AnyFloats,
    groups: AnyArray,
    *,
    horizon: int,
    sd: AnyFloats,
    theta: AnyFloats,
    rate_hz: float,
    repeated: Bools | None = None,
) -> Anticipation:
    """Return how well ``ahead`` predicts the changes of ``truth``, with alarms above ``theta`` (feature,).

    ``repeated`` (time,) marks rows that repeat the previous frame; None if every row is a new frame.
    """
    _check(truth, horizon, groups=groups, ahead=ahead, sd=sd, theta=theta)
    stretches = _stretches(groups)
    spaced = _spaced(stretches, horizon)
    fresh_so_far = np.cumsum(np.ones(len(truth), dtype=bool) if repeated is None else ~repeated)
    events, false_alarms, minutes = 0, 0, 0.0
    leads: list[tuple[int, int]] = []  # leads in rows and in frames
    for feature, spans in enumerate(changes(truth, groups, horizon=horizon, sd=sd)):
        deviation = np.abs(ahead[:, feature] - truth[:, feature])
        alarm = deviation > theta[feature]
        for onset in spans[:, 0]:
            first = onset - horizon
            if first < 0 or stretches[first] != stretches[onset] or not np.isfinite(deviation[first:onset]).all():
                continue
            events += 1
            if alarm[first:onset].any():
                row = first + int(alarm[first:onset].argmax())
                leads.append((int(onset - row), int(fresh_so_far[onset] - fresh_so_far[row])))
        free = _free(deviation, spans, stretches, horizon)
        false_alarms += _count(spaced[free & alarm], horizon)
        minutes += _minutes(free, rate_hz)
    rows, frames = (float(median) for median in np.median(leads, axis=0)) if leads else (np.nan, np.nan)
    return Anticipation(
        events,
        len(leads) / events if events else np.nan,
        rows,
        frames,
        false_alarms / minutes if minutes else np.nan,
    )


def _stretches(groups: AnyArray) -> Indices:
    """Return a unique group number for each row (time,), also if numbers in ``groups`` recur."""
    begins = np.ones(len(groups), dtype=bool)
    begins[1:] = groups[1:] != groups[:-1]
    return np.cumsum(begins)


def _spaced(stretches: Indices, horizon: int) -> Indices:
    """Return row numbers (time,) with gaps between groups that exceed every distance that is compared."""
    return np.arange(len(stretches)) + stretches * 2 * horizon


def _moved(truth: AnyFloats, stretches: Indices, horizon: int) -> AnyFloats:
    """Return z_t - z_{t-k} (time, feature), NaN in the first k rows of each group."""
    moved = np.full(truth.shape, np.nan)
    same_stretch = stretches[horizon:] == stretches[:-horizon]
    moved[horizon:][same_stretch] = (truth[horizon:] - truth[:-horizon])[same_stretch]
    return moved


def _changes_of(truth: AnyFloats, moved: AnyFloats, spaced: Indices, horizon: int, sd: float) -> Indices:
    """Return onset and end of the changes (change, 2) of one feature; ``truth`` and ``moved`` are (time,)."""
    size = np.abs(moved)
    on = (size > ON_SD * sd) & (sd > 0)
    starts, stops = runs(latch(on, ~(size >= OFF_SD * sd)))  # a change ends at a missing value
    if not len(starts):
        return np.zeros((0, 2), dtype=np.intp)
    separate = spaced[starts[1:]] - spaced[stops[:-1] - 1] > 2 * horizon
    starts, stops = starts[np.append(True, separate)], stops[np.append(separate, True)]
    before = starts[:, None] + np.arange(-horizon, 0)  # (change, row)
    has_begun = np.abs(truth[before] - truth[starts - horizon][:, None]) > ONSET_FRACTION * size[starts][:, None]
    lasts = np.argmin(has_begun[:, ::-1], axis=1)  # number of contiguous rows before the start that had begun to change
    return np.stack([starts - lasts, stops], axis=1)


def _free(deviation: AnyFloats, spans: Indices, stretches: Indices, horizon: int) -> Bools:
    """Return which rows (time,) have a forecast inside their group and are not near a change in ``spans``."""
    free: Bools = np.isfinite(deviation)
    free[max(len(free) - horizon, 0) :] = False
    free[:-horizon] &= stretches[horizon:] == stretches[:-horizon]
    early = horizon + round(EARLY_FRACTION * horizon)
    for onset, stop in spans:
        near = slice(max(onset - early, 0), stop)
        free[near] &= stretches[near] != stretches[onset]
    return free


def _count(alarms: Indices, horizon: int, enough: float = np.inf) -> int:
    """Return the number of alarms in the sorted rows ``alarms``; each alarm also represents the k rows after it.

    This is the largest choice of rows more than k apart, so more rows never give fewer alarms. Stops counting one above
    ``enough``.
    """
    count, at = 0, 0
    while at < len(alarms) and count <= enough:
        count += 1
        at = int(np.searchsorted(alarms, alarms[at] + horizon, side="right"))
    return count


def _minutes(rows: Bools, rate_hz: float) -> float:
    return float(rows.sum()) / rate_hz / 60


def _check(truth: AnyFloats, horizon: int, *, groups: AnyArray, **arrays: AnyFloats) -> None:
    """Raise an error for data that cannot be evaluated."""
    if horizon < 1:
        raise TacpipeError(f"A forecast of {horizon} rows predicts nothing; the horizon must be 1 or more.")
    if truth.ndim != 2 or len(groups) != len(truth):
        raise TacpipeError(
            f"Features of {truth.shape} and {len(groups)} group numbers do not fit; there must be one a row."
        )
    for name, values in arrays.items():
        expected = truth.shape if name == "ahead" else truth.shape[1:]
        if values.shape != expected:
            raise TacpipeError(f"{name} of {values.shape} does not fit features of {truth.shape}; give {expected}.")


def axes(layout: Sequence[Mapping[str, str]]) -> tuple[tuple[str, str], ...]:
    """Return stream and axis of each load of channels with this layout."""
    return tuple(dict.fromkeys(map(_axis, layout)))


def loads(counts: Any, layout: Sequence[Mapping[str, str]]) -> AnyFloats:
    """Return the loads (time, load), in the order of `axes`, of ``counts`` (time, channel) of channels that lie so.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xxz"]
    >>> loads(np.array([[1.0, 3.0, 7.0]]), layout).tolist()
    [[2.0, 7.0]]
    """
    places = [_axis(channel) for channel in layout]
    return np.stack(
        [
            counts[:, [index for index, place in enumerate(places) if place == load_axis]].mean(axis=1)
            for load_axis in axes(layout)
        ],
        axis=1,
    )


def _axis(channel: Mapping[str, str]) -> tuple[str, str]:
    return channel.get("stream", ""), channel.get("axis", "")


Layout = Sequence[Mapping[str, str]]

WATCHED = (MODEL, BASELINE, "damped_trend", "last_value_linear", "ridge", "ridge_actions")


@dataclass
class Loads:
    """The mean count of each sensor's axes in all rows, and its predictions at the last step of the horizon."""

    layout: Layout
    horizon: int
    truth: list[AnyFloats] = field(default_factory=list)  # (time, feature) each
    groups: list[Int64s] = field(default_factory=list)
    ahead: dict[str, list[AnyFloats]] = field(default_factory=dict)
    steps_s: list[float] = field(default_factory=list)

    def begin(self, track: Track) -> None:
        """Add the rows of a recording, without predictions yet."""
        truth = loads(track.tactile, self.layout)
        offset = max((int(groups[-1]) + 1 for groups in self.groups if len(groups)), default=0)
        self.truth.append(np.where(track.usable[:, None], truth, np.nan))
        self.groups.append(track.groups + offset)
        if len(track.t_ns) > 1:
            self.steps_s.append(float(np.median(np.diff(track.t_ns))) / 1e9)
        for name in WATCHED:
            self.ahead.setdefault(name, []).append(np.full_like(truth, np.nan))

    def add(self, windows: Predicted) -> None:
        """Add the predictions for some windows of the recording started last."""
        for name, prediction in windows.predictions.items():
            self.add_one(name, windows.now, prediction)

    def add_one(self, name: str, now: Int64s, prediction: Prediction) -> None:
        """Add the predictions of one predictor for windows with the last rows ``now``, as `add` does."""
        if name in WATCHED:
            self.ahead[name][-1][now] = loads(prediction.count[:, -1], self.layout)

    def calibrated(self) -> AlarmLevels:
        """Return each load's change sd and, by predictor, the alarm levels with one false alarm per minute."""
        if not self.truth:
            return {}
        truth, groups = np.concatenate(self.truth), np.concatenate(self.groups)
        sd = difference_sd(truth, groups, horizon=self.horizon)
        theta = {
            name: calibrate(truth, ahead, groups, horizon=self.horizon, sd=sd, rate_hz=self.rate_hz).tolist()
            for name, ahead in self._with_forecasts()
        }
        # null, because JSON has no infinity
        levels = {name: [value if math.isfinite(value) else None for value in values] for name, values in theta.items()}
        return {"sd": sd.tolist(), "theta": levels}

    def scored(self, levels: AlarmLevels) -> dict[str, AlarmScore]:
        """Return how well each predictor predicted changes with the ``levels`` from `calibrated`."""
        if not levels or not self.truth:
            return {}
        truth, groups, sd = np.concatenate(self.truth), np.concatenate(self.groups), np.array(levels["sd"])
        scores = {}
        for name, ahead in self._with_forecasts():
            if name not in levels["theta"]:
                continue
            theta = np.array([math.inf if value is None else value for value in levels["theta"][name]])
            result = score(
                truth,
                ahead,
                groups,
                horizon=self.horizon,
                sd=sd,
                theta=theta,
                rate_hz=self.rate_hz,
                repeated=repairs.repeated_rows(truth),
            )
            scores[name] = AlarmScore(
                events=result.events,
                recall=_number(result.recall),
                median_lead_rows=_number(result.median_lead_rows),
                median_lead_frames=_number(result.median_lead_frames),
                false_alarms_per_minute=_number(result.false_alarms_per_minute),
            )
        return scores

    def _with_forecasts(self) -> list[tuple[str, AnyFloats]]:
        joined = {name: np.concatenate(parts) for name, parts in self.ahead.items()}
        return [(name, values) for name, values in joined.items() if np.isfinite(values).any()]

    @property
    def rate_hz(self) -> float:
        """Rows per second, or 1 if no recording has two rows."""
        return 1 / float(np.median(self.steps_s)) if self.steps_s else 1.0


def _number(value: float) -> float | None:
    """Return ``value`` rounded to 9 digits, or None if it is not finite."""
    return float(f"{value:.9g}") if math.isfinite(value) else None
