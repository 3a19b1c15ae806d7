"""The tables against numbers worked out by hand."""

from typing import Any

from tacpipe.comparison.runs import Method
from tacpipe.report.blocks import Section, Table
from tacpipe.tasks.touch.report import paper
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import NOVEL, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
PDC: dict[str, Any] = {"targets": ("pdc_th",), "baselines": BASELINES}


def methods(*results: Any) -> list[Method]:
    return parts.methods("touch", *results)


def table_of(results: Section, title: str) -> Table:
    (tables,) = [
        dataset
        for dataset in parts.tables([parts.folds(results)["All methods and baselines"]])
        if dataset.title in (title, "")
    ]
    return tables


def test_errors_are_in_shares_and_counts_with_skill_r2_and_what_they_rest_on() -> None:
    results = [result(off=off, seed=seed, **PDC) for seed, off in enumerate((0.04, 0.06))]
    tables = table_of(parts.section("touch", *results, result("trees", off=0.07, **PDC)), "PDC thumb, known objects")

    def of(*heads: str) -> list[str]:
        return [parts.cell(tables, "tree-ensemble", head) for head in heads]

    # √((0.04² + 0.06²)/2) of 900 counts, 1 - 0.0026/0.01
    assert of("RMSE", "RMSE (counts)", "R²") == ["0.05099", "45.89", "0.74"]
    assert of("skill over the constant")[0].startswith("+0.490")
    assert of("RMSE over runs", "batch mean", "MAE (counts)", "grasps", "runs") == [
        "0.0500 ± 0.0141", "0.0500", "45", "24", "2"
    ]  # fmt: skip
    assert tables.groups[0].rows[0].kind == "best"


def test_baselines_have_their_group_and_other_ones_rows_of_their_own() -> None:
    results = result("pointnet", targets=("pdc_th",), baselines={**BASELINES, "trees": 0.03})
    tables = table_of(parts.section("touch", results), "PDC thumb, known objects")
    heads = ("RMSE", "R²", "skill over the constant")
    assert [parts.cell(tables, "constant", head) for head in heads] == ["0.1", "0.00", "+0.000"]
    assert [parts.cell(tables, "mean of the object", head).split(" | ")[0] for head in heads] == [
        "0.08",
        "0.36",
        "+0.200",
    ]
    assert parts.cell(tables, "mean of the nearest in time", "RMSE") == "0.09"
    assert parts.cell(tables, "trees", "RMSE") == "0.03"
    assert {parts.text(row.cells[0]) for row in tables.groups[-1].rows} == {
        "constant", "mean of the object", "mean of the nearest in time", "trees"
    }  # fmt: skip


def test_each_object_is_told_beside_its_mean_and_novel_ones_have_none() -> None:
    off = {"bleach": 0.02, "coffee": 0.05, "spam": 0.2, "drill": 0.11, "shoe": 0.05}
    (tables,) = paper.tables_by_object(methods(result(off=off, novel=NOVEL, **PDC)))
    assert parts.cells(tables, "bleach") == ["8", "0.0200 | 0.0800", "+0.800"]
    assert parts.cells(tables, "spam") == ["8", "0.2000 | 0.0800", "−1.000"]
    assert parts.cells(tables, "drill (novel)") == ["8", "0.1100", "−0.100"]


def test_every_run_is_listed() -> None:
    tables = parts.section("touch", result(novel=NOVEL, targets=("pdc_th",), seed=3, train=412))
    (table,) = parts.tables([parts.folds(tables)["Every run"]])
    row = parts.cells(table, "tree-ensemble")
    assert row[1:3] == ["3", "0.05"] and "412" in row and "random" in row
    assert "PDC thumb, known objects: 0.75" in row[-1]


def test_table_1_holds_heads_beside_the_papers_and_baselines() -> None:
    results = [
        result("pointnet", head=head, off=off, seed=seed, epochs=3, **PDC)
        for head, offs in {"fc1": (0.06, 0.08), "fc3": (0.04,)}.items()
        for seed, off in enumerate(offs)
    ]
    given_parts = paper.setting_tables(methods(*results))
    (tables,) = parts.tables(given_parts)
    row = parts.cells(tables, "FC1: 1024")
    assert row[:2] == ["0.0700 ± 0.0141", "63"]
    assert row[-3:] == ["24", "2", "0.02598 ± 0.00043"]
    assert parts.cells(tables, "FC2: 1024-512") == [*["–"] * 6, "0.02586 ± 0.00084"]
    assert [parts.text(row.cells[0])[:3] for row in tables.rows if row.kind == "best"] == ["FC3"]
    assert parts.cells(tables, "mean of the object")[0].startswith("0.0800")
    assert (
        "3 runs: paper schedule (250 epochs in batches of 10, learning rate 0.01). Trained on 100 grasps."
        in parts.words(given_parts)
    )


def test_a_table_of_one_row_and_one_of_other_networks_is_not_told() -> None:
    assert paper.setting_tables(methods(result("pointnet", **PDC), result(head="fc1", **PDC))) == []
    two_results = [result("pointnet", head="fc1", epochs=9, **PDC), result("pointnet", head="fc2", points=250, **PDC)]
    assert paper.setting_tables(methods(*two_results)) == []  # they differ in more than the head


def test_only_runs_on_the_same_split_are_rows_of_one_table() -> None:
    results = [result("pointnet", head=f"fc{n}", split=f"split {n}", **PDC) for n in (1, 2)]
    assert paper.setting_tables(methods(*results)) == []


def test_a_quick_schedule_is_told_beside_the_papers() -> None:
    results = [result("pointnet", head=head, **{**PDC, "epochs": 3}) for head in ("fc1", "fc2")]
    for dataset in results:
        dataset.files["config.json"] = dataset.files["config.json"].replace(b'"epochs": 250', b'"epochs": 30')
    assert "2 runs: quick (30 epochs in batches of 10, learning rate 0.01; the paper: 250, 10, 0.01)" in parts.words(
        paper.setting_tables(methods(*results))
    )


def test_table_2_holds_numbers_of_points_beside_the_papers() -> None:
    tables = parts.tables(
        paper.setting_tables(methods(*(result("pointnet", points=points, **PDC) for points in (250, 750))))
    )
    assert parts.cells(tables, "250 points")[-3:] == ["1", "0.03010 ± 0.00105", "8"]
    assert parts.cells(tables, "500 points")[-3:] == ["–", "0.02790 ± 0.00115", "14"]


def test_tables_3_and_4_and_figure_9_vary_one_setting_each() -> None:
    results = [
        result("pointnet", **PDC),
        *(result("pointnet", normalisation=name, wrist="estimated", **PDC) for name in ("none", "wrist")),
        *(result("pointnet", rotation_deg=angle, **PDC) for angle in (45.0, 180.0)),
        *(result("pointnet", inputs=name, wrist="estimated", **PDC) for name in ("xyz", "rgbpose")),
    ]
    blocks = paper.setting_tables(methods(*results))
    tables, text = parts.tables(blocks), parts.words(blocks)
    assert [name in text for name in ("Table I ", "Table II ", "Table III ", "Table IV ", "Figure 9 ")] == [
        False,
        False,
        True,
        True,
        True,
    ]
    assert parts.cells(tables, "±180°")[-2] == "1" and parts.cells(tables, "±90°")[-2] == "–"
    assert parts.cells(tables, "RGBPose")[-1] == "1" and parts.cells(tables, "XYZPose")[-1] == "–"
    assert parts.cells(tables, "wrist frame")[-2] == "1"
    assert text.count("it is estimated from the two contacts") == 2  # modes with pose, and the wrist frame
    assert len(parts.charts(blocks)) == 1


def test_simulated_tables_say_so() -> None:
    text = parts.words(
        paper.setting_tables(methods(*(result("pointnet", head=f"fc{n}", simulated=True, **PDC) for n in (1, 2))))
    )
    assert "(simulated)" in text and "so the results are not evidence about real sensors" in text


def test_figures_10_and_11_tell_known_beside_novel_objects_and_the_change() -> None:
    off = {"bleach": 0.04, "coffee": 0.04, "spam": 0.04, "drill": 0.06, "shoe": 0.06}
    blocks = paper.generalisation_tables(methods(result("pointnet", off=off, novel=NOVEL, baselines=BASELINES)))
    tables, text = parts.tables(blocks), parts.words(blocks)
    row = parts.cells(tables, "PDC thumb")
    assert row[0] == "0.0400 | 36 counts"
    assert row[3] == "0.0600 | 54 counts"
    assert row[6:] == ["+50", "0.05496 | 49 counts", "0.08289 | 74 counts", "+51"]
    assert parts.cells(tables, "electrodes middle finger")[-3:] == [
        "0.05922 | 195 counts",
        "0.10317 | 340 counts",
        "+74",
    ]
    assert "Evaluated on 24 grasps of known and 16 of novel objects." in text
    assert "The columns of the paper are for RGBPose, trained on 9,000 grasps" in text


def test_known_and_novel_objects_may_come_from_other_splits_of_the_same_network() -> None:
    two = ("pdc_th", "pdc_mf")
    known_result = result("pointnet", split="folds", targets=two)
    novel = result("pointnet", split="all known", known=(), novel=NOVEL, off=0.06, targets=two)
    assert parts.cells(parts.tables(paper.generalisation_tables(methods(known_result, novel))), "PDC thumb")[6] == "+20"
    other_result = result("pointnet", split="all known", known=(), novel=NOVEL, head="fc1", targets=two)
    assert paper.generalisation_tables(methods(known_result, other_result)) == []


def test_one_target_alone_is_no_table_of_targets() -> None:
    assert paper.generalisation_tables(methods(result("pointnet", novel=NOVEL, **PDC))) == []
