"""Numbers of the comparison against those worked out by hand.

Persistence errs by ``step`` a window and channel, and a model by its ratio of that, so that a skill is 1 minus the mean
ratio over windows. r1 and r2 are of known objects and hold 10 and 30 windows, r3 and r4 of unseen ones and hold 20 each.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from tacpipe.report.forward import comparison, methods
from tacpipe.report.forward.comparison import Pool
from tacpipe.report.forward.methods import Method, Run
from tests.fake_recordings import FakeDataset
from tests.report.forward.result_fakes import WINDOWS, errors, result

RATIO = {"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}
STEPS = (1, 3)


def runs(*results: Any) -> list[Run]:
    return [Run.read(one) for one in results]


def pooled(given: list[Run], predictor: str = "model", group: str = "both", known: bool | None = True) -> Pool:
    found = comparison.pool(given, predictor, group, known)
    assert found is not None
    return found


def three_methods() -> list[Method]:
    """Three methods with two runs each: skills on known objects are 0.6875 and 0, 0.5 and 0.5, -1 and -1."""
    return methods.grouped(
        runs(
            result("raw", 0, ratio=RATIO),
            result("raw", 1, ratio=1.0),
            result("AE-C1-8", 0, ratio=0.5),
            result("AE-C1-8", 1, ratio=0.5),
            result("PCA-20", 0, ratio=2.0),
            result("PCA-20", 1, ratio=2.0),
        )
    )


def test_errors_are_means_over_windows_and_channels_of_the_objects_asked_for() -> None:
    found = pooled(runs(result(ratio=RATIO)))
    assert found.recordings == ("r1", "r2")
    assert np.allclose(found.mse, [0.3125, 0.625, 0.9375])  # (10 · 0.5 + 30 · 0.25) / 40 = 0.3125, times the step
    assert np.allclose(found.mae, 2 * found.mse)
    assert np.allclose(found.baseline_mse, [1, 2, 3])
    assert np.allclose(pooled(runs(result(ratio=RATIO)), known=False).mse, [1, 2, 3])
    assert np.allclose(pooled(runs(result(ratio=RATIO)), known=None).mse, [0.65625, 1.3125, 1.96875])


def test_skill_and_its_mean_over_shown_steps_are_those_by_hand() -> None:
    found = comparison.skill(pooled(runs(result(ratio=RATIO))), STEPS)
    assert np.allclose(found.mean, [0.6875, 0.6875, 0.6875])
    # two recordings are drawn as r1 twice, once each or r2 twice, with chances 1/4, 1/2 and 1/4
    assert np.allclose(found.low, 0.5)
    assert np.allclose(found.high, 0.75)


def test_the_errors_of_a_recording_in_several_runs_stay_together() -> None:
    both = pooled(runs(result(seed=0, ratio=RATIO), result(seed=1, ratio=1.0)))
    assert both.windows.tolist() == [20, 60]
    assert both.distinct_windows == 40
    assert both.runs == 2
    found = comparison.skill(both, STEPS)
    assert np.allclose(found.mean, 1 - (12.5 + 40) / 80)
    assert np.allclose([found.low[0], found.high[0]], [1 - 1.5 / 2, 1 - 1.25 / 2])  # r1 alone, r2 alone


def test_a_recording_that_is_known_in_one_fold_and_unseen_in_another_counts_once_in_each() -> None:
    one, other = result(seed=0, ratio=RATIO), result(seed=1, ratio=RATIO)
    swapped = errors({"model": RATIO}, known=("r1", "r3"))
    folds = runs(one, FakeDataset(other.recordings, {**other.files, "errors.parquet": swapped}, other.manifest))
    known = pooled(folds)
    assert dict(zip(known.recordings, known.windows.tolist(), strict=True)) == {"r1": 20, "r2": 30, "r3": 20}
    unseen = pooled(folds, known=False)
    assert dict(zip(unseen.recordings, unseen.windows.tolist(), strict=True)) == {"r2": 30, "r3": 20, "r4": 40}


def test_one_recording_has_no_interval() -> None:
    one = result(ratio=RATIO)
    files = {**one.files, "errors.parquet": errors({"model": RATIO}, windows={"r1": 10})}
    found = comparison.skill(pooled(runs(FakeDataset(one.recordings, files, one.manifest))), STEPS)
    assert np.allclose(found.mean, 0.5)
    assert np.isnan(found.low).all()


def test_differences_are_paired_by_recording() -> None:
    worse = {name: ratio + 0.125 for name, ratio in RATIO.items()}
    one, other = (pooled(runs(result(ratio=ratio))) for ratio in (RATIO, worse))
    found = comparison.difference(one, other, STEPS)
    assert found is not None
    for part in (found.mean, found.low, found.high):  # the same on each recording, so without spread
        assert np.allclose(part, 0.125)


def test_differences_are_over_common_recordings() -> None:
    one = pooled(runs(result(ratio=RATIO)), known=None)
    found = comparison.difference(one, one.of(["r3", "r4"]), STEPS)
    assert found is not None
    assert np.allclose(found.mean, 0)
    assert comparison.difference(one.of(["r1"]), one.of(["r2"]), STEPS) is None


def test_rows_are_all_methods_and_baselines_with_the_best_first() -> None:
    found = comparison.rows(three_methods(), STEPS, known=True)
    scores = {row.name: row.score for row in found}
    assert scores == pytest.approx(
        {
            "codec AE-C1-8": 0.75,
            "codec PCA-20": 0.75,
            "codec raw": 0.75,
            "recurrent · AE-C1-8": 0.5,
            "recurrent · raw": 0.34375,
            "ridge": 0.25,
            "persistence": 0.0,
            "recurrent · PCA-20": -1.0,
            "train_mean": -8.0,
        }
    )
    assert list(scores.values()) == sorted(scores.values(), reverse=True)
    by_name = {row.name: row for row in found}
    assert by_name["recurrent · raw"].spread == pytest.approx(0.6875 / np.sqrt(2))  # of 0.6875 and 0
    assert by_name["recurrent · AE-C1-8"].spread == pytest.approx(0)
    standard = by_name["ridge"].standard
    assert standard is not None and np.allclose(standard.mse, [0.75, 1.5, 2.25])


def test_what_else_was_made_of_a_models_forecast_is_a_row_of_its_method_and_no_baseline() -> None:
    one = result("PCA-20", ratio=2.0)
    ratios = {"model": dict.fromkeys(WINDOWS, 2.0), "model_anchored": dict.fromkeys(WINDOWS, 0.5)}
    anchored = FakeDataset(one.recordings, {**one.files, "errors.parquet": errors(ratios)}, one.manifest)
    found = comparison.rows(methods.grouped(runs(anchored, result("raw"))), STEPS, known=True)
    assert {row.name: row.score for row in found if "anchored" in row.name} == {"recurrent · PCA-20 · anchored": 0.5}
    method, other = methods.grouped(runs(anchored, result("raw")))
    told = comparison.headline(method, [other], STEPS, known=True)
    assert told is not None
    assert [one.name for one in told.baselines] == ["ridge", "persistence", "train_mean"]  # ridge of the other's runs


def test_the_best_method_is_none_that_was_shown_a_wrong_plan() -> None:
    given = [*three_methods(), *methods.grouped(runs(result("raw", ratio=0.125, params={"actions": "shuffled"})))]
    found = comparison.rows(given, STEPS, known=True)
    best = comparison.best(found)
    assert best is not None and best.name == "recurrent · AE-C1-8"


def test_the_gain_over_the_best_baseline_is_that_of_its_errors_whatever_persistence_does() -> None:
    (method,) = methods.grouped(runs(result(ratio=0.5)))
    told = comparison.headline(method, [], STEPS, known=True)
    assert told is not None and told.best is not None
    assert (told.best.name, told.clusters, told.cluster) == ("ridge", 2, "recordings")
    assert told.gain == pytest.approx(1 / 3)
    assert told.model.values == pytest.approx((2 * 1 * 0.5, 2 * 3 * 0.5, 0.5))  # MAE is twice the step times the ratio
    assert told.best.values == pytest.approx((2 * 1 * 0.75, 2 * 3 * 0.75, 0.25))
    assert told.verdict == ""  # two recordings


def test_a_row_of_table_1_has_mean_and_sd_over_runs_in_the_models_own_space() -> None:
    (method,) = methods.grouped(runs(result(seed=0, ratio=0.5), result(seed=1, ratio=0.75)))
    found = comparison.represented(method)
    assert found is not None and found.known is not None
    assert (found.validation.mean, found.validation.sd) == pytest.approx((0.015, 0.01 / np.sqrt(2)))
    assert (found.test.mean, found.test.sd) == pytest.approx((1.25, 0.5 / np.sqrt(2)))  # ratio times the mean step, 2
    assert found.known.mean == pytest.approx(1.25)
    assert (found.persistence.mean, found.persistence.sd) == pytest.approx((2, 0))


def test_the_loss_of_the_recurrent_model_tells_its_validation_error() -> None:
    (method,) = methods.grouped(runs(result(validation={"loss": 0.25, "epoch": 3})))
    found = comparison.represented(method)
    assert found is not None and found.validation.mean == 0.25


def test_anticipation_is_weighted_by_events_and_leaves_out_what_was_never_seen_coming() -> None:
    told = [
        {"events": 4, "recall": 0.5, "median_lead_rows": 6.0, "median_lead_frames": None, "false_alarms_per_minute": 1},
        {"events": 12, "recall": 1.0, "median_lead_rows": 2.0, "median_lead_frames": 1.0, "false_alarms_per_minute": 3},
        {
            "events": 0,
            "recall": None,
            "median_lead_rows": None,
            "median_lead_frames": None,
            "false_alarms_per_minute": 9,
        },
    ]
    given = [result(seed=seed) for seed in range(3)]
    for one, content in zip(given, told, strict=True):
        one.files["metrics.json"] = json.dumps({"anticipation": {"model": content}}).encode()
    (method,) = methods.grouped(runs(*given))
    assert comparison.anticipation(method, "model") == pytest.approx(
        {
            "events": 16,
            "recall": 0.875,
            "median_lead_rows": 3.0,
            "median_lead_frames": 1.0,
            "false_alarms_per_minute": 2.5,
        }
    )
    assert comparison.anticipation(method, "ridge") is None


def test_only_steps_that_all_runs_predict_are_shown() -> None:
    one, other = result(), result(seed=1)
    files = {**other.files, "errors.parquet": errors({"model": dict.fromkeys(WINDOWS, 0.5)}, steps=range(1, 11))}
    long = FakeDataset(other.recordings, files, other.manifest)
    assert comparison.shown_steps(runs(long)) == (1, 3, 5, 10)
    assert comparison.shown_steps(runs(one, long)) == (1, 3)
    assert pooled(runs(one, long)).steps == (1, 2, 3)
