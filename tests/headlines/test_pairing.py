"""Gains and intervals against those worked out another way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacpipe.metrics import pairing, regression
from tacpipe.tasks.forward import headline as forward
from tacpipe.tasks.material import headline as material
from tacpipe.tasks.touch import headline as touch

RECORDINGS = [f"r{index:02d}" for index in range(12)]


def forecasts(ratios: dict[str, float], *, seed: int = 0, persistence: float = 1.0) -> Any:
    """Sums of one step: squared error of ``ratio`` times persistence's, a window of a value each."""
    one = np.array([persistence])
    return {(seed, name): forward.sums(ratio * one, ratio * one, one, 1.0) for name, ratio in ratios.items()}


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


def test_the_interval_is_that_of_drawing_recordings_with_model_and_baseline_paired() -> None:
    rng = np.random.default_rng(3)
    ratios, still = rng.uniform(0.2, 1.0, (2, 12)), rng.uniform(1, 9, 12)
    model, ridge = (
        {key: value for name, one, by in zip(RECORDINGS, told, still, strict=True)
         for key, value in forecasts({name: one}, persistence=by).items()}
        for told in ratios
    )  # fmt: skip
    found = forward.headline("net", (1,), model, {"ridge": ridge}, None)
    drawn = np.random.default_rng(0).multinomial(12, np.full(12, 1 / 12), size=2000)
    gains = 1 - drawn @ (ratios[0] * still) / (drawn @ (ratios[1] * still))
    assert found is not None
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(gains, [0.025, 0.975])))
    assert found.gain == pytest.approx(1 - (ratios[0] * still).sum() / (ratios[1] * still).sum())


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


def test_seeds_are_drawn_as_recordings_are() -> None:
    model = {key: one for seed, ratio in enumerate((0.1, 0.9)) for key, one in
             forecasts(dict.fromkeys(RECORDINGS, ratio), seed=seed).items()}  # fmt: skip
    found = forward.headline("net", (1,), model, {"persistence": forecasts(dict.fromkeys(RECORDINGS, 1.0))}, None)
    assert found is not None
    assert found.seeds == 2
    assert (found.gain, found.low, found.high) == pytest.approx((0.5, 0.1, 0.9))  # both draws are of one seed


def test_a_model_without_recordings_has_no_headline() -> None:
    assert pairing.headline("t", "net", forward.measure((1,)), {}, {}) is None
