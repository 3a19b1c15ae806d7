"""Check quantiles in the section of forecasts: coverage by step, worked by hand, and a forecast with its band."""

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
    tree = {**json.loads(plain.files["metrics.json"]), "quantiles": QUANTILES}
    more_files = {
        "coverage.parquet": to_parquet(pa.Table.from_pylist(rows)),
        "bands.json": json.dumps([{"recording": "r1", "channel": "xela1_taxel01_z", "step": 3, **curves}]).encode(),
        "metrics.json": json.dumps(tree).encode(),
    }
    return FakeDataset(plain.recordings, {**plain.files, **more_files}, plain.manifest)


def uncertainty(*results: Any) -> list[Fold]:
    return [fold for fold in parts.section("forward", *results).folds if fold.title == "Uncertainty"]


def test_coverage_and_pinball_loss_are_pooled_over_recordings_that_were_not_seen() -> None:
    (fold,) = uncertainty(calibrate(), calibrate(seed=1))
    (table,) = [block for block in fold.blocks if isinstance(block, Table)]
    rows = [[getattr(cell, "text", cell) for cell in row.cells] for group in table.groups for row in group.rows]
    assert rows[0] == ["known objects: quantiles of the model", "t+1", "2", "0.8", "2", "0.4", "20"]
    assert rows[-1][:4] == ["unseen objects: persistence, quantiles of its errors", "t+1", "1", "0.6"]


def test_coverage_is_drawn_by_step_and_a_forecast_with_its_band() -> None:
    (fold,) = uncertainty(calibrate())
    titles = [chart.title for block in fold.blocks if isinstance(block, Charts) for chart in block.charts]
    assert titles == ["Coverage: known objects", "Coverage: unseen objects", "r1: xela1_taxel01_z"]


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
