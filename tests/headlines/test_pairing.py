"""Gains and intervals against those worked out another way."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tacpipe.channels import biotac_sp
from tacpipe.cli import headline_table
from tacpipe.scores import headline, pairing, regression, words
from tacpipe.scores.table import Question
from tacpipe.tasks.forward import headline as forward
from tacpipe.tasks.material import headline as material
from tacpipe.tasks.touch import headline as touch

RECORDINGS = [f"r{index:02d}" for index in range(12)]


def forecasts(ratios: dict[str, float], *, seed: int = 0, persistence: float = 1.0) -> Any:
    """Sums of one step: squared error of ``ratio`` times persistence's, a window of a value each."""
    reference = np.array([persistence])
    return {
        (seed, name): forward.sums((ratio * reference, ratio * reference), (reference, reference), 1.0)
        for name, ratio in ratios.items()
    }


def compared_forecasts(model: Any, baselines: dict[str, Any]) -> headline.Headline | None:
    """Return the comparison of forecasts, which may have several seeds."""
    return pairing.headline("forward", "net", forward.measure((1,)), model, baselines)


def test_the_best_baseline_is_that_of_least_error_and_controls_and_codecs_are_none() -> None:
    model = forecasts(dict.fromkeys(RECORDINGS, 0.5))
    baselines = {
        name: forecasts(dict.fromkeys(RECORDINGS, ratio)) for name, ratio in (("persistence", 1.0), ("ridge", 0.4))
    }
    bounds = {name: forecasts(dict.fromkeys(RECORDINGS, 0.1)) for name in ("codec", "codec_anchored", "model_anchored")}
    sums = {
        name: {recording: row for (_, recording), row in rows.items()}
        for name, rows in {"model": model, **baselines, **bounds}.items()
    }
    result = forward.score_table((1,), sums).headline("forward", "net", Question())
    assert result is not None and result.best is not None
    assert [baseline.name for baseline in result.baselines] == ["ridge", "persistence"]
    assert result.gain == pytest.approx(1 - 0.5 / 0.4)
    assert result.verdict == "worse"  # though its skill over persistence is 0.5
    assert result.model.values[-1] == pytest.approx(0.5)


def test_the_interval_is_that_of_students_t_for_the_logarithm_of_the_ratio_of_errors() -> None:
    rng = np.random.default_rng(3)
    ratios, persistence = rng.uniform(0.2, 1.0, (2, 12)), rng.uniform(1, 9, 12)
    model, ridge = (
        {key: value for name, ratio, by in zip(RECORDINGS, method_ratios, persistence, strict=True)
         for key, value in forecasts({name: ratio}, persistence=by).items()}
        for method_ratios in ratios
    )  # fmt: skip
    result = compared_forecasts(model, {"ridge": ridge})
    logs = np.log(ratios[0] / ratios[1])  # however large the recordings are
    ends = stats.t.interval(0.95, 11, logs.mean(), stats.sem(logs))
    assert result is not None
    assert (result.low, result.high) == pytest.approx((1 - math.exp(ends[1]), 1 - math.exp(ends[0])))
    assert result.gain == pytest.approx(1 - math.exp(logs.mean()))


def test_a_baseline_counts_on_the_recordings_that_it_shares_with_the_model() -> None:
    model = forecasts({"a": 0.5, "b": 0.1})
    result = compared_forecasts(model, {"ridge": forecasts({"a": 0.4, "z": 9.0})})
    assert result is not None
    assert result.clusters == 1
    assert result.gain == pytest.approx(1 - 0.5 / 0.4)
    without_shared = compared_forecasts(model, {"ridge": forecasts({"z": 1.0})})
    assert without_shared is not None and without_shared.best is None


def test_where_persistence_never_errs_nothing_is_relative_to_it() -> None:
    model = forecasts(dict.fromkeys(RECORDINGS, 0.5), persistence=0.0)
    result = compared_forecasts(model, {"persistence": model})
    assert result is not None and result.verdict == "" and np.isnan(result.gain)


def test_the_gain_in_accuracy_is_in_points_and_chance_is_a_baseline_too() -> None:
    slides = [f"s{index}" for index in range(20)]
    right = {"model": {slide: at < 18 for at, slide in enumerate(slides)}}
    result = material.score_table(right, classes=4).headline("material", "net", Question("BioTac"))
    assert result is not None and result.best is not None
    assert (result.best.name, result.measure) == ("chance", "points")
    assert result.gain == pytest.approx(65)
    right["mean_level"] = {slide: at < 19 for at, slide in enumerate(slides)}
    right["permuted_labels"] = dict.fromkeys(slides, True)  # a control
    result = material.score_table(right, classes=4).headline("material", "net", Question("BioTac"))
    assert result is not None
    assert [baseline.name for baseline in result.baselines] == ["mean level alone", "chance"]
    assert result.gain == pytest.approx(-5)


def test_the_gain_on_touch_is_the_skill_that_the_metrics_have_over_the_same_baseline() -> None:
    rng = np.random.default_rng(0)
    true, model, mean = rng.normal(2000, 300, size=(3, 30, 24))
    fractions = [biotac_sp.normalise("e_th", values) for values in (true, model, mean)]
    squared = [regression.squared_sums(fractions[0], predicted) for predicted in fractions[1:]]
    objects = {f"g{index:02d}": f"o{index % 7}" for index in range(30)}
    for known_objects, clusters in ((True, list(objects)), (False, list(objects.values()))):
        predicted = {"model": model, "constant": mean}
        scores = touch.score_table("e_th", true, predicted, list(objects), objects, known_objects=known_objects)
        result = scores.headline("touch", "net", Question())
        expected = regression.skill_interval(squared[0], squared[1], np.array(clusters))
        assert result is not None
        assert (result.gain, result.low, result.high) == pytest.approx(tuple(expected))
        assert (result.clusters, result.cluster) == ((30, "grasps") if known_objects else (7, "objects"))
        assert result.model.values[1] == pytest.approx(regression.rmse(true, model))


def test_folds_that_have_seeds_of_their_own_are_no_repeats() -> None:
    rng = np.random.default_rng(4)
    ratios = dict(zip(RECORDINGS, rng.uniform(0.3, 0.9, 12), strict=True))
    persistence = forecasts(dict.fromkeys(RECORDINGS, 1.0))
    folds: Any = {}
    for fold in range(3):
        folds |= forecasts({name: ratios[name] for name in RECORDINGS[fold::3]}, seed=fold)
    single, folded = (compared_forecasts(method, {"persistence": persistence})
                      for method in (forecasts(ratios), folds))  # fmt: skip
    assert single is not None and folded is not None
    assert (folded.low, folded.high, folded.seeds) == (single.low, single.high, 1)


def test_a_few_recordings_that_carry_most_of_the_error_give_no_verdict() -> None:
    sizes = dict(zip(RECORDINGS, [40.0, 30.0, 20.0, *[1.0] * 9], strict=True))
    errors: list[Any] = [
        {(0, name): np.array([ratio * size, 1.0]) for name, size in sizes.items()} for ratio in (0.5, 1.0)
    ]
    result = pairing.headline("touch", "net", touch.measure(100.0, "grasps"), errors[0], {"constant": errors[1]})
    assert result is not None and result.low > 0
    assert result.effective == pytest.approx(99**2 / (40**2 + 30**2 + 20**2 + 9))
    assert result.verdict == ""
    assert "12 grasps count as 3.4 equal ones, and 6 are needed" in words.sentence(result)
    model, persistence = dict[Any, Any](), dict[Any, Any]()
    for name, size in sizes.items():
        model |= forecasts({name: 0.5}, persistence=size)
        persistence |= forecasts({name: 1.0}, persistence=size)
    forecast = compared_forecasts(model, {"persistence": persistence})
    assert forecast is not None and forecast.verdict == "better"  # there each recording counts the same


def test_recordings_on_which_persistence_makes_no_error_are_left_out_and_counted() -> None:
    model, persistence = (forecasts(dict.fromkeys(RECORDINGS, ratio)) for ratio in (0.5, 1.0))
    quiet = forecasts({"quiet": 0.5}, persistence=0.0)
    result = compared_forecasts({**model, **quiet}, {"persistence": {**persistence, **quiet}})
    assert result is not None
    assert result.gain == pytest.approx(0.5) and (result.clusters, result.left_out) == (12, 1)
    assert "Left out: 1 recording without an error of persistence." in words.legend([result])


def test_the_row_of_persistence_is_shown_where_another_baseline_is_better() -> None:
    sums = {name: forecasts(dict.fromkeys(RECORDINGS, ratio)) for name, ratio in
            (("net", 0.5), ("persistence", 1.0), ("ridge", 0.8), ("mean", 3.0))}  # fmt: skip
    result = compared_forecasts(sums.pop("net"), sums)
    assert result is not None and [baseline.name for baseline in result.table_baselines] == ["ridge", "persistence"]
    table = headline_table.text([result])
    row = next(line.split() for line in table.splitlines() if line.startswith("  persistence"))
    assert row[-2:] == ["0.0", "%"]
    assert "than ridge" in table and "\n  persistence" in table and "mean " not in table.split("n: recordings")[0]
    summary_values = headline.summarize([result])
    assert (summary_values["mae_t_1"], summary_values["persistence_mae_t_1"]) == (0.5, 1.0)


def test_one_large_recording_does_not_decide_and_errors_that_all_rise_are_never_called_better() -> None:
    """The absolute error rises on 22 of 23 recordings, and the squared error falls on the one that carries half of it."""
    names = [f"r{index:02d}" for index in range(23)]
    model: dict[Any, Any] = {}
    persistence: dict[Any, Any] = {}
    for place, name in enumerate(names):
        size, ratio = (60.0, 0.8) if place == 0 else (10.0, 1.15)
        reference = np.array([size])
        model[0, name] = forward.sums(((ratio * reference) ** 2, ratio * reference), (reference**2, reference), 1.0)
        persistence[0, name] = forward.sums((reference**2, reference), (reference**2, reference), 1.0)
    result = compared_forecasts(model, {"persistence": persistence})
    assert result is not None
    assert result.model.values[1] > 0 > result.gain == pytest.approx(result.model.values[2])
    assert result.verdict == "worse"


def test_the_end_that_a_choice_moves_is_that_of_the_largest_of_several_statistics() -> None:
    rng = np.random.default_rng(8)
    persistence = forecasts(dict.fromkeys(RECORDINGS, 1.0))
    methods = [forecasts(dict(zip(RECORDINGS, rng.uniform(0.5, 1.1, 12), strict=True))) for _ in range(5)]
    measure = forward.measure((1,))
    pairs = [pair for sums in methods if (pair := pairing.pair(measure, sums, persistence))]
    single, chosen = pairing.gain(measure, pairs[:1]), pairing.gain(measure, pairs[:1], pairs[1:])
    influence = np.stack([pair.jackknife.influence[:, 0] for pair in pairs])
    drawn = stats.multivariate_t(np.zeros(5), np.corrcoef(influence), df=11, allow_singular=True).rvs(
        40_000, random_state=1
    )
    reach = np.quantile(drawn.max(axis=1), 0.975)
    mean, error = (float(value[0]) for value in (pairs[0].jackknife.mean, pairs[0].jackknife.error))
    assert (single.mean, single.high) == (chosen.mean, chosen.high)
    assert chosen.low == pytest.approx(1 - math.exp(reach * error - mean), abs=0.01)
    assert chosen.low < single.low
    best_of_two = pairing.gain(measure, [pairs[0], pairs[1]])  # The best of two baselines was chosen.
    assert best_of_two.low == single.low and best_of_two.high > single.high


def test_seeds_are_left_out_as_recordings_are() -> None:
    model = {key: sums for seed, ratio in enumerate((0.1, 0.9)) for key, sums in
             forecasts(dict.fromkeys(RECORDINGS, ratio), seed=seed).items()}  # fmt: skip
    result = compared_forecasts(model, {"persistence": forecasts(dict.fromkeys(RECORDINGS, 1.0))})
    assert result is not None
    assert result.seeds == 2
    assert result.gain == pytest.approx(1 - math.sqrt(0.1 * 0.9)) and result.low < 0.1 and result.high > 0.9


def test_a_model_without_recordings_has_no_headline() -> None:
    assert pairing.headline("t", "net", forward.measure((1,)), {}, {}) is None


def points_of(model_right: list[bool], baseline_right: list[bool]) -> pairing.Pair:
    """Return the pair of two predictors that named slides right or wrong."""
    sums: list[Any] = [
        {(0, f"s{index}"): np.array([float(right), 1.0]) for index, right in enumerate(answers)}
        for answers in (model_right, baseline_right)
    ]
    pair = pairing.pair(material.MEASURE, *sums)
    assert pair is not None
    return pair


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=6, max_size=40))
def test_an_interval_in_points_is_bounded_and_never_empty_and_a_verdict_agrees_with_the_exact_test(
    answers: list[tuple[bool, bool]],
) -> None:
    pair = points_of(*(list(column) for column in zip(*answers, strict=True)))
    gain = pairing.gain(material.MEASURE, [pair])
    assert -100 <= gain.low <= gain.mean <= gain.high <= 100 and gain.low < gain.high
    assert gain.verdict == "unclear" or pair.p <= 0.05


def test_the_cases_of_18_slides_have_intervals_that_a_reader_can_trust() -> None:
    equal = pairing.gain(material.MEASURE, [points_of([True] * 18, [True] * 18)])
    assert (equal.low, equal.high) == pytest.approx((-12.06, 12.06), abs=0.01)
    four = pairing.gain(material.MEASURE, [points_of([True] * 18, [True] * 14 + [False] * 4)])
    assert four.mean == pytest.approx(22.2, abs=0.1) and four.verdict == "unclear"  # p is 0.125
    fifteen = pairing.gain(material.MEASURE, [points_of([False] * 15 + [True] * 3, [True] * 18)])
    assert fifteen.low == -100 and fifteen.high < -60 and fifteen.verdict == "worse"
