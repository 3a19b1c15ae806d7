"""Test that an evaluation needs memory only for the stored recording and one batch of windows."""

import tracemalloc
from pathlib import Path

import pytest

from tacpipe.io.spill import Spill
from tacpipe.tasks.forward import evaluation, predictors, tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.metrics import Trial
from tacpipe.tasks.forward.situations import BySituation
from tests.fake_recordings import FakeShard
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import trained

ROWS = 4000


def peak_bytes(forecaster: Forecaster, rows: int) -> int:
    """Return what the evaluation of a recording of so many rows takes at most, besides its track."""
    shard: FakeShard = motion(0, rows=rows)
    track = tracks.track(shard, forecaster.codec)  # type: ignore[arg-type]
    by_situation = BySituation(forecaster.horizon, len(forecaster.codec.channels))
    bands = evaluation.QuantileSums(forecaster)
    tracemalloc.start()
    evaluation._predictions(forecaster, track, Trial("a", True), by_situation, bands, Spill(1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_the_evaluation_of_a_longer_recording_takes_hardly_more_besides_its_track(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predictors, "CHUNK", 64)
    forecaster = Forecaster.load(trained(tmp_path))
    peak_bytes(forecaster, 3 * ROWS)  # what the first evaluation imports and caches is not counted
    short, long = (peak_bytes(forecaster, rows) for rows in (ROWS, 3 * ROWS))
    grown = (long - short) / (2 * ROWS)  # bytes a row
    assert grown < 25, grown
