"""Gains and intervals against those worked out another way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tacpipe.cli import headline_table
from tacpipe.metrics import headline as headlines
from tacpipe.metrics import pairing, regression, summary
from tacpipe.tasks.forward import headline as forward
from tacpipe.tasks.material import headline as material
from tacpipe.tasks.touch import headline as touch

RECORDINGS = [f"r{index:02d}" for index in range(12)]


def forecasts(ratios: dict[str, float], *, seed: int = 0, persistence: float = 1.0) -> Any:
    """Sums of one step: squared error of ``ratio`` times persistence's, a window of a value each."""
    one = np.array([persistence])
    return {(seed, name): forward.sums((ratio * one, ratio * one), (one, one), 1.0) for name, ratio in ratios.items()}


def test_the_best_baseline_is_that_of_least_error_and_controls_and_codecs_are_none() -> None:
    model = forecasts(dict.fromkeys(RECORDINGS, 0.5))
    others = {
        name: forecasts(dict.fromkeys(RECORDINGS, ratio)) for name, ratio in (("persistence", 1.0), ("ridge", 0.4))
    }
    bounds = {name: forecasts(dict.fromkeys(RECORDINGS, 0.1)) for name in ("codec", "codec_anchored", "model_anchored")}
    found = forward.headline("net", (1,), model, {**others, **bounds}, None)
    assert found is not None and found.best is not None
    assert [one.name for one in found.baselines] == ["ridge", "persistence"]
    assert found.gain == pytest.approx(1 - 0.5 / 0.4)
    assert found.verdict == "worse"  # though its skill over persistence is 0.5
    assert found.model.values[-1] == pytest.approx(0.5)


def test_the_interval_is_that_of_students_t_for_the_logarithm_of_the_ratio_of_errors() -> None:
    rng = np.random.default_rng(3)
    ratios, still = rng.uniform(0.2, 1.0, (2, 12)), rng.uniform(1, 9, 12)
    model, ridge = (
        {key: value for name, one, by in zip(RECORDINGS, told, still, strict=True)
         for key, value in forecasts({name: one}, persistence=by).items()}
        for told in ratios
    )  # fmt: skip
    found = forward.headline("net", (1,), model, {"ridge": ridge}, None)
    logs = np.log(ratios[0] / ratios[1])  # however large the recordings are
    ends = stats.t.interval(0.95, 11, logs.mean(), stats.sem(logs))
    assert found is not None
    assert (found.low, found.high) == pytest.approx((1 - math.exp(ends[1]), 1 - math.exp(ends[0])))
    assert found.gain == pytest.approx(1 - math.exp(logs.mean()))


def test_a_baseline_counts_on_the_recordings_that_it_shares_with_the_model() -> None:
    model = forecasts({"a": 0.5, "b": 0.1})
    found = forward.headline("net", (1,), model, {"ridge": forecasts({"a": 0.4, "z": 9.0})}, None)
    assert found is not None
    assert found.clusters == 1
    assert found.gain == pytest.approx(1 - 0.5 / 0.4)
    alone = forward.headline("net", (1,), model, {"ridge": forecasts({"z": 1.0})}, None)
    assert alone is not None and alone.best is None


def test_where_persistence_never_errs_nothing_is_relative_to_it() -> None:
    model = forecasts(dict.fromkeys(RECORDINGS, 0.5), persistence=0.0)
    found = forward.headline("net", (1,), model, {"persistence": model}, None)
    assert found is not None and found.verdict == "" and np.isnan(found.gain)


def test_the_gain_in_accuracy_is_in_points_and_chance_is_a_baseline_too() -> None:
    slides = [(0, f"s{index}") for index in range(20)]
    right = {"model": {key: (int(at < 18), 1) for at, key in enumerate(slides)}}
    found = material.headline("net", "BioTac", right, classes=4)
    assert found is not None and found.best is not None
    assert (found.best.name, found.measure) == ("chance", "points")
    assert found.gain == pytest.approx(65)
    right["mean_level"] = {key: (int(at < 19), 1) for at, key in enumerate(slides)}
    right["permuted_labels"] = dict.fromkeys(slides, (1, 1))  # a control
    found = material.headline("net", "BioTac", right, classes=4)
    assert found is not None
    assert [one.name for one in found.baselines] == ["mean level alone", "chance"]
    assert found.gain == pytest.approx(-5)


def test_the_gain_on_touch_is_the_skill_that_the_metrics_have_over_the_same_baseline() -> None:
    rng = np.random.default_rng(0)
    true, model, mean = rng.normal(size=(3, 30, 24))
    squared = [regression.squared_sums(true, one) for one in (model, mean)]
    objects = {f"g{index:02d}": f"o{index % 7}" for index in range(30)}
    errors = [{(0, name): (float(one), 24) for name, one in zip(objects, sums, strict=True)} for sums in squared]
    for known, clusters in ((True, list(objects)), (False, list(objects.values()))):
        found = touch.headline("net", "e_th", 100.0, errors[0], {"constant": errors[1]}, known, objects)
        wanted = regression.skill_interval(squared[0], squared[1], np.array(clusters))
        assert found is not None
        assert (found.gain, found.low, found.high) == pytest.approx(tuple(wanted))
        assert (found.clusters, found.cluster) == ((30, "grasps") if known else (7, "objects"))
        assert found.model.values[1] == pytest.approx(100 * regression.rmse(true, model))


def test_folds_that_have_seeds_of_their_own_are_no_repeats() -> None:
    rng = np.random.default_rng(4)
    ratios = dict(zip(RECORDINGS, rng.uniform(0.3, 0.9, 12), strict=True))
    still = forecasts(dict.fromkeys(RECORDINGS, 1.0))
    folds: Any = {}
    for fold in range(3):
        folds |= forecasts({name: ratios[name] for name in RECORDINGS[fold::3]}, seed=fold)
    single, folded = (forward.headline("net", (1,), one, {"persistence": still}, None)
                      for one in (forecasts(ratios), folds))  # fmt: skip
    assert single is not None and folded is not None
    assert (folded.low, folded.high, folded.seeds) == (single.low, single.high, 1)


def test_a_few_recordings_that_carry_most_of_the_error_give_no_verdict() -> None:
    sizes = dict(zip(RECORDINGS, [40.0, 30.0, 20.0, *[1.0] * 9], strict=True))
    errors = [{(0, name): (ratio * size, 1) for name, size in sizes.items()} for ratio in (0.5, 1.0)]
    found = touch.headline("net", "pdc_th", 100.0, errors[0], {"constant": errors[1]}, True, {})
    assert found is not None and found.low > 0
    assert found.effective == pytest.approx(99**2 / (40**2 + 30**2 + 20**2 + 9))
    assert found.verdict == ""
    assert "12 grasps count as 3.4 equal ones, too few for a verdict" in headlines.sentence(found)
    model, still = dict[Any, Any](), dict[Any, Any]()
    for name, size in sizes.items():
        model |= forecasts({name: 0.5}, persistence=size)
        still |= forecasts({name: 1.0}, persistence=size)
    forecast = forward.headline("net", (1,), model, {"persistence": still}, None)
    assert forecast is not None and forecast.verdict == "better"  # there each recording counts the same


def test_recordings_on_which_persistence_makes_no_error_are_left_out_and_counted() -> None:
    model, still = (forecasts(dict.fromkeys(RECORDINGS, ratio)) for ratio in (0.5, 1.0))
    quiet = forecasts({"quiet": 0.5}, persistence=0.0)
    found = forward.headline("net", (1,), {**model, **quiet}, {"persistence": {**still, **quiet}}, None)
    assert found is not None
    assert found.gain == pytest.approx(0.5) and (found.clusters, found.left_out) == (12, 1)
    assert "Left out: 1 recording without an error of persistence." in headlines.caption([found])


def test_the_row_of_persistence_is_shown_where_another_baseline_is_better() -> None:
    sums = {name: forecasts(dict.fromkeys(RECORDINGS, ratio)) for name, ratio in
            (("net", 0.5), ("persistence", 1.0), ("ridge", 0.8), ("mean", 3.0))}  # fmt: skip
    found = forward.headline("net", (1,), sums.pop("net"), sums, None)
    assert found is not None and [one.name for one in found.table_baselines] == ["ridge", "persistence"]
    table = headline_table.text([found])
    row = next(line.split() for line in table.splitlines() if line.startswith("  persistence"))
    assert row[-2:] == ["0", "0"]
    assert "vs ridge" in table and "\n  persistence" in table and "mean " not in table.split("n: recordings")[0]
    known = summary.from_headlines([found])
    assert (known["mae_t_1"], known["persistence_mae_t_1"]) == (0.5, 1.0)


def test_one_large_recording_does_not_decide_and_errors_that_all_rise_are_never_called_better() -> None:
    """The absolute error rises on 22 of 23 recordings, and the squared error falls on the one that carries half of it."""
    names = [f"r{index:02d}" for index in range(23)]
    model: dict[Any, Any] = {}
    still: dict[Any, Any] = {}
    for place, name in enumerate(names):
        size, ratio = (60.0, 0.8) if place == 0 else (10.0, 1.15)
        one = np.array([size])
        model[0, name] = forward.sums(((ratio * one) ** 2, ratio * one), (one**2, one), 1.0)
        still[0, name] = forward.sums((one**2, one), (one**2, one), 1.0)
    found = forward.headline("net", (1,), model, {"persistence": still}, None)
    assert found is not None
    assert found.model.values[1] > 0 > found.gain == pytest.approx(found.model.values[2])
    assert found.verdict == "worse"


def test_the_end_that_a_choice_moves_is_that_of_the_largest_of_several_statistics() -> None:
    rng = np.random.default_rng(8)
    still = forecasts(dict.fromkeys(RECORDINGS, 1.0))
    methods = [forecasts(dict(zip(RECORDINGS, rng.uniform(0.5, 1.1, 12), strict=True))) for _ in range(5)]
    measure = forward.measure((1,))
    pairs = [one for sums in methods if (one := pairing.pair(measure, sums, still))]
    alone, chosen = pairing.gain(measure, pairs[:1]), pairing.gain(measure, pairs[:1], pairs[1:])
    influence = np.stack([one.jackknife.influence[:, 0] for one in pairs])
    drawn = stats.multivariate_t(np.zeros(5), np.corrcoef(influence), df=11, allow_singular=True).rvs(
        40_000, random_state=1
    )
    reach = np.quantile(drawn.max(axis=1), 0.975)
    mean, error = (float(one[0]) for one in (pairs[0].jackknife.mean, pairs[0].jackknife.error))
    assert (alone.mean, alone.high) == (chosen.mean, chosen.high)
    assert chosen.low == pytest.approx(1 - math.exp(reach * error - mean), abs=0.01)
    assert chosen.low < alone.low
    other = pairing.gain(measure, [pairs[0], pairs[1]])  # of two baselines the best was chosen
    assert other.low == alone.low and other.high > alone.high


def test_seeds_are_left_out_as_recordings_are() -> None:
    model = {key: one for seed, ratio in enumerate((0.1, 0.9)) for key, one in
             forecasts(dict.fromkeys(RECORDINGS, ratio), seed=seed).items()}  # fmt: skip
    found = forward.headline("net", (1,), model, {"persistence": forecasts(dict.fromkeys(RECORDINGS, 1.0))}, None)
    assert found is not None
    assert found.seeds == 2
    assert found.gain == pytest.approx(1 - math.sqrt(0.1 * 0.9)) and found.low < 0.1 and found.high > 0.9


def test_a_model_without_recordings_has_no_headline() -> None:
    assert pairing.headline("t", "net", forward.measure((1,)), {}, {}) is None
