"""Which results are runs of one method."""

from __future__ import annotations

from typing import Any

from tacpipe.report.forward import methods
from tacpipe.report.forward.methods import Method, Run
from tests.report.forward.result_fakes import result


def grouped(*results: Any) -> dict[str, Method]:
    return {one.name: one for one in methods.grouped([Run.read(each) for each in results])}


def test_runs_that_differ_in_their_seed_alone_are_one_method() -> None:
    found = grouped(*(result(codec, seed) for seed in (0, 1) for codec in ("raw", "PCA-20")))
    assert {name: len(one.runs) for name, one in found.items()} == {"recurrent · raw": 2, "recurrent · PCA-20": 2}


def test_baselines_that_were_fitted_beside_a_model_make_no_other_method() -> None:
    found = grouped(*(result("raw", seed, params={"baselines": seed == 0}) for seed in (0, 1)))
    assert {name: len(one.runs) for name, one in found.items()} == {"recurrent · raw": 2}


def test_a_name_tells_only_what_tells_methods_apart() -> None:
    found = grouped(
        result("raw", params={"hidden": 100}),
        result("raw", params={"hidden": 200}),
        result("PCA-20", params={"hidden": 50}),
        result("PCA-20", params={"hidden": 50, "actions": "none"}),
        result("PCA-20", params={"hidden": 50, "actions": "shuffled"}),
        result("PCA-20", params={"hidden": 50}, timeline="fresh"),
        result(architecture="tcn"),
    )
    assert sorted(found) == [
        "recurrent · PCA-20",
        "recurrent · PCA-20 · fresh",
        "recurrent · PCA-20 · no actions",
        "recurrent · PCA-20 · shuffled actions",
        "recurrent · raw · hidden 100",
        "recurrent · raw · hidden 200",
        "tcn · PCA-20",
    ]
    planned, none, fresh = (found[f"recurrent · PCA-20{end}"] for end in ("", " · no actions", " · fresh"))
    assert planned.key_without("actions") == none.key_without("actions") != fresh.key_without("actions")
    assert planned.key_without("timeline") == fresh.key_without("timeline") != none.key_without("timeline")


def test_the_papers_method_is_the_recurrent_one_of_twenty_components() -> None:
    given = [result("raw"), result("AE-C1-8"), result("PCA-8"), result("PCA-20"), result(architecture="tcn")]
    found = grouped(*given)
    papers = methods.papers(list(found.values()))
    assert papers is found["recurrent · PCA-20"]
    nearest = methods.papers(list(grouped(*given[:2]).values()))
    assert nearest is not None and nearest.name == "recurrent · AE-C1-8"
    assert methods.papers(list(grouped(result(architecture="tcn")).values())) is None


def test_baselines_are_told_by_the_method_with_most_runs_and_a_plan() -> None:
    found = grouped(
        result("raw", 0, params={"actions": "none"}),
        result("raw", 1, params={"actions": "none"}),
        result("raw", 0),
        result("raw", 1),
        result("PCA-20"),
    )
    assert methods.reference(list(found.values())).name == "recurrent · raw"


def test_most_runs_say_which_timeline_is_the_main_one() -> None:
    fresh, uniform, logged = (Run.read(result(timeline=name)) for name in ("fresh", "uniform", "logged"))
    assert methods.main_timeline([fresh, uniform, fresh]) == "fresh"
    assert methods.main_timeline([fresh, uniform, logged]) == "uniform"
