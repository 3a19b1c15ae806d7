"""Measure scores of slips: area under the curve by kind of window, lead times, and intervals over objects.

An area is a sum over pairs of objects, so leaving out an object removes its row and its column of pairs (Obuchowski,
Nonparametric analysis of clustered ROC curve data, Biometrics 53, 1997). ``docs/benchmarks/intervals.md`` has the coverage
of the intervals.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Int64s
from tacpipe.scores.intervals import Estimate, share_interval
from tacpipe.scores.pairing import Gain, Measure
from tacpipe.scores.table import rounded
from tacpipe.tasks.slip.calibration import EventScore, ScoredTrack, false_alarms, score_events, stable_minutes
from tacpipe.tasks.slip.windows import BEFORE, DURING, STABLE

LEADS_S = (0.2, 0.5, 1.0)  # times before the start of a slip at which the area under the curve is measured
LEAD_WIDTH_S = 0.1  # half the width of the windows around such a time
EARLY_S = (2.0, 3.0)  # times before the start of a slip of the control of windows that are too early
SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")

PARTS = {  # kinds of windows of the area under the curve -> meaning
    "before": "windows in the horizon before a slip, against stable contact matched for time",
    "during": "windows during a slip (detection), against stable contact matched for time",
    "early": "windows 2 to 3 s before a slip, against recordings without a slip: the grasp, not the moment",
    "within": "windows before a slip against earlier windows of the same recording: the moment, not the grasp",
    **{f"lead {lead:g} s": f"windows {lead:g} s before a slip, against matched stable contact" for lead in LEADS_S},
}

# parts that are questions with a verdict -> question
QUESTIONS = {"before": "risk of a slip", "during": "detection of a slip", "within": "moment of a slip"}


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


class AreaLayout:
    """Places of the sums of a recording that determine areas, for all objects of the results that are compared."""

    def __init__(self, objects: Iterable[str]) -> None:
        """Give each object its place in the sums."""
        self.index = {name: index for index, name in enumerate(sorted(set(objects)))}
        count = len(self.index)
        # weighted pairs won by the recording's slips against each object's stable contact, all such pairs, the recording's
        # object, the weights of its stable contact, and for the Brier score the weighted squared error and the weight
        self.wins, self.pairs, self.present = (slice(at * count, (at + 1) * count) for at in range(3))
        self.stable, self.squared, self.weight = range(3 * count, 3 * count + 3)

    def area(self, sums: AnyFloats) -> AnyFloats:
        """Return areas under the curve (draw,) of sums (draw, part); NaN without pairs. Only present objects count."""
        present = sums[:, self.present] > 0
        won, pairs = ((sums[:, part] * present).sum(axis=1) for part in (self.wins, self.pairs))
        return np.where(pairs > 0, won / np.where(pairs > 0, pairs, 1), np.nan)

    def measure(self) -> Measure:
        """Return the `Measure` of these sums."""

        def values(sums: AnyFloats) -> tuple[float, ...]:
            brier = sums[self.squared] / sums[self.weight] if sums[self.weight] else np.nan
            return float(self.area(sums[None])[0]), float(brier)

        return Measure(
            ("area under the curve", "Brier score"),
            "area under the ROC curve, and squared probability",
            "the area under the curve",
            "area",
            "objects",
            lambda sums: 1 - self.area(sums),
            lambda errors, baseline: baseline - errors,
            values,
            lambda errors: 1 - errors,
            "area under the curve",
            rises=True,
            weight=lambda sums: np.stack([sums[:, self.pairs].sum(axis=1), sums[:, self.stable]], axis=1),
            reference="time only",
        )


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
        self.scores = joined([track.scores for track in self.tracks])
        self.states = joined([track.states for track in self.tracks]).astype(np.int64)
        self.weights = joined([track.weights for track in self.tracks])
        self.until_s = joined([_until_next(track) for track in self.tracks])
        self.has_slip = joined([np.full(len(track.t_ns), bool(len(track.events))) for track in self.tracks]) > 0

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

    def sums(self, name: str, layout: AreaLayout, probabilities: Floats) -> dict[str, AnyFloats]:
        """Return the sums of each recording (`AreaLayout`) for a part of `PARTS`, and ``probabilities`` (window,) of slips.

        Windows of the part within are compared in each recording only, with equal weight for each window before a slip.
        """
        counted, positive = self.part(name)
        weights = np.ones(len(self.scores)) if name in ("within", "early") else self.weights
        negative = counted & ~positive
        squared = weights * np.square(probabilities - (self.states > STABLE))
        rows = np.zeros((len(self.tracks), layout.weight + 1))
        objects = [layout.index[track.object] for track in self.tracks]
        rows[np.arange(len(objects)), layout.present.start + np.array(objects, np.intp)] = 1
        for column, values, chosen in (
            (layout.stable, weights, negative),
            (layout.squared, squared, counted),
            (layout.weight, weights, counted),
        ):
            np.add.at(rows[:, column], self.recording[chosen], values[chosen])
        if name == "within":
            self._add_pairs_within(rows, layout, counted, positive)
        else:
            slip_weights = np.bincount(self.recording[positive], weights[positive], len(self.tracks))
            for number in sorted(set(objects)):
                stable = negative & (np.array(objects, np.intp)[self.recording] == number)
                wins = _wins(self.scores[positive], self.scores[stable], weights[stable])
                np.add.at(rows[:, layout.wins.start + number], self.recording[positive], wins * weights[positive])
                rows[:, layout.pairs.start + number] = slip_weights * weights[stable].sum()
        return {track.name: row for track, row in zip(self.tracks, rows, strict=True)}

    def _add_pairs_within(self, rows: AnyFloats, layout: AreaLayout, counted: Bools, positive: Bools) -> None:
        """Add the pairs of windows of the same recording to ``rows`` (recording, part)."""
        rows[:, layout.stable] = 0
        for number in np.unique(self.recording[counted & positive]).tolist():
            own = counted & (self.recording == number)
            before, earlier = (self.scores[own & kind] for kind in (positive, ~positive))
            if len(earlier):
                place = layout.index[self.tracks[number].object]
                rows[number, layout.wins.start + place] = _wins(
                    before, earlier, np.full(len(earlier), 1 / len(earlier))
                ).sum()
                rows[number, layout.pairs.start + place] = rows[number, layout.stable] = len(before)


def _until_next(track: ScoredTrack) -> Floats:
    """Return the seconds from each row to the next start of a slip (row,), infinite without one."""
    starts = np.append(track.events[:, 0], np.iinfo(np.int64).max)
    following = starts[np.searchsorted(track.events[:, 0], track.t_ns, side="left")]
    return np.where(following == starts[-1], np.inf, (following - track.t_ns) / 1e9)


def joined(parts: Iterable[AnyFloats | Bools | Int64s]) -> Floats:
    """Return arrays joined to one, also if there is none."""
    return np.concatenate([np.zeros(0), *parts])


def ratio_estimate(flags: Bools, owners: Indices, count: int) -> ObjectEstimate:
    """Return the fraction of ``flags`` (item,) with its interval over ``count`` objects; ``owners`` (item,) are indices."""
    sums = np.stack([np.bincount(owners, part, count) for part in (flags, np.ones(len(flags)))])[:, :, None]
    with_items = sums[1, :, 0] > 0
    ends = share_interval(sums[0, with_items], sums[1, with_items]).first
    return to_json(ends)


def to_json(estimate: Estimate | Gain) -> ObjectEstimate:
    """Return a value and its interval with 6 digits; NaN becomes null."""
    return {"value": rounded(estimate.mean), "low": rounded(estimate.low), "high": rounded(estimate.high)}


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
