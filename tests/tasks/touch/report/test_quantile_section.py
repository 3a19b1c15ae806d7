"""The section of touch on quantiles: coverage pooled over runs, by target and electrode, worked by hand."""

import io
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tacpipe.channels import biotac_sp
from tacpipe.report.blocks import Charts, Fold, Table
from tacpipe.tasks.touch.report import quantiles
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import result

PINBALL = {"model": 3.0, "constant": 4.0, "object_mean": 3.5}
OBJECTS = ("bleach", "coffee", "drill", "shoe")  # the first two are known


def rows(seed: int = 0) -> pd.DataFrame:
    """A row a value of ten grasps an object; of electrode 3 of the thumb the model's band holds none."""
    rng = np.random.default_rng(seed)
    values = [
        {
            **{"recording": f"{name}-{grasp:03d}", "object": name, "known": name in OBJECTS[:2]},
            **{"predictor": predictor, "target": target, "value": value},
            "covered": bool(rng.random() < 0.7) and (predictor, target, value) != ("model", "e_th", 3),
            "width": np.float32(90.0 if predictor == "model" else 180.0),
            "pinball": np.float32(pinball),
        }
        for name in OBJECTS
        for grasp in range(10)
        for predictor, pinball in PINBALL.items()
        for target in biotac_sp.TARGETS
        for value in range(1, biotac_sp.width(target) + 1)
    ]
    return pd.DataFrame(values)


def calibrate(seed: int = 0, **options: Any) -> Any:
    base = result(novel=OBJECTS[2:], seed=seed, **options)
    config = {**json.loads(base.files["config.json"]), "quantiles": {"levels": [10, 50, 90]}}
    file = io.BytesIO()
    rows(seed).to_parquet(file)
    return FakeDataset(
        base.recordings,
        {**base.files, "config.json": json.dumps(config).encode(), "coverage.parquet": file.getvalue()},
        base.manifest,
    )


def folds(*results: Any) -> list[Fold]:
    return [
        section_fold for section_fold in parts.section("touch", *results).folds if section_fold.title == "Uncertainty"
    ]


def test_coverage_is_pooled_over_runs_and_certain_by_grasp_or_by_novel_object() -> None:
    runs = pd.concat([rows(0), rows(1)])
    for is_known, cluster in ((True, "recording"), (False, "object")):
        part = runs[runs.known == is_known]
        band = quantiles.measure_bands(part, is_known)["e_mf", "model"]
        model_rows = part[(part.target == "e_mf") & (part.predictor == "model")]
        assert band.values == len(model_rows) == 2 * 2 * 10 * 24
        assert band.coverage[0] == model_rows.covered.mean()
        means = model_rows.groupby(cluster).covered.mean().to_numpy()  # clusters are of one size
        ends = (
            stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means)) if len(means) > 2 else (np.nan,) * 2
        )
        assert band.coverage[1:] == pytest.approx(np.clip(ends, 0, 1), nan_ok=True)
        gains = (0.25, 0.25, 0.25) if len(means) > 2 else (0.25, np.nan, np.nan)
        assert band.gain == pytest.approx(gains, nan_ok=True) and (band.width, band.pinball) == (90, 3)


def test_the_part_has_coverage_by_target_a_table_and_the_electrodes_of_known_and_novel_objects() -> None:
    (uncertainty_fold,) = folds(calibrate(), calibrate(1))
    titles = [chart.title for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts]
    assert titles == [
        "Coverage: known objects", "Coverage: novel objects",
        "Coverage of each electrode, known objects", "Coverage of each electrode, novel objects",
    ]  # fmt: skip
    (table,) = [table_block for table_block in uncertainty_fold.blocks if isinstance(table_block, Table)]
    assert len(table.rows) == 2 * 4 * 3
    cells = [getattr(cell, "text", cell) for cell in table.rows[0].cells]
    assert cells[0] == "known objects, PDC thumb: model" and cells[1] == "40"
    assert cells[3:] == ["10", "3", "25"]  # 90 of 900 counts, and 3 against 4


def test_an_electrode_whose_band_holds_nothing_is_drawn_so() -> None:
    (uncertainty_fold,) = folds(calibrate())
    *_, electrodes = [block for block in uncertainty_fold.blocks if isinstance(block, Charts)]
    for chart in electrodes.charts:
        drawn = {(mark["panel"], mark["Electrode"]): mark for mark in chart.spec["data"]["values"]}
        assert len(drawn) == 2 * 24
        assert drawn["thumb", 3]["text"] == "0" and drawn["thumb", 3]["side"] == "b"


def test_results_without_quantiles_have_no_such_part() -> None:
    assert folds(result()) == []
    assert "quantiles" not in json.loads(result().files["config.json"])
