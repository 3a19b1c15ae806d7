"""Calibrate scores to probabilities by isotonic regression, and set alarm levels by their false alarms.

Calibration uses scores of recordings outside the training set: those of validation, and out-of-fold scores of training
recordings, where each fold leaves out whole objects. An alarm is on while the score is at its level or above. A
false alarm counts for the horizon after it begins, as long as it warns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Int64s, Times
from tacpipe.tasks.slip.params import CalibrationConfig
from tacpipe.tasks.slip.windows import BEFORE, DURING, STABLE

RATES = (0.1, 1.0, 10.0)  # false alarms per minute of stable contact
LEVELS_TRIED = 512
PRIOR = 1.0  # number of windows of each kind that are added to each end, so that no probability is 0 or 1


@dataclass(frozen=True)
class ScoredTrack:
    """The scores of the rows of a recording, with their states."""

    name: str
    object: str
    t_ns: Times  # (row,)
    states: Int64s  # (row,), as `GraspTrack.states` returns them
    scores: Floats  # (row,)
    events: Times  # (event, 2)
    weights: Floats  # (row,), 0 for a row without a match in time
    since_s: Floats  # (row,)


def rate_name(per_minute: float) -> str:
    """Return a rate as a name.

    >>> rate_name(0.1), rate_name(10.0)
    ('0.1', '10')
    """
    return f"{per_minute:g}"


def stable_minutes(tracks: Sequence[ScoredTrack]) -> float:
    """Return the minutes of stable contact."""
    total = 0.0
    for track in tracks:
        period_ns = float(np.median(np.diff(track.t_ns))) if len(track.t_ns) > 1 else 0.0
        total += int((track.states == STABLE).sum()) * period_ns
    return total / 6e10


def false_alarms(track: ScoredTrack, level: float, horizon_ns: int) -> int:
    """Return the number of false alarms of a recording, each of which lasts for the horizon."""
    times = track.t_ns[(track.scores >= level) & (track.states == STABLE)]
    count, until_ns = 0, np.iinfo(np.int64).min
    for t_ns in times.tolist():
        if t_ns > until_ns:
            count += 1
            until_ns = t_ns + horizon_ns
    return count


def alarm_level(tracks: Sequence[ScoredTrack], per_minute: float, horizon_ns: int) -> float:
    """Return the lowest tried score at which there are at most so many false alarms per minute of stable contact.

    It is above all stable scores if even one false alarm is too many, and infinite without stable contact.
    """
    minutes = stable_minutes(tracks)
    stable = np.concatenate([np.zeros(0), *(track.scores[track.states == STABLE] for track in tracks)])
    if not len(stable):
        return math.inf
    tried = np.unique(
        np.quantile(stable, 1 - np.geomspace(1 / (10 * len(stable) + 1), 1, LEVELS_TRIED), method="higher")
    )
    allowed = per_minute * minutes
    level = float(np.nextafter(stable.max(), math.inf))
    for candidate in tried[::-1].tolist():
        if sum(false_alarms(track, candidate, horizon_ns) for track in tracks) > allowed:
            break
        level = candidate
    return level


@dataclass(frozen=True)
class SlipCalibration:
    """A monotone map from scores to probabilities, and alarm levels."""

    scores: Floats  # (knot,)
    probabilities: Floats  # (knot,)
    levels: dict[str, float]  # scores by false alarms per minute
    method: str
    minutes: float

    @classmethod
    def fit(
        cls,
        scores: AnyFloats,
        slips: Bools,
        weights: AnyFloats,
        tracks: Sequence[ScoredTrack],
        method: str,
        horizon_ns: int,
    ) -> SlipCalibration:
        """Return the calibration of windows (window,), with alarm levels set on ``tracks``."""
        from sklearn.isotonic import IsotonicRegression

        ends = float(scores.min()), float(scores.max())
        ordered = np.concatenate([np.repeat(ends, 2), scores])
        labels = np.concatenate([[0.0, 1.0, 0.0, 1.0], slips.astype(np.float64)])
        regression = IsotonicRegression(y_min=0.0, y_max=1.0)
        regression.fit(ordered, labels, np.concatenate([np.full(4, PRIOR), weights]))
        levels = {rate_name(rate): alarm_level(tracks, rate, horizon_ns) for rate in RATES}
        return cls(
            np.asarray(regression.X_thresholds_, np.float64),
            np.asarray(regression.y_thresholds_, np.float64),
            levels,
            method,
            stable_minutes(tracks),
        )

    def probability(self, scores: AnyFloats) -> Floats:
        """Return the probability of each score."""
        return np.interp(scores, self.scores, self.probabilities)

    def to_config(self) -> CalibrationConfig:
        """Return the calibration as ``config.json`` has it. An infinite level is the largest number."""
        largest = float(np.finfo(np.float64).max)
        return {
            "scores": self.scores.tolist(),
            "probabilities": self.probabilities.tolist(),
            "levels": {rate: min(level, largest) for rate, level in self.levels.items()},
            "method": self.method,
            "minutes": float(f"{self.minutes:.9g}"),
        }

    @classmethod
    def from_config(cls, config: CalibrationConfig) -> SlipCalibration:
        """Return the calibration that `to_config` wrote. Raises `ValueError` if its parts do not fit one another."""
        scores, probabilities = (np.array(config[name], np.float64) for name in ("scores", "probabilities"))
        if not len(scores) or len(scores) != len(probabilities) or (np.diff(scores) < 0).any():
            raise ValueError("the calibration's scores are not ascending")
        return cls(scores, probabilities, dict(config["levels"]), config["method"], float(config["minutes"]))


@dataclass(frozen=True)
class EventScore:
    """How an alarm did on one slip."""

    name: str  # recording
    object: str
    begins_s: float  # time in s since the start of the recording
    lead_ms: float  # time from the first alarm in the horizon before the slip; NaN without one
    detected_ms: float  # time from the slip's start to the first alarm; NaN without one before its end
    to_end_ms: float  # time from the first alarm to the end of the slip; NaN without an alarm


def score_events(track: ScoredTrack, level: float, horizon_ns: int) -> list[EventScore]:
    """Return lead and delay of the alarm at ``level`` for each slip of a recording; slips without earlier rows are left out.

    An alarm that starts before a slip and lasts into it has no delay.
    """
    results = []
    start_ns = int(track.t_ns[0]) - round(float(track.since_s[0]) * 1e9) if len(track.t_ns) else 0
    is_alarm = track.scores >= level
    for begin, end in track.events.tolist():
        is_before = (track.states == BEFORE) & (track.t_ns >= begin - horizon_ns) & (track.t_ns < begin)
        is_during = (track.states == DURING) & (track.t_ns >= begin) & (track.t_ns <= end)
        if not is_before.any():
            continue
        early, late = track.t_ns[is_before & is_alarm], track.t_ns[is_during & is_alarm]
        lead = (begin - int(early[0])) / 1e6 if len(early) else math.nan
        delay = (int(late[0]) - begin) / 1e6 if len(late) else math.nan
        if is_alarm[is_before][-1]:
            delay = 0.0
        first_alarms_ns = [int(times[0]) for times in (early, late) if len(times)]
        to_end = (end - min(first_alarms_ns)) / 1e6 if first_alarms_ns else math.nan
        results.append(EventScore(track.name, track.object, (begin - start_ns) / 1e9, lead, delay, to_end))
    return results
