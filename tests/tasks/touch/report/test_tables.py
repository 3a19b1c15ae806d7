"""The tables against numbers worked out by hand."""

from typing import Any

from tacpipe.report.blocks import Section, Table
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import NOVEL, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
PDC: dict[str, Any] = {"targets": ("pdc_th",), "baselines": BASELINES}


def table_of(results: Section, title: str) -> Table:
    (tables,) = [
        dataset
        for dataset in parts.tables([parts.folds(results)["All methods and baselines"]])
        if dataset.title in (title, "")
    ]
    return tables


def test_errors_are_in_shares_and_counts_with_r2_and_what_they_rest_on() -> None:
    results = [result(off=off, seed=seed, **PDC) for seed, off in enumerate((0.04, 0.06))]
    tables = table_of(parts.section("touch", *results, result("trees", off=0.07, **PDC)), "PDC thumb, known objects")

    def of(*heads: str) -> list[str]:
        return [parts.cell(tables, "tree-ensemble", head) for head in heads]

    # √((0.04² + 0.06²)/2) of 900 counts, 1 - 0.0026/0.01
    assert of("RMSE")[0].startswith("0.05099 | ")
    assert of("RMSE (counts)", "R²", "sd over seeds", "grasps", "runs") == ["45.89", "0.74", "0.0141", "24", "2"]
    assert tables.groups[0].rows[0].kind == "best"


def test_baselines_have_their_group_and_other_ones_rows_of_their_own() -> None:
    results = result("pointnet", targets=("pdc_th",), baselines={**BASELINES, "trees": 0.03})
    tables = table_of(parts.section("touch", results), "PDC thumb, known objects")

    def of(name: str) -> list[str]:
        return [parts.cell(tables, name, head).split(" | ")[0] for head in ("RMSE", "R²")]

    assert of("constant") == ["0.1", "0"] and of("mean of the object") == ["0.08", "0.36"]
    assert of("mean of the nearest in time")[0] == "0.09" and of("trees")[0] == "0.03"
    assert {parts.text(row.cells[0]) for row in tables.groups[-1].rows} == {
        "constant", "mean of the object", "mean of the nearest in time", "trees"
    }  # fmt: skip


def test_each_object_has_its_error_next_to_its_mean_and_novel_ones_have_none() -> None:
    off = {"bleach": 0.02, "coffee": 0.05, "spam": 0.2, "drill": 0.11, "shoe": 0.05}
    section = parts.section("touch", result(off=off, novel=NOVEL, **PDC))
    known, novel = parts.tables([parts.folds(section)["By object"]])
    bleach, spam = parts.cells(known, "bleach"), parts.cells(known, "spam")
    assert bleach[:4] == ["8", "0.02", "0.08", "0.1"] and bleach[4].startswith("+0.800")
    assert spam[1] == "0.2" and spam[4].startswith("−1.000")
    assert parts.cells(novel, "drill")[1:2] == ["0.11"]


def test_every_run_is_listed() -> None:
    tables = parts.section("touch", result(novel=NOVEL, targets=("pdc_th",), seed=3, train=412))
    (table,) = parts.tables([parts.folds(tables)["Every run"]])
    row = parts.cells(table, "tree-ensemble")
    assert row[1:3] == ["3", "0.05"] and row[-3:] == ["–", "random", "412"]
