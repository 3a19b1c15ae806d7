"""Evaluate recordings of live sessions: what was published next to what `predict --causal` computes, and the latencies."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Times
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Model, Recording
from tacpipe.errors import UsageError
from tacpipe.live.messages import summarize_latencies
from tacpipe.plugins.stage import Result
from tacpipe.tasks.slip.calibration import EventScore, ScoredTrack, false_alarms, score_events, stable_minutes
from tacpipe.tasks.slip.live.messages import SLIP
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.windows import GraspTrack

MODEL = "live_model"  # attribute of a recording: the digest of the model that its session ran


def evaluate(model: Model, recordings: Dataset) -> Result:
    """Return rows, equality, latencies and, with labels of slips, leads of alarms.

    Raises `UsageError` for a recording without a session, or of another model.
    """
    loaded = SlipModel.load(model.files)
    live = {}
    for name, recording in sorted(recordings.recordings.items()):
        if SLIP not in recording.streams or "probability" not in recording.columns(SLIP).column_names:
            raise UsageError(
                f"{name} is not a recording of a live session with a slip model. Give what `tacpipe live -o` recorded, or "
                f"leave --live out."
            )
        if recording.attributes.get(MODEL, model.digest) != model.digest:
            raise UsageError(
                f"The session of {name} ran another model. Give the model that it ran, or leave --live out."
            )
        live[name] = _session(loaded, recording)
    totals = {key: sum(session[key] for session in live.values()) for key in ("published", "compared", "equal")}
    notes = [
        f"{totals['equal']} of {totals['compared']} published probabilities are what `tacpipe predict --causal` gives, bit "
        f"for bit."
    ]
    metrics = {"live": {**totals, "recordings": live}}
    return Result(
        files={model_files.CONFIG: model.files[model_files.CONFIG], "metrics.json": model_files.to_json(metrics)},
        notes=notes,
    )


def _session(model: SlipModel, recording: Recording) -> dict[str, Any]:
    """Return the figures of one recorded session: counts of rows, latency, and alarms if slips are labelled."""
    stream, predicted = recording.table(SLIP), model.table(recording)
    clock = "t_device_ns" if "t_device_ns" in stream.column_names else "t_ns"
    published = {name: stream[name].to_numpy() for name in (clock, "probability", "score", "alarm")}
    answered = np.isfinite(published["probability"])
    times = published[clock][answered]
    _, published_rows, predicted_rows = np.intersect1d(times, predicted["t_ns"].to_numpy(), return_indices=True)
    same = np.ones(len(published_rows), bool)
    for name in ("probability", "score"):
        sent, computed = published[name][answered][published_rows], predicted[name].to_numpy()[predicted_rows]
        same &= sent.view(np.int64) == computed.view(np.int64)
    session: dict[str, Any] = {
        "published": int(answered.sum()),
        "compared": len(published_rows),
        "equal": int(same.sum()),
        "latency": summarize_latencies(recording.table("latency")["latency_ms"].to_numpy()),
    }
    track = model.reader.track(recording)
    if track.labels is not None:
        alarms = score_session(model, track, times, published["alarm"][answered] > 0)
        session["alarms"] = alarms.to_json()
    return session


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
