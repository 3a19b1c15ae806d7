"""What the section of forecasts holds of quantiles: coverage by step, worked by hand, and a forecast with its band."""

from __future__ import annotations

import json
from typing import Any

import pyarrow as pa

from tacpipe.io.parquet import to_parquet
from tacpipe.report.blocks import Charts, Fold, Table
from tacpipe.tasks.forward.report import methods
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.forward.report.result_fakes import STEPS, WINDOWS, result

PREDICTORS = {"model": (8.0, 4.0), "persistence": (6.0, 5.0)}  # of ten values: covered, and pinball loss of all


def calibrated(**how: Any) -> Any:
    """A result with quantiles of recordings whose objects are known and unseen, and one of a recording that was seen."""
    one = result("raw", **how)
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
    tree = {**json.loads(one.files["metrics.json"]), "quantiles": {"levels": [10, 50, 90]}}
    more = {
        "coverage.parquet": to_parquet(pa.Table.from_pylist(rows)),
        "bands.json": json.dumps([{"recording": "r1", "channel": "xela1_taxel01_z", "step": 3, **curves}]).encode(),
        "metrics.json": json.dumps(tree).encode(),
    }
    return FakeDataset(one.recordings, {**one.files, **more}, one.manifest)


def uncertainty(*results: Any) -> list[Fold]:
    return [one for one in parts.section("forward", *results).folds if one.title == "Uncertainty"]


def test_coverage_and_pinball_loss_are_pooled_over_recordings_that_were_not_seen() -> None:
    (found,) = uncertainty(calibrated(), calibrated(seed=1))
    (table,) = [one for one in found.blocks if isinstance(one, Table)]
    rows = [[getattr(cell, "text", cell) for cell in row.cells] for group in table.groups for row in group.rows]
    assert rows[0] == ["known objects: quantiles of the model", "t+1", "2", "0.8", "2", "0.4", "20"]
    assert rows[-1][:4] == ["unseen objects: persistence, quantiles of its errors", "t+1", "1", "0.6"]


def test_coverage_is_drawn_by_step_and_a_forecast_with_its_band() -> None:
    (found,) = uncertainty(calibrated())
    titles = [chart.title for block in found.blocks if isinstance(block, Charts) for chart in block.charts]
    assert titles == ["Coverage: known objects", "Coverage: unseen objects", "r1: xela1_taxel01_z"]


def test_results_without_quantiles_have_no_such_part() -> None:
    assert uncertainty(result("raw")) == []


def test_a_model_that_was_evaluated_before_and_after_its_calibration_counts_once() -> None:
    plain, one = result("raw"), calibrated()
    config = {**json.loads(one.files["config.json"]), "quantiles": {}, "trained_on": {"r9": "00"}}
    copy = FakeDataset(one.recordings, {**one.files, "config.json": json.dumps(config).encode()}, one.manifest)
    other = result("raw", seed=1)
    for several in ([plain, copy, other], [copy, other, plain], [copy, other]):
        assert [run.dataset for run in methods.read_runs(several)] == [one for one in several if one is not plain]
    assert [run.dataset for run in methods.read_runs([plain, other])] == [plain, other]
