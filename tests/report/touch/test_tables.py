"""The tables against numbers worked out by hand."""

from __future__ import annotations

from html import unescape
from typing import Any

from tacpipe.report.touch import forms, generalisation, tables
from tacpipe.report.touch.methods import Method, Run, grouped, groups
from tests.report.elements import cells
from tests.report.touch.touch_fakes import NOVEL, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
PDC: dict[str, Any] = {"targets": ("pdc_th",), "baselines": BASELINES}


def methods(*results: Any) -> list[Method]:
    return grouped([Run.read(one) for one in results])


def test_errors_stand_in_shares_and_counts_with_skill_r2_and_what_they_rest_on() -> None:
    given = [result(off=off, seed=seed, **PDC) for seed, off in enumerate((0.04, 0.06))]
    (group,) = groups(methods(*given, result("trees", off=0.07, **PDC)))
    html = tables.errors(group, True)
    row = cells(html, "tree-ensemble")
    assert row[:3] == ["0.0510", "46", "0.74"]  # √((0.04² + 0.06²)/2) of 900 counts, 1 - 0.0026/0.01
    assert row[3].startswith("+0.490")
    assert [one.replace("\N{NO-BREAK SPACE}", " ") for one in row[4:]] == [
        "0.0500 ± 0.0141",
        "0.0500",
        "45",
        "24",
        "2",
    ]
    assert '<tr class="best"><td>tree-ensemble' in html
    assert tables.errors(group, False) == ""


def test_every_table_has_the_baselines_that_must_be_beaten_even_where_no_result_holds_them() -> None:
    (group,) = groups(methods(result(**PDC)))
    html = tables.errors(group, True)
    assert cells(html, "constant: the mean of training")[:4] == ["0.1000", "90", "0.00", "+0.000"]
    assert cells(html, "mean of the object")[:4] == ["0.0800", "72", "0.36", "+0.200"]
    assert cells(html, "mean of the nearest in time")[0] == "0.0900"
    (bare,) = groups(methods(result(targets=("pdc_th",))))
    assert set(cells(tables.errors(bare, True), "mean of the object")) == {"–"}


def test_other_baselines_have_rows_of_their_own() -> None:
    given = result("pointnet", targets=("pdc_th",), baselines={"trees": 0.03})
    html = tables.errors(groups(methods(given))[0], True)
    assert cells(html, "trees")[0] == "0.0300"


def test_each_object_is_told_beside_its_mean_and_novel_ones_have_none() -> None:
    off = {"bleach": 0.02, "coffee": 0.05, "spam": 0.2, "drill": 0.11, "shoe": 0.05}
    html = tables.by_object(groups(methods(result(off=off, novel=NOVEL, **PDC)))[0])
    assert cells(html, "bleach") == ["8", "0.0200 | 0.0800", "+0.800"]
    assert cells(html, "spam") == ["8", "0.2000 | 0.0800", "−1.000"]
    assert cells(html, "drill (novel)") == ["8", "0.1100", "−0.100"]


def test_every_run_is_listed_on_known_and_on_novel_objects() -> None:
    html = tables.every_run(methods(result(novel=NOVEL, targets=("pdc_th",), seed=3, train=412)))
    assert "The run" in html
    assert cells(html, "tree-ensemble")[:7] == ["random", "3", "412", "known objects", "24", "0.0500", "0.75"]


def test_table_1_holds_heads_beside_the_papers_and_baselines() -> None:
    given = [
        result("pointnet", head=head, off=off, seed=seed, epochs=3, **PDC)
        for head, offs in {"fc1": (0.06, 0.08), "fc3": (0.04,)}.items()
        for seed, off in enumerate(offs)
    ]
    html = forms.section(methods(*given)).replace("\N{NO-BREAK SPACE}", " ")
    assert html.count("<h4>") == 1
    row = cells(html, "FC1: 1024")
    assert row[:2] == ["0.0700 ± 0.0141", "63"]
    assert row[-3:] == ["24", "2", "0.02598 ± 0.00043"]
    assert cells(html, "FC2: 1024-512") == [*["–"] * 6, "0.02586 ± 0.00084"]
    assert '<tr class="best"><td>FC3' in html
    assert cells(html, "mean of the object")[0].startswith("0.0800")
    assert "3 runs: paper schedule (250 epochs in batches of 10, learning rate 0.01). Trained on 100 grasps." in html


def test_a_table_of_one_row_and_one_of_other_networks_is_not_told() -> None:
    assert forms.section(methods(result("pointnet", **PDC), result(head="fc1", **PDC))) == ""
    both = [result("pointnet", head="fc1", epochs=9, **PDC), result("pointnet", head="fc2", points=250, **PDC)]
    assert forms.section(methods(*both)) == ""  # they differ in more than the head


def test_only_runs_on_the_same_split_are_rows_of_one_table() -> None:
    given = [result("pointnet", head=f"fc{n}", split=f"split {n}", **PDC) for n in (1, 2)]
    assert forms.section(methods(*given)) == ""


def test_a_quick_schedule_is_told_beside_the_papers() -> None:
    given = [result("pointnet", head=head, **{**PDC, "epochs": 3}) for head in ("fc1", "fc2")]
    for one in given:
        one.files["config.json"] = one.files["config.json"].replace(b'"epochs": 250', b'"epochs": 30')
    assert "2 runs: quick (30 epochs in batches of 10, learning rate 0.01; the paper: 250, 10, 0.01)" in forms.section(
        methods(*given)
    )


def test_table_2_holds_numbers_of_points_beside_the_papers() -> None:
    html = forms.section(methods(*(result("pointnet", points=points, **PDC) for points in (250, 750))))
    html = html.replace("\N{NO-BREAK SPACE}", " ")
    assert cells(html, "250 points")[-2:] == ["1", "0.03010 ± 0.00105"]
    assert cells(html, "500 points")[-2:] == ["–", "0.02790 ± 0.00115"]


def test_tables_3_and_4_and_figure_9_vary_one_setting_each() -> None:
    given = [
        result("pointnet", **PDC),
        *(result("pointnet", normalisation=name, wrist="estimated", **PDC) for name in ("none", "wrist")),
        *(result("pointnet", rotation_deg=angle, **PDC) for angle in (45.0, 180.0)),
        *(result("pointnet", inputs=name, wrist="estimated", **PDC) for name in ("xyz", "rgbpose")),
    ]
    html = forms.section(methods(*given))
    assert [name in html for name in ("Table I ", "Table II ", "Table III ", "Table IV ", "Figure 9 ")] == [
        False,
        False,
        True,
        True,
        True,
    ]
    assert cells(html, "±180°")[-2] == "1" and cells(html, "±90°")[-2] == "–"
    assert cells(html, "RGBPose")[-1] == "1" and cells(html, "XYZPose")[-1] == "–"
    assert cells(html, "wrist frame")[-2] == "1"
    assert html.count("it is estimated from the two contacts") == 2  # with pose, and in the wrist frame
    assert html.count("<svg") == 1


def test_simulated_tables_say_so() -> None:
    html = forms.section(methods(*(result("pointnet", head=f"fc{n}", simulated=True, **PDC) for n in (1, 2))))
    assert "(simulated)" in html and "nothing here is evidence about a real sensor" in html


def test_figures_10_and_11_tell_known_beside_novel_objects_and_the_change() -> None:
    off = {"bleach": 0.04, "coffee": 0.04, "spam": 0.04, "drill": 0.06, "shoe": 0.06}
    html = generalisation.section(methods(result("pointnet", off=off, novel=NOVEL, baselines=BASELINES)))
    row = cells(html, "PDC thumb")
    assert row[0] == "0.0400 | 36 counts"
    assert row[3] == "0.0600 | 54 counts"
    assert row[6:] == ["+50", "0.05496 | 49 counts", "0.08289 | 74 counts", "+51"]
    assert cells(html, "electrodes middle finger")[-3:] == ["0.05922 | 195 counts", "0.10317 | 340 counts", "+74"]
    assert cells(html, "· nearest in time" if "· nearest in time" in html else "· mean of the nearest in time")[0]
    assert "Evaluated on 24 grasps of known and 16 of novel objects." in html
    assert "The paper's columns are of RGBPose, trained on 9,000 grasps" in unescape(html)


def test_known_and_novel_objects_may_come_from_other_splits_of_the_same_network() -> None:
    two = ("pdc_th", "pdc_mf")
    known = result("pointnet", split="folds", targets=two)
    novel = result("pointnet", split="all known", known=(), novel=NOVEL, off=0.06, targets=two)
    assert cells(generalisation.section(methods(known, novel)), "PDC thumb")[6] == "+20"
    other = result("pointnet", split="all known", known=(), novel=NOVEL, head="fc1", targets=two)
    assert generalisation.section(methods(known, other)) == ""


def test_one_target_alone_is_no_table_of_targets() -> None:
    assert generalisation.section(methods(result("pointnet", novel=NOVEL, **PDC))) == ""
