"""Measure whether forecasts warn of a slip before it begins, with the score and the level of the slip alarm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Int64s, Times
from tacpipe.tasks.forward import anticipation
from tacpipe.tasks.forward.alarms import WATCHED
from tacpipe.tasks.forward.leads import Leads, LeadSums, events, leads, near, summed
from tacpipe.tasks.forward.shear import Layout, floors, rise_and_fall
from tacpipe.tasks.forward.tracks import Track

if TYPE_CHECKING:
    from tacpipe.tasks.forward.forecaster import Forecaster

PER_HOUR = 60.0  # false alarms that `evaluate` sets levels for
PARTS = 5  # parts of the recordings; each has the level that was set on the others


@dataclass(frozen=True)
class Rows:
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
    """The slip alarm's scores (`tacpipe.tasks.forward.shear`) of predictors, on recordings one after another."""

    layout: Layout
    floors: AnyFloats  # (skin,), of the model's training
    horizon: int
    recordings: list[Rows] = field(default_factory=list)

    @classmethod
    def of(cls, forecaster: Forecaster) -> Self:
        """Return those of a model, without recordings yet."""
        layout = forecaster.codec.layout
        return cls(layout, floors(forecaster.channel_scale, layout), forecaster.horizon)

    def begin(self, track: Track) -> None:
        """Add the rows of a recording, without predictions yet."""
        self.recordings.append(Rows(track.t_ns, track.slips))

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
        return anticipation.level(
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
        sets its own. Nothing where fewer than two recordings state it, or none slips.
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

    def _worth(self, recording: Rows, name: str, level: float) -> Leads:
        scores = recording.scores.get(name, np.full(len(recording.t_ns), np.nan))
        has_state = np.isfinite(scores) & math.isfinite(level)
        states = np.where(has_state, (scores > level).astype(np.int64), -1)
        return leads(
            recording.t_ns, states, recording.events(), self.horizon * recording.period_ns, recording.period_ns
        )
