"""Results are grouped into methods, which get names."""

from typing import Any

from tacpipe.comparison import engine
from tacpipe.comparison.runs import Method
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import result


def methods(*results: Any) -> list[Method]:
    return parts.methods("touch", *results)


def test_runs_that_differ_in_seed_words_or_other_networks_targets_are_one_method() -> None:
    method_list = methods(
        result("patches", seed=0),
        result("patches", seed=1, setting="random"),
        result("patches", seed=2, baselines={}),
        result("patches", targets=("pdc_th",)),
    )
    assert [(method.name, len(method.runs)) for method in method_list] == [("patches", 4)]


def test_options_that_another_architecture_has_set_no_method_apart() -> None:
    method_list = methods(
        result(trees=300), result(trees=300, points=64, head="fc1"), result(trees=300, wrist="estimated")
    )
    assert [(method.name, len(method.runs)) for method in method_list] == [("tree-ensemble", 3)]


def test_one_network_for_other_targets_is_another_method() -> None:
    method_list = methods(result(together=True), result(together=True), result(together=True, targets=("pdc_th",)))
    assert [method.name for method in method_list] == ["tree-ensemble", "tree-ensemble · targets pdc_th"]


def test_a_name_tells_what_sets_a_method_apart_from_most_of_its_architecture() -> None:
    method_list = methods(
        *(result("pointnet", head=head) for head in ("fc3", "fc1")),
        result("pointnet", points=250),
        result("pointnet", transform=False),
        result("trees", head="fc6"),
    )
    assert [method.name for method in method_list] == [
        "PointNet",
        "PointNet · head fc1",
        "PointNet · no transform",
        "PointNet · points 250",
        "trees on geometry and colour",
    ]


def test_a_name_states_that_the_papers_network_was_trained_for_fewer_epochs_than_in_the_paper() -> None:
    given = [result("pointnet", **options) for options in ({}, {"head": "fc1"}, {"published": False}, {"points": 250})]
    for short in given[1:3]:
        short.files["config.json"] = short.files["config.json"].replace(b'"epochs": 250', b'"epochs": 15')
    assert [one.name for one in methods(*given)] == [  # also on recordings that are not the paper's
        "PointNet (15 of 250 epochs) · head fc1",
        "PointNet (15 of 250 epochs) · head fc3",
        "PointNet · points 250",
        "PointNet · points 750",
    ]


def test_trees_are_called_by_whether_they_read_colour_and_others_say_where_they_do_not() -> None:
    kinds = ("strong", "trees", "patches")  # stored names
    method_list = methods(*(result(kind, inputs=inputs) for kind in kinds for inputs in ("rgbcont", "xyzcont", "xyz")))
    assert [(method.name, len(method.runs)) for method in method_list] == [
        ("patches", 1),
        ("patches · without colour", 2),  # contacts are read whatever the inputs
        ("tree-ensemble", 1),
        ("tree-ensemble · without colour", 2),
        ("trees on geometry", 2),
        ("trees on geometry and colour", 1),
    ]
    assert [method.name for method in methods(result(inputs="xyz"))] == ["tree-ensemble · without colour"]  # alone, too
    assert [
        method.name for method in methods(result("pointnet", inputs="xyz"), result("pointnet"), result("pointnet"))
    ] == [
        "PointNet",
        "PointNet · inputs xyz",
    ]


def test_marks_of_other_settings_come_behind_the_colour() -> None:
    method_list = methods(result(leaf=0), *(result(inputs="xyz", leaf=leaf) for leaf in (0, 4)))
    assert [method.name for method in method_list] == [
        "tree-ensemble",
        "tree-ensemble · without colour · leaf 0",
        "tree-ensemble · without colour · leaf 4",
    ]


def test_the_wrist_makes_a_method_only_where_it_is_read() -> None:
    pairs = [("rgbcont", "given"), ("rgbcont", "estimated"), ("rgbpose", "given"), ("rgbpose", "estimated")]
    method_list = methods(*(result("pointnet", inputs=inputs, wrist=wrist) for inputs, wrist in pairs))
    assert sorted(len(method.runs) for method in method_list) == [1, 1, 2]


def test_each_split_is_a_question_of_its_own_recorded_grasps_first() -> None:
    comparisons = engine.compare(
        [
            *(result("pointnet", split="folds", seed=seed, targets=("pdc_th",)) for seed in range(5)),
            result(split="random"),
            result("trees", split="random"),
            result(simulated=True),
        ]
    )
    rows = {comparison.question.part: {row.name for row in comparison.models} for comparison in comparisons}
    assert rows == {
        "known objects, random": {"tree-ensemble", "trees on geometry and colour"},
        "known objects, folds": {"PointNet"},
        "known objects, random, simulated": {"tree-ensemble"},
    }
    assert list(rows) == ["known objects, random", "known objects, folds", "known objects, random, simulated"]
