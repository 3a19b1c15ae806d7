"""Alarms on tracks made by hand: levels from quiet rows, and events that are led or missed."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import AnyFloats
from tacpipe.tasks.forward.alarms import Loads
from tacpipe.tasks.forward.predictors import Predicted, Prediction
from tacpipe.tasks.forward.tracks import Track
from tests.models.window_fakes import LAYOUT
from tests.stages.learning_fakes import CHANNELS, table
from tests.tasks.forward.trials import track

HORIZON, ROWS, STEP = 4, 400, 200  # rows; the load steps up at row 200


def made(load: AnyFloats) -> Track:
    """A track all of whose channels have this load (time,)."""
    return track(table(np.repeat(load[:, None], len(CHANNELS), axis=1)))


def stepped(seed: int = 0) -> AnyFloats:
    """A load that is quiet and steps up by much."""
    load = np.random.default_rng(seed).normal(0, 1, ROWS)
    load[STEP:] += 200
    return load


def said(one: Track, ahead: dict[str, AnyFloats]) -> Predicted:
    """What predictors say of each row (time,) but the first: the load of the last step of the horizon."""
    now = np.arange(1, len(one.t_ns) - HORIZON)
    predictions = {
        name: Prediction(None, np.tile(values[now, None, None], (1, HORIZON, len(CHANNELS))))
        for name, values in ahead.items()
    }
    return Predicted(now, np.zeros(0), Prediction(None, np.zeros(0)), predictions)


def loads(*parts: tuple[Track, dict[str, AnyFloats]]) -> Loads:
    found = Loads(LAYOUT, HORIZON)
    for one, ahead in parts:
        found.begin(one)
        if ahead:
            found.add(said(one, ahead))
    return found


def seer(load: AnyFloats) -> dict[str, AnyFloats]:
    """A model that knows, a persistence that does not, and one that nobody watches."""
    knows = np.concatenate([load[HORIZON:], np.full(HORIZON, load[-1])])
    return {"model": knows, "persistence": load, "context_mean": load}


def test_a_model_that_knows_leads_the_event_and_persistence_misses_it() -> None:
    load = stepped()
    found = loads((made(load), seer(load)))
    scores = found.scored(found.calibrated())
    assert set(scores) == {"model", "persistence"}
    features = 6  # two sensors with three axes each
    assert scores["model"]["events"] == scores["persistence"]["events"] == features
    assert scores["model"]["recall"] == 1.0
    assert scores["model"]["median_lead_rows"] == HORIZON
    assert scores["persistence"]["recall"] == 0.0
    assert scores["persistence"]["median_lead_rows"] is None
    assert scores["persistence"]["false_alarms_per_minute"] == 0.0


def test_levels_give_no_more_than_one_false_alarm_a_minute_where_they_were_set() -> None:
    load = stepped()
    noisy: dict[str, AnyFloats] = {"model": load + np.random.default_rng(1).normal(0, 5, ROWS)}
    found = loads((made(load), noisy))
    levels = found.calibrated()
    assert np.array(levels["sd"]).shape == (6,)
    rate = found.scored(levels)["model"]["false_alarms_per_minute"]
    assert rate is not None and rate <= 1.0


def test_the_load_is_the_mean_of_a_sensor_s_axis() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 10, (30, len(CHANNELS)))
    found = loads((track(table(values)), {}))
    wanted = [values[:, [0, 3]], values[:, [1, 4]], values[:, [2, 5]], values[:, [6, 9]]]
    assert np.allclose(found.truth[0][:, :4], np.stack([one.mean(axis=1) for one in wanted], axis=1), atol=0.01)


def test_unusable_rows_are_no_load_and_recordings_do_not_touch() -> None:
    load = stepped()
    torn = dataclasses.replace(made(load), usable=np.arange(ROWS) != 50)
    empty = made(load[:0])
    found = loads((empty, {}), (torn, seer(load)), (empty, {}), (made(load), seer(load)))
    assert np.flatnonzero(np.isnan(found.truth[1]).all(axis=1)).tolist() == [50]
    groups = np.concatenate(found.groups)
    assert np.unique(groups[:ROWS]).tolist() != np.unique(groups[ROWS:]).tolist()
    assert found.scored(found.calibrated())["model"]["events"] == 12


def test_a_level_that_is_never_reached_is_written_as_nothing_and_read_as_never() -> None:
    short = made(stepped()[:8])
    found = loads((short, seer(stepped()[:8])))
    levels = found.calibrated()
    read: dict[str, Any] = json.loads(json.dumps(levels), parse_constant=pytest.fail)
    assert read == levels
    load = stepped()
    never = {"sd": [1.0] * 6, "theta": {"model": [None] * 6}}
    scores = loads((made(load), seer(load))).scored(never)
    assert set(scores) == {"model"}  # nothing was set for persistence
    assert scores["model"]["recall"] == 0.0


def test_without_recordings_or_levels_there_is_nothing_to_tell() -> None:
    assert loads().calibrated() == {}
    assert loads().scored({"sd": [1.0], "theta": {}}) == {}
    load = stepped()
    assert loads((made(load), seer(load))).scored({}) == {}
    assert loads((made(load), {})).calibrated()["theta"] == {}
