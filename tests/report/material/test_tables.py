"""The tables against numbers worked out by hand."""

from __future__ import annotations

from typing import Any

from tacpipe.metrics.proportions import wilson
from tacpipe.report.material import grouping, reduction, tables, zero_shot
from tacpipe.report.material.methods import Method, Run
from tests.report.elements import cells
from tests.report.material.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
LEVEL = {"mean_level": {"biotac": 4, "roboskin": 8}, "permuted_labels": {"biotac": 15, "roboskin": 20}}


def grouped(*results: Any) -> list[Method]:
    return grouping.grouped([Run.read(one) for one in results])


def test_table_1_holds_the_papers_numbers_beside_ours_and_says_what_was_not_run() -> None:
    html = tables.accuracies(
        grouped(
            result("minirocket", wrong=BOTH, also=LEVEL),
            result(wrong=BOTH, joint=True, also={"last_epoch": {"biotac": 5, "roboskin": 2}}, fold=0),
            result(
                wrong={"biotac": 3, "roboskin": 2},
                joint=True,
                also={"last_epoch": {"biotac": 5, "roboskin": 2}},
                fold=1,
            ),
        )
    )
    joint = cells(html, "RAEC joint")
    assert joint[0].startswith("90.0 ± 7.1 | 36/40 · ")  # of 95 and 85
    assert joint[1:4] == ["75.0", "–", "96.01"]
    assert joint[7:] == ["93.23", "2"]
    assert cells(html, "X-LSTM") == [*["–"] * 3, "94.50", *["–"] * 3, "90.00", "0"]
    assert cells(html, "MiniRocket")[2] == "+0.750" and cells(html, "MiniRocket")[3] == "–"
    assert '<tr class="best"><td>MiniRocket' in html


def test_baselines_and_chance_close_table_1() -> None:
    html = tables.accuracies(grouped(result("minirocket", wrong=BOTH, also=LEVEL), result(wrong=BOTH)))
    assert cells(html, "mean level alone")[0].startswith("80.0 | 16/20")
    assert cells(html, "mean level alone")[2] == "+0.000"
    assert cells(html, "trained on shuffled labels")[0].startswith("25.0 | 5/20")
    assert cells(html, "chance")[0] == "25.0"  # of four materials


def test_without_any_baseline_there_is_no_number_of_one() -> None:
    html = tables.accuracies(grouped(result(wrong=BOTH)))
    assert cells(html, "mean level alone")[:3] == ["–", "–", "–"]


def test_table_2_tells_what_exchanging_classifiers_costs() -> None:
    html = tables.swaps(
        grouped(
            result(wrong=BOTH, joint=True, also={"swapped": {"biotac": 3, "roboskin": 2}}),
            result(wrong=BOTH, joint=True, pairing="permuted", also={"swapped": {"biotac": 2, "roboskin": 1}}),
            result("minirocket", wrong=BOTH),
        )
    )
    joint = cells(html, "RAEC joint")
    assert [joint[0][:4], joint[1][:4], joint[2]] == ["95.0", "85.0", "−10.0"]
    assert cells(html, "RAEC joint · permuted pairs")[5] == "+5.0"
    assert cells(html, "paper: RAEC joint") == ["96.01", "95.31", "−0.7", "93.23", "93.23", "+0.0", "–"]
    assert "MiniRocket" not in html
    assert tables.swaps(grouped(result("minirocket", wrong=BOTH))) == ""


def test_tables_3_and_4_stand_beside_the_papers_and_a_readout_of_as_many_slides() -> None:
    html = reduction.tables(
        grouped(
            result(wrong=BOTH, joint=True, reduce="roboskin", ratio=11, shuffle=False),
            result(wrong={"roboskin": 10}, reduce="roboskin", ratio=11, shuffle=False),
            result("minirocket", wrong={"roboskin": 5}),
            result("minirocket", wrong={"roboskin": 6}, train={"roboskin": 64}),
        )
    )
    assert "Table IV" in html and "Table III " not in html
    row = cells(html, "11 %")
    assert row[0] == "64"
    assert [cell[:5].strip() for cell in row[1:]] == ["95.0", "96.88", "90.0", "45.31", "50.0", "46.35", "70.0"]
    assert cells(html, "50 %") == ["288", "–", "96.88", "–", "86.98", "–", "82.29", "–"]
    assert reduction.tables(grouped(result(wrong=BOTH, joint=True))) == ""


def test_a_sensor_that_a_split_gave_fewer_slides_stands_in_for_one_that_learns_from_fewer_batches() -> None:
    fewer = {"biotac": 96, "roboskin": 576}
    html = reduction.tables(
        grouped(
            result(wrong=BOTH, joint=True),
            result(wrong={"biotac": 4, "roboskin": 2}, joint=True, train=fewer),
            result(wrong={"biotac": 6}, train={"biotac": 96}),
            result(wrong={"biotac": 1}),
            result(wrong={"biotac": 8, "roboskin": 2}, joint=True, train=dict.fromkeys(BOTH, 96)),
        )
    )
    assert "Table III" in html and "Table IV" not in html
    assert [cell[:5].strip() for cell in cells(html, "17 %")] == [
        "96",
        "80.0",
        "77.08",
        "90.0",
        "91.67",
        "70.0",
        "78.65",
        "–",
    ]


def test_paired_comparisons_tell_points_disagreements_and_tests() -> None:
    html = tables.differences(
        grouped(
            *(result(wrong={"biotac": wrong}, joint=True, fold=wrong) for wrong in (1, 2)),
            *(result(wrong={"biotac": 6}, fold=fold) for fold in (1, 2)),
        )
    )
    row = cells(html, "BioTac: RAEC joint − RAEC independent")
    assert row[0].startswith("+22.5 | ")
    # slides that one of two joint runs names right count as right, and the five others only the joint one does
    assert row[1:4] == ["20", "5 : 0", "0.062"]
    assert row[5] == "2 folds"
    assert tables.differences(grouped(result("minirocket", wrong=BOTH))) == ""


def test_every_run_is_listed() -> None:
    validation: dict[str, Any] = {"use_validation": True, "validation_slides": 100}
    html = tables.every_run(
        grouped(result("minirocket", wrong=BOTH, fold=3, **validation), result(wrong={"roboskin": 4}, epochs=5))
    )
    assert cells(html, "MiniRocket") == ["3", "0", "676 + 676", "95.0", "20", "90.0", "20", "–", "–", "–"]
    assert cells(html, "RAEC independent") == ["0", "0", "576", "–", "–", "80.0", "20", "–", "5", "–"]


def test_held_out_materials_are_told_out_of_all_and_out_of_themselves() -> None:
    zero = {
        "accuracy": {"roboskin": 0.2},
        "correct": {"roboskin": 8},
        "n": {"roboskin": 40},
        "chance": {"roboskin": 0.05},
    }
    among = {
        "accuracy": {"roboskin": 0.5},
        "correct": {"roboskin": 20},
        "n": {"roboskin": 40},
        "chance": {"roboskin": 0.25},
    }
    given = [
        result(
            wrong=BOTH,
            joint=True,
            hold_out="roboskin=3,4",
            seed=seed,
            metrics={"zero_shot": {**zero, "among_held_out": among}},
        )
        for seed in (0, 1)
    ]
    html = zero_shot.table(grouped(*given))
    name = "RAEC joint · RoboSkin without 3, 4"
    assert cells(html, f"{name}, out of all")[1].startswith("20.0 ± 0.0 | 16/80")
    assert cells(html, f"{name}, out of all")[2:] == ["5.0", "2"]
    low, high = wilson(1, 4)  # two materials in two runs, a fifth of which is right
    assert cells(html, f"{name}, out of all")[1].endswith(f"· {100 * low:.1f} to {100 * high:.1f}")
    assert cells(html, f"{name}, out of those held out")[1].startswith("50.0 ± 0.0 | 40/80")
    assert zero_shot.table(grouped(result(wrong=BOTH))) == ""
