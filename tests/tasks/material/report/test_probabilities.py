"""The section of materials on calibrated classifiers: rates worked by hand, curves, and the answer unknown."""

from typing import Any

import numpy as np
import pytest

from tacpipe.report.blocks import Charts, Fold, Table
from tacpipe.tasks.material.report import probabilities
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.material.report.material_fakes import result, slides

HEAD = "recording,sensor,known,seen,named,probability,score,answer\n"
BEFORE = {"calibration_error": 0.9, "log_loss": 3.0, "reliability": [{"n": 20, "confidence": 0.05, "accuracy": 0.95}]}
AFTER = {"calibration_error": 0.02, "log_loss": 0.1, "reliability": []}
OTHERS = 8  # slides of a material that was left out


def calibrated(sensor: str = "biotac", **options: Any) -> Any:
    """A result that names one of 20 slides wrong, refuses 2 of them, and names 2 of 8 slides of another material."""
    names, truth = slides(sensor)
    rows = [
        f"{name},{sensor},true,false,{material if at else 9},{0.5 + at / 40:g},{at},{'unknown' if at < 2 else material}"
        for at, (name, material) in enumerate(zip(names, truth, strict=True))
    ]
    rows += [
        f"{sensor}-m09-t{at},{sensor},false,false,1,0.4,{at - 5},{1 if at > 5 else 'unknown'}" for at in range(OTHERS)
    ]
    rows.append(f"{sensor}-seen,{sensor},true,true,1,0.9,99,unknown")
    tree = {
        "calibration": {sensor: {"n": 20, "temperature": 0.1, "before": BEFORE, "after": AFTER}},
        "unknown": {sensor: {"rule": "distance", "auroc": {"probability": 0.7, "distance": 0.9}}},
    }
    base = result(wrong={sensor: 1}, metrics=tree, **options)
    files = {**base.files, "answers.csv": (HEAD + "\n".join(rows) + "\n").encode()}
    return FakeDataset(base.recordings, files, base.manifest)


def folds(*results: Any) -> list[Fold]:
    return [
        section_fold
        for section_fold in parts.section("material", *results).folds
        if section_fold.title == "Uncertainty"
    ]


def test_rates_of_slides_are_pooled_over_runs_and_each_slide_counts_once() -> None:
    (uncertainty_fold,) = folds(calibrated(fold=0), calibrated(fold=1))
    (table,) = [block for block in uncertainty_fold.blocks if isinstance(block, Table)]
    (row,) = table.rows
    cells = [getattr(cell, "text", cell) for cell in row.cells]
    assert cells == ["BioTac: RAEC independent", "20", "0.02", "0.1", "10.0", "25.0", "0.9", "100.0"]
    assert row.cells[4].below == "2.8 to 30.1 of 20"  # type: ignore[union-attr]  # Wilson, of 2 of 20


def test_reliability_is_drawn_of_as_many_slides_a_bin_and_unknown_with_its_threshold() -> None:
    (uncertainty_fold,) = folds(calibrated(fold=0), calibrated(fold=1))
    reliable, refused = (
        chart for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts
    )
    assert reliable.title == "BioTac: RAEC independent" and refused.title == "Unknown: BioTac"
    lines = {
        name: [mark for mark in reliable.spec["data"]["values"] if mark["name"] == name]
        for name in ("calibrated", "as trained")
    }
    assert [(mark["x"], mark["y"]) for mark in lines["as trained"]] == [(0.05, 0.95)]
    assert len(lines["calibrated"]) == 2  # two bins of 40 answers
    assert np.mean([mark["y"] for mark in lines["calibrated"]]) == pytest.approx(0.95)
    (point,) = refused.spec["layer"][-1]["data"]["values"]
    assert (point["x"], point["y"]) == (10, 75)


def test_a_curve_states_which_fraction_of_unknown_slides_lies_below_each_threshold() -> None:
    rng = np.random.default_rng(0)
    known_scores, unknown = rng.normal(1, 1, 300), rng.normal(0, 1, 200)
    curve = probabilities.unknown_curve(known_scores, unknown)
    for at in (10, 50, 90):  # thresholds below which so many percent of known slides lie
        threshold = np.sort(known_scores)[3 * at]
        assert curve[at] == pytest.approx(np.mean(unknown < threshold), abs=1e-12)
    assert curve[0] == pytest.approx(np.mean(unknown < known_scores.min())) and curve[-1] == 1


def test_results_without_answers_have_no_such_part_and_those_without_unknown_slides_no_curve() -> None:
    assert folds(result(wrong={"biotac": 1})) == []
    base = calibrated()
    known_answers = b"\n".join(line for line in base.files["answers.csv"].splitlines() if b",false,false," not in line)
    (uncertainty_fold,) = folds(
        FakeDataset(base.recordings, {**base.files, "answers.csv": known_answers + b"\n"}, base.manifest)
    )
    assert [
        chart.title for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts
    ] == ["BioTac: RAEC independent"]
