"""Results of forecasts as runs, against numbers worked out by hand.

Persistence errs by ``step`` a window and channel, and a model by its ratio of that, so that a skill is 1 minus the mean
ratio over windows. r1 and r2 are of known objects and hold 10 and 30 windows, r3 and r4 of unseen ones and hold 20 each.
"""

import io
import math
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.comparison import engine
from tacpipe.comparison.engine import Comparison
from tacpipe.comparison.runs import Method, grouped
from tacpipe.report import differences
from tacpipe.tasks.forward.report import methods
from tests.fake_recordings import FakeDataset
from tests.tasks.forward.report.result_fakes import WINDOWS, errors, result

RATIO = {"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}


def with_errors(ratios: dict[str, dict[str, float]], codec: str = "raw", **options: Any) -> Any:
    plain = result(codec, **options)
    return FakeDataset(plain.recordings, {**plain.files, "errors.parquet": errors(ratios)}, plain.manifest)


def compared(*results: Any) -> dict[str, Comparison]:
    return {comparison.question.part: comparison for comparison in engine.compare(results)}


def methods_named(*results: Any) -> dict[str, Method]:
    return {method.name: method for method in grouped(methods.read_runs(results))}


def test_errors_are_means_over_windows_and_channels_of_the_objects_asked_for() -> None:
    comparisons = compared(result(ratio=RATIO))
    best = comparisons["known objects"].best
    assert best is not None
    # (10 · 0.5 + 30 · 0.25) / 40 = 0.3125; the absolute error is twice the step times that
    skill = 1 - math.sqrt(0.5 * 0.25)  # ratios of single recordings
    assert best.values == pytest.approx((0.625, 1.875, 0.6875, skill))
    unseen = comparisons["unseen objects"].best
    assert unseen is not None and unseen.values == pytest.approx((2.0, 6.0, 0.0, 1 - math.sqrt(1.5 * 0.5)))


def test_two_recordings_have_no_interval() -> None:
    best = compared(result(ratio=RATIO))["known objects"].best
    assert best is not None
    assert best.score.mean == pytest.approx(1 - math.sqrt(0.5 * 0.25)) and math.isnan(best.score.low)


def test_the_gain_over_the_best_baseline_is_that_of_its_errors_whatever_persistence_does() -> None:
    best = compared(result(ratio=0.5))["known objects"].best
    assert best is not None
    assert (best.baseline, best.n) == ("ridge", 2)
    assert best.gain.mean == pytest.approx(1 / 3)  # 0.5 next to 0.75


def test_rows_are_all_methods_and_baselines_with_the_best_first() -> None:
    comparison = compared(
        result("raw", 0, ratio=RATIO),
        result("raw", 1, ratio=1.0),
        result("AE-C1-8", 0, ratio=0.5),
        result("PCA-20", 0, ratio=2.0),
    )["known objects"]
    rows: dict[str, Any] = {row.name: (row.kind, row.score.mean) for row in comparison.rows}
    assert rows == {
        "codec AE-C1-8": ("oracle", pytest.approx(0.75)),
        "codec PCA-20": ("oracle", pytest.approx(0.75)),
        "codec raw": ("oracle", pytest.approx(0.75)),
        "recurrent · AE-C1-8": ("model", pytest.approx(0.5)),
        "recurrent · raw": ("model", pytest.approx(1 - math.sqrt(0.5 * 0.25) ** 0.5)),
        "ridge": ("baseline", pytest.approx(0.25)),
        "persistence": ("baseline", pytest.approx(0.0)),
        "recurrent · PCA-20": ("model", pytest.approx(-1.0)),
        "train mean": ("baseline", pytest.approx(-8.0)),
    }
    scores = [row.score.mean for row in comparison.rows]
    assert scores == sorted(scores, reverse=True)
    spread = {row.name: row.spread for row in comparison.rows}
    assert spread["recurrent · raw"] == pytest.approx(
        (1 - math.sqrt(0.5 * 0.25)) / np.sqrt(2)
    )  # with a lower bound of 0


def test_what_else_was_made_of_a_models_forecast_is_a_variant_and_no_baseline() -> None:
    ratios = {"model": dict.fromkeys(WINDOWS, 2.0), "model_anchored": dict.fromkeys(WINDOWS, 0.5)}
    comparison = compared(with_errors(ratios, "PCA-20"), result("raw"))["known objects"]
    (variant,) = comparison.of("variant")
    assert variant.name == "recurrent · PCA-20 · anchored" and variant.score.mean == pytest.approx(0.5)
    (recurrent,) = [row for row in comparison.models if row.name == "recurrent · PCA-20"]
    assert recurrent.baseline == "ridge"  # the baseline of the other method's runs


def test_a_model_that_was_shown_a_wrong_plan_is_a_control() -> None:
    comparison = compared(result("raw"), result("raw", ratio=0.125, params={"actions": "shuffled"}))["known objects"]
    assert comparison.best is not None and comparison.best.name == "recurrent · raw"
    assert "recurrent · raw · shuffled actions" in [row.name for row in comparison.of("control")]


def test_a_recording_that_is_known_in_one_fold_and_unseen_in_another_counts_once_in_each() -> None:
    first, second = result(seed=0, ratio=RATIO), result(seed=1, ratio=RATIO)
    swapped = errors({"model": RATIO}, known_objects_of=("r1", "r3"))
    comparisons = compared(
        first, FakeDataset(second.recordings, {**second.files, "errors.parquet": swapped}, second.manifest)
    )
    assert [comparisons[part].models[0].recordings for part in ("known objects", "unseen objects")] == [3, 3]


def test_recordings_whose_objects_nobody_named_are_neither_known_nor_unseen() -> None:
    plain = result()
    table = pq.read_table(io.BytesIO(plain.files["errors.parquet"]))
    content = io.BytesIO()
    none = pa.array([None] * table.num_rows, pa.string())
    pq.write_table(table.set_column(table.column_names.index("object"), "object", none), content)
    comparisons = compared(
        FakeDataset(plain.recordings, {**plain.files, "errors.parquet": content.getvalue()}, plain.manifest)
    )
    assert list(comparisons) == [""]


def test_other_timelines_are_questions_of_their_own_behind_the_main_one() -> None:
    comparisons = compared(
        result("raw", ratio=0.25, timeline="fresh", rate_hz=10.0), *(result("raw", seed) for seed in range(2))
    )
    assert list(comparisons) == [
        "known objects", "unseen objects", "known objects, fresh timeline", "unseen objects, fresh timeline"
    ]  # fmt: skip
    assert [row.name for row in comparisons["known objects"].models] == ["recurrent · raw"]


def test_only_steps_that_all_runs_predict_are_shown() -> None:
    first, second = result(), result(seed=1)
    files = {**second.files, "errors.parquet": errors({"model": dict.fromkeys(WINDOWS, 0.5)}, steps=range(1, 11))}
    datasets: list[Any] = [first, FakeDataset(second.recordings, files, second.manifest)]
    runs = [methods.ForwardResult(dataset) for dataset in datasets]
    assert methods.shown_steps(runs[1:]) == (1, 3, 5, 10)
    assert methods.shown_steps(runs) == (1, 3)


def test_results_without_errors_by_recording_or_all_trained_on_are_left_out() -> None:
    plain = result()
    trained_on = errors({"model": dict.fromkeys(WINDOWS, 0.5)}, seen_recordings=tuple(WINDOWS))
    files = {name: content for name, content in plain.files.items() if name != "errors.parquet"}
    datasets = [
        FakeDataset(plain.recordings, dataset_files, plain.manifest)
        for dataset_files in (files, {**files, "errors.parquet": trained_on})
    ]
    assert methods.read_runs(datasets) == []  # type: ignore[arg-type]


def test_runs_that_differ_in_their_seed_alone_are_one_method() -> None:
    methods_by_name = methods_named(*(result(codec, seed) for seed in (0, 1) for codec in ("raw", "PCA-20")))
    assert {name: len(method.runs) for name, method in methods_by_name.items()} == {
        "recurrent · raw": 2,
        "recurrent · PCA-20": 2,
    }


def test_baselines_that_were_fitted_next_to_a_model_make_no_other_method() -> None:
    methods_by_name = methods_named(*(result("raw", seed, params={"baselines": seed == 0}) for seed in (0, 1)))
    assert {name: len(method.runs) for name, method in methods_by_name.items()} == {"recurrent · raw": 2}


def test_a_name_states_only_in_what_methods_differ() -> None:
    methods_by_name = methods_named(
        result("raw", params={"hidden": 100}),
        result("raw", params={"hidden": 200}),
        result("PCA-20", params={"hidden": 50}),
        result("PCA-20", params={"hidden": 50, "actions": "none"}),
        result("PCA-20", params={"hidden": 50, "actions": "shuffled"}),
        result("PCA-20", params={"hidden": 50}, timeline="fresh"),
        result(architecture="tcn"),
    )
    assert sorted(methods_by_name) == [
        "recurrent · PCA-20",
        "recurrent · PCA-20 · fresh",
        "recurrent · PCA-20 · no actions",
        "recurrent · PCA-20 · shuffled actions",
        "recurrent · raw · hidden 100",
        "recurrent · raw · hidden 200",
        "tcn · PCA-20",
    ]
    planned, none, fresh = (methods_by_name[f"recurrent · PCA-20{end}"] for end in ("", " · no actions", " · fresh"))
    assert list(differences.pairs_by_setting([planned, none, fresh])) == [
        ("actions", planned, none),
        ("timeline", planned, fresh),
    ]


def test_most_runs_decide_which_timeline_is_the_main_one() -> None:
    fresh, uniform, logged = (methods.ForwardResult(result(timeline=name)) for name in ("fresh", "uniform", "logged"))
    assert methods.main_timeline([fresh, uniform, fresh]) == "fresh"
    assert methods.main_timeline([fresh, uniform, logged]) == "uniform"


def test_the_papers_network_trained_for_a_part_of_its_schedule_is_named_with_that_part() -> None:
    shortened = [result(params={"epochs": 12}), result(architecture="tcn", params={"epochs": 12})]
    assert sorted(methods_named(*shortened, result("raw"))) == [
        "recurrent · PCA-20 · 12 of 50 epochs",
        "recurrent · raw",
        "tcn · PCA-20",
    ]
