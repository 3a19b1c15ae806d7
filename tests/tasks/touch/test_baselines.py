"""The yardsticks, computed by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
from safetensors.numpy import load, save

from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.predictor import Baselines
from tests.tasks.touch.handmade import grasps

FELT = {"pdc_th": np.array([[10.0], [20.0], [40.0], [90.0]]), "e_th": np.arange(96.0).reshape(4, 24)}


def baselines(objects: tuple[str, ...] = ("ball", "ball", "egg", "")) -> Baselines:
    return Baselines(FELT, objects, np.array([0, 100, 200, 900], np.int64))


def ask(objects: tuple[str, ...], t_ns: tuple[int, ...]) -> Grasps:
    batch = grasps(0, len(objects), kinds=["ball"])
    return dataclasses.replace(batch, objects=objects, t_ns=np.array(t_ns, np.int64))


def test_the_constant_is_the_mean_of_all_training_grasps() -> None:
    predicted = baselines().predict(ask(("ball", "drill"), (0, 5)))["constant"]
    assert predicted["pdc_th"].tolist() == [[40.0], [40.0]]
    assert predicted["e_th"].tolist() == [list(np.arange(24) + 36.0)] * 2


def test_the_object_mean_is_that_of_the_same_object_and_the_constant_for_others() -> None:
    predicted = baselines().predict(ask(("egg", "ball", "drill", ""), (0, 0, 0, 0)))["object_mean"]
    assert predicted["pdc_th"].tolist() == [[40.0], [15.0], [40.0], [40.0]]
    assert predicted["e_th"][1].tolist() == list(np.arange(24) + 12.0)


def test_the_nearest_in_time_are_three_whatever_their_object() -> None:
    predicted = baselines().predict(ask(("drill",) * 3, (90, 1000, 10**18)))["nearest_in_time"]
    assert predicted["pdc_th"].tolist() == [[(10 + 20 + 40) / 3], [(20 + 40 + 90) / 3], [(20 + 40 + 90) / 3]]


def test_of_fewer_than_three_training_grasps_all_are_nearest() -> None:
    two = Baselines({"pdc_th": FELT["pdc_th"][:2]}, ("a", "b"), np.array([0, 1], np.int64))
    assert two.predict(ask(("a",), (7,)))["nearest_in_time"]["pdc_th"].tolist() == [[15.0]]


def test_tensors_and_their_bytes_give_back_the_baselines() -> None:
    original = baselines()
    restored = Baselines.from_tensors(load(save(original.tensors())), original.objects)
    assert restored.objects == original.objects
    assert restored.t_ns.tolist() == original.t_ns.tolist()
    assert {name: felt.tolist() for name, felt in restored.readings.items()} == {n: f.tolist() for n, f in FELT.items()}


def test_times_of_nanoseconds_since_1970_keep_their_last_digit() -> None:
    late = 1_561_629_162_123_456_789
    original = dataclasses.replace(baselines(), t_ns=np.array([late, late + 1, late + 2, late + 3], np.int64))
    restored = Baselines.from_tensors(load(save(original.tensors())), original.objects)
    assert restored.t_ns.tolist() == [late, late + 1, late + 2, late + 3]
