"""Recordings of live sessions evaluated: what was published next to what the offline chain and model give of the same.

`evaluate` returns what `tacpipe evaluate` does of the recordings after the model's own stages, and adds what the session
recorded: errors of the published forecasts, alarms with their leads, latencies, and whether `tacpipe predict --causal` gives
the published values again, bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Int64s, Times
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.unstored import Recordings, continued, recorded
from tacpipe.metrics import headline
from tacpipe.plugins.stage import Result
from tacpipe.signals import anticipation
from tacpipe.signals.leads import Leads, events, leads
from tacpipe.signals.loads import loads
from tacpipe.tasks.forward import evaluation, tracks, units
from tacpipe.tasks.forward import headline as headlines
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.levels import Levels
from tacpipe.tasks.forward.live import replay, truth, worth
from tacpipe.tasks.forward.live.alarms import NAMES, Alarms
from tacpipe.tasks.forward.live.chain import Chain, Forecast
from tacpipe.tasks.forward.live.published import Published, times
from tacpipe.tasks.forward.live.worth import LIVE, LIVE_STILL, OFFLINE, STILL, Session, Sums, summed
from tacpipe.tasks.forward.predictors import forecasts
from tacpipe.tasks.forward.tracks import Track

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model, Recording

LEVELS = "live_alarm_levels"  # attribute of a recording: the levels of its alarms, as JSON
DIGITS = 12  # of a digest in a message, as `tacpipe show` prints it
MODEL = "live_model"  # attribute of a recording: the digest of the model that its session ran


class _Offline(NamedTuple):
    """What the offline model predicts of a recording."""

    now: Int64s  # (window,), rows of the track
    ahead: AnyFloats  # (window, horizon, channel), above rest


def evaluate(model: Model, recordings: Dataset) -> Result:
    """Return the evaluation of recordings of live sessions.

    Raises `UsageError` where one has no stream ``forecast``, or its session ran another model.
    """
    check(model.digest, recordings)
    forecaster = Forecaster.load(model.files)
    steps = headlines.shown(range(1, forecaster.horizon + 1))
    offline: dict[str, Any] = {}
    sessions: dict[str, Session] = {}
    for name, recording in sorted(recordings.recordings.items()):
        try:
            offline[name] = continued(recording, model)
            sessions[name] = _session(forecaster, model, recording, offline[name], steps)
        except TacpipeError as error:
            raise type(error)(f"{name}: {error}") from error
    given: Any = Recordings(offline, model.files)
    result = evaluation.evaluate(model.files, given)
    tree = json.loads(result.files["metrics.json"])
    channels = len(forecaster.codec.channels)
    tree["live"] = {
        **summed(list(sessions.values()), steps, channels),
        "recordings": {name: summed([one], steps, channels) for name, one in sessions.items()},
    }
    found = headline.read(result.files[headline.FILE])
    added = _headline(forecaster, sessions, steps, channels)
    files = {
        **result.files,
        "metrics.json": (json.dumps(tree, indent=1, sort_keys=True) + "\n").encode(),
        "live.csv": worth.table(tree["live"], steps),
        headline.FILE: headline.write([*found, *added]),
    }
    return dataclasses.replace(result, files=files, notes=[*result.notes, *worth.sentences(tree["live"])])


def check(digest: str, recordings: Dataset) -> None:
    """Refuse recordings without a session, and those of a session that ran another model than that of this digest.

    What another model published describes nothing of this one, and differs from what this one predicts in every row.
    """
    for name, recording in sorted(recordings.recordings.items()):
        if "forecast" not in recording.streams:
            raise UsageError(
                f"{name} is not a recording of a live session: it has no stream forecast. Give what `tacpipe live -o` "
                f"recorded, or leave --live out."
            )
        ran = recording.attributes.get(MODEL, digest)  # nothing states it in what other programs recorded
        if ran != digest:
            raise UsageError(
                f"The session of {name} ran the model {str(ran)[:DIGITS]}, and this one is {digest[:DIGITS]}: what was "
                f"published is that model's. Give the model that the session ran, or leave --live out to evaluate this one "
                f"on the same recordings."
            )


def _session(
    forecaster: Forecaster, model: Model, recording: Recording, offline: Any, steps: tuple[int, ...]
) -> Session:
    tables = recorded(recording)
    known = () if forecaster.uncertainty is None else forecaster.uncertainty.percents
    session = Published.of(tables["forecast"], forecaster.codec.channels, known)
    chain = replay.chain_of(forecaster, model.source.chain, recording, tables, session.levels, allow_look_ahead=True)
    every = list(replay.replayed(chain, tables))
    made = [one for one in every if one.count is not None]
    made_ns = np.array([one.t_ns for one in made], np.int64)
    same, equal = truth.equality(session.t_ns, session.whole(), made_ns, session.alike(made))
    latency = tables["latency"]
    track = tracks.track(offline, forecaster.codec, forecaster.pose)
    predicted = _offline(forecaster, track)
    rows, sums = _errors(forecaster, chain, every, session, track, predicted, steps)
    late = latency.column("late").to_numpy()
    grew = times(latency)[np.flatnonzero(np.diff(late, prepend=0) > 0)]
    return Session(
        same,
        _after(session.t_ns[~equal & np.isin(session.t_ns, made_ns)], grew, forecaster),
        rows,
        sums,
        _alarms(forecaster, recording, tables, track, predicted),
        latency.column("latency_ms").to_numpy().astype(np.float64),
        int(latency.column("skipped").to_numpy().max(initial=0)),
        int(late.max(initial=0)),
    )


def _offline(forecaster: Forecaster, track: Track) -> _Offline:
    starts = track.starts(forecaster.context, forecaster.horizon)
    some = list(forecasts(forecaster, track, starts))
    if not some:
        nothing = np.zeros((0, forecaster.horizon, len(forecaster.codec.channels)))
        return _Offline(np.zeros(0, np.int64), nothing)
    return _Offline(np.concatenate([one.now for one in some]), np.concatenate([one.count for one in some]))


def _errors(
    forecaster: Forecaster,
    chain: Chain,
    every: Sequence[Forecast],
    session: Published,
    track: Track,
    predicted: _Offline,
    steps: tuple[int, ...],
) -> tuple[int, Sums]:
    """Return how many rows all predictors have, and the sums of their errors over these."""
    row_ns, values = session.t_ns, session.values
    if not set(steps) <= set(session.steps) or chain.rest is None or not len(predicted.now):
        return 0, {}
    uniform = forecaster.config["timeline"] == "uniform"
    period_ns = 1e9 / float(forecaster.config["rate_hz"])
    still = {one.t_ns: one.now for one in every if one.now is not None}
    grid_ns = np.array(sorted(still), np.int64)
    counts = track.tactile.stored if isinstance(track.tactile, Levels) else np.asarray(track.tactile)
    wanted = truth.targets(grid_ns, row_ns, steps, period_ns if uniform else None)
    flat = truth.at(track.t_ns, counts.astype(np.float64), track.groups, track.usable, wanted.ravel())
    ahead = flat.reshape(len(row_ns), len(steps), -1)  # (row, step, channel)
    now_ns = track.t_ns[predicted.now]
    nearest = np.clip(np.searchsorted(now_ns, row_ns - round(period_ns / 2)), 0, len(now_ns) - 1)
    kept = np.isfinite(ahead).all(axis=(1, 2)) & (np.abs(now_ns[nearest] - row_ns) <= period_ns / 2)
    kept &= np.isin(row_ns, grid_ns)
    if not kept.any():
        return 0, {}
    rest = counts[0] - track.tactile[0]  # offline
    own = [session.steps.index(step) for step in steps]
    held = np.stack([still[at_ns] for at_ns in row_ns[kept].tolist()])[:, None] + chain.rest
    windows = nearest[kept]
    later = counts[predicted.now[windows][:, None] + np.array(steps)].astype(np.float64)
    now = counts[predicted.now[windows]].astype(np.float64)[:, None]
    found = {
        LIVE: truth.sums(values[kept][:, own] + chain.rest, ahead[kept]),
        LIVE_STILL: truth.sums(held, ahead[kept]),
        OFFLINE: truth.sums(predicted.ahead[windows][:, [step - 1 for step in steps]] + rest, later),
        STILL: truth.sums(now, later),
    }
    return int(kept.sum()), found


def _after(differing_ns: Times, late_ns: Times, forecaster: Forecaster) -> int:
    """Return how many rows differ within a context after, or a row before, samples that came too late."""
    period_ns = 1e9 / float(forecaster.config["rate_hz"])
    reach_ns = (forecaster.context + 1) * period_ns
    if not len(late_ns):
        return 0
    place = np.searchsorted(late_ns, differing_ns + 1.5 * period_ns, side="right") - 1
    return int(((place >= 0) & (differing_ns - late_ns[np.maximum(place, 0)] <= reach_ns)).sum())


def _alarms(
    forecaster: Forecaster,
    recording: Recording,
    tables: Mapping[str, Any],
    track: Track,
    predicted: _Offline,
) -> dict[str, dict[str, Leads]]:
    """Return what alarms were worth: by alarm, by event, live and offline."""
    stream = tables["alarm"]
    states = {name: stream.column(f"{name}_state").to_numpy().astype(np.int64) for name in NAMES}
    if not any((one >= 0).any() for one in states.values()):
        return {}
    series = {LIVE: (times(stream), states)}
    if LEVELS in recording.attributes and len(predicted.now):
        series[OFFLINE] = (track.t_ns[predicted.now], _offline_states(forecaster, recording, track, predicted))
    period_ns = round(1e9 / float(forecaster.config["rate_hz"]))
    found: dict[str, dict[str, Leads]] = {}
    for event, times_ns in _events(forecaster, track).items():
        for name in NAMES:
            for who, (t_ns, each) in series.items():
                one = leads(t_ns, each[name], times_ns, forecaster.horizon * period_ns, period_ns)
                found.setdefault(f"{name} alarm, {event}", {})[who] = one
    return found


def _events(forecaster: Forecaster, track: Track) -> dict[str, Times]:
    """Return when loads change, as `tacpipe evaluate` defines it, and when the object slips, if known (event, 2)."""
    found: dict[str, Times] = {}
    sd = forecaster.config.get("anticipation", {}).get("sd")
    if sd:
        values = loads(np.where(track.usable[:, None], track.tactile[:], np.nan), forecaster.codec.layout)
        rows = anticipation.changes(values, track.groups, horizon=forecaster.horizon, sd=np.array(sd))
        begun = np.zeros(len(track.t_ns), bool)
        for each in rows:
            for first, stop in each:
                begun[first:stop] = True
        found["changes of load"] = events(track.t_ns, begun)
    if track.slips is not None:
        found["slips"] = events(track.t_ns, track.slips)
    return found


def _offline_states(
    forecaster: Forecaster, recording: Recording, track: Track, predicted: _Offline
) -> dict[str, Int64s]:
    """Return the states of alarms (window,) with the session's levels, of offline predictions."""
    alarms = Alarms.from_json(json.loads(str(recording.attributes[LEVELS])))
    layout = forecaster.codec.layout
    found = {name: np.empty(len(predicted.now), np.int64) for name in NAMES}
    for place, (row, ahead) in enumerate(zip(predicted.now.tolist(), predicted.ahead, strict=True)):
        for name, one in alarms.states(ahead, track.tactile[row], layout).items():
            found[name][place] = one.state
    return found


def _headline(
    forecaster: Forecaster, sessions: Mapping[str, Session], steps: tuple[int, ...], channels: int
) -> list[Any]:
    """Return how what was published compares with persistence of the same rows."""
    held = {name: one for name, one in sessions.items() if one.rows}
    if not held:
        return []

    def sums(name: str) -> Any:
        return {
            (0, recording): headlines.sums(one.sums[name], one.sums[LIVE_STILL], one.rows * channels)
            for recording, one in held.items()
        }

    method = f"{forecaster.config['architecture']} · {forecaster.config['codec']['name']} · published live"
    others = {"persistence": sums(LIVE_STILL)}
    unit = units.of_model(forecaster.config)
    found = headlines.headline(method, steps, sums(LIVE), others, None, unit=unit)
    return [found] if found else []
