"""Measure scores of slips: area under the curve by kind of window, lead times, and intervals over objects.

Intervals of areas are jackknife intervals over objects on the scale of log odds, with Student's t. An area is a sum over
pairs of objects, so leaving out an object removes its row and its column of pairs (Obuchowski, Nonparametric analysis of
clustered ROC curve data, Biometrics 53, 1997). ``docs/benchmarks/intervals.md`` has their coverage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Int64s
from tacpipe.metrics.intervals import MIN_INTERVAL_CLUSTERS, Jackknife, effective_number, share_interval
from tacpipe.tasks.slip.calibration import EventScore, ScoredTrack, false_alarms, score_events, stable_minutes
from tacpipe.tasks.slip.windows import BEFORE, DURING, STABLE

LEADS_S = (0.2, 0.5, 1.0)  # times before the start of a slip at which the area under the curve is measured
LEAD_WIDTH_S = 0.1  # half the width of the windows around such a time
EARLY_S = (2.0, 3.0)  # times before the start of a slip of the control of windows that are too early
ROUNDING = 1e-9  # standard error up to which it counts as zero
SMALLEST_SHARE = 1e-3  # minimum share, and minimum distance from 1, for the transformation to log odds
SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")

PARTS = {  # kinds of windows of the area under the curve -> meaning
    "before": "windows in the horizon before a slip, against stable contact matched for time",
    "during": "windows during a slip (detection), against stable contact matched for time",
    "early": "windows 2 to 3 s before a slip, against recordings without a slip: the grasp, not the moment",
    "within": "windows before a slip against earlier windows of the same recording: the moment, not the grasp",
    **{f"lead {lead:g} s": f"windows {lead:g} s before a slip, against matched stable contact" for lead in LEADS_S},
}


class ObjectEstimate(TypedDict):
    """A value with its 95 % interval over objects; null where it is undefined."""

    value: float | None
    low: float | None
    high: float | None


class SlipAlarmScore(TypedDict):
    """Score of an alarm over all slips."""

    events: int
    predicted: int  # number of slips with an alarm before their start
    detected: int  # number of slips with an alarm before their end, including predicted slips
    median_lead_ms: float | None  # time from the alarm to the start of the slip, for predicted slips
    median_to_end_ms: float | None  # time from the alarm to the end of the slip, for detected slips
    false_alarms: int
    minutes: float  # duration of stable contact
    false_alarms_per_minute: float | None
    predicted_ratio: ObjectEstimate
    detected_ratio: ObjectEstimate


@dataclass(frozen=True)
class Area:
    """An area under the curve as sums by object, from which that of any selection of objects follows."""

    wins: Floats  # (object of the slip, object of the stable contact), weighted pairs in which the slip scores higher
    positives: Floats  # (object,), weight of windows with a slip
    negatives: Floats | None  # (object,), weight of stable windows; None if pairs are within one object

    @property
    def value(self) -> float:
        """The area over all objects; NaN without pairs."""
        return float(self.selected(np.ones((1, len(self.positives))))[0])

    @property
    def without(self) -> Floats:
        """The area without each object (object,)."""
        return self.selected(1 - np.eye(len(self.positives)))

    @property
    def effective(self) -> float:
        """The effective number of objects: that of slips or of stable contact, whichever is smaller."""
        parts = [self.positives] if self.negatives is None else [self.positives, self.negatives]
        return min(float(effective_number(part)) for part in parts)

    def selected(self, objects: Floats) -> Floats:
        """Return the area (selection,) of objects, for the number of each in each selection (selection, object)."""
        if self.negatives is None:
            won, pairs = objects @ np.diag(self.wins), objects @ self.positives
        else:
            won = ((objects @ self.wins) * objects).sum(axis=1)
            pairs = (objects @ self.positives) * (objects @ self.negatives)
        return np.where(pairs > 0, won / np.where(pairs > 0, pairs, 1), np.nan)


def _wins(slips: AnyFloats, stable: AnyFloats, weights: AnyFloats) -> Floats:
    """Return the weight of stable scores below each score of a slip (slip,), half for equal ones."""
    order = np.argsort(stable, kind="stable")
    cumulative = np.concatenate([[0.0], np.cumsum(weights[order])])
    left, right = (cumulative[np.searchsorted(stable[order], slips, side=side)] for side in SIDES)
    wins: Floats = (left + right) / 2
    return wins


class WindowScores:
    """All counted windows of several recordings with the scores of one predictor."""

    def __init__(self, tracks: Sequence[ScoredTrack]) -> None:
        """Join the windows of tracks (window,)."""
        self.tracks = list(tracks)
        sizes = [len(track.t_ns) for track in self.tracks]
        self.recording = np.repeat(np.arange(len(sizes)), sizes)
        names = sorted({track.object for track in self.tracks})
        self.objects = np.array([names.index(track.object) for track in self.tracks], np.intp)[self.recording]
        self.object_count = len(names)
        self.scores = _joined([track.scores for track in self.tracks])
        self.states = _joined([track.states for track in self.tracks]).astype(np.int64)
        self.weights = _joined([track.weights for track in self.tracks])
        self.until_s = _joined([_until_next(track) for track in self.tracks])
        self.has_slip = _joined([np.full(len(track.t_ns), bool(len(track.events))) for track in self.tracks]) > 0

    def part(self, name: str) -> tuple[Bools, Bools]:
        """Return which windows a part of `PARTS` counts, and which of them are positive (window,)."""
        stable = self.states == STABLE
        if name == "before":
            return (self.states == BEFORE) | stable, self.states == BEFORE
        if name == "during":
            return (self.states == DURING) | stable, self.states == DURING
        if name == "early":
            early = stable & (self.until_s >= EARLY_S[0]) & (self.until_s <= EARLY_S[1])
            return early | (stable & ~self.has_slip), early
        if name == "within":
            return ((self.states == BEFORE) | stable) & self.has_slip, self.states == BEFORE
        lead_s = float(name.split()[1])
        before = (self.states == BEFORE) & (np.abs(self.until_s - lead_s) <= LEAD_WIDTH_S)
        return before | stable, before

    def area(self, name: str) -> Area:
        """Return the area under the curve of a part, as sums by object.

        Windows of the part within are compared in each recording only.
        """
        counted, positive = self.part(name)
        weights = np.ones(len(self.scores)) if name in ("within", "early") else self.weights
        negative = counted & ~positive
        positives, negatives = (np.zeros(self.object_count) for _ in range(2))
        np.add.at(positives, self.objects[positive], weights[positive])
        np.add.at(negatives, self.objects[negative], weights[negative])
        if name == "within":
            return self._within(counted, positive)
        wins = np.zeros((self.object_count, self.object_count))
        for number in np.unique(self.objects[negative]).tolist():
            rows = negative & (self.objects == number)
            gained = _wins(self.scores[positive], self.scores[rows], weights[rows])
            np.add.at(wins[:, number], self.objects[positive], gained * weights[positive])
        return Area(wins, positives, negatives)

    def _within(self, counted: Bools, positive: Bools) -> Area:
        """Return the mean of the areas of recordings, weighted by their windows before a slip."""
        wins, totals = np.zeros((self.object_count, self.object_count)), np.zeros(self.object_count)
        for number in np.unique(self.recording[counted & positive]).tolist():
            rows = counted & (self.recording == number)
            before, earlier = (self.scores[rows & kind] for kind in (positive, ~positive))
            if len(earlier):
                owner = int(self.objects[rows][0])
                wins[owner, owner] += _wins(before, earlier, np.full(len(earlier), 1 / len(earlier))).sum()
                totals[owner] += len(before)
        return Area(wins, totals, None)


def _until_next(track: ScoredTrack) -> Floats:
    """Return the seconds from each row to the next start of a slip (row,), infinite without one."""
    starts = np.append(track.events[:, 0], np.iinfo(np.int64).max)
    following = starts[np.searchsorted(track.events[:, 0], track.t_ns, side="left")]
    return np.where(following == starts[-1], np.inf, (following - track.t_ns) / 1e9)


def _joined(parts: Sequence[AnyFloats | Bools | Int64s]) -> AnyFloats:
    return np.concatenate([np.zeros(0), *parts])


def estimate(value: float, without: AnyFloats, effective: float, *, is_share: bool = False) -> ObjectEstimate:
    """Return a value with its interval from the values without each object (object,); NaN becomes null.

    ``effective`` is the effective number of objects. A share, such as an area, is transformed to log odds, because its
    distribution is skewed near 0 and 1. There is no interval if no object changes the value.
    """
    values, mean = (_log_odds(without), _log_odds(value)) if is_share else (without, np.asarray(value))
    influence = values.mean() - values
    error = np.sqrt((len(values) - 1) / max(len(values), 1) * np.square(influence).sum())
    freedom = effective - 1 if effective >= MIN_INTERVAL_CLUSTERS else np.nan
    ends = (
        Jackknife(np.atleast_1d(mean), np.atleast_1d(error), np.array([freedom]), influence[:, None]).interval().first
    )
    low, high = (ends.low, ends.high) if error > ROUNDING else (np.nan, np.nan)
    if is_share:
        low, high = (float(1 / (1 + np.exp(-end))) for end in (low, high))
    return _rounded(value, low, high)


def ratio_estimate(flags: Bools, owners: Indices, count: int) -> ObjectEstimate:
    """Return the fraction of ``flags`` (item,) with its interval over ``count`` objects; ``owners`` (item,) are indices."""
    sums = np.stack([np.bincount(owners, part, count) for part in (flags, np.ones(len(flags)))])[:, :, None]
    with_items = sums[1, :, 0] > 0
    ends = share_interval(sums[0, with_items], sums[1, with_items]).first
    is_certain = ends.low == ends.high
    return _rounded(ends.mean, *((np.nan, np.nan) if is_certain else (ends.low, ends.high)))


def _log_odds(share: AnyFloats | float) -> Floats:
    limited = np.clip(share, SMALLEST_SHARE, 1 - SMALLEST_SHARE)
    odds: Floats = np.log(limited / (1 - limited))
    return odds


def _rounded(value: float, low: float, high: float) -> ObjectEstimate:
    texts = [float(f"{number:.6g}") if np.isfinite(number) else None for number in (value, low, high)]
    return {"value": texts[0], "low": texts[1], "high": texts[2]}


def areas(windows: WindowScores) -> dict[str, ObjectEstimate]:
    """Return the area under the curve of each part, with intervals over objects."""
    return {name: area_estimate(windows.area(name)) for name in PARTS}


def area_estimate(area: Area) -> ObjectEstimate:
    """Return an area under the curve with its interval over objects."""
    return estimate(area.value, area.without, area.effective, is_share=True)


def margin(model: WindowScores, baseline: WindowScores, name: str = "before") -> ObjectEstimate:
    """Return by how much the area of a model exceeds that of a baseline, with its interval over the same objects."""
    first, second = model.area(name), baseline.area(name)
    return estimate(first.value - second.value, first.without - second.without, first.effective)


def brier(probabilities: AnyFloats, slips: Bools, weights: AnyFloats) -> float:
    """Return the weighted mean squared difference of probabilities and slips (window,); NaN without weight."""
    total = float(weights.sum())
    return float((weights * np.square(probabilities - slips)).sum() / total) if total else float("nan")


def accuracy(probabilities: AnyFloats, windows: WindowScores) -> ObjectEstimate:
    """Return the fraction of windows whose slip is stated with a probability on the right side of one half."""
    right = (probabilities >= 0.5) == (windows.states > STABLE)
    return ratio_estimate(right, windows.objects, windows.object_count)


def score_alarm(tracks: Sequence[ScoredTrack], levels: Mapping[str, float] | float, horizon_ns: int) -> SlipAlarmScore:
    """Return the score of an alarm; ``levels`` are one for all recordings or one by recording name."""
    events: list[EventScore] = []
    false = 0
    for track in tracks:
        level = levels[track.name] if isinstance(levels, Mapping) else levels
        events += score_events(track, level, horizon_ns)
        false += false_alarms(track, level, horizon_ns)
    minutes = stable_minutes(tracks)
    names = sorted({track.object for track in tracks})
    predicted = np.array([event.lead_ms == event.lead_ms for event in events], bool)
    detected = np.array([event.to_end_ms == event.to_end_ms for event in events], bool)
    owners = np.array([names.index(event.object) for event in events], np.intp)

    return {
        "events": len(events),
        "predicted": int(predicted.sum()),
        "detected": int(detected.sum()),
        "median_lead_ms": _median([event.lead_ms for event in events]),
        "median_to_end_ms": _median([event.to_end_ms for event in events]),
        "false_alarms": false,
        "minutes": float(f"{minutes:.6g}"),
        "false_alarms_per_minute": float(f"{false / minutes:.6g}") if minutes else None,
        "predicted_ratio": ratio_estimate(predicted, owners, len(names)),
        "detected_ratio": ratio_estimate(detected, owners, len(names)),
    }


def _median(values: Sequence[float]) -> float | None:
    finite = [value for value in values if value == value]
    return float(f"{np.median(finite):.6g}") if finite else None
