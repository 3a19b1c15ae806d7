"""Measure alarms by what happens to the object: ``python docs/slip_events.py DATA --models M… --results R…``.

``DATA`` is a dataset of simulated trials with the label ``handling`` (``simulate forward --handling mixed``). Models and
results are those of the folds of ``train slip`` and ``evaluate``. Trials of objects that a model has seen are left out. The
script prints tables of ``docs/benchmarks/slip.md``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.arrays import Floats, Times
from tacpipe.datasets.dataset import Recording
from tacpipe.scores.table import MODEL
from tacpipe.tasks.learning.features import ChannelAxes
from tacpipe.tasks.slip import metrics
from tacpipe.tasks.slip.calibration import ScoredTrack
from tacpipe.tasks.slip.evaluation import EvaluatedSlips

RATES = ("1", "10")  # false alarms per minute that levels are set for
CONTRASTS = {  # windows before a slip of these handlings, against stable contact of those
    "all": (("jolt", "fade"), ("jolt", "jolt-held", "fade", "fade-held", "release", "shake", "hold")),
    "jolts, against jolts that hold": (("jolt",), ("jolt-held",)),
    "fading grip, against fading grip that holds": (("fade",), ("fade-held",)),
    "jolts, against shaking": (("jolt",), ("shake",)),
    "fading grip, against a hand at rest": (("fade",), ("hold",)),
}


def lines(data: Path, models: Sequence[Path], results: Sequence[Path]) -> Iterator[str]:
    """Yield the lines of the tables."""
    recordings = tacpipe.open(data).recordings
    parts = [read_unseen(path) for path in results]
    pooled = parts[0].pooled(parts[1:])
    handling = {name: str(recording.attributes["handling"]) for name, recording in recordings.items()}
    yield "| windows | before the slip | during the slip | time only, before |"
    yield "| --- | --- | --- | --- |"
    for name, (slips, stable) in CONTRASTS.items():
        chosen = select(pooled, [handling[track.name] in (*slips, *stable) for track in pooled.tracks])
        tables = chosen.tables()
        estimates = (
            tables[part].score(name) for part, name in (("before", MODEL), ("during", MODEL), ("before", "time_only"))
        )
        cells = [metrics.to_json(estimate) for estimate in estimates]
        yield f"| {name} | " + " | ".join(map(estimate_text, cells)) + " |"
    yield ""
    heads = [
        f"{text} (level {rate})"
        for rate in RATES
        for text in ("false alarms per minute", "slips predicted, median lead")
    ]
    yield "| handling | trials | minutes of stable contact | " + " | ".join(heads) + " |"
    yield "| --- " * (3 + len(heads)) + "|"
    for kind in sorted(set(handling.values())):
        tracks = [track for track in pooled.tracks if handling[track.name] == kind]
        scores = [alarm_score(tracks, pooled.levels, rate) for rate in RATES]
        cells_of_kind = [f"{len(tracks)}", f"{scores[0]['minutes']:.1f}"]
        for score in scores:
            cells_of_kind.append(f"{score['false_alarms_per_minute'] or 0:.1f}")
            lead = "" if score["median_lead_ms"] is None else f", {score['median_lead_ms']:.0f} ms"
            cells_of_kind.append(f"{score['predicted']} of {score['events']}{lead}" if score["events"] else "")
        yield f"| {kind} | " + " | ".join(cells_of_kind) + " |"
    yield ""
    for rate in RATES:
        alarms = [
            release_has_alarm(recordings[track.name], tacpipe.load(model), rate)
            for model, part in zip(models, parts, strict=True)
            for track in part.tracks
            if handling[track.name] == "release"
        ]
        yield f"At level {rate}, {sum(alarms)} of {len(alarms)} releases have an alarm while the gripper opens."


def read_unseen(path: Path) -> EvaluatedSlips:
    """Return the evaluation of recordings with objects that the model was not trained on."""
    evaluated = EvaluatedSlips.from_result(tacpipe.open(path))
    return select(evaluated, [track.object not in evaluated.known_objects for track in evaluated.tracks])


def select(evaluated: EvaluatedSlips, chosen: Sequence[bool]) -> EvaluatedSlips:
    """Return the evaluation of some recordings, matched for time again."""

    def chosen_parts(parts: Mapping[str, tuple[Floats, ...]]) -> dict[str, tuple[Floats, ...]]:
        return {name: tuple(itertools.compress(values, chosen)) for name, values in parts.items()}

    tracks = tuple(itertools.compress(evaluated.tracks, chosen))
    scores, probabilities = chosen_parts(evaluated.scores), chosen_parts(evaluated.probabilities)
    return EvaluatedSlips(tracks, scores, probabilities, evaluated.levels).pooled([])


def estimate_text(estimate: metrics.ObjectEstimate) -> str:
    """Return a value with its interval."""
    if estimate["value"] is None:
        return ""
    if estimate["low"] is None or estimate["high"] is None:
        return f"{estimate['value']:.2f}"
    return f"{estimate['value']:.2f} ({estimate['low']:.2f} to {estimate['high']:.2f})"


def alarm_score(
    tracks: Sequence[ScoredTrack], levels: Mapping[str, Mapping[str, Mapping[str, float]]], rate: str
) -> metrics.SlipAlarmScore:
    """Return the score of the model's alarm on some recordings, each with the level of its fold."""
    return metrics.score_alarm(tracks, {track.name: levels[track.name][MODEL][rate] for track in tracks}, 1_000_000_000)


def release_has_alarm(recording: Recording, model: Any, rate: str) -> bool:
    """Return whether an alarm is on between the start of a release and the end of the touch."""
    table, truth = model.predict(recording), recording.table("truth")
    start_ns = int(str(recording.attributes["gt_release_ns"]))
    force = truth["gt_finger1_normal_n"].to_numpy() + truth["gt_finger2_normal_n"].to_numpy()
    end_ns = int(truth["t_ns"].to_numpy()[np.flatnonzero(force > 0)[-1]])
    t_ns = table["t_ns"].to_numpy()
    return bool(table[f"alarm_{rate}"].to_numpy()[(t_ns >= start_ns) & (t_ns <= end_ns)].any())


SHOWN = {  # handling -> title of its column
    "fade": "the grip weakens: slip",
    "fade-held": "the grip weakens: holds",
    "jolt": "the hand moves: slip",
    "jolt-held": "the hand moves: holds",
    "release": "the gripper opens",
}
BEFORE_S, AFTER_S = 2.0, 0.6  # time that the picture shows around an event
GRASPED_S = 2.1  # latest time at which the grip is complete
BLUE, GREY, RED = "#1f6feb", "#6e7781", "#cf222e"


def draw(path: Path, data: Path, models: Sequence[Path], results: Sequence[Path]) -> None:
    """Draw one unseen trial of each handling: friction that is used, touch of the first finger, and probability."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    recordings = tacpipe.open(data).recordings
    parts = [read_unseen(result) for result in results]
    figure, grid = pyplot.subplots(3, len(SHOWN), figsize=(13, 6.5), sharex=True, sharey="row", layout="constrained")
    for column, (kind, title) in enumerate(SHOWN.items()):
        fold, name = next(
            (fold, track.name)
            for fold, part in enumerate(parts)
            for track in part.tracks
            if recordings[track.name].attributes["handling"] == kind
            and event_is_late(friction_in_use(recordings[track.name]))
        )
        recording, model = recordings[name], tacpipe.load(models[fold])
        event_ns, truth_ns, used = friction_in_use(recording)
        table, track = model.predict(recording), model.reader.track(recording)
        touch, places = track.streams[0], ChannelAxes.from_layout(model.reader.streams[0].layout)
        x, y = (touch.values[:, axis].mean(axis=1) for axis in places.shear)
        upper, middle, lower = grid[:, column]
        upper.plot((truth_ns - event_ns) / 1e9, used, color=BLUE, linewidth=1)
        upper.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--")
        since_s = (touch.t_ns - event_ns) / 1e9
        middle.plot(since_s, np.hypot(x, y), color=BLUE, linewidth=1, label="shear")
        if len(places.normal):
            middle.plot(since_s, np.abs(touch.values[:, places.normal].mean(axis=1)), color=GREY, label="pressure")
        since_s, probability = (table["t_ns"].to_numpy() - event_ns) / 1e9, table["probability"].to_numpy()
        on = table["alarm_1"].to_numpy() > 0
        lower.plot(since_s, probability, color=BLUE, linewidth=1)
        lower.plot(since_s[on], probability[on], ".", color=RED, label="alarm")
        for axes in grid[:, column]:
            axes.axvline(0.0, color=RED if kind in ("fade", "jolt") else GREY, linewidth=1)
        upper.set_title(title)
        upper.set_xlim(-BEFORE_S, AFTER_S)
        upper.set_ylim(0, 1.3)
        lower.set_ylim(0, 1)
        lower.set_xlabel("time from the event, s")
    for axes, text in zip(grid[:, 0], ("used part of friction", "touch, scaled", "probability"), strict=True):
        axes.set_ylabel(text)
    grid[1, 0].legend(frameon=False)
    grid[2, 0].legend(frameon=False)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def event_is_late(course: tuple[int, Times, Floats]) -> bool:
    """Return whether the picture shows only the grasp before an event, and not the closing of the fingers."""
    event_ns, truth_ns, _ = course
    return (event_ns - int(truth_ns[0])) / 1e9 > GRASPED_S + BEFORE_S


def friction_in_use(recording: Recording) -> tuple[int, Times, Floats]:
    """Return the time of the event, and times and load as a fraction of the friction limit, from the ground truth.

    The event is the start of the slip or of the release, or else the largest fraction.
    """
    truth = recording.table("truth")
    t_ns, values = truth["t_ns"].to_numpy(), {name: truth[name].to_numpy() for name in truth.column_names}
    force = np.hypot(values["gt_force_x_n"], values["gt_force_z_n"])
    pressed = values["gt_finger1_normal_n"] + values["gt_finger2_normal_n"]
    limit = float(str(recording.attributes["gt_friction"])) * pressed
    used = np.where(pressed > 0.05, force / np.maximum(limit, 1e-9), np.nan)
    slips = np.flatnonzero(values["gt_slip"])
    released_ns = recording.attributes["gt_release_ns"]
    if released_ns is not None:
        return int(str(released_ns)), t_ns, used
    return int(t_ns[slips[0] if len(slips) else np.nanargmax(used)]), t_ns, used


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--models", type=Path, nargs="+", required=True)
    parser.add_argument("--results", type=Path, nargs="+", required=True)
    parser.add_argument("--picture", type=Path, help="file to draw trials to")
    options = parser.parse_args()
    for line in lines(options.data, options.models, options.results):
        print(line, flush=True)
    if options.picture:
        draw(options.picture, options.data, options.models, options.results)
