"""The whole section of materials, and the numbers that go into its charts."""

from typing import Any

import numpy as np
import pytest

from tacpipe.comparison.runs import Method
from tacpipe.report import context
from tacpipe.report.blocks import Charts, Fold, Section, Table
from tacpipe.tasks.material.report import figures, probabilities, scores
from tacpipe.tasks.material.report.methods import MaterialResult
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.material.report import material_fakes
from tests.tasks.material.report.material_fakes import result, slides

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
        "All methods and baselines", "Joint learning", "Fewer slides of one sensor", "Few slides",
        "Which materials are confused", "Latents", "Training", "The slides", "Recordings", "Every run",
        "Basis and limits", "Where it comes from",
    ]  # fmt: skip
    text = parts.words(full_section)
    for sentence in (
        "Table II in",
        "Table III in",
        "Figure 5",
        "Figure 6",
        "Figure 9",
        "Figure 10",
        "driven by labels",
        "cd" * 32,
    ):
        assert sentence in text, sentence
    assert "20 slides of biotac after training on 64, 160 and 576" in text


@pytest.mark.parametrize("simulated", [False, True])
def test_a_labs_own_slides_get_nothing_that_the_paper_states_of_its_own(simulated: bool) -> None:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}, "swapped": BOTH}
    options: dict[str, Any] = {"published": False, "simulated": simulated, "sessions": 2}
    results = [
        result("minirocket", wrong=BOTH, also=level, **options),
        result(wrong=BOTH, also=level, joint=True, epochs=3, **options),
        result(wrong=BOTH, also=level, joint=True, reduce="biotac", ratio=25, epochs=3, **options),
    ]
    slides = material_fakes.recorded()
    for shard in slides.recordings.values():
        del shard.attributes["published"]
    section = parts.section("material", *results, others=[slides])
    text = parts.words(section)
    for sentence in ("paper", "192 slides", "one session", "mapping to known space", "X-LSTM", "Figure"):
        assert sentence not in text, sentence
    assert (section.simulated, text.count(context.SIMULATED)) == (simulated, int(simulated))


@pytest.mark.parametrize(("sessions", "sentence"), [(1, True), (2, False)])
def test_that_each_material_has_one_session_is_stated_where_it_is_so(sessions: int, sentence: bool) -> None:
    results = result("minirocket", wrong=BOTH, published=False, sessions=sessions)
    assert (scores.SESSIONS in parts.words(parts.section("material", results))) == sentence


def test_one_result_alone_has_no_comparison_of_methods() -> None:
    section = parts.section("material", result("minirocket", wrong={"biotac": 1}))
    assert "Joint learning" not in parts.folds(section) and "MiniRocket" in section.sentence


def test_results_that_are_all_variants_have_no_best_method() -> None:
    results = [result(wrong=BOTH, labels="permuted"), result(wrong=BOTH, joint=True, pairing="permuted")]
    section = parts.section("material", *results)
    assert (section.sentence, section.table) == ("", None)
    assert "RAEC joint · permuted pairs" in parts.words(section)


def test_a_result_without_unseen_slides_is_reported_as_its_metrics_name_it() -> None:
    results = result("minirocket", wrong=BOTH, metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, results.files, results.manifest)
    assert parts.cells(parts.tables(parts.section("material", bare)), "seen, n") == ["7"]


def test_confusions_are_counted_over_runs_and_stated_in_words() -> None:
    (method,) = group(result(wrong={"biotac": 2}, fold=0), result(wrong={"biotac": 1}, fold=1))
    counts, materials = figures.count_confusions(method, "biotac")
    assert materials == [1, 2, 3, 4]
    # the fakes take the first slide of material 1 for 2 in both runs, and that of 2 for 3 in one
    assert counts.tolist() == [[8, 2, 0, 0], [0, 9, 1, 0], [0, 0, 10, 0], [0, 0, 0, 10]]
    assert figures.describe_worst(counts, materials) == "Most often it takes 1 for 2 (2 of 10) and 2 for 3 (1 of 10)."
    assert figures.describe_worst(np.diag([3, 3]), [1, 2]) == "It confuses no materials."


def test_confusion_matrices_hold_every_count_of_the_best_method_and_of_the_joint_one() -> None:
    drawn = parts.charts(
        figures.confusion_folds(
            parts.context("material", result("minirocket", wrong={"biotac": 1}), result(wrong=BOTH, joint=True))
        )
    )
    assert [item.title for item in drawn] == ["BioTac: MiniRocket", "BioTac: RAEC joint", "RoboSkin: RAEC joint"]
    cells = {(row["row"], row["column"]): (row["count"], row["right"]) for row in parts.values(drawn[0])}
    assert cells == {("1", "1"): (4, True), ("1", "2"): (1, False), **{(n, n): (5, True) for n in "234"}}


def test_projections_keep_what_lies_in_a_plane() -> None:
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(2, 5))
    points = [rng.normal(size=(count, 2)) @ plane for count in (4, 7)]
    flat = figures.project_on_plane(points)
    assert [item.shape for item in flat] == [(4, 2), (7, 2)]
    stacked = np.vstack(points), np.vstack(flat)
    distances = [np.linalg.norm(item[:, None] - item[None], axis=2) for item in stacked]
    assert np.allclose(*distances)


def test_a_projection_does_not_depend_on_the_sign_that_a_decomposition_takes() -> None:
    points = np.random.default_rng(1).normal(size=(9, 4)) * [5, 2, 1, 1]
    first, second = figures.project_on_plane([points])[0], figures.project_on_plane([points[::-1]])[0][::-1]
    assert np.allclose(first, second)


def test_materials_lie_together_with_those_that_they_were_paired_with() -> None:
    unpermuted, permuted = (
        MaterialResult(result(wrong=BOTH, joint=True, epochs=2, partners=partners, pairing="permuted")).predictions
        for partners in (None, PARTNERS)
    )
    assert figures.count_nearest_partners(unpermuted.of("biotac"), unpermuted.of("roboskin"), {}) == (4, 4)
    assert figures.count_nearest_partners(permuted.of("biotac"), permuted.of("roboskin"), {}) == (0, 4)
    assert figures.count_nearest_partners(permuted.of("biotac"), permuted.of("roboskin"), PARTNERS) == (4, 4)


def test_latents_of_a_joint_run_are_next_to_the_control_and_two_that_learned_alone() -> None:
    drawn = parts.charts(
        figures.latent_folds(
            group(
                result(wrong=BOTH, joint=True, epochs=2),
                result(wrong=BOTH, joint=True, epochs=2, partners=PARTNERS, pairing="permuted"),
                result(wrong={"biotac": 1}, epochs=2),
                result(wrong={"roboskin": 1}, epochs=2),
            )
        )
    )
    names = ["RAEC joint", "RAEC joint · permuted pairs", "RAEC independent"]
    assert [item.title.split(":")[0] for item in drawn] == names
    assert "4 of 4 materials" in drawn[1].caption and "paired" in drawn[1].caption
    assert {row["shape"] for row in parts.values(drawn[0])} == {"BioTac", "RoboSkin"}
    lines = drawn[1].spec["layer"][-1]["data"]["values"]
    assert [item["text"] for item in lines] == ["1", "2", "3", "4"]
    assert figures.latent_folds(group(result("minirocket", wrong=BOTH))) == []


def test_convergence_is_drawn_for_each_sensor_and_the_alignment_with_its_control() -> None:
    results = group(
        result(wrong=BOTH, joint=True, epochs=4, fold=0),
        result(wrong=BOTH, joint=True, epochs=5, fold=1),
        result(wrong=BOTH, joint=True, epochs=4, pairing="permuted"),
        result(wrong={"roboskin": 1}, epochs=4),
    )
    biotac, roboskin = figures.validation_charts(results)
    assert "BioTac" in biotac.title and "RoboSkin" in roboskin.title
    rows = parts.values(biotac)
    assert {row["name"] for row in rows} == {"RAEC joint"}
    assert sorted(sum(row["run"] == run for row in rows) for run in {row["run"] for row in rows}) == [
        4,
        4,
        5,
    ]  # the mean last
    (pairs,) = figures.alignment_charts(results)
    assert {row["name"] for row in parts.values(pairs)} == {"RAEC joint", "RAEC joint · permuted pairs"}
    assert figures.validation_charts(group(result("minirocket", wrong=BOTH))) == []
    assert figures.alignment_charts(group(result(wrong=BOTH, epochs=3))) == []


def test_curves_over_slides_are_those_of_methods_with_several_numbers() -> None:
    drawn = parts.charts(
        figures.few_slides_folds(
            group(
                *(result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, count)) for count in (64, 576)),
                *(result(wrong=BOTH, joint=True, reduce="biotac", ratio=ratio, shuffle=False) for ratio in (11, 50)),
                *(result(wrong=BOTH, joint=True, train={"biotac": 576, "roboskin": count}) for count in (96, 576)),
                result("x-lstm", wrong=BOTH),
            )
        )
    )
    joint = "RAEC joint · other sensor whole"
    names = [{row["name"] for row in parts.values(item)} for item in drawn]
    assert names == [{"MiniRocket", f"{joint} · fixed batches"}, {"MiniRocket", joint}]
    assert {row["x"] for row in parts.values(drawn[0]) if row["name"] == "MiniRocket"} == {64, 576}
    assert figures.few_slides_folds(group(result("minirocket", wrong=BOTH))) == []


def test_slides_are_counted_and_the_one_of_median_force_is_drawn() -> None:
    section = figures.profile_folds([material_fakes.recorded(5, outside=2)])
    text = parts.words(section)
    assert "5 slides of BioTac, 2 of them outside the protocol (2 moved at 12 mm/s)." in text
    assert "1 slide of RoboSkin, 0 of them outside the protocol." in text
    drawn = parts.charts(section)
    assert len(drawn) == 2 and "biotac-m01-t003" in drawn[0].caption  # forces of 3, 4 and 5 N kept to the protocol
    assert {row["name"] for row in parts.values(drawn[1])} == {"as measured", "median of 3"}


@pytest.mark.parametrize("lacking", ["force_n", "speed_m_s"])
def test_what_was_not_measured_is_not_drawn(lacking: str) -> None:
    results = material_fakes.recorded(1, outside=0)
    shard = results.recordings["biotac-m01-t000"]
    short = shard.tables["profile"].drop_columns([lacking] if lacking == "force_n" else [lacking, "speed_raw_m_s"])
    shard.tables = {**shard.tables, "profile": short}
    assert len(parts.charts(figures.profile_folds([results]))) == 1


HEAD = "recording,sensor,known,seen,named,probability,score,answer\n"
BEFORE = {"calibration_error": 0.9, "log_loss": 3.0, "reliability": [{"n": 20, "confidence": 0.05, "accuracy": 0.95}]}
AFTER = {"calibration_error": 0.02, "log_loss": 0.1, "reliability": []}
OTHERS = 8  # slides of a material that was left out


def calibrated(sensor: str = "biotac", **options: Any) -> Any:
    """A result that names one of 20 slides wrong, refuses 2 of them, and names 2 of 8 slides of another material."""
    names, truth = slides(sensor)
    rows = [
        f"{name},{sensor},true,false,{material if at else 9},{0.5 + at / 40:g},{at},{'unknown' if at < 2 else material}"
        for at, (name, material) in enumerate(zip(names, truth, strict=True))
    ]
    rows += [
        f"{sensor}-m09-t{at},{sensor},false,false,1,0.4,{at - 5},{1 if at > 5 else 'unknown'}" for at in range(OTHERS)
    ]
    rows.append(f"{sensor}-seen,{sensor},true,true,1,0.9,99,unknown")
    tree = {
        "calibration": {sensor: {"n": 20, "temperature": 0.1, "before": BEFORE, "after": AFTER}},
        "unknown": {sensor: {"rule": "distance", "auroc": {"probability": 0.7, "distance": 0.9}}},
    }
    base = result(wrong={sensor: 1}, metrics=tree, **options)
    files = {**base.files, "answers.csv": (HEAD + "\n".join(rows) + "\n").encode()}
    return FakeDataset(base.recordings, files, base.manifest)


def folds(*results: Any) -> list[Fold]:
    return [
        section_fold
        for section_fold in parts.section("material", *results).folds
        if section_fold.title == "Uncertainty"
    ]


def test_rates_of_slides_are_pooled_over_runs_and_each_slide_counts_once() -> None:
    (uncertainty_fold,) = folds(calibrated(fold=0), calibrated(fold=1))
    (table,) = [block for block in uncertainty_fold.blocks if isinstance(block, Table)]
    (row,) = table.rows
    cells = [getattr(cell, "text", cell) for cell in row.cells]
    assert cells == ["BioTac: RAEC independent", "20", "0.02", "0.1", "10.0", "25.0", "0.9", "100.0"]
    assert row.cells[4].below == "2.8 to 30.1 of 20"  # type: ignore[union-attr]  # Wilson, of 2 of 20


def test_reliability_is_drawn_of_as_many_slides_a_bin_and_unknown_with_its_threshold() -> None:
    (uncertainty_fold,) = folds(calibrated(fold=0), calibrated(fold=1))
    reliable, refused = (
        chart for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts
    )
    assert reliable.title == "BioTac: RAEC independent" and refused.title == "Unknown: BioTac"
    lines = {
        name: [mark for mark in reliable.spec["data"]["values"] if mark["name"] == name]
        for name in ("calibrated", "as trained")
    }
    assert [(mark["x"], mark["y"]) for mark in lines["as trained"]] == [(0.05, 0.95)]
    assert len(lines["calibrated"]) == 2  # two bins of 40 answers
    assert np.mean([mark["y"] for mark in lines["calibrated"]]) == pytest.approx(0.95)
    (point,) = refused.spec["layer"][-1]["data"]["values"]
    assert (point["x"], point["y"]) == (10, 75)


def test_a_curve_states_which_fraction_of_unknown_slides_lies_below_each_threshold() -> None:
    rng = np.random.default_rng(0)
    known_scores, unknown = rng.normal(1, 1, 300), rng.normal(0, 1, 200)
    curve = probabilities.unknown_curve(known_scores, unknown)
    for at in (10, 50, 90):  # thresholds below which so many percent of known slides lie
        threshold = np.sort(known_scores)[3 * at]
        assert curve[at] == pytest.approx(np.mean(unknown < threshold), abs=1e-12)
    assert curve[0] == pytest.approx(np.mean(unknown < known_scores.min())) and curve[-1] == 1


def test_results_without_answers_have_no_such_part_and_those_without_unknown_slides_no_curve() -> None:
    assert folds(result(wrong={"biotac": 1})) == []
    base = calibrated()
    known_answers = b"\n".join(line for line in base.files["answers.csv"].splitlines() if b",false,false," not in line)
    (uncertainty_fold,) = folds(
        FakeDataset(base.recordings, {**base.files, "answers.csv": known_answers + b"\n"}, base.manifest)
    )
    assert [
        chart.title for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts
    ] == ["BioTac: RAEC independent"]
