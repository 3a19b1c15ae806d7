"""Test how far the rest levels of recordings lie from those of the training recordings, and what is said about sessions."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.tasks.forward import rest_shift
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, table
from tests.tasks.forward.trials import evaluated, trained


def at_rest(name: str, rest: float, **attributes: Any) -> FakeShard:
    """Return a recording whose channels all rest at ``rest``."""
    moved = np.random.default_rng(len(name)).normal(0, 20, (40, len(CHANNELS)))
    return FakeShard(name, table(moved, rest=rest), attributes)


TRAIN = [at_rest(f"train-{rest}", rest, session="monday") for rest in (15990.0, 16000.0, 16010.0)]  # deviation 10
VAL = [at_rest("val", 16500.0, session="tuesday")]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"), dataset(*TRAIN), dataset(*VAL), epochs=1)


def test_a_shift_is_counted_in_standard_deviations_of_the_training_recordings_alone(files: dict[str, bytes]) -> None:
    config = json.loads(files["config.json"])
    assert config["rest_levels"] == {"mean": [16000.0] * len(CHANNELS), "deviation": [10.0] * len(CHANNELS)}
    metrics, result = evaluated(files, at_rest("near", 16005.0), at_rest("far", 15920.0), TRAIN[0])
    assert metrics["rest_shift"] == {
        "near": {"largest": 0.5, "median": 0.5},
        "far": {"largest": 8.0, "median": 8.0},
    }
    (note,) = result.notes
    assert note.startswith("1 of 2 test recordings have rest levels that differ from training")
    sentence = rest_shift.describe_shifts(metrics["rest_shift"])
    assert "4.2 standard deviations" in sentence and "at most 8 (far)" in sentence


def test_rest_levels_are_printed_and_noted_only_where_they_are_far(
    files: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    _, result = evaluated(files, at_rest("near", 16005.0))
    assert result.notes == []
    assert "Rest levels are 0.5 standard deviations" in capsys.readouterr().err


def test_largest_and_median_are_over_the_channels_that_vary_in_training() -> None:
    rng = np.random.default_rng(0)
    levels = rng.normal(16000, 10, (5, 7))
    levels[:, 3] = 16000.0
    mean, deviation = levels.mean(axis=0), levels.std(axis=0, ddof=1)
    level = rng.normal(16000, 50, 7)
    distances = np.abs((level - mean)[deviation > 0] / deviation[deviation > 0])
    shift = rest_shift.measure_shift(level.tolist(), {"mean": mean.tolist(), "deviation": deviation.tolist()})
    assert shift is not None
    assert shift["largest"] == pytest.approx(distances.max(), rel=1e-5)
    assert shift["median"] == pytest.approx(np.median(distances), rel=1e-5)


def test_recordings_of_a_session_of_training_or_validation_are_noted(files: dict[str, bytes]) -> None:
    assert json.loads(files["config.json"])["sessions"] == ["monday", "tuesday"]
    sessions = ("monday", "tuesday", "friday", None)
    tested = [at_rest(f"test-{day}", 16000.0, **({"session": day} if day else {})) for day in sessions]
    _, result = evaluated(files, *tested)
    assert result.notes[-1].startswith("2 of 4 test recordings are of a session of the training recordings")
    assert "--group session" in result.notes[-1]
    _, result = evaluated(files, *tested[2:])
    assert not any("session" in note for note in result.notes)


def test_without_known_sessions_and_with_one_training_recording_nothing_is_noted(tmp_path: Path) -> None:
    recordings = [dataclasses.replace(recording, attributes={}) for recording in (TRAIN[0], VAL[0])]
    files = trained(tmp_path, dataset(recordings[0]), dataset(recordings[1]), epochs=1)
    assert not {"rest_levels", "sessions"} & set(json.loads(files["config.json"]))
    metrics, result = evaluated(files, at_rest("test", 15000.0, session="monday"))
    assert "rest_shift" not in metrics
    assert result.notes == []
