"""Error sums as arrays."""

from __future__ import annotations

import io

import pyarrow.parquet as pq
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.forward.report import methods
from tests.tasks.forward.report.result_fakes import GROUPS, errors

RATIOS = {"model": {"r1": 0.5, "r2": 0.25}}
WINDOWS = {"r1": 10, "r2": 30}


def test_every_row_lands_at_its_predictor_group_recording_and_step() -> None:
    sums_read = methods.read_error_sums(errors(RATIOS, WINDOWS, known_objects_of=["r2"]))
    assert sums_read.recordings == ("r1", "r2")
    assert sums_read.steps == (1, 2, 3)
    assert sums_read.known.tolist() == [False, True]
    assert sums_read.windows.tolist() == [10, 30]
    assert sums_read.channels == GROUPS
    sums = sums_read.of("model", "x")
    assert sums is not None
    assert sums[0].tolist() == [
        [0.5 * 10 * 4 * step for step in (1, 2, 3)],
        [0.25 * 30 * 4 * step for step in (1, 2, 3)],
    ]
    assert sums[1].tolist() == (2 * sums[0]).tolist()
    assert sums_read.of("nobody", "x") is None
    assert sums_read.of("model", "y") is None


def test_recordings_that_were_trained_on_are_left_out() -> None:
    assert methods.read_error_sums(errors(RATIOS, WINDOWS, seen_recordings=["r1"])).recordings == ("r2",)
    empty = methods.read_error_sums(errors(RATIOS, WINDOWS, seen_recordings=["r1", "r2"]))
    assert (empty.recordings, empty.steps, empty.predictors) == ((), (), ())


def test_a_predictor_that_lacks_a_group_has_no_errors_there() -> None:
    table = pq.read_table(io.BytesIO(errors(RATIOS, WINDOWS)))
    lacking = [not (row["predictor"] == "model" and row["group"] == "feature") for row in table.to_pylist()]
    content = io.BytesIO()
    pq.write_table(table.filter(lacking), content)
    sums_read = methods.read_error_sums(content.getvalue())
    assert sums_read.of("model", "feature") is None
    assert sums_read.of("persistence", "feature") is not None


def test_a_missing_column_and_uneven_windows_are_refused() -> None:
    table = pq.read_table(io.BytesIO(errors(RATIOS, WINDOWS)))
    content = io.BytesIO()
    pq.write_table(table.drop_columns(["known"]), content)
    with pytest.raises(TacpipeError, match="has no column known"):
        methods.read_error_sums(content.getvalue())
    rows = table.to_pylist()
    rows[0]["windows"] = 11
    content = io.BytesIO()
    pq.write_table(table.from_pylist(rows), content)
    with pytest.raises(TacpipeError, match="different windows of r1"):
        methods.read_error_sums(content.getvalue())
