"""The tables against numbers worked out by hand."""

from typing import Any

from tacpipe.comparison import engine
from tacpipe.comparison.runs import Method
from tacpipe.scores.intervals import wilson
from tacpipe.tasks.material.report.pictures import zero_shot_folds
from tests.report import parts
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
LEVEL = {"mean_level": {"biotac": 4, "roboskin": 8}, "permuted_labels": {"biotac": 15, "roboskin": 20}}


def group(*results: Any) -> list[Method]:
    return parts.methods("material", *results)


def test_accuracies_have_their_interval_and_counts() -> None:
    last = {"last_epoch": {"biotac": 5, "roboskin": 2}}
    section = parts.section(
        "material",
        result("minirocket", wrong=BOTH, also=LEVEL),
        result(wrong=BOTH, joint=True, also=last, fold=0),
        result(wrong={"biotac": 3, "roboskin": 2}, joint=True, also=last, fold=1, seed=1),
    )
    table = parts.tables([parts.folds(section)["All methods and baselines"]])[0]
    assert table.title == "BioTac"
    accuracies = {
        parts.text(row.cells[0]): parts.text(row.cells[1]).split(" | ")[0]
        for group in table.groups
        for row in group.rows
    }
    assert accuracies == {
        "MiniRocket": "95",
        "RAEC joint": "90",  # 95 and 85
        "mean level alone": "80",
        "chance": "25",  # one of four materials
        "RAEC joint · last epoch": "75",
        "trained on shuffled labels": "25",
    }
    assert [parts.cell(table, "RAEC joint", head) for head in ("sd over seeds", "slides", "runs")] == [
        "7.07",
        "20",
        "2",
    ]


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


def test_every_run_is_listed() -> None:
    validation: dict[str, Any] = {"use_validation": True, "validation_slides": 100}
    results = [result("minirocket", wrong=BOTH, fold=3, **validation), result(wrong={"roboskin": 4}, epochs=5)]
    (table,) = parts.tables([parts.folds(parts.section("material", *results))["Every run"]])
    assert parts.cells(table, "MiniRocket") == ["3", "0", "95", "20", "90", "20", "–", "576 + 576"]
    assert parts.cells(table, "RAEC independent") == ["0", "0", "–", "–", "80", "20", "5", "576"]


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
    assert parts.cells(tables, f"{name}, out of all")[1].startswith("20.0 | ")
    assert parts.cells(tables, f"{name}, out of all")[2:] == ["5.0", "2"]
    low, high = wilson(0, 2)  # two materials, each once however many runs there are, a fifth of which is right
    assert parts.cells(tables, f"{name}, out of all")[1].endswith(f"{100 * low:.1f} to {100 * high:.1f}, 16/80")
    assert parts.cells(tables, f"{name}, out of those held out")[1].startswith("50.0 | ")
    assert zero_shot_folds(group(result(wrong=BOTH))) == []
