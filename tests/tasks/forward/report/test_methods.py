"""Error sums as arrays."""

import io
import json
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import to_parquet
from tacpipe.report.blocks import Fold
from tacpipe.tasks.forward.metrics import ErrorSums
from tacpipe.tasks.forward.report import methods
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.forward.report.result_fakes import GROUPS, STEPS, WINDOWS, errors, result

RATIOS = {"model": {"r1": 0.5, "r2": 0.25}}
WINDOW_COUNTS = {"r1": 10, "r2": 30}


def test_every_row_lands_at_its_predictor_group_recording_and_step() -> None:
    sums_read = ErrorSums.from_parquet(errors(RATIOS, WINDOW_COUNTS, known_objects_of=["r2"]))
    assert sums_read.recordings == ("r1", "r2")
    assert sums_read.steps == (1, 2, 3)
    assert sums_read.known.tolist() == [False, True]
    assert sums_read.windows.tolist() == [10, 30]
    assert sums_read.channels == GROUPS
    sums = sums_read.sums["model", "x"]
    assert sums[0].tolist() == [
        [0.5 * 10 * 4 * step for step in (1, 2, 3)],
        [0.25 * 30 * 4 * step for step in (1, 2, 3)],
    ]
    assert sums[1].tolist() == (2 * sums[0]).tolist()


def test_the_mean_error_weighs_windows_and_not_recordings() -> None:
    squared, absolute = ErrorSums.from_parquet(errors(RATIOS, WINDOW_COUNTS)).means("model", "x")
    assert squared == pytest.approx([(0.5 * 10 + 0.25 * 30) / 40 * step for step in (1, 2, 3)])
    assert absolute == pytest.approx(2 * squared)


def test_recordings_that_were_trained_on_are_left_out() -> None:
    assert ErrorSums.from_parquet(errors(RATIOS, WINDOW_COUNTS, seen_recordings=["r1"])).recordings == ("r2",)
    empty = ErrorSums.from_parquet(errors(RATIOS, WINDOW_COUNTS, seen_recordings=["r1", "r2"]))
    assert (empty.recordings, empty.steps, empty.predictors) == ((), (), ())


def test_a_predictor_that_lacks_a_group_has_no_errors_there() -> None:
    table = pq.read_table(io.BytesIO(errors(RATIOS, WINDOW_COUNTS)))
    lacking = [not (row["predictor"] == "model" and row["group"] == "feature") for row in table.to_pylist()]
    content = io.BytesIO()
    pq.write_table(table.filter(lacking), content)
    sums_read = ErrorSums.from_parquet(content.getvalue())
    assert ("model", "feature") not in sums_read.sums
    assert ("persistence", "feature") in sums_read.sums


def test_a_missing_column_and_uneven_windows_are_refused() -> None:
    table = pq.read_table(io.BytesIO(errors(RATIOS, WINDOW_COUNTS)))
    content = io.BytesIO()
    pq.write_table(table.drop_columns(["known"]), content)
    with pytest.raises(TacpipeError, match="has no column known"):
        ErrorSums.from_parquet(content.getvalue())
    rows = table.to_pylist()
    rows[0]["windows"] = 11
    content = io.BytesIO()
    pq.write_table(table.from_pylist(rows), content)
    with pytest.raises(TacpipeError, match="different windows of r1"):
        ErrorSums.from_parquet(content.getvalue())


PREDICTORS = {"model": (8.0, 4.0), "persistence": (6.0, 5.0)}  # sums over ten values: covered, and pinball loss
QUANTILES = {
    "levels": [10, 50, 90],
    "method": "pooled",
    "recordings": {"fitted": 3, "corrected": 3},
    "most_promised": 75.0,
}


def calibrate(**options: Any) -> Any:
    """A result with quantiles of recordings whose objects are known and unseen, and one of a recording that was seen."""
    plain = result("raw", **options)
    rows = [
        {
            **{"recording": name, "object": name, "known": name in ("r1", "r2"), "seen": name == "r4"},
            **{"predictor": predictor, "step": step, "values": 10.0},
            **{"covered": covered, "width": 20.0 * step, "pinball": pinball},
        }
        for predictor, (covered, pinball) in PREDICTORS.items()
        for name in WINDOWS
        for step in STEPS
    ]
    curves = {"t_s": [1.0, 1.1], "measured": [3.0, 4.0], "q10": [1.0, 2.0], "q50": [3.0, 3.5], "q90": [4.0, 6.0]}
    more_files = {
        "coverage.parquet": to_parquet(pa.Table.from_pylist(rows)),
        "bands.json": json.dumps([{"recording": "r1", "channel": "xela1_taxel01_z", "step": 3, **curves}]).encode(),
        "config.json": json.dumps({**json.loads(plain.files["config.json"]), "quantiles": QUANTILES}).encode(),
    }
    return FakeDataset(plain.recordings, {**plain.files, **more_files}, plain.manifest)


def uncertainty(*results: Any) -> list[Fold]:
    return [fold for fold in parts.section("forward", *results).folds if fold.title == "Uncertainty"]


def test_coverage_and_pinball_loss_are_pooled_over_recordings_that_were_not_seen() -> None:
    (fold,) = uncertainty(calibrate(), calibrate(seed=1))
    known_table, unseen_table = parts.tables([fold])
    assert known_table.title == "recurrent · raw, known objects; width and pinball loss in counts"
    rows = [[getattr(cell, "text", cell) for cell in row.cells] for row in (*known_table.rows, *unseen_table.rows)]
    assert rows[0] == ["t+1: model", "40", "80", "2", "0.4", "20"]
    assert rows[-1][:3] == ["t+3: persistence", "20", "60"]


def test_coverage_is_drawn_by_step_and_a_forecast_with_its_band() -> None:
    (fold,) = uncertainty(calibrate())
    titles = [chart.title.removeprefix("Coverage of the 10 to 90 % band: ") for chart in parts.charts([fold])]
    assert titles == ["recurrent · raw, known objects", "recurrent · raw, unseen objects", "r1: xela1_taxel01_z"]


def test_results_without_quantiles_have_no_such_part() -> None:
    assert uncertainty(result("raw")) == []


def test_a_model_that_was_evaluated_before_and_after_its_calibration_counts_once() -> None:
    plain, with_quantiles = result("raw"), calibrate()
    config = {**json.loads(with_quantiles.files["config.json"]), "quantiles": {}, "trained_on": {"r9": "00"}}
    copy = FakeDataset(
        with_quantiles.recordings,
        {**with_quantiles.files, "config.json": json.dumps(config).encode()},
        with_quantiles.manifest,
    )
    another_seed = result("raw", seed=1)
    for datasets in ([plain, copy, another_seed], [copy, another_seed, plain], [copy, another_seed]):
        assert [run.dataset for run in methods.read_runs(datasets)] == [
            with_quantiles for with_quantiles in datasets if with_quantiles is not plain
        ]
    assert [run.dataset for run in methods.read_runs([plain, another_seed])] == [plain, another_seed]
