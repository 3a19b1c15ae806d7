"""The tables against numbers worked out by hand."""

import json
from typing import Any

from tacpipe.comparison import engine
from tacpipe.comparison.runs import Method
from tacpipe.metrics.intervals import wilson
from tacpipe.tasks.material.report.joint import difference_table, reduction_tables, swap_table, zero_shot_folds
from tests.report import parts
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
LEVEL = {"mean_level": {"biotac": 4, "roboskin": 8}, "permuted_labels": {"biotac": 15, "roboskin": 20}}


def group(*results: Any) -> list[Method]:
    return parts.methods("material", *results)


def test_accuracies_have_counts_the_last_epoch_skill_and_the_papers_numbers() -> None:
    last = {"last_epoch": {"biotac": 5, "roboskin": 2}}
    tables = parts.section(
        "material",
        result("minirocket", wrong=BOTH, also=LEVEL),
        result(wrong=BOTH, joint=True, also=last, fold=0),
        result(wrong={"biotac": 3, "roboskin": 2}, joint=True, also=last, fold=1),
    )
    table = parts.tables([parts.folds(tables)["All methods and baselines"]])[0]
    assert table.title == "BioTac"
    assert parts.cell(table, "RAEC joint", "slides named right").startswith(
        "90.0 ± 7.1 | 36/40 · "
    )  # deviation of 95 and 85
    assert parts.cell(table, "RAEC joint", "last epoch (%)") == "75.0"
    assert parts.cell(table, "RAEC joint", "paper, Table I (%)") == "96.01"
    assert parts.cell(table, "MiniRocket", "skill over the mean level") == "0.75"
    assert parts.cell(table, "mean level alone", "slides named right").startswith("80.0 | 16/20")
    assert parts.cell(table, "trained on shuffled labels", "slides named right").startswith("25.0 | 5/20")
    assert parts.cell(table, "chance", "accuracy (%)") == "25"  # one of four materials
    assert "X-LSTM: BioTac 94.50 %" in parts.words(tables)  # X-LSTM was not run


def test_without_any_baseline_chance_remains() -> None:
    (tables, *_) = engine.compare([result(wrong=BOTH)])
    assert [item.name for item in tables.of("baseline")] == ["chance"]


def test_controls_and_fewer_slides_do_not_compete() -> None:
    also = {"permuted_labels": {"biotac": 0}, "swapped": {"biotac": 0}, "last_epoch": {"biotac": 0}}
    (tables,) = engine.compare(
        [
            result("x-lstm", wrong={"biotac": 2}, also=also),
            result("x-lstm", wrong={"biotac": 0}, train={"biotac": 32}),
            result("raec", wrong={"biotac": 0}, labels="permuted"),
        ]
    )
    assert [item.name for item in tables.models] == ["X-LSTM"]
    assert [item.name for item in tables.of("baseline")] == ["chance"]
    assert {item.name for item in tables.of("control")} == {
        "trained on shuffled labels", "X-LSTM · 32 slides", "RAEC independent · permuted labels"
    }  # fmt: skip


def test_table_2_tells_what_exchanging_classifiers_costs() -> None:
    tables = swap_table(
        group(
            result(wrong=BOTH, joint=True, also={"swapped": {"biotac": 3, "roboskin": 2}}),
            result(wrong=BOTH, joint=True, pairing="permuted", also={"swapped": {"biotac": 2, "roboskin": 1}}),
            result("minirocket", wrong=BOTH),
        )
    )
    assert tables is not None
    joint = parts.cells(tables, "RAEC joint")
    assert [joint[0][:4], joint[1][:4], joint[2]] == ["95.0", "85.0", "−10.0"]
    assert parts.cells(tables, "RAEC joint · permuted pairs")[5] == "+5.0"
    assert parts.cells(tables, "paper: RAEC joint") == ["96.01", "95.31", "−0.7", "93.23", "93.23", "+0.0", "–"]
    assert "MiniRocket" not in parts.words([tables])
    assert swap_table(group(result("minirocket", wrong=BOTH))) is None


def test_tables_3_and_4_stand_beside_the_papers_and_a_readout_of_as_many_slides() -> None:
    tables = reduction_tables(
        group(
            result(wrong=BOTH, joint=True, reduce="roboskin", ratio=11, shuffle=False),
            result(wrong={"roboskin": 10}, reduce="roboskin", ratio=11, shuffle=False),
            result("minirocket", wrong={"roboskin": 5}),
            result("minirocket", wrong={"roboskin": 6}, train={"roboskin": 64}),
        )
    )
    assert [item.title.split(" in ")[0] for item in tables] == ["Table IV"]
    row = parts.cells(tables, "11 %")
    assert row[0] == "64"
    assert [cell[:5].strip() for cell in row[1:]] == ["95.0", "96.88", "90.0", "45.31", "50.0", "46.35", "70.0"]
    assert parts.cells(tables, "50 %") == ["288", "–", "96.88", "–", "86.98", "–", "82.29", "–"]
    assert reduction_tables(group(result(wrong=BOTH, joint=True))) == []


def test_heads_of_tables_3_and_4_state_epochs_that_are_fewer_than_the_papers() -> None:
    dataset = result(wrong=BOTH, joint=True, reduce="roboskin", ratio=11, shuffle=False)
    config = json.loads(dataset.files["config.json"])
    config["params"]["epochs"] = 150
    dataset.files["config.json"] = json.dumps(config).encode()
    (short,) = reduction_tables(group(dataset))
    assert [head for head in short.heads if "150 of 2,000 epochs" in head] == [
        "joint (150 of 2,000 epochs), BioTac",
        "joint (150 of 2,000 epochs), RoboSkin",
    ]
    (full,) = reduction_tables(group(result(wrong=BOTH, joint=True, reduce="roboskin", ratio=11, shuffle=False)))
    assert "epochs" not in " ".join(full.heads)


def test_a_sensor_that_a_split_gave_fewer_slides_stands_in_for_one_that_learns_from_fewer_batches() -> None:
    fewer = {"biotac": 96, "roboskin": 576}
    tables = reduction_tables(
        group(
            result(wrong=BOTH, joint=True),
            result(wrong={"biotac": 4, "roboskin": 2}, joint=True, train=fewer),
            result(wrong={"biotac": 6}, train={"biotac": 96}),
            result(wrong={"biotac": 1}),
            result(wrong={"biotac": 8, "roboskin": 2}, joint=True, train=dict.fromkeys(BOTH, 96)),
        )
    )
    assert [item.title.split(" in ")[0] for item in tables] == ["Table III"]
    assert [cell[:5].strip() for cell in parts.cells(tables, "17 %")] == [
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
    tables = difference_table(
        group(
            *(result(wrong={"biotac": wrong}, joint=True, fold=wrong) for wrong in (1, 2)),
            *(result(wrong={"biotac": 6}, fold=fold) for fold in (1, 2)),
        )
    )
    assert tables is not None
    row = parts.cells(tables, "BioTac: RAEC joint − RAEC independent")
    assert row[0].startswith("+22.5 | ")
    # slides that one of two joint runs names right count as right, and the five others only the joint one does
    assert row[1:4] == ["20", "5 : 0", "0.062"]
    assert row[5] == "2 folds"
    assert difference_table(group(result("minirocket", wrong=BOTH))) is None


def test_every_run_is_listed() -> None:
    validation: dict[str, Any] = {"use_validation": True, "validation_slides": 100}
    results = [result("minirocket", wrong=BOTH, fold=3, **validation), result(wrong={"roboskin": 4}, epochs=5)]
    (table,) = parts.tables([parts.folds(parts.section("material", *results))["Every run"]])
    assert parts.cells(table, "MiniRocket") == ["3", "0", "95", "20", "90", "20", "676 + 676", "–", "–"]
    assert parts.cells(table, "RAEC independent") == ["0", "0", "–", "–", "80", "20", "576", "–", "5"]


def test_held_out_materials_are_told_out_of_all_and_out_of_themselves() -> None:
    zero = {
        "accuracy": {"roboskin": 0.2},
        "correct": {"roboskin": 8},
        "n": {"roboskin": 40},
        "chance": {"roboskin": 0.05},
    }
    held_out = {
        "accuracy": {"roboskin": 0.5},
        "correct": {"roboskin": 20},
        "n": {"roboskin": 40},
        "chance": {"roboskin": 0.25},
    }
    results = [
        result(
            wrong=BOTH,
            joint=True,
            hold_out="roboskin=3,4",
            seed=seed,
            metrics={"zero_shot": {**zero, "among_held_out": held_out}},
        )
        for seed in (0, 1)
    ]
    tables = parts.tables(zero_shot_folds(group(*results)))
    name = "RAEC joint · RoboSkin without 3, 4"
    assert parts.cells(tables, f"{name}, out of all")[1].startswith("20.0 ± 0.0 | 16/80")
    assert parts.cells(tables, f"{name}, out of all")[2:] == ["5.0", "2"]
    low, high = wilson(0, 2)  # two materials, each once however many runs there are, a fifth of which is right
    assert parts.cells(tables, f"{name}, out of all")[1].endswith(f"· {100 * low:.1f} to {100 * high:.1f}")
    assert parts.cells(tables, f"{name}, out of those held out")[1].startswith("50.0 ± 0.0 | 40/80")
    assert zero_shot_folds(group(result(wrong=BOTH))) == []
