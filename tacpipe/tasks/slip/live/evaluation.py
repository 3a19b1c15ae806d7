"""Evaluate recordings of live sessions: what was published, its latencies, and what the alarms did."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Times
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.plugins.stage import Result
from tacpipe.tasks.learning.live.evaluation import evaluate as compare_sessions
from tacpipe.tasks.slip.calibration import EventScore, ScoredTrack, false_alarms, score_events, stable_minutes
from tacpipe.tasks.slip.live.messages import SLIP
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.windows import GraspTrack


def evaluate(model: Model, recordings: Dataset) -> Result:
    """Return rows, equality, latencies and, with labels of slips, leads of alarms.

    Raises `UsageError` for a recording without a session, or of another model.
    """
    loaded = SlipModel.load(model.files)

    def measure(recording: Recording, times: Times, published: Mapping[str, Any]) -> dict[str, Any]:
        track = loaded.reader.track(recording)
        if track.labels is None:
            return {}
        return {"alarms": score_session(loaded, track, times, published["alarm"] > 0).to_json()}

    return compare_sessions(model, recordings, SLIP, loaded.table, measure)


@dataclass(frozen=True)
class SessionAlarms:
    """How a published alarm did."""

    events: list[EventScore]
    false_alarms: int
    minutes: float  # duration of stable contact

    def to_json(self) -> dict[str, Any]:
        """Return the measures as a JSON object, with null for NaN."""
        slips = []
        for event in self.events:
            times = {name: value for name, value in dataclasses.asdict(event).items() if isinstance(value, float)}
            slips.append({name: None if math.isnan(value) else round(value, 3) for name, value in times.items()})
        return {"slips": slips, "false_alarms": self.false_alarms, "minutes": round(self.minutes, 4)}


def score_session(model: SlipModel, track: GraspTrack, times: Times, on: Bools) -> SessionAlarms:
    """Return how an alarm that was ``on`` (row,) at ``times`` (row,) did on the labelled slips of a track."""
    states = track.states(model.horizon_ns, round(model.params.recovery_s * 1e9))
    rows = np.clip(np.searchsorted(track.t_ns, times), 0, len(track.t_ns) - 1)
    scored = ScoredTrack(
        track.name,
        track.object,
        times,
        states[rows],
        on.astype(np.float64),
        track.events,
        np.ones(len(times)),
        track.since_s[rows],
    )
    events = score_events(scored, 0.5, model.horizon_ns)
    return SessionAlarms(events, false_alarms(scored, 0.5, model.horizon_ns), stable_minutes([scored]))
