"""Repeatability is that of readings whose noise is known, and a learning curve is of grasps that were not trained on."""

import dataclasses
import json
import math

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch import limits as limits_of
from tacpipe.tasks.touch.limits import Pairs, repeatability, variances
from tests.tasks.touch.handmade import dataset, recording

ALL_MM = (0.0, math.inf)


def test_pairs_are_of_one_object_and_as_far_apart_as_both_contacts_moved() -> None:
    contacts_m = np.zeros((4, 2, 3))
    contacts_m[1] = [[0.003, 0, 0], [0, 0.004, 0]]  # mm: 3 and 4
    pairs = Pairs.from_contacts(contacts_m, ["cup", "cup", "bowl", ""])
    assert (pairs.first.tolist(), pairs.second.tolist()) == ([0], [1])
    np.testing.assert_allclose(pairs.distance_mm, [np.sqrt((9 + 16) / 2)])
    assert not len(Pairs.from_contacts(contacts_m, ["", "", "", ""]).first)


def test_variances_are_those_of_numpy_and_of_repeated_grasps_where_some_count_twice() -> None:
    values, kind = np.random.default_rng(0).normal(size=(6, 2)), np.array([0, 0, 0, 1, 1, 2])
    variance_within, total = variances(values, kind, np.ones(6))
    np.testing.assert_allclose(
        variance_within, [values[:3].var(axis=0, ddof=1).sum(), values[3:5].var(axis=0, ddof=1).sum(), 0]
    )
    np.testing.assert_allclose(total, values.var(axis=0).sum())
    weights = np.array([2.0, 1, 1, 1, 0, 0])
    variance_within, total = variances(values, kind, weights)
    repeated = np.concatenate([values[:1], values[:4]])
    np.testing.assert_allclose(variance_within, [repeated[:4].var(axis=0, ddof=1).sum(), 0, 0])
    np.testing.assert_allclose(total, repeated.var(axis=0).sum())


def noisy(noise: float, count: int = 400) -> tuple[np.ndarray, list[str], Pairs]:
    """Return readings of two objects at pairs of equal places: a spread of 3 within objects, and noise at each grasp."""
    rng = np.random.default_rng(1)
    place = np.repeat(rng.normal(size=(count // 2, 1)), 2, axis=0)  # two grasps at each
    objects = ["cup" if number % 4 < 2 else "bowl" for number in range(count)]
    contacts_m = np.repeat(place[:, None], 2, axis=1) * np.array([1.0, 0, 0])
    level = np.array([[10.0] if name == "cup" else [0.0] for name in objects])
    return level + 3 * place + noise * rng.normal(size=(count, 1)), objects, Pairs.from_contacts(contacts_m, objects)


def test_equal_grasps_imply_the_skill_of_who_knows_all_but_the_noise() -> None:
    values, objects, pairs = noisy(2.0)
    measured = repeatability(values, objects, pairs, 0, 1e-6)
    assert measured.pairs == 200
    assert measured.likeness.low < 9 / (9 + 4) < measured.likeness.high
    assert measured.pair_skill.mean == pytest.approx(1 - 2 / np.sqrt(25 + 9 + 4), abs=0.04)
    assert measured.pair_skill.low < measured.pair_skill.mean < measured.pair_skill.high


def test_pairs_at_any_distance_are_as_unlike_as_the_object_varies() -> None:
    values, objects, pairs = noisy(2.0)
    assert repeatability(values, objects, pairs, *ALL_MM).likeness.mean == pytest.approx(0, abs=0.02)
    assert repeatability(np.tile(values, 2), objects, pairs, *ALL_MM).pair_skill.mean == pytest.approx(
        repeatability(values, objects, pairs, *ALL_MM).pair_skill.mean
    )


def test_near_pairs_of_a_steady_object_do_not_raise_the_skill_of_others() -> None:
    rng = np.random.default_rng(2)
    objects = ["steady"] * 40 + ["restless"] * 40
    values = rng.normal(size=(80, 1)) * np.repeat([1.0, 20.0], 40)[:, None]
    contacts_m = np.zeros((80, 2, 3))
    contacts_m[40:, :, 0] = np.arange(40)[:, None]  # only grasps of the steady one are near each other
    measured = repeatability(values, objects, Pairs.from_contacts(contacts_m, objects), 0, 6)
    assert measured.pairs == 40 * 39 // 2
    assert measured.pair_skill.high < 0.1


def test_no_pair_implies_nothing() -> None:
    values, objects, pairs = noisy(1.0, 8)
    measured = repeatability(values, objects, pairs, 1e9, math.inf)
    assert measured.pairs == 0
    assert math.isnan(measured.pair_skill.mean)


def test_folds_spread_each_object_and_a_size_is_of_each_object() -> None:
    objects = ["cup"] * 10 + ["bowl"] * 7
    folds = limits_of.stratified_folds(objects, np.random.default_rng(0))
    assert np.bincount(folds[:10]).tolist() == [2] * 5
    assert sorted(np.bincount(folds[10:]).tolist()) == [1, 1, 1, 2, 2]
    candidates = np.flatnonzero(folds != 0)
    chosen = limits_of.sample_grasps(candidates, objects, 3, np.random.default_rng(0))
    assert sorted(objects[at] for at in chosen) == ["bowl"] * 3 + ["cup"] * 3
    assert set(chosen) <= set(candidates)
    assert len(limits_of.sample_grasps(candidates, objects, 99, np.random.default_rng(0))) == len(candidates)


@pytest.mark.long
def test_limits_of_grasps_whose_touch_follows_from_their_geometry_rise_with_the_number_of_grasps() -> None:
    shards = [recording(n, kind) for kind in ("ball", "melon") for n in range(15)]
    grasps = grasps_of.read(dataset(*shards))
    advanced: list[str] = []
    limits = limits_of.limits(
        grasps, sizes=(1, 12, 40), draws=1, trees=5, advance=lambda note="": advanced.append(note)
    )
    assert limits.counts == {"ball": 15, "melon": 15}
    assert [item.grasps for item in limits.curve] == [1, 12]
    assert [item.trained for item in limits.curve] == [2, 24]
    assert limits.curve[1].skill["pdc_th"].mean > limits.curve[0].skill["pdc_th"].mean
    assert len(advanced) == limits_of.steps((1, 12), 1)
    tree = json.loads(json.dumps(limits.to_json(), allow_nan=False))
    assert tree["repeatability"][-1]["high_mm"] is None
    assert sum(item["pairs"] for item in tree["repeatability"]) == 2 * 15 * 14 // 2


@pytest.mark.long
def test_the_reading_of_the_other_finger_is_used_and_never_the_own() -> None:
    grasps = grasps_of.read(dataset(*[recording(n, kind) for kind in ("ball", "melon") for n in range(10)]))
    rng = np.random.default_rng(0)
    hidden = rng.normal(size=(20, 1))
    readings = {name: rng.normal(size=values.shape) for name, values in grasps.readings.items()}
    readings |= {"pdc_th": hidden, "pdc_mf": hidden.copy()}
    measured = limits_of.limits(dataclasses.replace(grasps, readings=readings), sizes=(8,), draws=2, trees=20)
    assert measured.other_finger["pdc_th"].mean > measured.curve[0].skill["pdc_th"].mean + 0.1
    assert measured.other_finger["e_th"].mean < 0.1


@pytest.mark.parametrize("objects", [["ball"] * 4, [None] * 6, ["ball"] * 8 + ["melon"]])
def test_too_few_grasps_have_no_limits(objects: list[str | None]) -> None:
    grasps = grasps_of.read(dataset(*[recording(n, object=kind) for n, kind in enumerate(objects)]))
    with pytest.raises(TacpipeError):
        limits_of.limits(grasps, sizes=(2,), draws=1, trees=2)
