"""The whole section of materials, and the numbers that go into its charts."""

from typing import Any

import pytest

from tacpipe.comparison.runs import Method
from tacpipe.report import context
from tacpipe.report.blocks import Section
from tacpipe.scores.intervals import wilson
from tacpipe.tasks.material.report import SESSIONS, pictures
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.material.report import material_fakes
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}


def group(*results: Any) -> list[Method]:
    return parts.methods("material", *results)


def all_results(**kind: Any) -> list[Any]:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}, "permuted_labels": {"biotac": 15, "roboskin": 20}}
    joint = {**level, "swapped": BOTH, "last_epoch": BOTH}
    results = []
    for fold in (0, 1):
        options: dict[str, Any] = {"fold": fold, "epochs": 3, **kind}
        results += [
            result("minirocket", wrong=BOTH, also=level, fold=fold, **kind),
            result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, 64), fold=fold, **kind),
            result("x-lstm", wrong=BOTH, **options),
            result(wrong={"biotac": 2 + fold}, **options),
            result(wrong={"roboskin": 3}, **options),
            result(wrong=BOTH, also=joint, joint=True, **options),
            result(wrong=BOTH, also=joint, joint=True, pairing="permuted", partners=PARTNERS, **options),
            result(wrong={"roboskin": 3}, known="biotac", **options),
        ]
    return [*results, result(wrong=BOTH, joint=True, reduce="biotac", ratio=25, shuffle=False, epochs=3, **kind)]


@pytest.fixture(scope="module")
def full_section() -> Section:
    return parts.section("material", *all_results(), others=[material_fakes.recorded()])


def test_the_first_screen_is_about_both_sensors(full_section: Section) -> None:
    assert (
        "BioTac" in full_section.sentence
        and "RoboSkin" in full_section.sentence
        and "20 slides" in full_section.sentence
    )
    assert full_section.table is not None and len(full_section.table.rows) <= 7
    assert full_section.counts == ["8 methods", "17 results", "40 slides"]


def test_all_that_there_is_has_its_fold(full_section: Section) -> None:
    assert list(parts.folds(full_section)) == [
        "All methods and baselines", "Effects of settings", "The paper's own numbers", "Which materials are confused",
        "Training", "Recordings", "Every run", "Basis and limits", "Where it comes from",
    ]  # fmt: skip
    text = parts.words(full_section)
    for sentence in ("Table II", "Table III", "pairing: random instead of permuted", "cd" * 32):
        assert sentence in text, sentence


@pytest.mark.parametrize("simulated", [False, True])
def test_a_labs_own_slides_get_nothing_that_the_paper_states_of_its_own(simulated: bool) -> None:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}, "swapped": BOTH}
    options: dict[str, Any] = {"published": False, "simulated": simulated, "sessions": 2}
    results = [
        result("minirocket", wrong=BOTH, also=level, **options),
        result(wrong=BOTH, also=level, joint=True, epochs=3, **options),
        result(wrong=BOTH, also=level, joint=True, reduce="biotac", ratio=25, epochs=3, **options),
    ]
    section = parts.section("material", *results)
    text = parts.words(section)
    for sentence in ("paper", "192 slides", "one session", "mapping to known space", "X-LSTM", "Figure"):
        assert sentence not in text, sentence
    assert (section.simulated, text.count(context.SIMULATED)) == (simulated, int(simulated))


@pytest.mark.parametrize(("sessions", "sentence"), [(1, True), (2, False)])
def test_that_each_material_has_one_session_is_stated_where_it_is_so(sessions: int, sentence: bool) -> None:
    results = result("minirocket", wrong=BOTH, published=False, sessions=sessions)
    assert (SESSIONS in parts.words(parts.section("material", results))) == sentence


def test_one_result_alone_has_no_comparison_of_methods() -> None:
    section = parts.section("material", result("minirocket", wrong={"biotac": 1}))
    assert "Effects of settings" not in parts.folds(section) and "MiniRocket" in section.sentence


def test_results_that_are_all_variants_have_no_best_method() -> None:
    results = [result(wrong=BOTH, labels="permuted"), result(wrong=BOTH, joint=True, pairing="permuted")]
    section = parts.section("material", *results)
    assert (section.sentence, section.table) == ("", None)
    assert "RAEC joint · permuted pairs" in parts.words(section)


def test_a_result_without_unseen_slides_is_reported_as_its_metrics_name_it() -> None:
    results = result("minirocket", wrong=BOTH, metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, results.files, results.manifest)
    assert parts.cells(parts.tables(parts.section("material", bare)), "seen, n") == ["7"]


def test_confusions_are_counted_over_runs() -> None:
    (method,) = group(result(wrong={"biotac": 2}, fold=0), result(wrong={"biotac": 1}, fold=1))
    counts, materials = pictures.count_confusions(method, "biotac")
    assert materials == [1, 2, 3, 4]
    # the fakes take the first slide of material 1 for 2 in both runs, and that of 2 for 3 in one
    assert counts.tolist() == [[8, 2, 0, 0], [0, 9, 1, 0], [0, 0, 10, 0], [0, 0, 0, 10]]


def test_confusion_matrices_hold_every_count_of_the_best_method() -> None:
    drawn = parts.charts(
        pictures.confusion_folds(
            parts.context("material", result("minirocket", wrong={"biotac": 1}), result(wrong=BOTH, joint=True))
        )
    )
    assert [item.title for item in drawn] == ["BioTac: MiniRocket", "RoboSkin: RAEC joint"]
    assert "orange: wrong" in drawn[0].caption
    cells = {(row["row"], row["column"]): (row["count"], row["right"]) for row in parts.values(drawn[0])}
    assert cells == {("1", "1"): (4, True), ("1", "2"): (1, False), **{(n, n): (5, True) for n in "234"}}


BEFORE = {"calibration_error": 0.9, "log_loss": 3.0, "reliability": [{"n": 20, "confidence": 0.05, "accuracy": 0.95}]}
AFTER = {"calibration_error": 0.02, "log_loss": 0.1, "reliability": [{"n": 20, "confidence": 0.94, "accuracy": 0.95}]}
UNKNOWN = {
    "rule": "distance",
    **{"false_unknown": 0.1, "false_unknown_n": 20, "false_unknown_low": 0.028, "false_unknown_high": 0.301},
    **{"false_known": 0.25, "false_known_n": 8, "accuracy_of_answers": 1.0},
    "auroc": {"probability": 0.7, "distance": 0.9},
}


def calibrated(**options: Any) -> Any:
    """A result with calibrated probabilities of 20 slides, and answers on slides of a material that was left out."""
    measured = {"n": 20, "temperature": 0.1, "before": BEFORE, "after": AFTER}
    tree = {"calibration": {"biotac": measured}, "unknown": {"biotac": UNKNOWN}}
    return result(wrong={"biotac": 1}, metrics=tree, **options)


def test_probabilities_and_the_answer_unknown_are_those_of_the_median_run() -> None:
    fold = parts.folds(parts.section("material", calibrated(seed=0), calibrated(seed=1)))["Uncertainty"]
    (table,) = parts.tables([fold])
    assert parts.cells(table, "BioTac: RAEC independent") == [
        "0.02 | before: 0.9", "0.1 | before: 3", "10.0 | 2.8 to 30.1, of 20", "25.0 | of 8", "0.9", "100"
    ]  # fmt: skip
    (chart,) = parts.charts([fold])
    points = {(row["name"], row["x"], row["y"]) for row in parts.values(chart)}
    assert points == {("calibrated", 0.94, 0.95), ("as trained", 0.05, 0.95)}
    bands = [(row["low"], row["high"]) for row in parts.values(chart) if "low" in row]
    assert bands == [pytest.approx(wilson(19, 20), rel=1e-4)]


def test_results_without_calibration_have_no_such_part() -> None:
    assert "Uncertainty" not in parts.folds(parts.section("material", result(wrong={"biotac": 1})))
