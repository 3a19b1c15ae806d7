"""Methods that differ in one setting."""

from typing import Any

from tacpipe.comparison.runs import Method
from tacpipe.report.differences import pairs_by_setting
from tests.report import parts
from tests.tasks.forward.report import result_fakes
from tests.tasks.material.report import material_fakes

TITLE = "Effects of settings"
BOTH = {"biotac": 1, "roboskin": 2}


def method(name: str, family: str = "net", **settings: Any) -> Method:
    return Method(name, family, settings, {}, ())


def names(*methods: Method) -> list[tuple[str, str, str]]:
    return [(setting, first.name, second.name) for setting, first, second in pairs_by_setting(methods)]


def test_methods_that_differ_in_one_setting_are_paired_with_the_first_of_their_group() -> None:
    a, b, c = (method(name, width=width, deep=True) for name, width in (("a", 1), ("b", 2), ("c", 3)))
    d = method("d", width=1, deep=False)
    assert names(a, b, c, d) == [("deep", "a", "d"), ("width", "a", "b"), ("width", "a", "c")]


def test_methods_that_differ_in_two_settings_or_in_the_architecture_are_not() -> None:
    assert names(method("a", width=1, deep=True), method("b", width=2, deep=False)) == []
    assert names(method("a", width=1), method("b", "tree", width=2)) == []


def test_settings_that_only_one_of_both_has_do_not_count() -> None:
    assert names(method("a", joint=True, weight=2.0), method("b", joint=False)) == [("joint", "a", "b")]


def test_the_worth_of_the_plan_is_the_difference_to_a_model_without_it() -> None:
    ratio = {"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}
    none = {name: value + 0.125 for name, value in ratio.items()}
    section = parts.section(
        "forward",
        result_fakes.result("raw", ratio=ratio),
        result_fakes.result("raw", ratio=none, params={"actions": "none"}),
        result_fakes.result("PCA-20", ratio=2.0, params={"hidden": 1}),
    )
    known, unseen = parts.tables([parts.folds(section)[TITLE]])
    name = "actions: planned instead of none"
    model, gain, count = parts.cells(known, name)
    # the errors are 0.125 ** 0.5 and (0.625 * 0.375) ** 0.5 of persistence's, and 1 less their ratio is the gain
    assert (model, gain, count) == ("recurrent · raw", "+27.0 %", "2")
    assert parts.cells(unseen, name)[0] == "recurrent · raw"


def test_joint_learning_is_compared_with_the_same_network_alone_and_with_permuted_pairs() -> None:
    section = parts.section(
        "material",
        material_fakes.result(wrong=BOTH, joint=True),
        material_fakes.result(wrong={"biotac": 12, "roboskin": 2}),
        material_fakes.result(wrong={"biotac": 3, "roboskin": 2}, joint=True, pairing="permuted"),
        material_fakes.result("minirocket", wrong=BOTH),
    )
    biotac, roboskin = parts.tables([parts.folds(section)[TITLE]])
    assert parts.cells(biotac, "joint: yes instead of no")[1].startswith("+55.0 | ")
    assert parts.cells(biotac, "pairing: random instead of permuted")[1].startswith("+10.0 | ")
    assert parts.cells(roboskin, "joint: no instead of yes")[1].startswith("+0.0 | −")  # equal, and earlier by name


def test_one_method_has_no_such_part() -> None:
    assert TITLE not in parts.folds(parts.section("forward", result_fakes.result("raw")))
