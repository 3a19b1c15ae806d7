"""Alarms on tracks made by hand: levels from quiet rows, and events that are led or missed."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import AnyFloats
from tacpipe.tasks.forward.alarms import Loads
from tacpipe.tasks.forward.params import AlarmLevels
from tacpipe.tasks.forward.predictors import Predicted, Prediction
from tacpipe.tasks.forward.tracks import Track
from tests.models.window_fakes import LAYOUT
from tests.stages.learning_fakes import CHANNELS, table
from tests.tasks.forward.trials import track

HORIZON, ROWS, STEP = 4, 400, 200  # rows; the load steps up at row 200


def recorded_track(load: AnyFloats) -> Track:
    """A track all of whose channels have this load (time,)."""
    return track(table(np.repeat(load[:, None], len(CHANNELS), axis=1)))


def stepped(seed: int = 0) -> AnyFloats:
    """A load that is quiet and steps up by much."""
    load = np.random.default_rng(seed).normal(0, 1, ROWS)
    load[STEP:] += 200
    return load


def predictions(recorded: Track, ahead: dict[str, AnyFloats]) -> Predicted:
    """Return predictions for each row (time,) but the first: the load of the last step of the horizon."""
    now = np.arange(1, len(recorded.t_ns) - HORIZON)
    by_predictor = {
        name: Prediction(None, np.tile(values[now, None, None], (1, HORIZON, len(CHANNELS))))
        for name, values in ahead.items()
    }
    return Predicted(now, np.zeros(0), Prediction(None, np.zeros(0)), by_predictor)


def loads(*parts: tuple[Track, dict[str, AnyFloats]]) -> Loads:
    loads_added = Loads(LAYOUT, HORIZON)
    for recorded, ahead in parts:
        loads_added.begin(recorded)
        if ahead:
            loads_added.add(predictions(recorded, ahead))
    return loads_added


def seer(load: AnyFloats) -> dict[str, AnyFloats]:
    """A model that knows, a persistence that does not, and one that nobody watches."""
    knows = np.concatenate([load[HORIZON:], np.full(HORIZON, load[-1])])
    return {"model": knows, "persistence": load, "context_mean": load}


def test_a_model_that_knows_leads_the_event_and_persistence_misses_it() -> None:
    load = stepped()
    loads_added = loads((recorded_track(load), seer(load)))
    scores = loads_added.scored(loads_added.calibrated())
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
    loads_added = loads((recorded_track(load), noisy))
    levels = loads_added.calibrated()
    assert np.array(levels["sd"]).shape == (6,)
    rate = loads_added.scored(levels)["model"]["false_alarms_per_minute"]
    assert rate is not None and rate <= 1.0


def test_the_load_is_the_mean_of_a_sensor_s_axis() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 10, (30, len(CHANNELS)))
    loads_added = loads((track(table(values)), {}))
    expected = [values[:, [0, 3]], values[:, [1, 4]], values[:, [2, 5]], values[:, [6, 9]]]
    assert np.allclose(
        loads_added.truth[0][:, :4], np.stack([channels.mean(axis=1) for channels in expected], axis=1), atol=0.01
    )


def test_unusable_rows_are_no_load_and_recordings_do_not_touch() -> None:
    load = stepped()
    torn = dataclasses.replace(recorded_track(load), usable=np.arange(ROWS) != 50)
    empty = recorded_track(load[:0])
    loads_added = loads((empty, {}), (torn, seer(load)), (empty, {}), (recorded_track(load), seer(load)))
    assert np.flatnonzero(np.isnan(loads_added.truth[1]).all(axis=1)).tolist() == [50]
    groups = np.concatenate(loads_added.groups)
    assert np.unique(groups[:ROWS]).tolist() != np.unique(groups[ROWS:]).tolist()
    assert loads_added.scored(loads_added.calibrated())["model"]["events"] == 12


def test_a_level_that_is_never_reached_is_written_as_nothing_and_read_as_never() -> None:
    short = recorded_track(stepped()[:8])
    loads_added = loads((short, seer(stepped()[:8])))
    levels = loads_added.calibrated()
    read: dict[str, Any] = json.loads(json.dumps(levels), parse_constant=pytest.fail)
    assert read == levels
    load = stepped()
    never: AlarmLevels = {"sd": [1.0] * 6, "theta": {"model": [None] * 6}}
    scores = loads((recorded_track(load), seer(load))).scored(never)
    assert set(scores) == {"model"}  # nothing was set for persistence
    assert scores["model"]["recall"] == 0.0


def test_without_recordings_or_levels_there_is_nothing_to_tell() -> None:
    assert loads().calibrated() == {}
    assert loads().scored({"sd": [1.0], "theta": {}}) == {}
    load = stepped()
    assert loads((recorded_track(load), seer(load))).scored({}) == {}
    assert loads((recorded_track(load), {})).calibrated()["theta"] == {}
