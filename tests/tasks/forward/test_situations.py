"""Check situations of windows, and that errors by situation add up to those of all windows."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.tasks.forward import situations, tracks
from tacpipe.tasks.forward.predictors import Prediction
from tacpipe.tasks.forward.situations import SITUATIONS, BySituation, Motion
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import CONTEXT, HORIZON, evaluated, trained

REST = {
    "touched_now": 1.0,
    "touched_then": 1.0,
    "load_now": 100.0,
    "load_then": 100.0,
    "wider_m": 0.0,
    "pace_m_s": 0.0,
    "turning_rad_s": 0.0,
}


@pytest.mark.parametrize(
    ("changed", "situation"),
    [
        ({}, "holding still"),
        ({"pace_m_s": 0.021}, "holding in motion"),
        ({"turning_rad_s": 0.11, "load_then": 96.0}, "holding in motion"),
        ({"load_then": 94.0, "pace_m_s": 1.0}, "slipping"),
        ({"load_then": 94.0, "wider_m": 0.0006}, "releasing"),
        ({"touched_then": 0.0}, "releasing"),
        ({"wider_m": -0.0006, "pace_m_s": 1.0}, "closing"),
        ({"touched_now": 0.0}, "closing"),
        ({"touched_now": 0.0, "touched_then": 0.0, "wider_m": -0.01}, "closing"),
        ({"touched_now": 0.0, "touched_then": 0.0, "pace_m_s": 1.0}, "no contact"),
    ],
)
def test_a_window_has_the_first_name_that_fits(changed: dict[str, float], situation: str) -> None:
    numbers = situations.situation_numbers(
        Motion(**{name: np.array([value]) for name, value in {**REST, **changed}.items()})
    )
    assert SITUATIONS[numbers[0]] == situation


def test_windows_of_a_recording_are_named_by_their_last_row_and_those_to_come() -> None:
    recording = motion(0)
    track = tracks.track(recording, tracks.codec_of(recording.content.schema, {}))  # type: ignore[arg-type]
    rows = len(track.t_ns)
    arm = np.zeros((rows, 13), np.float32)
    arm[40:, 7] = 0.5
    contact = np.where(np.arange(rows) < 10, -1, 0)
    finger = np.where(np.arange(rows) < 60, 0.04, 0.05).astype(np.float32)
    tactile = np.full(track.tactile.shape, 50.0)
    tactile[20:] = 40.0
    changed: Any = dataclasses.replace(track, arm=arm, contact=contact, finger=finger, tactile=tactile)
    now = np.array([3, 8, 12, 17, 25, 37, 45, 57])
    names = [SITUATIONS[at] for at in situations.window_situations(changed, now, HORIZON)]
    assert names == [
        *("no contact", "closing", "holding still", "slipping"),
        *("holding still", "holding in motion", "holding in motion", "releasing"),
    ]
    assert situations.window_situations(changed, now[:0], HORIZON).tolist() == []


def test_errors_and_skill_are_those_of_numpy_over_the_windows_of_a_situation() -> None:
    rng = np.random.default_rng(0)
    sums, by_recording = BySituation(HORIZON, 3), {}
    for recording in ("a", "b", "c"):
        doing = rng.integers(0, 3, 30)
        truth = rng.normal(size=(30, HORIZON, 3))
        model, persistence = truth + rng.normal(0, 0.5, truth.shape), truth + rng.normal(0, 1, truth.shape)
        for part in (slice(0, 11), slice(11, 30)):
            sums.count(recording, doing[part])
            for name, values in (("model", model), ("persistence", persistence)):
                sums.add(recording, doing[part], name, Prediction(None, values[part]), Prediction(None, truth[part]))
        by_recording[recording] = (doing, truth, model, persistence)
    measures = sums.summary()
    assert set(measures) == set(SITUATIONS[:3])
    at = 1
    errors = [
        np.concatenate([(entry[2 + predictor] - entry[1])[entry[0] == at] for entry in by_recording.values()])
        for predictor in (0, 1)
    ]
    entry = measures[SITUATIONS[at]]
    assert (entry["windows"], entry["recordings"]) == (len(errors[0]), 3)
    assert entry["mae_counts"]["model"]["t2"] == pytest.approx(np.abs(errors[0][:, 1]).mean(), rel=1e-6)
    assert entry["mae_counts"]["persistence"]["mean"] == pytest.approx(np.abs(errors[1]).mean(), rel=1e-6)
    ratios = [np.divide(*(np.abs(part - truth)[doing == at, 2].sum() for part in (model, persistence)))
              for doing, truth, model, persistence in by_recording.values()]  # fmt: skip
    assert entry["skill"]["t3"]["mean"] == pytest.approx(1 - np.prod(ratios) ** (1 / 3), rel=1e-6)
    assert entry["skill"]["t3"]["low"] < entry["skill"]["t3"]["mean"] < entry["skill"]["t3"]["high"]


def test_evaluate_states_situations_whose_windows_are_all_windows_of_unseen_recordings(tmp_path: Path) -> None:
    files = trained(tmp_path, epochs=1)
    metrics, _ = evaluated(files, motion(20), motion(21), motion(0))  # the last one was trained on
    measures = metrics["situations"]
    assert (
        sum(measured["windows"] for measured in measures.values())
        == metrics["counts"]["windows"]
        == 2 * (80 - CONTEXT - HORIZON + 1)
    )
    for name in ("model", "persistence", "ridge"):
        pooled = sum(measured["windows"] * measured["mae_counts"][name]["t1"] for measured in measures.values())
        assert pooled / metrics["counts"]["windows"] == pytest.approx(
            metrics[name]["mae_counts"]["both"]["t1"], rel=1e-6
        )
    only, _ = evaluated(files, motion(0))
    assert "situations" not in only
